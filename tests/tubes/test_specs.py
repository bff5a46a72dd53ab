"""Verdicts: proved, refuted with a trajectory, or unknown, and never a bare truth value."""

import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.closed_loops import autonomous, recursion
from tests.networks import he_network


def contraction(n_x=2, input_box=None):
    """`x+ = x / 2`."""
    return autonomous(np.eye(n_x) / 2, input_box)


@pytest.fixture(scope="module")
def tube():
    """From `[0.5, 1]^2` to `[1/8, 1/4]^2` in two steps."""
    return recursion(contraction(), rj.Box([0.5, 0.5], [1, 1]), 2, rj.Template.octagonal(2))


@pytest.fixture(scope="module")
def loose():
    """A tube whose sets are much larger than what is reached."""
    layers = [(2 * W, b) for W, b in he_network((2, 8, 8, 1), seed=3)]
    loop = rj.ClosedLoop(
        rj.AffinePlant([[1.0, 0.5], [0.0, 1.0]], [[0.1], [0.5]]),
        rj.MLP.from_layers(layers),
        rj.Box([-1.0], [1.0]),
    )
    template = rj.Template.box(2)
    return recursion(loop, rj.Box([-0.2, -0.2], [0.2, 0.2]), 3, template, rj.PaperQC(False))


def half_space(a, b):
    return rj.Polytope([a], [b])


PROVED = {
    "goal": ({"goal": rj.Box([0, 0], [0.3, 0.3])}, "goal", 2, 0.05),
    "polytope goal": ({"goal": half_space([3.0, 4.0], 2.0)}, "goal", 2, 0.05),
    "safe": ({"safe": rj.Box([0, 0], [1, 1])}, "safe", 0, 0.0),
    "half-space avoided": ({"avoid": [half_space([1, 0], 0.1)]}, "avoid[0]", 2, 0.025),
    "avoided early": ({"avoid": {0: [half_space([1, 0], 0.2)]}}, "avoid[0]", 0, 0.3),
    "box avoided": ({"avoid": {1: [rj.Box([0.6, 0.0], [0.9, 1.0])]}}, "avoid[0]", 1, 0.1),
}


@pytest.mark.parametrize(("spec", "name", "t", "margin"), PROVED.values(), ids=PROVED.keys())
def test_what_holds_is_proved_with_its_margin(tube, spec, name, t, margin):
    verdict = rj.verify(tube, **spec)
    assert verdict.status is rj.VerdictStatus.PROVED
    assert verdict.counterexample is None
    assert verdict.margins[name][t] == pytest.approx(margin, abs=1e-7)
    assert np.nanmin(verdict.margins[name]) == verdict.margins[name][t]
    assert np.all(np.nan_to_num(verdict.simulated[name] - verdict.margins[name]) >= -1e-12)


REFUTED = {
    "goal": ({"goal": rj.Box([0, 0], [0.2, 0.3])}, "goal", 2, 0.05),
    "safe": ({"safe": rj.Box([0.2, 0.0], [1, 1])}, "safe", 2, 0.075),
    "avoid": ({"avoid": {1: [half_space([-1, 0], -0.4)]}}, "avoid[0]", 1, 0.1),
    "worst of several": (
        {"goal": rj.Box([0, 0], [0.24, 0.3]), "safe": rj.Box([0, 0], [0.9, 2])},
        "safe",
        0,
        0.1,
    ),
}


@pytest.mark.parametrize(("spec", "name", "t", "violation"), REFUTED.values(), ids=REFUTED.keys())
def test_what_fails_is_refuted_by_a_trajectory_of_the_loop(tube, spec, name, t, violation):
    verdict = rj.verify(tube, **spec)
    assert verdict.status is rj.VerdictStatus.REFUTED
    example = verdict.counterexample
    assert (example.requirement, example.time) == (name, t)
    assert example.violation == pytest.approx(violation, abs=1e-9)
    assert tube.sets[0].contains(example.states[0])
    again = tube.loop.simulate(jnp.asarray(example.states[0]), tube.horizon)
    np.testing.assert_array_equal(example.states, again)
    for k, u in enumerate(example.inputs):
        stepped = tube.loop.plant.propagate(example.states[k], u, k)
        np.testing.assert_allclose(stepped, example.states[k + 1], rtol=1e-14)
    assert "counterexample" in str(verdict)


def test_what_neither_is_proved_nor_broken_is_unknown_with_both_margins(loose):
    certified = np.asarray(loose.sets[3].support(np.array([[0.0, 1.0]])))[0]
    reached = float(np.max(loose.simulate(10_000)[:, 3, 1]))
    between = (certified + reached) / 2
    assert reached < between - 0.01
    assert between < certified - 0.01
    verdict = rj.verify(loose, goal=half_space([0, 1], between))
    assert verdict.status is rj.VerdictStatus.UNKNOWN
    assert verdict.counterexample is None
    assert verdict.margins["goal"][3] < 0 < verdict.simulated["goal"][3]
    assert str(verdict).startswith("UNKNOWN")


def test_touching_is_inside_a_closed_safe_set_but_not_outside_a_closed_avoid_set(tube):
    edge = rj.Box([0.0, 0.0], [1.0, 1.0])  # the initial set touches its upper sides
    assert rj.verify(tube, safe=edge).status is rj.VerdictStatus.PROVED
    touched = {0: [half_space([-1, 0], -1.0)]}  # x_1 >= 1
    assert rj.verify(tube, avoid=touched).status is rj.VerdictStatus.UNKNOWN


def test_a_larger_goal_never_loses_a_proof(loose):
    upper = float(np.asarray(loose.sets[3].support(np.eye(2)))[0])
    order = [rj.verify(loose, goal=half_space([1, 0], upper + e)).status for e in (-1e-6, 1e-6)]
    assert order[1] is rj.VerdictStatus.PROVED
    assert order[0] is not rj.VerdictStatus.PROVED


@pytest.mark.costly
def test_the_safe_set_is_the_complement_of_its_outer_half_spaces(loose):
    box = rj.Box([-2.0, -1.0], [2.0, 1.0])
    A, b = box.facets
    outside = [rj.Polytope([-a], [-float(limit)]) for a, limit in zip(A, b, strict=True)]
    safe, avoid = rj.verify(loose, safe=box), rj.verify(loose, avoid=outside)
    worst = np.min([avoid.margins[f"avoid[{i}]"] for i in range(4)], axis=0)
    np.testing.assert_allclose(safe.margins["safe"], worst, atol=1e-9)


@pytest.mark.costly
def test_three_dimensions_and_a_narrow_avoid_set():
    start = rj.Box(np.full(3, 0.5), np.ones(3))
    tube = recursion(contraction(3), start, 2, rj.Template.box(3))
    beside = rj.Polytope(np.vstack([np.eye(3), -np.eye(3)]), [0.1, 1, 1, 0, 0, 0])
    inside = rj.Box(np.full(3, 0.2), np.full(3, 0.21))
    assert rj.verify(tube, avoid={2: [beside]}).status is rj.VerdictStatus.PROVED
    assert rj.verify(tube, avoid={2: [inside]}, samples=100).status is not rj.VerdictStatus.PROVED


def test_a_verdict_is_no_truth_value(tube):
    verdict = rj.verify(tube, safe=rj.Box([0, 0], [1, 1]))
    with pytest.raises(TypeError, match=r"use verdict\.proved"):
        bool(verdict)


@pytest.mark.costly
def test_a_violation_that_rounding_makes_is_no_counterexample():
    """Exactly `u = x`, but the simulation rounds upwards over large intermediate numbers."""
    K, high = 2.0**30, 1 + 2.0**-22 * 0.9
    net = rj.MLP.from_layers([([[1.0], [0.0]], [K, K]), ([[1.0, -1.0]], [0.0])])
    loop = rj.ClosedLoop(rj.AffinePlant([[0.0]], [[1.0]]), net)
    tube = recursion(loop, rj.Box([0.0], [high]), 1, rj.Template.box(1))
    verdict = rj.verify(tube, goal=rj.Box([-1.0], [high]))
    assert np.nanmin(verdict.simulated["goal"]) < -1e-9
    assert verdict.status is not rj.VerdictStatus.REFUTED


SCALES = [1e155, 1e-170, 1e300, 1e-300]


@pytest.mark.costly
def test_nothing_is_proved_by_normals_whose_squares_are_no_numbers():
    """The sum of 13 coordinates reaches 6.5, where no corner is simulated."""
    start = rj.Box(-np.ones(13), np.ones(13))
    tube = recursion(contraction(13), start, 1, rj.Template.box(13))
    for scale in SCALES:
        goals = [rj.Polytope(np.full((1, 13), scale), [most * scale]) for most in (6, 7)]
        beyond, inside = (rj.verify(tube, goal=goal, samples=100) for goal in goals)
        assert beyond.status is not rj.VerdictStatus.PROVED
        assert beyond.margins["goal"][1] == pytest.approx(-0.5 / np.sqrt(13), abs=1e-6)
        assert inside.status is rj.VerdictStatus.PROVED


@pytest.mark.parametrize("scale", SCALES)
def test_a_verdict_does_not_depend_on_the_length_of_normals(tube, scale):
    for offset in (0.2, 0.4):  # the sum reaches 1/2 at last, and is 1/4 at least
        normal, other = np.full((1, 2), scale), rj.Polytope([[1.0, 1.0]], [offset])
        goal = rj.Polytope(normal, [offset * scale])
        for spec, same in (({"goal": goal}, {"goal": other}),
                           ({"avoid": {2: [goal]}}, {"avoid": {2: [other]}})):  # fmt: skip
            verdict, expected = (rj.verify(tube, **each, samples=20) for each in (spec, same))
            assert verdict.status is expected.status
            for name, margins in expected.margins.items():
                np.testing.assert_allclose(verdict.margins[name], margins, rtol=1e-9, atol=1e-12)


@pytest.mark.costly
def test_products_that_underflow_prove_and_refute_nothing():
    """At most 1e-200, where 1e-200 x <= 0 rounds to 0 <= 0."""
    tube = recursion(contraction(1), rj.Box([0.0], [2e-200]), 1, rj.Template.box(1))
    below = rj.Polytope([[1e-200]], [0.0])
    assert rj.verify(tube, goal=below, samples=20).status is not rj.VerdictStatus.PROVED
    apart = recursion(contraction(1), rj.Box([1e-200], [2e-200]), 1, rj.Template.box(1))
    assert rj.verify(apart, avoid=[below], samples=20).status is rj.VerdictStatus.PROVED


@pytest.mark.parametrize("goal", [[[1e-170, 0.0]], [[1e300, 1e-300]]], ids=str)
def test_offsets_out_of_reach_have_verdicts_too(tube, goal):
    for offset, status in (1e308, rj.VerdictStatus.PROVED), (-1e308, rj.VerdictStatus.REFUTED):
        assert rj.verify(tube, goal=rj.Polytope(goal, [offset]), samples=20).status is status


def test_what_is_avoided_may_be_as_far_away_as_floats_go(tube):
    for lower, upper in ((1e20, 2e20), (1e150, 1e308), (-1e308, -1e150)):
        away = rj.verify(tube, avoid=[rj.Box([lower] * 2, [upper] * 2)], samples=20)
        assert away.status is rj.VerdictStatus.PROVED
        assert np.nanmin(away.margins["avoid[0]"]) == pytest.approx(min(abs(lower), abs(upper)))


@pytest.mark.costly
def test_a_tube_from_a_set_too_thin_to_be_sampled_has_bounds_and_no_witnesses():
    cap = rj.Intersection(rj.Box([1 - 1e-12], [2.0]), rj.Ellipsoid([0.0], [[1.0]]))
    thin = recursion(contraction(1), cap, 1, rj.Template.box(1))
    assert np.isnan(thin.proof(1).witnesses).all()
    assert rj.verify(thin, goal=rj.Box([0.4], [0.6]), samples=20).status is rj.VerdictStatus.PROVED
    assert rj.verify(thin, goal=rj.Box([0.0], [0.1]), samples=20).status is rj.VerdictStatus.UNKNOWN
