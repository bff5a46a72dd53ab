"""Law: what is proved holds, what is refuted is broken by a trajectory of the loop, and no call
contradicts another.
"""

import numpy as np
import pytest

import reachjax as rj
from tests.cases import FEW, HORIZON, Case, each


def around(case, room):
    """A box around all that is simulated, larger by a part of its sides, which may be negative."""
    runs = case.runs.reshape(-1, case.runs.shape[-1])
    lower, upper = runs.min(axis=0), runs.max(axis=0)
    by = room * (upper - lower) + 1e-6 * np.sign(room)
    return rj.Box(lower - by, upper + by)


def verdicts(case, **asked):
    """Of every call that takes a specification, and of cells."""
    given = case.closed_loop, case.X0, HORIZON
    options = {"start": case.of.start, "samples": 50}
    yield rj.verify(case.tube, **asked, samples=50)
    yield rj.decide(*given, **asked, **options, time_limit=20.0)
    if isinstance(case.X0, rj.Box):
        yield rj.decide(*given, **asked, **options, cells=3, time_limit=20.0)


def checked(case, verdict, **asked):
    """Margins are none of trajectories', and a counterexample is one."""
    assert (verdict.counterexample is not None) == verdict.refuted
    assert verdict.status.name in repr(verdict)
    for name, margins in verdict.margins.items():
        assert not np.any(margins > verdict.simulated[name] + 1e-9)
    if verdict.refuted:
        genuine(case, verdict.counterexample, **asked)
    with pytest.raises(TypeError, match=r"use verdict\.proved"):
        bool(verdict)


def certified(verdict, X0):
    """Certificates prove the signs of what they are of; witnesses begin in the initial set."""
    for (name, k), proof in verdict.certificates.items():
        bounds = np.asarray(proof.bounds)
        assert bounds.max() < 0 or (bounds.max() == 0 and not proof.least)
        assert k >= 1
        for value, state in zip(proof.witnesses, proof.witness_states, strict=True):
            assert value <= bounds.max()
            assert X0.contains(state)
        assert verdict.margins[name][k] >= 0
        np.testing.assert_allclose(proof.recheck(), bounds, atol=1e-12)


def genuine(case, example, goal=None, safe=None, avoid=()):
    """The loop itself runs so from its initial set, and breaks what is asked for."""
    loop, start, states = case.closed_loop, case.of.start, np.asarray(example.states)
    assert bool(case.X0.contains(states[0]))
    given = {"disturbances": example.disturbances, "noises": example.noises}
    given = {name: drawn for name, drawn in given.items() if drawn is not None}
    again = loop.simulate(states[0], len(states) - 1, start, **given)
    np.testing.assert_allclose(again, states, rtol=1e-9, atol=1e-12)
    for name, drawn in given.items():
        X = getattr(loop, name[:-1])
        for k, point in enumerate(np.asarray(drawn)):
            assert bool((X if X.steps is None else X.at(start + k)).contains(point, 1e-9))
    assert example.violation >= 0
    if loop.plant.continuous:
        return
    at = states[example.time]
    if example.requirement == "safe":
        assert not bool(safe.contains(at))
    elif example.requirement == "goal":
        assert not bool(goal.contains(at))
    else:
        regions = avoid[example.time] if isinstance(avoid, dict) else avoid
        assert any(bool(region.contains(at)) for region in regions)


@each(lambda case: case.method in ("default", "forms", "programs"), basic=FEW, every=2)
def test_what_trajectories_leave_is_refuted_and_nothing_proves_it(case):
    if case.initial in ("point", "flat", "thin"):
        return
    region = around(case, -0.1)
    found = [*verdicts(case, safe=region)]
    for verdict in found:
        checked(case, verdict, safe=region)
        assert not verdict.proved
    assert found[0].refuted


@each(lambda case: case.method in ("default", "forms", "programs"), basic=FEW, every=2)
def test_what_sets_stay_in_is_proved_and_nothing_refutes_it(case):
    boxes = [X.bounding_box() for X in case.tube.sets]
    if case.continuous:
        boxes += [X.bounding_box() for X in case.tube.spans]
    lower = np.min([box.lower for box in boxes], axis=0) - 1e-6
    upper = np.max([box.upper for box in boxes], axis=0) + 1e-6
    safe, beside = rj.Box(lower, upper), rj.Box(upper + 0.1, upper + 1.0)
    asked = {"safe": safe, "avoid": [beside], "goal": rj.Box(lower - 1, upper + 1)}
    found = [*verdicts(case, **asked)]
    for verdict in found:
        checked(case, verdict, **asked)
        assert not verdict.refuted
    assert found[0].proved
    assert all(len(margins) == HORIZON + 1 for margins in found[0].margins.values())


ROWS = (
    *(Case(loop) for loop in ("relu", "varying", "one state", "three states", "hard")),
    Case("relu", "default", "ellipsoid"),
    Case("sine"),
    Case("sine, tanh"),
)


@each(rows=ROWS)
def test_verdicts_change_where_bounds_are(case):
    """A little above and below what the last set says of each direction."""
    A, b = (np.asarray(part) for part in case.tube.sets[HORIZON].facets)
    width = np.ptp(case.runs[:, HORIZON], axis=0).max()
    for share, status in ((0.02, "PROVED"), (-0.02, "REFUTED")):
        goal = rj.Polytope(A, b + share * width)
        avoid = {HORIZON: [rj.Polytope(-A[:1], -b[:1] - share * width)]}
        for asked in ({"goal": goal}, {"avoid": avoid}):
            for verdict in verdicts(case, **asked):
                assert verdict.status.name == status
                checked(case, verdict, **asked)
                certified(verdict, case.X0)
