"""Gradients of the default's offsets against fourth-order differences.

At random numbers, where no worst trajectory changes: bounds are those of trajectories, so linear
programs' accuracy divided by the step is all that a difference is off by.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.closed_loops import initial_set, switching_loop
from tests.differences import central_difference, dot, error_in_all_parts, norm

HORIZON = 3
STEP = 1e-5

UNITS = {
    "ReLU": {"activation": rj.ReLU()},
    "LeakyReLU": {"activation": rj.LeakyReLU(0.1)},
    "HardTanh": {"activation": rj.HardTanh()},
    "residual": {"residual": True},
    "no input box": {"boxed": False},
    "time-varying": {"steps": HORIZON + 1},
}

CASES = [
    (1, "box", "HardTanh"),
    (2, "box", "ReLU"),
    (2, "box", "time-varying"),
    (2, "polytope", "LeakyReLU"),
    (2, "polytope", "HardTanh"),
    (3, "box", "residual"),
    (3, "polytope", "no input box"),
]


def summed(template, start=0, **options):
    """All offsets of all steps, each with a weight of its own."""

    def value(loop, X0):
        tube = rj.reach(loop, X0, HORIZON, template, start=start, samples=100, gap=1e-9, **options)
        weights = 1.0 + jnp.arange(len(template.directions))
        return sum((k + 1.0) * weights @ X.b for k, X in enumerate(tube.sets[1:]))

    return value


def problem(n_x, kind, units):
    loop = switching_loop(n_x, seed=n_x + 20, hidden=(4, 3), **UNITS[units])
    X0, start = initial_set(kind, n_x, seed=n_x), 1 if units == "time-varying" else 0
    return summed(rj.Template.box(n_x), start), (loop, X0)


@pytest.fixture(scope="module", params=CASES, ids=lambda case: "-".join(map(str, case)))
def case(request):
    """(function, arguments, its gradient)."""
    f, args = problem(*request.param)
    return f, args, jax.grad(f, argnums=(0, 1))(*args)


def test_gradients_are_those_of_differences(case):
    """Also where a facet is proved by splits of phases."""
    f, args, gradient = case
    assert error_in_all_parts(f, args, gradient, STEP) < 1e-6


@pytest.mark.costly
def test_gradients_in_all_numbers_of_the_set_are_those_of_differences(case):
    """Normals of polytopes too; their programs' 1e-9 over the step is 1e-4, for a norm of 60."""
    f, (loop, X0), gradient = case
    rng = np.random.default_rng(0)
    still = jax.tree.map(jnp.zeros_like, loop)
    move = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), X0)
    exact = dot(gradient, (still, move))
    found = central_difference(f, (loop, X0), (still, move), STEP)
    assert abs(exact - found) < 1e-5 * norm(gradient[1])


@pytest.mark.costly
def test_values_do_not_depend_on_whether_a_gradient_is_asked_for(case):
    f, args, _ = case
    value, _ = jax.value_and_grad(f)(*args)
    assert float(value) == pytest.approx(float(f(*args)), abs=1e-6)


@pytest.mark.long  # programs of cones leave gaps of 1e-8, and facets climb on to products
@pytest.mark.parametrize("units", ["ReLU", "HardTanh"])
def test_gradients_from_round_sets_are_those_of_differences(units):
    """To the accuracy of conic programs."""
    f, args = problem(2, "ellipsoid", units)
    gradient = jax.grad(f, argnums=(0, 1))(*args)
    assert error_in_all_parts(f, args, gradient, h=1e-4) < 1e-3


@pytest.mark.costly
def test_gradients_in_directions_are_those_of_differences():
    _, (loop, X0) = problem(2, "box", "ReLU")
    directions = np.random.default_rng(0).normal(size=(3, 2))

    def value(directions):
        return summed(rj.Template(directions))(loop, X0)

    move = np.random.default_rng(1).normal(size=(3, 2))
    found = central_difference(value, (directions,), (move,), STEP)
    assert dot(jax.grad(value)(jnp.asarray(directions)), move) == pytest.approx(found, rel=1e-6)


@pytest.mark.costly
def test_gradients_in_the_weights_alone_are_part_of_all():
    f, (loop, X0) = problem(2, "polytope", "ReLU")
    alone = jax.grad(lambda net: f(loop.replace(controller=net), X0))(loop.controller)
    together = jax.grad(f)(loop, X0).controller
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), alone, together)
