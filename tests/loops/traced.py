"""Networks of functions, and their bounds by intervals."""

import jax
import jax.numpy as jnp
import numpy as np

import reachjax as rj
from reachjax.loops.batches import Batch
from reachjax.numerics.rounding import Ball

LOWER, UPPER = np.array([-1.0, -0.5]), np.array([1.0, 1.5])


def network(function, inputs=2):
    """The network of a function, whatever its outputs."""
    shape = jax.eval_shape(function, jax.ShapeDtypeStruct((inputs,), float)).shape
    return rj.Network(function, inputs, shape[0])


def on_batches(unit, *y):
    """Units at many points at once."""
    return Batch(unit(*(each.values for each in y)))


def by_interval(unit, *given):
    """Units by the intervals of their inputs, which are rounded."""
    y = Ball.joined(given)
    slack = 1e-14 * (abs(y.mid) + y.rad)
    return Ball.between(*unit.interval(y.lower - slack, y.upper + slack))


def interval(net, lower=LOWER, upper=UPPER):
    """Bounds of the outputs."""
    found = net.propagate(Ball.between(jnp.asarray(lower), jnp.asarray(upper)), by_interval)
    return np.asarray(found.lower), np.asarray(found.upper)


def points(lower=LOWER, upper=UPPER, count=300):
    """Some between these, both among them."""
    drawn = np.random.default_rng(1).uniform(lower, upper, size=(count, len(lower)))
    return np.concatenate([np.stack([lower, upper, (lower + upper) / 2]), drawn])


def assert_sound(function, lower=LOWER, upper=UPPER):
    """Every kind of number has the values of the function, and intervals hold them."""
    net, x = network(function, len(lower)), points(lower, upper)
    expected = np.asarray(jax.vmap(function)(x))
    np.testing.assert_allclose(jax.vmap(net)(x), expected, rtol=1e-13, atol=1e-14)
    steps = jax.vmap(lambda x: net.propagate(x, lambda unit, *y: unit(*y)))(x)
    np.testing.assert_allclose(steps, expected, rtol=1e-12, atol=1e-13)
    at_once = jax.device_get(net).propagate(
        Batch(x), lambda unit, *y: Batch(unit(*(each.values for each in y)))
    )
    found = np.broadcast_to(at_once.values, expected.shape)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13)
    low, high = interval(net, lower, upper)
    assert np.all(low <= expected.min(axis=0)), (low, expected.min(axis=0))
    assert np.all(high >= expected.max(axis=0)), (high, expected.max(axis=0))
    assert np.isfinite([low, high]).all()
