"""Tubes of loops whose inputs are projected onto a polytope: sound, exact and differentiable."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from experiments.tightness.exact import exact_tube
from reachjax.proofs.branches import Rung
from tests.cases import Case
from tests.closed_loops import initial_set
from tests.differences import PARTS, along, relative_error
from tests.input_polytopes import SETS, box_facets, polytope_loop
from tests.quick_cases import some

HORIZON = 3
X0 = rj.Box([-0.6, -0.4], [0.5, 0.7])
TEMPLATE = rj.Template.box(2)


def excess(tube, loop, start, count=3000):
    """The most that simulated states are outside of a tube's sets, from `count` initial states."""
    states = np.asarray(start.sample(jax.random.key(3), count))
    runs = np.asarray(loop.simulate(states, HORIZON))
    return max(
        float(np.max(np.asarray(X.bounded_values(runs[:, k]) - X.limits)))
        for k, X in enumerate(tube.sets[1:], start=1)
    )


def often_projected(loop):
    states = np.asarray(X0.sample(jax.random.key(0), 500))
    given, projected = (np.asarray(jax.vmap(f)(states)) for f in (loop.controller, loop.input))
    return np.mean(np.any(abs(given - projected) > 1e-9, axis=1))


def test_what_laws_say_of_a_pentagon_is_of_inputs_that_are_often_projected():
    assert 0.2 < often_projected(Case("inputs in a pentagon").closed_loop) < 1


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("linear", [True, False], ids=["affine forms", "default"])
def test_nothing_simulated_is_outside_whatever_the_polytope(name, linear):
    loop, start = polytope_loop(SETS[name], seed=2), initial_set("polytope", 2)
    options = {"relaxation": rj.LinearBounds()} if linear else {"samples": 100}
    tube = rj.reach(loop, start, HORIZON, TEMPLATE, **options)
    assert excess(tube, loop, start) <= 1e-12


@pytest.mark.parametrize("name", ["triangle", "rotated square", "pentagon"])
@pytest.mark.costly
def test_the_default_is_exact(name):
    loop = polytope_loop(SETS[name])
    assert 0.1 < often_projected(loop) < 1
    tube = rj.reach(loop, X0, HORIZON, TEMPLATE, gap=1e-6)
    exact = exact_tube(loop, X0, HORIZON, TEMPLATE.directions)
    for k, (values, spreads) in enumerate(zip(exact.values, exact.spreads, strict=True), start=1):
        over = np.asarray(tube.sets[k].b) - values
        assert np.all(over >= -1e-9)
        assert np.all(over <= 1e-5 * spreads)
        assert Rung.PRODUCTS not in tube.proof(k).ways
        np.testing.assert_allclose(tube.proof(k).recheck(), tube.sets[k].b, atol=1e-12)


@pytest.mark.costly
def test_a_box_as_a_polytope_is_the_box():
    C, d = box_facets(2)
    loop = polytope_loop((C, d), seed=1)
    boxed = loop.replace(input_box=rj.Box(-d[2:], d[:2]))
    assert often_projected(loop) > 0.2
    states = X0.sample(jax.random.key(1), 200)
    runs = loop.simulate(states, HORIZON), boxed.simulate(states, HORIZON)
    np.testing.assert_allclose(*runs, atol=1e-13)
    sets = (rj.reach(each, X0, HORIZON, TEMPLATE, gap=1e-7).sets for each in (loop, boxed))
    for one, other in zip(*sets, strict=True):
        np.testing.assert_allclose(one.limits, other.limits, atol=1e-6)


def summed(loop, X0):
    """All offsets of all steps, each with a weight of its own."""
    tube = rj.reach(loop, X0, HORIZON, TEMPLATE, samples=100, gap=1e-9)
    weights = 1.0 + jnp.arange(4)
    return sum((k + 1.0) * weights @ X.b for k, X in enumerate(tube.sets[1:]))


@pytest.mark.parametrize("name", some(["triangle", "pentagon", "cube"], "triangle".__eq__))
@pytest.mark.costly
def test_gradients_are_those_of_differences(name):
    loop = polytope_loop(SETS[name], seed=1)
    gradient = jax.grad(summed, argnums=(0, 1))(loop, X0)
    for part in PARTS:
        direction = along(part, loop, X0, seed=0)
        assert relative_error(summed, (loop, X0), gradient, direction, 1e-5) < 1e-6, part


@pytest.mark.costly
def test_offsets_that_are_given_to_a_polytope_have_a_derivative():
    C, d = SETS["pentagon"]
    loop = polytope_loop((C, d), seed=1)

    def f(d):
        return summed(loop.replace(input_box=rj.Polytope(C, d)), X0)

    by = np.random.default_rng(0).normal(size=5)
    difference = (f(jnp.asarray(d + 1e-5 * by)) - f(jnp.asarray(d - 1e-5 * by))) / 2e-5
    np.testing.assert_allclose(jax.grad(f)(jnp.asarray(d)) @ by, difference, rtol=1e-6)


@pytest.mark.costly
def test_compiled_affine_forms_are_those_of_the_host_and_have_derivatives():
    loop = polytope_loop(SETS["triangle"], hidden=(3,), seed=3)

    def offsets(loop, X0):
        tube = rj.reach(loop, X0, HORIZON, TEMPLATE, rj.LinearBounds())
        return jnp.concatenate([X.b for X in tube.sets[1:]])

    np.testing.assert_allclose(jax.jit(offsets)(loop, X0), offsets(loop, X0), rtol=1e-9)

    def total(loop, X0):
        return jnp.arange(1.0, 13.0) @ offsets(loop, X0)

    gradient = jax.jit(jax.grad(total, argnums=(0, 1)))(loop, X0)
    for part in PARTS:
        direction = along(part, loop, X0, seed=0)
        assert relative_error(total, (loop, X0), gradient, direction, 1e-5) < 1e-6, part


@pytest.mark.parametrize(("room", "status"), [(1e-3, "PROVED"), (-1e-3, "REFUTED")])
@pytest.mark.costly
def test_verdicts_are_decided(room, status):
    loop = polytope_loop(SETS["rotated square"])
    upper, lower = exact_tube(loop, X0, HORIZON, [[1.0, 0.0], [-1.0, 0.0]]).values[-1]
    goal = rj.Box([-lower - room, -5.0], [upper + room, 5.0])
    assert rj.decide(loop, X0, HORIZON, goal=goal).status.name == status
    tube = rj.reach(loop, X0, HORIZON, TEMPLATE)
    assert rj.verify(tube, goal=goal).status.name == status
