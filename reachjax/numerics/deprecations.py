"""What callers wrote before still works for one version, with a warning that says what to write."""

from __future__ import annotations

import functools
import inspect
import warnings
from collections.abc import Callable
from typing import Any, TypeVar

Called = TypeVar("Called", bound=Callable[..., Any])


def once_positional(*names: str) -> Callable[[Called], Called]:
    """Let a function take some of its keywords by position too, in the order that they had.

    Args:
        names: these keywords. They followed what still is given by position.

    Returns:
        A decorator.

    Example:
        >>> @once_positional("high", "low")
        ... def between(x, *, low=0, high=1):
        ...     return low <= x <= high
        >>> with warnings.catch_warnings(record=True) as seen:
        ...     warnings.simplefilter("always")
        ...     between(2, 3)
        True
        >>> print(seen[0].message)
        between takes high by keyword: by position it is read as before until the next version
    """

    def decorated(function: Called) -> Called:
        given_by_position = [
            name
            for name, parameter in inspect.signature(function).parameters.items()
            if parameter.kind is inspect.Parameter.POSITIONAL_OR_KEYWORD
        ]
        count = len(given_by_position)

        @functools.wraps(function)
        def called(*given: Any, **named: Any) -> Any:
            late = given[count : count + len(names)]
            if not late:
                return function(*given, **named)
            before = dict(zip(names, late, strict=False))
            twice = [name for name in before if name in named]
            if twice:
                raise TypeError(f"{function.__name__} got {', '.join(twice)} twice")
            warnings.warn(
                f"{function.__name__} takes {', '.join(before)} by keyword: by position it is read "
                "as before until the next version",
                DeprecationWarning,
                stacklevel=2,
            )
            rest = given[count + len(names) :]  # too many: the function says so
            return function(*given[:count], *rest, **before, **named)

        return called  # type: ignore[return-value]

    return decorated
