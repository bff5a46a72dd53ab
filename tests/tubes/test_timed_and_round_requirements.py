"""Goals at times and over spans, ellipsoids, and boxes with infinite sides, in every call."""

import jax
import numpy as np
import pytest

import reachjax as rj
from reachjax.sets.ball_polytopes import inner_polytope, outer_polytope
from reachjax.verdicts.specification import requirements
from tests.closed_loops import autonomous

HALVES = autonomous(0.5 * np.eye(2))
X0 = rj.Box([1.0, 1.0], [2.0, 2.0])
INFINITE = np.inf


@pytest.fixture(scope="module")
def tube():
    return rj.reach(HALVES, X0, 4, rj.Template.octagonal(2))


def verdicts(tube, **asked):
    """Of every call that takes a specification."""
    calls = {"goal": asked.get("goal"), "safe": asked.get("safe"), "avoid": asked.get("avoid")}
    return {
        "verify": rj.verify(tube, **calls, samples=200),
        "decide": rj.decide(HALVES, X0, 4, **calls, samples=200),
        "cells": rj.decide(HALVES, X0, 4, **calls, samples=200, cells=20),
    }


def statuses(tube, **asked):
    return {verdict.status.name for verdict in verdicts(tube, **asked).values()}


def box(end):
    return rj.Box([0.0, 0.0], [end, end])


def test_a_goal_at_a_time(tube):
    assert statuses(tube, goal={2: box(0.51)}) == {"PROVED"}
    assert statuses(tube, goal={1: box(0.51)}) == {"REFUTED"}
    assert statuses(tube, goal={2: box(0.51), 4: box(0.13)}) == {"PROVED"}
    assert statuses(tube, goal={2: box(0.51), 4: box(0.12)}) == {"REFUTED"}


def test_a_goal_over_a_span(tube):
    assert statuses(tube, goal={range(2, 5): box(0.51)}) == {"PROVED"}
    assert statuses(tube, goal={range(1, 5): box(0.51)}) == {"REFUTED"}
    margins = rj.verify(tube, goal={range(2, 5): box(0.51)}).margins["goal"]
    np.testing.assert_array_equal(np.isnan(margins), [True, True, False, False, False])
    np.testing.assert_allclose(margins[3], 0.125, rtol=1e-9)  # from zero


def test_a_goal_at_the_first_time(tube):
    assert statuses(tube, goal={0: box(2.0)}) == {"PROVED"}


@pytest.mark.parametrize(
    ("goal", "error", "said"),
    [
        ({5: box(1.0)}, ValueError, "goal names time 5, but the horizon is 4"),
        ({-1: box(1.0)}, ValueError, "goal names time -1"),
        ({1: box(1.0), range(0, 2): box(1.0)}, ValueError, "goal names time 1 twice"),
        ({}, ValueError, "goal must name a time"),
        ({"end": box(1.0)}, TypeError, "goal must name times or ranges of them, but 'end' arrived"),
        ({True: box(1.0)}, TypeError, "goal must name times"),
        ({2: 1.0}, TypeError, "goal must be a Box, a Polytope or an Ellipsoid"),
    ],
)
def test_a_goal_that_is_none(goal, error, said, tube):
    with pytest.raises(error, match=said):
        rj.verify(tube, goal=goal)


def ball(radius, center=(0.0, 0.0)):
    return rj.Ellipsoid(center, radius**2 * np.eye(len(center)))


SIZE = np.sqrt(8) / 16
"""Of the largest state at the last time."""


@pytest.mark.costly
def test_a_round_goal(tube):
    assert statuses(tube, goal=ball(1.01 * SIZE)) == {"PROVED"}
    assert statuses(tube, goal=ball(0.99 * SIZE)) == {"REFUTED"}
    found = rj.verify(tube, goal=ball(0.99 * SIZE)).counterexample
    assert np.linalg.norm(found.states[-1]) > 0.99 * SIZE


@pytest.mark.costly
def test_within_rounding_of_a_round_goal_nothing_is_said(tube):
    for radius in (SIZE * (1 - 1e-15), SIZE * (1 + 1e-15)):
        said = verdicts(tube, goal=ball(radius))
        refuted = [name for name, verdict in said.items() if verdict.refuted]
        exact = np.linalg.norm([0.125, 0.125]) > radius
        assert exact or not refuted


def test_a_round_safe_set(tube):
    assert statuses(tube, safe=ball(1.01 * np.sqrt(8))) == {"PROVED"}
    assert statuses(tube, safe=ball(0.99 * np.sqrt(8))) == {"REFUTED"}


def test_a_round_obstacle(tube):
    beside = (1.0, 0.2)  # the diagonal strip of states is as near to it as (0.6, 0.6) is
    assert statuses(tube, avoid=[ball(0.15, beside)]) == {"PROVED"}
    assert statuses(tube, avoid=[ball(0.9, beside)]) == {"REFUTED"}


def test_a_wrong_box_around_a_ball_refutes_nothing(tube):
    """A corner of the polytope around a ball is no point of the ball."""
    center = np.array([0.25, 0.25])  # touched by a state at times 2 and 3
    radius = 0.01
    outer = outer_polytope(ball(radius, center), "avoid[0]")
    corner = np.asarray(outer.vertices())[0]
    gap = np.linalg.norm(corner - center) / radius
    assert 1.0 < gap < 1.01
    loop = autonomous(np.eye(2))
    at = rj.Box(corner, corner)
    verdict = rj.decide(loop, at, 1, avoid=[ball(radius, center)], samples=10)
    assert not verdict.refuted
    inner = inner_polytope(ball(radius, center), "goal")
    normal = np.asarray(inner.A)[0] / np.linalg.norm(inner.A[0])
    between = center + 0.9995 * radius * normal  # in the ball, beyond the middle of a facet
    assert not bool(inner.contains(between))
    at = rj.Box(between, between)
    verdict = rj.decide(loop, at, 1, goal=ball(radius, center), samples=10)
    assert verdict.unknown


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5])
def test_polytopes_lie_within_and_around(n):
    rng = np.random.default_rng(n)
    L = rng.normal(size=(n, n)) + np.eye(n)
    ellipsoid = rj.Ellipsoid(10 * rng.normal(size=n), L @ L.T)
    inner, outer = inner_polytope(ellipsoid, "goal"), outer_polytope(ellipsoid, "goal")
    assert bool(np.all(ellipsoid.contains(inner.vertices())))
    surface = ellipsoid.sample_boundary(jax.random.key(0), 5000)
    assert bool(np.all(outer.contains(surface)))
    A, b = (np.asarray(part) for part in inner.facets)
    far = (np.asarray(surface) @ A.T - b).max(axis=1)
    assert np.all(far > 0)  # nothing of the surface is within


def test_what_is_no_ball_to_be_decided_is_refused(tube):
    for shape, said in ((np.diag([1.0, 1e-12]), "too thin"), (1e-20 * np.eye(2), "too small")):
        with pytest.raises(ValueError, match=f"goal is too thin.*|{said}"):
            rj.verify(tube, goal=rj.Ellipsoid([1.0, 1.0], shape))
    with pytest.raises(ValueError, match="goal is an ellipsoid of dimension 6, and up to 5"):
        requirements(6, 2, goal=ball(1.0, np.zeros(6)))
    with pytest.raises(ValueError, match="goal must be a polytope inside"):
        jax.jit(lambda r: len(requirements(2, 2, goal=ball(r))))(0.3)


@pytest.mark.costly
def test_winning_sets_and_largest_sets_take_them():
    goal = {2: ball(0.5)}  # |x0| <= 2
    found = rj.winning_set(HALVES, rj.Box([-3.0, -3.0], [3.0, 3.0]), 2, goal=goal, cells=300)
    states = np.random.default_rng(0).uniform(-3, 3, size=(5000, 2))
    wins = np.linalg.norm(states, axis=1) <= 2.0
    assert np.all(wins[found.contains(states)])
    assert not np.any(wins[found.excludes(states)])
    assert found.contains(states).sum() > 0.8 * wins.sum()
    largest = rj.largest_set(HALVES, rj.Box([-0.1, -0.1], [0.1, 0.1]), 2, goal=goal)
    corners = np.asarray(largest.region.corners())
    assert 1.7 < np.linalg.norm(corners, axis=1).max() <= 2.0


@pytest.mark.costly
def test_a_round_set_for_ever(tube):
    assert rj.verify(tube, safe=ball(3.0), forever=True).proved


def test_a_shortfall_of_a_round_goal_is_zero_where_it_is_proved(tube):
    assert float(rj.shortfall(tube, goal=ball(1.01 * SIZE))) == 0.0
    assert float(rj.shortfall(tube, goal={4: ball(0.9 * SIZE)})) > 0.0


def test_infinite_sides(tube):
    half = rj.Polytope.between([-INFINITE, 0.0], [INFINITE, 0.13])
    assert statuses(tube, goal=half) == {"PROVED"}
    assert statuses(tube, avoid=[rj.Polytope.between([2.1, -INFINITE], [INFINITE, 0.0])]) == {
        "PROVED"
    }


@pytest.mark.parametrize(
    ("ends", "said"),
    [
        (([0.0], [1.0, 2.0]), "vectors of one length"),
        (([1.0], [0.0]), "lower must not be above upper"),
        (([np.nan], [0.0]), "lower must not be above upper"),
        (([-INFINITE], [INFINITE]), "must have a finite entry"),
    ],
)
def test_sides_that_are_none(ends, said):
    with pytest.raises(ValueError, match=said):
        rj.Polytope.between(*ends)


def away(end):
    return rj.Box([end, end], [end + 1, end + 1])


def test_sets_to_avoid_at_times_and_over_spans(tube):
    assert statuses(tube, avoid={range(2, 5): [away(0.51)]}) == {"PROVED"}
    assert statuses(tube, avoid={range(1, 5): [away(0.51)]}) == {"REFUTED"}
    both = {range(1, 3): [away(1.1)], np.int64(2): [away(0.4)]}
    named = [(item.time, item.name) for item in requirements(2, 4, avoid=both)]
    assert named == [(1, "avoid[0]"), (2, "avoid[0]"), (2, "avoid[1]")]
    assert statuses(tube, avoid={range(1, 3): [away(1.1)], 2: [away(0.4)]}) == {"REFUTED"}


NOWHERE = rj.Polytope([[1.0, 0.0], [-1.0, 0.0]], [0.0, -1.0])


@pytest.mark.parametrize(
    ("asked", "error", "said"),
    [
        ({"avoid": {1.0: [away(5.0)]}}, TypeError, r"avoid must name times or ranges of them, but"),
        ({"avoid": {5: [away(5.0)]}}, ValueError, r"avoid names time 5, but the horizon is"),
        ({"avoid": {True: [away(5.0)]}}, TypeError, r"avoid must name times"),
        ({"avoid": {1: away(5.0)}}, TypeError, r"avoid must be a sequence of sets"),
        ({"avoid": {range(5, 2): [away(5.0)]}}, ValueError, r"avoid names the span range\(5, 2\)"),
        ({"goal": {range(5, 2): box(1.0), 4: box(1.0)}}, ValueError, r"goal names the span"),
        ({"goal": NOWHERE}, ValueError, r"goal is empty"),
        ({"safe": NOWHERE}, ValueError, r"safe is empty"),
        ({"avoid": [away(5.0), NOWHERE]}, ValueError, r"avoid\[1\] is empty"),
    ],
)
def test_what_cannot_be_required_is_named(asked, error, said, tube):
    with pytest.raises(error, match=said):
        rj.verify(tube, **asked)
    with pytest.raises(error, match=said):
        rj.decide(HALVES, X0, 4, **asked)


def test_thin_and_unbounded_sets_are_not_empty(tube):
    plane = rj.Polytope([[1.0, 0.0], [-1.0, 0.0]], [3.0, -3.0])
    assert statuses(tube, avoid=[plane, rj.Polytope([[-1.0, -1.0]], [-9.0])]) == {"PROVED"}


@pytest.mark.parametrize("ends", [([INFINITE, 0.0], [INFINITE, 1.0]), ([-INFINITE], [-INFINITE])])
def test_a_box_with_infinite_sides_has_points(ends):
    with pytest.raises(ValueError, match="lower must be below infinity"):
        rj.Polytope.between(*ends)


@pytest.mark.parametrize("call", [rj.winning_set, rj.largest_set, rj.decide])
def test_numbers_must_be_known(call):
    def traced(end):
        call(HALVES, rj.Box([0.0, 0.0], end), 2, safe=box(4.0))

    with pytest.raises(ValueError, match=f"holds traced numbers.* call {call.__name__} outside of"):
        jax.jit(traced)(np.ones(2))
    moving = rj.Box([[0.0, 0.0], [1.0, 1.0]], [[1.0, 1.0], [2.0, 2.0]])
    with pytest.raises(ValueError, match="must be one box, but a time-varying one arrived"):
        call(HALVES, moving, 2, safe=box(4.0))


def test_for_ever_is_yes_or_no(tube):
    with pytest.raises(TypeError, match="forever must be True or False, but 'no' arrived"):
        rj.verify(tube, safe=box(4.0), forever="no")


@pytest.mark.filterwarnings("error")
def test_of_trajectories_that_overflow_no_margin_is_said():
    net = rj.MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
    loop = rj.ClosedLoop(rj.AffinePlant([[1e60]], [[1.0]]), net)
    for cells in (None, 4):
        verdict = rj.decide(loop, rj.Box([1.0], [2.0]), 8, goal=rj.Box([-1.0], [1.0]), cells=cells)
        assert "simulated margin unknown" in str(verdict)
        assert "nan" not in str(verdict)
