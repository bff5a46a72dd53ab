"""Claims about decisions: true where the truth is known, and a refutation is a trajectory."""

import jax
import numpy as np
import pytest

import reachjax as rj
from tests.closed_loops import autonomous, initial_set, switching_loop
from tests.laws.test_verdicts_tell import certified

PROVED, REFUTED, UNKNOWN = (
    rj.VerdictStatus.PROVED,
    rj.VerdictStatus.REFUTED,
    rj.VerdictStatus.UNKNOWN,
)


def half_space(a, b):
    return rj.Polytope([a], [b])


TRIANGLE = rj.Polytope([[-1.0, 0.0], [0.0, -1.0], [1.0, 1.0]], [-0.24, -0.24, 0.495])
"""Beyond both `x >= 0.24` and `y >= 0.24`: no facet alone keeps it apart from the states below."""


def halves(X0):
    """`x+ = x / 2`, and its initial set."""
    return autonomous(np.eye(2) / 2), X0


BOX = rj.Box([0.5, 0.5], [1.0, 1.0])
DIAMOND = rj.Polytope([[1, 1], [1, -1], [-1, 1], [-1, -1]], [1.0, 1.0, 1.0, 1.0])
BALL = rj.Ellipsoid([0.0, 0.0], np.eye(2))
THIN = rj.Box([0.5, 1.0], [1.0, 1.0])

KNOWN = {
    "goal": (BOX, {"goal": rj.Box([0.12, 0.12], [0.26, 0.26])}, PROVED),
    "goal missed": (BOX, {"goal": rj.Box([0.0, 0.0], [0.24, 0.3])}, REFUTED),
    "safe": (BOX, {"safe": rj.Box([0.12, 0.12], [1.1, 1.1])}, PROVED),
    "not safe at first": (BOX, {"safe": rj.Box([0.1, 0.1], [0.9, 2.0])}, REFUTED),
    "not safe at last": (BOX, {"safe": rj.Box([0.13, 0.1], [2.0, 2.0])}, REFUTED),
    "avoided": (BOX, {"avoid": [half_space([1, 0], 0.12)]}, PROVED),
    "not avoided": (BOX, {"avoid": [half_space([1, 0], 0.13)]}, REFUTED),
    "avoided at its time": (BOX, {"avoid": {1: [rj.Box([0.6, 0.0], [0.9, 1.0])]}}, PROVED),
    "hit at its time": (BOX, {"avoid": {0: [rj.Box([0.6, 0.0], [0.9, 1.0])]}}, REFUTED),
    "avoided at first": (BOX, {"avoid": {0: [half_space([1, 0], 0.49)]}}, PROVED),
    "a corner passed": (DIAMOND, {"avoid": {2: [rj.Box([0.2, 0.2], [1.0, 1.0])]}}, PROVED),
    "a corner met": (DIAMOND, {"avoid": {2: [rj.Box([0.1, 0.1], [1.0, 1.0])]}}, REFUTED),
    "round, passed": (BALL, {"avoid": {2: [rj.Box([0.18, 0.18], [1.0, 1.0])]}}, PROVED),
    "round, goal": (BALL, {"goal": rj.Box([-0.251, -0.251], [0.251, 0.251])}, PROVED),
    "round, goal missed": (BALL, {"goal": half_space([1.0, 1.0], 0.35)}, REFUTED),
    "thin": (THIN, {"goal": rj.Box([0.12, 0.24], [0.26, 0.26])}, PROVED),
    "thin, not avoided": (THIN, {"avoid": {1: [half_space([1, 0], 0.3)]}}, REFUTED),
    "several": (BOX, {"safe": rj.Box([0, 0], [2, 2]), "goal": half_space([1, 1], 0.51)}, PROVED),
    "one of several": (
        BOX,
        {"safe": rj.Box([0, 0], [2, 2]), "goal": half_space([1, 1], 0.4)},
        REFUTED,
    ),
}


def checked(verdict, loop, X0, start=0):
    """A counterexample is the loop's own, from the set, and certificates prove their signs."""
    example = verdict.counterexample
    assert (example is not None) == (verdict.status is REFUTED)
    assert verdict.status.name in repr(verdict)
    if example is not None:
        assert X0.contains(example.states[0])
        run = loop.simulate(example.states[:1], len(example.states) - 1, start)[0]
        np.testing.assert_allclose(example.states, run, atol=1e-9)
        assert example.violation >= 0
        assert verdict.simulated[example.requirement][example.time] <= 1e-12
    certified(verdict, X0)


@pytest.mark.parametrize(("X0", "required", "status"), KNOWN.values(), ids=KNOWN.keys())
def test_what_is_known_is_decided(X0, required, status):
    loop, X0 = halves(X0)
    verdict = rj.decide(loop, X0, 2, **required, samples=100)
    assert verdict.status is status
    checked(verdict, loop, X0)


def broken(states, horizon, goal=None, safe=None, avoid=()):
    """Whether a trajectory breaks what is required."""
    if not isinstance(avoid, dict):
        avoid = dict.fromkeys(range(horizon + 1), avoid)
    return (
        (goal is not None and not goal.contains(states[horizon]))
        or (safe is not None and not all(safe.contains(x) for x in states))
        or any(region.contains(states[t]) for t, regions in avoid.items() for region in regions)
    )


@pytest.mark.parametrize("name", [name for name, case in KNOWN.items() if case[2] is REFUTED])
def test_a_counterexample_breaks_what_is_required(name):
    X0, required, _ = KNOWN[name]
    loop, X0 = halves(X0)
    verdict = rj.decide(loop, X0, 2, **required, samples=100)
    assert broken(verdict.counterexample.states, 2, **required)


def test_a_set_that_no_facet_keeps_apart_is_avoided():
    loop, X0 = halves(rj.Polytope([[-1, 0], [0, -1], [1, 1]], [0.0, 0.0, 1.9]))
    region = {2: [TRIANGLE]}
    verdict = rj.decide(loop, X0, 2, avoid=region, samples=100)
    assert verdict.status is PROVED  # x + y <= 0.475 there, and at least 0.48 in the set
    ((_, proof),) = verdict.certificates.items()
    assert len(proof.about.rows.rows) == 3
    checked(verdict, loop, X0)


def test_margins_are_those_of_exact_suprema():
    loop, X0 = halves(BOX)
    verdict = rj.decide(loop, X0, 2, goal=half_space([3.0, 4.0], 2.0), samples=100)
    assert verdict.margins["goal"][2] == pytest.approx(0.05, abs=1e-9)
    assert np.isnan(verdict.margins["goal"][:2]).all()


def test_certificates_own_their_numbers():
    loop, X0 = halves(BOX)
    verdict = rj.decide(loop, X0, 2, goal=half_space([1, 1], 0.6), samples=100)
    ((_, proof),) = verdict.certificates.items()
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(proof))


@pytest.mark.costly
def test_a_ball_that_touches_what_is_avoided_is_refuted():
    loop, X0 = halves(BALL)
    verdict = rj.decide(loop, X0, 2, avoid={2: [rj.Box([0.17, 0.17], [1.0, 1.0])]}, samples=100)
    assert verdict.status is REFUTED  # (0.68, 0.68) is in the ball
    checked(verdict, loop, X0)


@pytest.mark.costly
def test_what_cannot_be_decided_soon_leaves_work_for_what_comes_later(monkeypatch):
    """Else the first requirement takes everything, and a later counterexample is not found."""
    monkeypatch.setattr(rj.methods.ladder, "WORK", 3e5)
    loop, X0 = switching_loop(3, seed=23, hidden=(4, 3)), initial_set("box", 3, seed=3)
    tube = rj.reach(loop, X0, 3, rj.Template.box(3), samples=100)
    rows = np.asarray(tube.template.directions)
    second, third = (np.asarray(tube.sets[k].b) for k in (2, 3))
    at_bound = [half_space(-rows[i], -second[i] - 1e-9) for i in range(6)]
    broken = [half_space(-rows[0], -third[0] + 1e-4)]
    verdict = rj.decide(loop, X0, 3, avoid={2: at_bound, 3: broken}, samples=1)
    assert verdict.status is REFUTED
    checked(verdict, loop, X0)


@pytest.mark.costly
def test_without_time_what_forms_leave_open_is_unknown():
    loop, X0 = switching_loop(3, seed=23, hidden=(4, 3)), initial_set("box", 3, seed=3)
    tube = rj.reach(loop, X0, 3, rj.Template.box(3), samples=100)
    rows, offsets = np.asarray(tube.template.directions), np.asarray(tube.sets[3].b)
    width = np.asarray(tube.sets[3].bounding_box().widths).max()
    goal = rj.Polytope(rows, offsets + 1e-3 * width)
    assert rj.decide(loop, X0, 3, goal=goal).status is PROVED
    verdict = rj.decide(loop, X0, 3, goal=goal, time_limit=0)
    assert verdict.status is UNKNOWN
    assert not verdict.certificates
    assert verdict.margins["goal"][3] < 0 < verdict.simulated["goal"][3]


def test_what_a_sample_breaks_is_refuted_without_time():
    loop, X0 = halves(BOX)
    verdict = rj.decide(loop, X0, 2, goal=half_space([1, 1], 0.4), time_limit=0)
    assert verdict.status is REFUTED
    checked(verdict, loop, X0)


def test_the_time_of_the_initial_set_is_the_start():
    """`x+ = x / 2` at first and `x+ = x` later: from 2, nothing shrinks."""
    A = np.stack([np.eye(1) / 2, np.eye(1) / 2, np.eye(1), np.eye(1)])
    plain = autonomous(np.eye(1))
    loop = plain.replace(plant=plain.plant.replace(A=A))
    X0, goal = rj.Box([1.0], [2.0]), rj.Box([0.0], [0.6])
    assert rj.decide(loop, X0, 2, goal=goal).status is PROVED
    verdict = rj.decide(loop, X0, 2, goal=goal, start=2)
    assert verdict.status is REFUTED
    checked(verdict, loop, X0, start=2)


GOAL = {"goal": rj.Box([0.0, 0.0], [1.0, 1.0])}

WRONG = {
    "nothing": ({}, ValueError, "goal"),
    "dimension": ({"goal": rj.Box([0.0], [1.0])}, ValueError, "goal"),
    "a goal that is no set": ({"goal": 1.0}, TypeError, "goal"),
    "late": ({"avoid": {3: [BOX]}}, ValueError, "avoid"),
    "relaxation": ({**GOAL, "relaxation": rj.CuttingPlanes()}, TypeError, "relaxation"),
    "time": ({**GOAL, "time_limit": -1.0}, ValueError, "time_limit"),
    "no time": ({**GOAL, "time_limit": "1"}, TypeError, "time_limit"),
    "samples": ({**GOAL, "samples": 0}, ValueError, "samples"),
    "seed": ({**GOAL, "seed": 0.5}, TypeError, "seed"),
    "another X0": ({**GOAL, "X0": rj.Box([0.0], [1.0])}, ValueError, "X0"),
    "no set": ({**GOAL, "X0": [0.0, 1.0]}, TypeError, "X0"),
    "no loop": ({**GOAL, "loop": 3}, TypeError, "loop"),
}


@pytest.mark.parametrize(("changes", "kind", "name"), WRONG.values(), ids=WRONG.keys())
def test_wrong_arguments_are_named(changes, kind, name):
    loop, X0 = halves(BOX)
    with pytest.raises(kind, match=name):
        rj.decide(**({"loop": loop, "X0": X0, "horizon": 2} | changes))


def test_traced_numbers_are_refused():
    loop, _ = halves(BOX)
    with pytest.raises(ValueError, match=r"outside of jax\.jit"):
        jax.jit(lambda X0: rj.decide(loop, X0, 2, **GOAL).margins)(BOX)
