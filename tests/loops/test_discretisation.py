"""Sampled plants: exact for a held input, and Runge-Kutta's approximation of it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import reachjax as rj

DIMENSIONS = [(1, 1), (2, 1), (3, 2), (6, 3)]


def continuous(n, m):
    rng = np.random.default_rng(n)
    return rng.normal(size=(n, n)), rng.normal(size=(n, m)), rng.normal(size=n)


@pytest.mark.parametrize(("n", "m"), DIMENSIONS)
def test_a_held_input_is_integrated_exactly(n, m):
    A, B, c = continuous(n, m)
    plant = rj.zero_order_hold(A, B, c, period=0.3)
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=n), rng.normal(size=m)
    solved = solve_ivp(lambda _, x: A @ x + B @ u + c, (0, 0.3), x, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(plant.propagate(x, u), solved.y[:, -1], atol=1e-9)


@pytest.mark.parametrize(("n", "m"), DIMENSIONS)
def test_runge_kutta_is_the_four_stage_method(n, m):
    A, B, c = continuous(n, m)
    plant = rj.runge_kutta(A, B, c, period=0.3)
    rng = np.random.default_rng(0)
    x, u, h = rng.normal(size=n), rng.normal(size=m), 0.3
    f = lambda x: A @ x + B @ u + c  # noqa: E731
    k1 = f(x)
    k2 = f(x + h / 2 * k1)
    k3 = f(x + h / 2 * k2)
    k4 = f(x + h * k3)
    np.testing.assert_allclose(plant.propagate(x, u), x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4))


def test_they_agree_to_fifth_order():
    A, B, c = continuous(3, 2)
    errors = []
    for period in (0.1, 0.05):
        exact, rough = (f(A, B, c, period=period) for f in (rj.zero_order_hold, rj.runge_kutta))
        errors.append(float(abs(exact.A - rough.A).max()))
    assert errors[0] / errors[1] == pytest.approx(2**5, rel=0.1)


@pytest.mark.costly
def test_the_derivative_in_the_plant_is_that_of_the_exponential():
    gradient = jax.grad(lambda a: rj.zero_order_hold(a[None, None], [[1.0]], period=2.0).A[0, 0])
    assert float(gradient(jnp.array(-0.5))) == pytest.approx(2 * np.exp(-1.0))


@pytest.mark.parametrize("method", [rj.zero_order_hold, rj.runge_kutta])
@pytest.mark.parametrize(
    ("arguments", "period", "message"),
    [
        (([[0.0]], [[1.0]]), 0.0, "period must be above 0, but 0 arrived"),
        (([[0.0]], [[1.0]]), float("nan"), "period must be finite and at least 0, but nan arrived"),
        (([[0.0]], [[1.0]]), -0.1, "period must be finite and at least 0, but -0.1 arrived"),
        (([[1e200]], [[1.0]]), 1.0, "the sampled plant overflows"),
        (([[0.0]], [[1.0], [2.0]]), 0.1, "B must have 1 rows"),
        (([[0.0]], [[1.0]], [1.0, 2.0]), 0.1, "c must have 1 rows"),
        (([[[0.0]], [[0.0]]], [[1.0]]), 0.1, "must be constant to be sampled"),
    ],
)
def test_bad_arguments_are_named(method, arguments, period, message):
    with pytest.raises(ValueError, match=message):
        method(*arguments, period=period)
