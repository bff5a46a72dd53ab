"""Law: each bound says how its search ended, and a limit of time costs tightness alone."""

import numpy as np

import reachjax as rj
from reachjax.proofs.branches import Rung
from reachjax.proofs.proposal import AS_ASKED
from tests.cases import FEW, HORIZON, ROUNDING, Case, each

HALF = 0.55
"""A gap is a part of half a range, of a call's own samples, which may lie a little further out."""


def ranges(case, k):
    """What facets' values range over on trajectories at a time."""
    return np.ptp(np.asarray(case.tube.sets[k].bounded_values(case.runs[:, k])), axis=0)


@each(lambda case: not case.round and case.initial != "thin")  # whose witnesses are samples alone
def test_a_gap_that_is_open_is_said(case):
    """A search that says it is solved left no more open than was asked for."""
    for k in range(1, HORIZON + 1):
        proof = case.tube.proof(k)
        if isinstance(proof, rj.AbstractCertificate):
            continue  # solved is the program: what it leaves open is the relaxation's
        room = HALF * case.options.get("gap", 1e-4) * ranges(case, k) + 1e-9
        for status, gap, most in zip(proof.statuses, proof.gaps, room, strict=True):
            assert status is not rj.SolverStatus.SOLVED or gap <= most
            assert status is rj.SolverStatus.AFFINE_FORM or case.method != "forms"


SOLVED = (
    *("relu", "leaky", "hard", "residual", "unlimited", "varying", "one state", "three states"),
    *("hard, one state", "leaky, six states", "residual, three states", "six states"),
    *("inputs in a pentagon", "inputs in a cube", "tanh", "sigmoid", "traced"),
    *("sine", "sine, tanh", "oscillator", "oscillator, hard", "tank", "quotient"),
)
"""Loops whose gaps phases and cells close."""


@each(
    rows=(
        *map(Case, SOLVED),
        *(Case("relu", "default", kind) for kind in ("polytope", "ellipsoid")),
        *(Case("relu", "default", "own", each) for each in ("octagonal", "random")),
    )
)
def test_gaps_are_closed_by_default(case):
    """So bounds are as tight as is asked for: witnesses attain all but a ten-thousandth."""
    for k in range(1, HORIZON + 1):
        proof = case.tube.proof(k)
        assert set(proof.statuses) == {rj.SolverStatus.SOLVED}
        room = HALF * case.options.get("gap", 1e-4) * ranges(case, k) + 1e-9
        assert np.all(np.asarray(proof.gaps) <= room)


SWITCHING = "relu", "leaky", "hard", "residual", "varying"
"""Of these loops, beside those of other dimensions, units switch on their sets."""


@each(rows=[Case(loop) for loop in SOLVED if loop in SWITCHING or "state" in loop])
def test_what_is_closed_by_default_is_open_by_forms(case):
    """Else units that switch would be said nothing of."""
    forms = Case(case.loop, "forms").tube
    pairs = zip(forms.sets[1:], case.tube.sets[1:], strict=True)
    assert max(np.max(wide.limits - tight.limits) for wide, tight in pairs) > 1e-6


@each(rows=[Case("car")])
def test_what_cells_leave_open_is_less_than_a_quarter_of_what_is_reached(case):
    for k in range(1, HORIZON + 1):
        reached = np.ptp(case.runs[:, k], axis=0)
        assert np.all(case.tube.sets[k].bounding_box().widths <= 1.25 * reached)


@each()
def test_what_a_tube_says_of_its_ends_its_verdicts_and_tables_say(case):
    ends = [status for k in range(1, HORIZON + 1) for status in case.tube.proof(k).statuses]
    open_ones = sum(status not in AS_ASKED for status in ends)
    assert int(rj.unsolved(case.tube)) == open_ones
    wide = rj.Box([-1e3] * case.closed_loop.states, [1e3] * case.closed_loop.states)
    verdict = rj.verify(case.tube, safe=wide, samples=10)
    assert verdict.ends == {status: ends.count(status) for status in set(ends)}
    assert verdict.unsolved == open_ones
    table = case.tube.to_dataframe()
    assert [*table.status] == [status.name for status in ends]
    assert case.method != "forms" or np.all(table.seconds > 0)
    np.testing.assert_array_equal(
        table.bound, np.concatenate([case.tube.proof(k).bounds for k in range(1, HORIZON + 1)])
    )


@each(basic=FEW)
def test_without_time_sets_hold_and_none_says_that_more_was_done(case):
    tube = case.reach(time_limit=0.0)
    for k in range(1, HORIZON + 1):
        assert case.excess(tube.sets[k], case.runs[:, k]) <= ROUNDING
        proof = tube.proof(k)
        assert np.all(np.asarray(proof.recheck()) <= np.asarray(proof.bounds) + 1e-9)
        if isinstance(proof, rj.BranchCertificate):
            assert set(proof.ways) == {Rung.AFFINE_FORM}
        with_time = np.asarray(case.tube.proof(k).bounds)
        closed = np.asarray(proof.bounds) <= with_time + 1e-3 * ranges(case, k) + 1e-9
        for status, is_closed in zip(proof.statuses, closed, strict=True):
            # over a round set programs are solved whose cuts are not all there is to say of it
            assert status is not rj.SolverStatus.SOLVED or is_closed or case.X0.parts[1] is not None


@each(
    lambda case: (
        case.method in ("programs", "paper")
        and case.loop.startswith(("relu", "varying", "disturbed"))
    )
)
def test_programs_of_sets_that_are_not_flat_are_solved(case):
    if case.initial not in ("point", "flat", "thin"):
        for k in range(1, HORIZON + 1):
            assert set(case.tube.proof(k).statuses) == {rj.SolverStatus.SOLVED}
