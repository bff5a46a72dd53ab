"""Statements for all time: sets that are said to come back do, and what breaks is never proved."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from experiments.quadrotor import model
from reachjax.verdicts.recurrent_sets import _safe_part
from tests.closed_loops import double_integrator

LATER = 2000
"""Steps of simulation, beyond what any proof looks at."""


def scalar(a, b=0.0, net=None):
    """`x+ = a x + b u`, under a network or none."""
    net = net or rj.MLP.from_layers([([[0.0]], [0.0])])
    return rj.ClosedLoop(rj.AffinePlant([[a]], [[b]]), net, rj.Box([-1.0], [1.0]))


def turning(growth):
    """A rotation by 0.3 that grows or shrinks."""
    c, s = growth * np.cos(0.3), growth * np.sin(0.3)
    net = rj.MLP.from_layers([([[0.0, 0.0]], [0.0])])
    return rj.ClosedLoop(rj.AffinePlant([[c, -s], [s, c]], [[0.0], [1.0]]), net)


def stays(verdict, loop, X0, safe):
    """Attack what is proved: the set it rests on, when it is entered, and what comes later."""
    assert verdict.status is rj.VerdictStatus.PROVED
    found = verdict.recurrence
    assert found.proved
    assert found.margin >= 0
    begun = jnp.concatenate([X0.corners(), X0.sample(jax.random.key(0), 500)])
    runs = loop.simulate(begun, LATER)
    assert safe.contains(runs, 1e-9).all()
    assert found.region.contains(runs[:, found.step], 1e-9).all()
    S = found.region
    begun = jnp.concatenate([S.corners(), S.sample(jax.random.key(1), 500)])
    runs = loop.simulate(begun, found.period)
    assert safe.contains(runs, 1e-9).all()
    assert S.contains(runs[:, -1], 1e-9).all()


@pytest.fixture(scope="module")
def with_margin():
    return double_integrator()


@pytest.mark.costly
def test_the_double_integrator_is_safe_for_ever(with_margin):
    X0, safe = rj.Box([2.5, -0.25], [3.0, 0.25]), rj.Box([-1.0, -1.0], [5.0, 1.0])
    tube = rj.reach(with_margin, X0, 6, rj.Template.box(2))
    verdict = rj.verify(tube, safe=safe, forever=True)
    stays(verdict, with_margin, X0, safe)
    assert f"for ever: in a set at t = {verdict.recurrence.step}" in str(verdict)
    cells = rj.reach_partitioned(with_margin, X0, 6, rj.Template.box(2), cells=(2, 1))
    stays(rj.verify(cells, safe=safe, forever=True), with_margin, X0, safe)


@pytest.mark.long
def test_a_quadrotor_is_safe_for_ever():
    plant, aim, g = model.plant(), np.array([3.9, 3.0, 2.0, 0.0, 0.0, 0.0]), model.GRAVITY
    gain = np.array([[0.16, 0, 0, 0.18, 0, 0], [0, -0.16, 0, 0, -0.18, 0], [0, 0, 1.2, 0, 0, 1.6]])
    parts = [(np.vstack([np.eye(6), -np.eye(6)]), np.concatenate([-aim, aim]))]
    net = rj.MLP.from_layers([*parts, (np.hstack([-gain, gain]), [0.0, 0.0, g])])
    loop = rj.ClosedLoop(plant, net, rj.Box(*model.INPUT_LIMITS))
    X0, safe = model.initial_set().bounding_box(), model.safe_set(False)
    tube = rj.reach(loop, X0, 10, rj.Template.box(6))
    verdict = rj.verify(tube, safe=safe, forever=True)
    stays(verdict, loop, X0, safe)


@pytest.mark.costly
def test_a_tube_that_comes_back_to_where_it_began_is_closed():
    X0 = rj.Box([-1.0, -1.0], [1.0, 1.0])
    loop, safe = turning(0.9), rj.Box([-2.0, -2.0], [2.0, 2.0])
    verdict = rj.verify(rj.reach(loop, X0, 8, rj.Template.box(2)), safe=safe, forever=True)
    stays(verdict, loop, X0, safe)
    found = verdict.recurrence
    np.testing.assert_array_equal([found.region.lower, found.region.upper], [X0.lower, X0.upper])
    assert found.step == found.period


@pytest.mark.costly
def test_what_is_safe_may_cut_the_set():
    X0, safe = rj.Box([0.3, 0.3], [0.4, 0.4]), rj.Box([-0.02, -1.0], [1.0, 1.0])
    net = rj.MLP.from_layers([([[0.0, 0.0]], [0.0])])
    loop = rj.ClosedLoop(rj.AffinePlant([[0.8, 0.0], [0.1, 0.7]], [[0.0], [1.0]]), net)
    tube = rj.reach(loop, X0, 4, rj.Template.box(2))
    stays(rj.verify(tube, safe=safe, forever=True), loop, X0, safe)


def test_a_limit_cycle_is_safe_where_it_is_and_refuted_where_it_is_not():
    net = rj.MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-1.0, 1.0]], [0.0])])
    loop, X0 = scalar(1.0, 2.5, net), rj.Box([0.4], [0.6])  # ends between -1.5 and 1.5
    tube = rj.reach(loop, X0, 6, rj.Template.box(1))
    wide, narrow = (rj.Box([-size], [size]) for size in (2.0, 1.2))
    stays(rj.verify(tube, safe=wide, forever=True), loop, X0, wide)
    short = rj.reach(loop, X0, 1, rj.Template.box(1))
    assert rj.verify(short, safe=narrow).status is rj.VerdictStatus.PROVED
    verdict = rj.verify(short, safe=narrow, forever=True)
    assert verdict.status is rj.VerdictStatus.REFUTED
    assert verdict.counterexample.time > 1


@pytest.mark.parametrize("loop", [scalar(1.05), turning(1.02)], ids=["line", "spiral"])
@pytest.mark.costly
def test_what_leaves_after_fifty_steps_is_refuted(loop):
    n = loop.states
    X0, safe = rj.Box([0.08] * n, [0.1] * n), rj.Box([-1.0] * n, [1.0] * n)
    tube = rj.reach(loop, X0, 10, rj.Template.box(n))
    assert rj.verify(tube, safe=safe).status is rj.VerdictStatus.PROVED
    verdict = rj.verify(tube, safe=safe, forever=True)
    example = verdict.counterexample
    assert verdict.status is rj.VerdictStatus.REFUTED
    assert example.time > 40
    assert len(example.states) == example.time + 1
    assert not safe.contains(example.states[-1])
    again = loop.simulate(example.states[0], example.time)
    np.testing.assert_allclose(again, example.states, rtol=1e-9)


@pytest.mark.costly
def test_what_leaves_after_any_simulation_is_unknown():
    loop, X0 = scalar(1.0005), rj.Box([0.1], [0.2])
    tube = rj.reach(loop, X0, 3, rj.Template.box(1))
    verdict = rj.verify(tube, safe=rj.Box([-1.0], [1.0]), forever=True)
    assert verdict.status is rj.VerdictStatus.UNKNOWN
    assert verdict.recurrence is None or verdict.recurrence.margin < 0


@pytest.mark.costly
def test_disturbances_that_never_end():
    loop, X0 = turning(0.9), rj.Box([0.3, -0.1], [0.4, 0.1])
    noise, push = rj.Box([-0.01, -0.01], [0.01, 0.01]), rj.Box([-0.02, -0.01], [0.02, 0.01])
    plant = loop.plant.replace(E=np.eye(2))
    loop = rj.ClosedLoop(plant, loop.controller, disturbance=push, noise=noise)
    tube, safe = rj.reach(loop, X0, 8, rj.Template.box(2)), rj.Box([-1.0, -1.0], [1.0, 1.0])
    verdict = rj.verify(tube, safe=safe, forever=True)
    stays(verdict, loop, X0, safe)
    S, period = verdict.recurrence.region, verdict.recurrence.period
    rng = np.random.default_rng(0)
    begun = np.repeat(np.asarray(S.corners()), 50, axis=0)
    extreme = rng.choice([-1.0, 1.0], size=(len(begun), period, 2)) * push.upper
    runs = loop.simulate(begun, period, disturbances=extreme)
    assert S.contains(runs[:, -1], 1e-9).all()


@pytest.mark.costly
def test_what_cannot_be_asked_for_is_named():
    loop, X0 = scalar(0.5), rj.Box([0.1], [0.2])
    tube, safe = rj.reach(loop, X0, 2, rj.Template.box(1)), rj.Box([-1.0], [1.0])
    with pytest.raises(ValueError, match="nothing is required for ever"):
        rj.verify(tube, goal=safe, forever=True)
    with pytest.raises(ValueError, match="avoid must be a sequence of sets, for all times"):
        rj.verify(tube, avoid={1: [rj.Box([2.0], [3.0])]}, forever=True)
    with pytest.raises(ValueError, match="time_limit"):
        rj.verify(tube, safe=safe, forever=True, time_limit=-1.0)
    varying = loop.replace(input_box=rj.Box(-np.ones((4, 1)), np.ones((4, 1))))
    tube = rj.reach(varying, X0, 2, rj.Template.box(1))
    with pytest.raises(ValueError, match="do not vary in time"):
        rj.verify(tube, safe=safe, forever=True)


@pytest.mark.costly
def test_a_set_to_return_into_of_which_nothing_is_safe_is_none(monkeypatch):
    """Trajectories end beside what is safe, later than anything proved: they refute it."""
    modes = np.array([[1.0, 1.0], [1.0, 0.3]])
    A = modes @ np.diag([0.995, -0.9]) @ np.linalg.inv(modes)
    end = 10 * modes[:, 0]
    net = rj.MLP.from_layers([(np.zeros((1, 2)), [0.0])])
    loop = rj.ClosedLoop(rj.AffinePlant(A, np.zeros((2, 1)), end - A @ end), net)
    X0, safe = rj.Box([-0.01, -0.01], [0.01, 0.01]), rj.Polytope([[1.0, 0.0]], [6.0])
    tube = rj.reach(loop, X0, 125, rj.Template.box(2), rj.LinearBounds())
    verdict = rj.verify(tube, safe=safe, samples=20, forever=True)
    assert verdict.refuted
    assert verdict.counterexample.time > 125
    assert np.max(verdict.counterexample.upper - verdict.counterexample.lower) < 1e-9
    monkeypatch.setattr("reachjax.verdicts.invariance.counterexample", lambda *_: None)
    assert rj.verify(tube, safe=safe, samples=20, forever=True).status is rj.VerdictStatus.UNKNOWN


@pytest.mark.parametrize("kind", ["box", "polytope"])
def test_what_is_left_of_a_set_is_safe(kind):
    region, far = rj.Box([0.0, 0.0], [1.0, 1.0]), rj.Box([1.5, 0.0], [2.0, 1.0])
    near = rj.Box([0.5, -1.0], [2.0, 2.0])
    if kind == "polytope":
        region = rj.Polytope(*region.facets)
    assert _safe_part(region, far) is None
    part = _safe_part(region, near)
    np.testing.assert_allclose(part.bounding_box().lower, [0.5, 0.0], atol=1e-12)
    assert _safe_part(region, None) is region
