"""Tables, lengths, and choices by comparisons that travel: through loops, stacks and branches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.scipy.special import xlogy

import reachjax as rj
from tests.loops.traced import assert_sound, network
from tests.loops.widths import widths

Partial = jax.tree_util.Partial
PLACES, HEIGHTS = jnp.array([-1.0, 0.0, 0.7, 2.0]), jnp.array([0.0, 1.0, -1.0, 3.0])
SLOPES, ROWS = jnp.array([2.0, 1.0]), jnp.array([[1.0, -2.0], [0.5, 3.0], [0.2, 0.7]])


def leaky(mask, y):
    return jnp.where(mask, y, 0.1 * y)


CONTINUOUS = {
    "table": lambda x: jnp.interp(x, PLACES, HEIGHTS),
    "table of parameters": Partial(lambda h, x: jnp.interp(x, PLACES, h), HEIGHTS),
    "table of states": lambda x: jnp.interp(x[:1], PLACES, x[1] * HEIGHTS),
    "table at one number": lambda x: jnp.interp(x[0], PLACES, HEIGHTS)[None],
    "length": lambda x: jnp.hypot(x[:1], x[1:]),
    "length beside a constant": lambda x: jnp.hypot(x, 0.3),
    "x log y": lambda x: xlogy(x, x[::-1] + 2.0),
    "x log x": lambda x: xlogy(x + 2.0, x + 2.0),
    "x log of a constant": lambda x: xlogy(x, 2.0) + xlogy(3.0, x + 2.0),
    "select": lambda x: jnp.select([x < 0, x < 1], [0 * x, x], 1.0),
    "pieces": lambda x: jnp.piecewise(x, [x < 0, x >= 1], [0.0, 1.0, lambda y: y]),
    "pieces of one entry": lambda x: jnp.piecewise(
        x[:1], [x[:1] < 0, x[:1] >= 1], [0.0, 1.0, lambda y: y]
    ),
    "pieces of a number": lambda x: jnp.piecewise(
        x[0], [x[0] < 0, x[0] >= 1], [0.0, 1.0, lambda y: y]
    )[None],
    "branches": lambda x: lax.cond(x[0] > 0, lambda x: x[:1], lambda x: 2 * x[:1], x),
    "branches of several": lambda x: jnp.stack(
        lax.cond(x[0] > 0, lambda x: (x[0], 0.0), lambda x: (0.0, x[0]), x)
    ),
    "branches with parameters": Partial(
        lambda p, x: lax.cond(x[0] > 0, lambda x: x[:1], lambda x: x[:1] * jnp.sum(p), x), SLOPES
    ),
    "branches of each": jax.vmap(lambda y: lax.cond(y > 0, lambda y: y, jnp.tanh, y)),
    "switch": lambda x: lax.switch(
        (x[0] > 0).astype(int), [lambda x: x[:1], lambda x: 2 * x[:1]], x
    ),
    "masks in a scan": lambda x: lax.scan(lambda c, m: (c + leaky(*m), c), 0.0, (x > 0, x))[0] * x,
    "masks in a map": lambda x: lax.map(lambda m: leaky(*m), (x - 0.5 > 0, x - 0.5)),
    "masks of rows": lambda x: lax.map(
        lambda m: leaky(*m), (x * ROWS - 0.5 > 0, x * ROWS - 0.5)
    ).ravel(),
    "masks of rows of parameters": Partial(
        lambda p, x: lax.map(lambda m: leaky(*m), (x / p + p > 0, x / p + p)).ravel(), ROWS
    ),
}


@pytest.mark.parametrize("name", CONTINUOUS)
def test_continuous_functions_are_sound(name):
    assert_sound(CONTINUOUS[name])


JUMPS = {
    "a table that jumps": (
        lambda x: jnp.interp(x, jnp.array([0.0, 0.0]), SLOPES),
        "'jit'.* must increase.* steep slope",
    ),
    "learned places": (
        Partial(lambda p, x: jnp.interp(x, p, HEIGHTS), PLACES),
        "'jit'.* places of its table must be constants",
    ),
}


@pytest.mark.parametrize("name", JUMPS)
def test_what_jumps_is_told_a_way_out(name):
    function, message = JUMPS[name]
    with pytest.raises(TypeError, match=message):
        network(function)


AROUND, BESIDE = rj.Box([-0.5, -0.5], [0.5, 0.5]), rj.Box([0.1, 0.1], [0.5, 0.5])
FORMS = rj.LinearBounds()
TIGHT = {
    "table": (CONTINUOUS["table"], AROUND, rj.BranchAndCut(), 1.001),
    "table by forms": (CONTINUOUS["table"], AROUND, FORMS, 1.4),
    "length": (lambda x: jnp.append(x[:1], jnp.hypot(x[0], x[1])), AROUND, FORMS, 1.01),
    "length by a root": (lambda x: jnp.append(x[0], jnp.sqrt(x @ x)), AROUND, FORMS, 1.01),
    "x log y": (CONTINUOUS["x log y"], BESIDE, FORMS, 1.05),
    "branches": (CONTINUOUS["branches of each"], AROUND, rj.BranchAndCut(), 1.01),
    "pieces": (CONTINUOUS["pieces"], AROUND, rj.BranchAndCut(), 1.001),
}


@pytest.mark.parametrize("name", TIGHT)
def test_bounds_are_tight(name):
    function, X0, relaxation, most = TIGHT[name]
    bounds, sampled = widths(lambda x, u: function(x), X0, relaxation)
    assert np.all(bounds <= most * sampled), bounds / sampled
