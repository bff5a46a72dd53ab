"""Law: every state that a loop can reach lies in its set, whatever bounded it."""

import numpy as np
import pytest

import reachjax as rj
from tests.campaign.faults import FAULTS, Faulty
from tests.cases import FEW, HORIZON, LOOPS, ROUNDING, Case, each


def outside(case, tube, first=0):
    """By how much states are outside of a tube's sets at most."""
    sets = list(enumerate(tube.sets))[first:]
    return max(case.excess(region, case.runs[:, k]) for k, region in sets)


@each(longest=pytest.mark.costly)
def test_no_state_is_outside(case):
    assert outside(case, case.tube) <= ROUNDING
    assert len(case.tube.sets) == HORIZON + 1


@each(lambda case: case.continuous)
def test_no_state_is_outside_in_between_samples(case):
    """States of shorter periods, under the disturbances in their middle."""
    loop, start = case.closed_loop, case.of.start
    for k, span in enumerate(case.tube.spans):
        assert case.excess(span, case.runs[:, k]) <= ROUNDING
        assert case.excess(span, case.runs[:, k + 1]) <= ROUNDING
        for part in (0.1, 0.3, 0.5, 0.9):
            shorter = loop.replace(plant=loop.plant.replace(period=part * loop.plant.period))
            inner = np.asarray(shorter.simulate(case.runs[:, k], 1, start + k))[:, 1]
            assert case.excess(span, inner) <= ROUNDING


@each(
    lambda case: case.method in ("forms", "programs") and case.template == "axes",
    basic=FEW,
    every=2,
)
def test_no_state_is_outside_of_all_cells(case):
    options = {"start": case.of.start, **case.options}
    cells = rj.reach_partitioned(
        case.closed_loop, case.X0, HORIZON, case.shape,
        cells=[2, 1 + case.of.smooth, *[1] * case.of.n][: case.of.n], **options,
    )  # fmt: skip
    for k in range(HORIZON + 1):
        inside = [np.asarray(X.contains(case.runs[:, k], 1e-9)) for X in cells.sets(k)]
        assert np.any(inside, axis=0).all()


@pytest.mark.parametrize("name", [name for name, of in LOOPS.items() if of.plain])
def test_what_is_simulated_is_what_plain_numbers_are(name):
    case = Case(name, "forms")
    states, start = case.runs[::50, 0], case.of.start
    found = np.asarray(case.closed_loop.simulate(states, HORIZON, start))
    np.testing.assert_allclose(found, case.runs[::50], rtol=1e-12, atol=1e-13)


BY_PROGRAMS = [
    Case("relu", method, "own", template)
    for method, template in (
        ("programs", "given shape"), ("programs", "axes"), ("paper", "octagonal"),
        ("programs", "mixed"), ("programs", "ellipsoids"),
    )
]  # fmt: skip


@pytest.mark.costly
@pytest.mark.parametrize("fault", FAULTS)
@each(rows=BY_PROGRAMS, basic=(), every=4)
def test_no_state_is_outside_whatever_a_solver_answers(case, fault):
    tube = case.reach(steps=2, solver=Faulty(rj.Clarabel(), fault))
    assert outside(case, tube) <= ROUNDING
