"""Which cases of a claim the test command runs, and which a person runs by `-m long`."""

from collections.abc import Callable, Iterable
from typing import Any

import pytest


def some(cases: Iterable[Any], quick: Callable[..., bool]) -> list[Any]:
    """All cases, those that are not `quick` marked `long`; a tuple is several arguments."""
    found = []
    for case in cases:
        values = case if isinstance(case, tuple) else (case,)
        found.append(case if quick(*values) else pytest.param(*values, marks=pytest.mark.long))
    return found
