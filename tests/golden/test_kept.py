"""What the library says of a few drawn cases is what it said when they were kept.

Another kernel of BLAS rounds otherwise, and a search for bounds may end elsewhere within the gap
that it may leave open. A change beyond that is meant, or a fault: `python -m tests.golden write
--kept tests/golden/kept.json` keeps what is said from then on.
"""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.golden.cases import KEPT, every
from tests.golden.records import SECONDS, read, recorded

BEFORE = read(Path(__file__).with_name("kept.json"))

GAP, ROUNDED = 1e-4, 1e-9
"""What `reach` may leave open by default, as a part of a facet's range; and what rounding may."""


@pytest.fixture(scope="module")
def cases(request):
    if request.config.getoption("seed"):
        pytest.skip("what is kept was drawn from the seed 0")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return {case.name: replace(case, differentiated=False) for case in every()}


@pytest.mark.parametrize("name", KEPT)
def test_what_was_kept_is_still_said(name, cases):
    case, before = cases[name], BEFORE[name]
    after = recorded(case)
    assert before.keys() == after.keys()
    open_parts = case.options.get("gap", GAP)
    for what in before.keys() - {SECONDS}:
        if what not in ("sets", "bounds"):
            assert after[what] == before[what], what
            continue
        old, new = np.array(before[what]), np.array(after[what])
        room = (ROUNDED + open_parts) * max(1.0, np.ptp(old))
        np.testing.assert_allclose(new, old, rtol=0, atol=room)
