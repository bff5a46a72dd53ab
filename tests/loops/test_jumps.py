"""Functions that jump are traced: every kind of number has their values, intervals hold them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import reachjax as rj
from reachjax.loops.batches import trajectories
from reachjax.numerics.host import in_numpy
from tests.loops.traced import assert_sound, interval, network, points

T, ROWS = jnp.array([1.0, -2.0, 3.0]), jnp.array([[1.0, 2.0], [0.5, -1.0], [-3.0, 0.0]])
W = jnp.array([[1.0, 0.3], [-0.2, 1.1], [0.7, -0.9]])
Partial = jax.tree_util.Partial


def bits(x):
    """Whether the numbers are above places."""
    return jnp.stack([x[0] > 0.3, x[1] > 0])


def hypot(x, y):
    """It is no length, whatever its name."""
    return jnp.sign(x) + y


JUMPS = {
    "sign": jnp.sign,
    "heaviside": lambda x: jnp.heaviside(x, 0.5),
    "sign times a number": lambda x: jnp.sign(x) * x[::-1],
    "size by a sign": lambda x: jnp.sign(x) * x,
    "comparison times a number": lambda x: (x > 0) * x[::-1],
    "numbers of truth values": lambda x: (x > 0).astype(float),
    "whole numbers of truth values": lambda x: (x > 0).astype(int) * x,
    "one of two functions": lambda x: jnp.where(x > 0, x + 1.0, 2.0 * x - 1.0),
    "one of two numbers": lambda x: jnp.where(x >= 0.3, 0.1, 0.3),
    "one of two smooth ones": lambda x: jnp.where(x > 0.1, jnp.log(x), 0.0),
    "one of two smooth ones below": lambda x: jnp.where(x > 0.1, 0.0, jnp.sqrt(0.2 - x)),
    "branches": lambda x: lax.cond(x[0] > 0, lambda x: x, lambda x: x[::-1] + 1.0, x),
    "branches of pairs": lambda x: jnp.stack(
        lax.cond(x[0] > 0, lambda x: (x[0], 1.0), lambda x: (x[1], 0.0), x)
    ),
    "select": lambda x: jnp.select([x < 0, x < 1], [x + 2, 3 * x], 0.5),
    "select of constants": lambda x: jnp.select([x < 0, x < 1], [2.0, 3.0], 0.5),
    "both hold": lambda x: ((x > 0) & (x < 1)) * 1.0,
    "one holds": lambda x: jnp.where((x > 0.5) | (x < -0.5), 1.0, x),
    "one alone holds": lambda x: jnp.where((x > 0.5) ^ (x[::-1] < 0.2), 1.0, x),
    "neither": lambda x: jnp.where(~((x > 0.5) | (x < -0.5)), 1.0, x),
    "all": lambda x: jnp.where(jnp.all(x > 0), x, -x),
    "any": lambda x: jnp.where(jnp.any(x > 0), x + 1, -x),
    "how many": lambda x: jnp.sum(x > 0) * x,
    "round": lambda x: jnp.round(jnp.clip(x, -1, 1) / 0.25) * 0.25,
    "round to digits": lambda x: jnp.round(jnp.clip(x, -1, 1), 1),
    "floor": lambda x: jnp.floor(2.0 * jnp.clip(x, -1, 1)),
    "ceil": lambda x: jnp.ceil(2.0 * jnp.clip(x, -1, 1)) * x,
    "round away": lambda x: lax.round(2.0 * jnp.clip(x, -1, 1)),
    "floor of anything": jnp.floor,
    "ceil of anything": lambda x: jnp.ceil(3.0 * x),
    "round of anything": lambda x: jnp.round(3.0 * x),
    "whole quotient": lambda x: jnp.clip(x, -1, 1) // 0.3,
    "remainder": lambda x: jnp.clip(x, -1, 1) % 0.3,
    "remainder of the sign of the number": lambda x: jnp.fmod(jnp.clip(x, -1, 1), 0.3),
    "entries by whole numbers": lambda x: T[jnp.clip(x[0] + 1.0, 0.0, 2.0).astype(int)] * x,
    "argmax": lambda x: T[jnp.argmax(W @ x)] * jnp.ones(1),
    "argmin": lambda x: T[jnp.argmin(W @ x)] * x,
    "argmax of two": lambda x: T[jnp.argmax(x)] * x,
    "rows of a table": lambda x: ROWS[jnp.argmax(W @ x)],
    "taken rows": lambda x: jnp.take(ROWS, jnp.argmax(W @ x), axis=0),
    "one hot": lambda x: jax.nn.one_hot(jnp.argmax(W @ x), 3) @ ROWS,
    "one hot of numbers": lambda x: (jax.nn.one_hot(jnp.argmax(W @ x), 3) @ (W @ x))[None],
    "the chosen number": lambda x: (W @ x)[jnp.argmax(W @ x)][None],
    "whole results": lambda x: jnp.argmax(W @ x)[None] + 1,
    "half of a whole number": lambda x: (jnp.argmax(W @ x) // 2)[None] * x,
    "switch": lambda x: lax.switch(jnp.argmax(W @ x), [jnp.sin, lambda x: 2 * x, jnp.negative], x),
    "argmax of rows": lambda x: (jnp.argmax(W * x, axis=0) == 1) * x,
    "table of parameters": Partial(lambda t, x: t[jnp.argmax(W @ x)] * x, T),
    "where of parameters": Partial(lambda t, x: jnp.where(x > t[0] - 0.9, t[1], t[2] * x), T),
    "masks in a scan": lambda x: lax.scan(
        lambda c, m: (jnp.where(m[0], c + 1.0, c - m[1]), c), 0.0, (x > 0, x)
    )[0] * x,
    "actions in a scan": lambda x: lax.scan(
        lambda c, w: (c + T[jnp.argmax(w * x)], c), 0.0, W
    )[0] * x,
    "entries of a table": lambda x: T[(x > 0).astype(int)] * x,
    "entries of what is given": lambda x: (W @ x)[(x > 0).astype(int)],
    "rows of a table by each": lambda x: ROWS[(x > 0).astype(int)].ravel(),
    "a function of the name of one of JAX": lambda x: jax.jit(hypot)(x[0], x[1])[None],
    "relative to large numbers": lambda x: jnp.where(x > 1e6, 2 * x - 2e6, x - 1e6 + 1e-6),
    "smooth functions": lambda x: jnp.where(x > 0, jnp.cos(x), jnp.tanh(x)),
    "not rational": lambda x: jnp.where(x > 1, jnp.exp(x), jnp.exp(2 * x - 1)),
    "by another number": lambda x: jnp.where(x[::-1] > 0, 2 * x, x),
    "by a learned threshold": Partial(lambda s, x: jnp.where(x > s, x, 0.0), 0.1),
    "equal": lambda x: jnp.where(x == 0.25, 2.0, x),
    "signs beside numbers": lambda x: jnp.concatenate([jnp.sign(x), x, x > 0.5]),
    "a place beside a number": lambda x: jnp.array([jnp.argmax(W @ x), 2]) * x,
    "stacked truth values turned": lambda x: (~bits(x).astype(int)) * x,
    "stacked truth values as numbers": lambda x: (2 * bits(x).astype(int) + 1) * x,
    "entries by stacked truth values": lambda x: T[bits(x).astype(int)] * x,
    "the first that holds": lambda x: T[jnp.argmax(bits(x).astype(int))] * x,
    "the last that holds": lambda x: T[jnp.argmax(jnp.cumsum(bits(x).astype(int)))] * x,
    "a place moved": lambda x: lax.switch(
        jnp.argmax(W @ x) - 1, [jnp.sin, lambda x: 2 * x, jnp.negative], x
    ),
    "one that always holds": lambda x: jnp.select([jnp.array(True), x[0] > 0], [1.0, 2.0], 3.0) * x,
    "branches of comparisons": lambda x: jnp.where(
        lax.cond(x[0] > 0, lambda x: x[1] > 0, lambda x: x[1] > 0.5, x), x, -x
    ),
    "a truth value and a place": lambda x: ((x[0] > 0).astype(int) == jnp.argmax(x)) * x,
    "a number times signs": lambda x: x[0] * jnp.sign(x),
    "all products with signs": lambda x: jnp.outer(jnp.sign(x), x).ravel(),
    "a column by a row": lambda x: (x[:, None] * jnp.sign(x)[None]).ravel(),
    "a sign times signs": lambda x: jnp.sign(x[0]) * jnp.sign(x),
    "branches of signs": lambda x: lax.cond(x[0] > 0, jnp.negative, jnp.sign, x),
    "thresholds that were chosen": lambda x: jnp.where(x[0] > T[jnp.argmax(W @ x)], x, -x),
    "a relay with hysteresis": lambda x: jnp.where(x[0] > jnp.where(x[1] > 0, -0.1, 0.1), 1.0, -1.0)
    * x,
    "places among bounds": lambda x: jnp.searchsorted(jnp.array([-0.5, 0.1, 0.7]), x) * x,
    "counts in eight bits": lambda x: jnp.sum(x > 0, dtype=jnp.uint8) * x,
}  # fmt: skip

REFUSED = {
    "counts below none": lambda x: (jnp.uint8(1) - jnp.sum(x > 0, dtype=jnp.uint8)) * x,
    "counts that are turned": lambda x: -jnp.sum(x > 0, dtype=jnp.uint8) * x,
    "products of eight bits": lambda x: (jnp.sum(x > 0, dtype=jnp.int8) * jnp.int8(100)) * x,
    "sums of eight bits": lambda x: jnp.sum(
        jnp.where(x > 0, jnp.int8(100), jnp.int8(0)), dtype=jnp.int8
    ) * x,
    "products of 64 bits": lambda x: (jnp.sum(x > 0) * 2**62) * x,
    "counts beside others": lambda x: T[
        jnp.argmax(jnp.append(jnp.cumsum(bits(x).astype(int)), 1))
    ] * x,
    "counts as truth values": lambda x: T[
        jnp.argmax(jnp.cumsum(bits(x).astype(int)).astype(bool))
    ] * x,
    "products of truth values": lambda x: (bits(x) @ jnp.array([True, True])) * x,
    "truth values by a matrix of them": lambda x: (
        jnp.array([[True, False], [True, True]]) @ bits(x)
    ) * x,
    "sums of products of truth values": lambda x: jnp.einsum("i,i->", bits(x), x > 0.1) * x,
    "bits of any number": lambda x: lax.reduce_or(jnp.where(bits(x), jnp.array([1, 2]), 0), (0,))
    * x,
    "bits of all numbers": lambda x: lax.reduce_and(jnp.where(bits(x), 2, 1), (0,)) * x,
    "cases by a parameter": Partial(lambda t, x: jnp.where(t[jnp.argmax(W @ x)] > 0, x, -x), T),
    "a condition of a parameter": Partial(
        lambda t, x: jnp.select([x[0] > 0, t[0] > 0], [1.0, 2.0], 3.0) * x, T
    ),
}  # fmt: skip


REASONS = (
    r"cannot be certified: .*(range of|counting|parameter|too large|truth values JAX|bit by bit)"
)

BY_COUNTS = {
    "a case": lambda x: lax.select_n(jnp.sum(x > 0), 0.5 * x, 0.9 * x, 1.5 * x),
    "constants": lambda x: lax.select_n(jnp.sum(x > 0), T, 2 * T, 3 * T)[:2] * x,
    "a case of each entry": lambda x: lax.select_n(
        jnp.full(2, jnp.sum(x > 0) + jnp.sum(x > 1)), x, -x, x, x, x
    ),
}


@pytest.mark.parametrize("name", JUMPS)
def test_functions_that_jump_are_sound(name):
    assert_sound(JUMPS[name])


ON = np.array([[0.0, 0.0], [0.3, 0.3], [-0.0, 0.5], [0.25, -0.25], [1.0, 1.0]])
BESIDE = np.concatenate([ON, np.nextafter(ON, np.inf), np.nextafter(ON, -np.inf)])


@pytest.mark.parametrize("name", JUMPS)
def test_values_on_the_surfaces_are_within_the_bounds_of_a_point(name):
    function = JUMPS[name]
    net = network(function)
    expected = np.asarray(jax.vmap(function)(BESIDE))
    for x, value in zip(BESIDE, expected, strict=True):
        low, high = interval(net, x, x)
        slack = 1e-13 * (1 + abs(value))
        assert np.all((low - slack <= value) & (value <= high + slack)), (x, low, value, high)


@pytest.mark.parametrize("name", REFUSED)
def test_what_would_be_read_otherwise_than_it_is_computed_is_refused(name):
    with pytest.raises(TypeError, match=REASONS):
        network(REFUSED[name])


@pytest.mark.parametrize("name", BY_COUNTS)
def test_a_case_is_not_chosen_by_a_count(name):
    """It depends on inputs, and is no decision whose cases are listed."""
    with pytest.raises(TypeError, match="it chooses by a number that depends on inputs"):
        network(BY_COUNTS[name])


def test_a_remainder_is_by_a_plain_number():
    with pytest.raises(TypeError, match="the remainder by a number that depends on inputs"):
        network(lambda x: jnp.fmod(x, 1.0 + x**2))


def test_known_and_traced_tables_are_gated_by_the_same_events():
    net = network(Partial(lambda t, x: t[jnp.argmax(W @ x)] * x, jnp.array([1.0, 0.0, 3.0])))

    def gates(net, x):
        found = []
        net.propagate(x, lambda unit, *y: found.append(unit(*y)) or found[-1])
        return found

    for x in np.array([[1.0, 0.2], [-1.0, 0.5], [0.3, 1.0], [0.5, -1.0]]):
        pairs = zip(gates(in_numpy(net), x), jax.jit(gates)(net, x), strict=True)
        assert all(np.array_equal(*pair) for pair in pairs)


def test_switched_loops_are_simulated_alike_where_points_stand_for_one_another():
    gains = [[-0.2, -0.1], [0.3, -0.5], [0.1, 0.4]]
    nets = [rj.MLP.from_layers([(W, np.zeros(3)), ([[*gain, 0.2]], [0.1])]) for gain in gains]
    policy = rj.Switched(nets, by=lambda x: jnp.argmax(W @ x))
    plant = rj.AffinePlant([[1.0, 0.2], [0.0, 1.0]], [[0.1], [0.5]])
    loop = rj.ClosedLoop(plant, policy)
    states = points()
    found = trajectories(in_numpy(loop), states, horizon=4)
    np.testing.assert_allclose(found, loop.simulate(states, 4), rtol=1e-12, atol=1e-13)
    for alone in (states[:1], states[:2]):  # one point, and branches that nobody takes
        few = trajectories(in_numpy(loop), alone, horizon=4)
        np.testing.assert_allclose(few, found[: len(alone)], rtol=1e-12, atol=1e-13)


def test_a_jump_that_is_small_is_in_the_bounds():
    net, near = network(lambda x: jnp.where(x > 0, x, x + 1e-14)), np.full(2, 1e-16)
    low, high = interval(net, -near, near)
    assert np.all(low <= near)
    assert np.all(high >= 1e-14 - near)
