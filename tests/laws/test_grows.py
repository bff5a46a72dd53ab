"""Law: of a smaller set, and by a method that does more, bounds are no larger."""

import numpy as np
import pytest

from tests.cases import FEW, HORIZON, Case, each
from tests.laws.changes import smaller

GAP, ACCURACY = 1e-4, 1e-7
"""What may stay open of a facet, as a part of its range; and what solvers leave open."""


def room(case, k):
    """What a bound may be larger by, of a facet at a time."""
    limits = np.asarray(case.tube.sets[k].limits)
    values = np.asarray(case.tube.sets[k].bounded_values(case.runs[:, k]))
    gap = 0.0 if case.by.grows else case.options.get("gap", GAP)  # programs search for nothing
    return gap * np.ptp(values, axis=0) + ACCURACY * (1 + abs(limits))


@each(
    lambda case: (case.by.closes or case.by.grows) and case.template == "axes", basic=FEW, every=2
)
def test_bounds_are_no_larger_of_a_smaller_set(case):
    small = case.reach(X0=smaller(case.X0, 0.2))
    for k in range(HORIZON + 1):
        assert np.all(small.sets[k].limits <= case.tube.sets[k].limits + room(case, k))


TIGHTER = [
    ("default", "few programs"),
    ("few programs", "no programs"),
    ("default", "programs"),
    ("programs", "paper"),
    ("paper", "paper, plain"),
    ("windows of two", "programs"),
    ("all products", "programs"),
    ("twelve cells", "forms"),
    ("cells of forms", "forms"),
    ("cells of branches", "cells of forms"),
]
"""Pairs of methods: the first does all that the second does, and more."""


@pytest.mark.parametrize("loop", ["relu", "sine", "disturbed"])
@pytest.mark.parametrize("pair", TIGHTER, ids=" than ".join)
def test_bounds_are_no_larger_by_a_method_that_does_more(loop, pair):
    more, less = (Case(loop, method) for method in pair)
    for k in range(1, HORIZON + 1):
        slack = room(more, k)
        assert np.all(more.tube.sets[k].limits <= less.tube.sets[k].limits + slack)


@pytest.mark.costly
@pytest.mark.parametrize("less", ["paper, plain", "no programs"])
def test_some_bounds_are_smaller(less):
    gains = [
        np.max(Case(loop, less).tube.sets[-1].limits - Case(loop).tube.sets[-1].limits)
        for loop in ("relu", "sine")
    ]
    assert max(gains) > 1e-3
