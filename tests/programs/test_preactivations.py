"""Pre-activation bounds over an ellipsoid hold in exact arithmetic, and are tight."""

from fractions import Fraction

import jax
import numpy as np
import pytest

import reachjax as rj
from reachjax.programs.bounds import loop_bounds
from reachjax.programs.preactivations import bounds_over, known_inputs

exactly = np.vectorize(Fraction, otypes=[object])


@jax.jit
def bounds_of(loop, X):
    """At time 0, with nothing known beforehand."""
    return bounds_over(loop, X, X.bounding_box(), 0, known_inputs(loop.units, None))


def cancelling(n, seed, offset, size):
    """A loop whose first layer stays active, and an ellipsoid far out: large numbers cancel."""
    rng = np.random.default_rng(seed)
    q, L = offset * rng.normal(size=n), size * rng.normal(size=(n, n))
    W1, W2, W3 = rng.normal(size=(3, n)), rng.normal(size=(3, 3)), rng.normal(size=(1, 3))
    b1 = -W1 @ q + 100 * size * (1 + rng.uniform(size=3))
    b2 = -W2 @ (W1 @ q + b1)
    layers = [(W1, b1), (W2, b2), (W3, [0.0])]
    plant = rj.AffinePlant(np.eye(n), np.ones((n, 1)))
    loop = rj.ClosedLoop(plant, rj.MLP.from_layers(layers), rj.Box([-size], [size]))
    return loop, rj.Ellipsoid(q, L @ L.T)


def exact_preactivations(loop, x):
    """Inputs of all units, projections included, in rational numbers."""
    *hidden, (W, b) = [tuple(map(exactly, layer)) for layer in loop.controller.layers]
    found, z = [], x
    for V, a in hidden:
        found.append(V @ z + a)
        z = np.maximum(found[-1], 0)
    lower, upper = exactly(loop.input_box.lower), exactly(loop.input_box.upper)
    found.append(W @ z + b - lower)
    found.append(upper - lower - np.maximum(found[-1], 0))
    return np.concatenate(found)


def is_member(X, x):
    """Whether `x` is in the ellipsoid, exactly; in two dimensions."""
    (a, b), (c, d) = exactly(X.shape)
    away = x - exactly(X.center)
    return away @ np.array([[d, -b], [-c, a]]) @ away <= a * d - b * c


def touching(X, direction):
    """Exact members near where a direction is largest and smallest."""
    Q, q = np.asarray(X.shape), np.asarray(X.center)
    away = Q @ direction / np.sqrt(direction @ Q @ direction)
    for end in (q + away, q - away):
        x = exactly(end)
        for k in range(40):
            if is_member(X, x):
                yield x
                break
            x = x + (exactly(q) - x) * Fraction(2**k, 2**52)


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e2])
@pytest.mark.parametrize("offset", [1e-2, 1.0, 1e6])
@pytest.mark.costly
def test_no_exact_input_of_a_unit_is_beyond_its_bounds(offset, size):
    checked = 0
    for seed in range(6):
        loop, X = cancelling(2, seed, offset, size)
        bounds = bounds_of(loop, X).preactivation
        (W1, _), (W2, _), _ = ((np.asarray(W), b) for W, b in loop.controller.layers)
        for direction in (*W1, *(W2 @ W1)):
            for x in touching(X, direction):
                inputs = exact_preactivations(loop, x)
                assert np.all(exactly(bounds.lower) <= inputs)
                assert np.all(inputs <= exactly(bounds.upper))
                checked += 1
    assert checked > 40


@pytest.mark.parametrize("n", [1, 2, 3, 6])
@pytest.mark.costly
def test_bounds_of_the_layers_before_any_switch_are_attained(n):
    loop, X = cancelling(n, seed=3, offset=1.0, size=1.0)
    bounds = bounds_of(loop, X).preactivation
    (W1, b1), (W2, b2), _ = ((np.asarray(W), np.asarray(b)) for W, b in loop.controller.layers)
    rows, constants = np.vstack([W1, W2 @ W1]), np.concatenate([b1, W2 @ b1 + b2])
    middle = rows @ np.asarray(X.center) + constants
    spread = np.sqrt(np.einsum("ki,ij,kj->k", rows, np.asarray(X.shape), rows))
    np.testing.assert_allclose(bounds.upper[:6], middle + spread, rtol=1e-9)
    np.testing.assert_allclose(bounds.lower[:6], middle - spread, rtol=1e-9)


@pytest.mark.costly
def test_no_bound_is_looser_than_that_of_the_box():
    loop, X = cancelling(3, seed=1, offset=1.0, size=1.0)
    over, around = bounds_of(loop, X), loop_bounds(loop, X.bounding_box(), 0)
    assert np.all(over.preactivation.upper <= around.preactivation.upper)
    assert np.all(over.preactivation.lower >= around.preactivation.lower)
    assert np.any(over.preactivation.upper < around.preactivation.upper - 0.1)
