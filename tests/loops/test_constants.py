"""What a function computes of constants and parameters alone is the same wherever it is used.

XLA rounds a function that is compiled as a whole in other ways than equation by equation; what is
certified, what is simulated, and what a user's own compiled code simulates see the same numbers.
"""

import flax.nnx as nnx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import reachjax as rj

STILL = rj.Network(lambda x: 0 * x, inputs=1, outputs=1)
D = 1e6 + 1e-3 * np.random.default_rng(0).normal(size=1000)
M = np.random.default_rng(1).normal(size=(5, 5))
F32, F16, B16 = jnp.float32, jnp.float16, jnp.bfloat16


def variance(d):
    """A variance in which digits cancel."""
    return jnp.mean(d**2) - jnp.mean(d) ** 2


def power_iteration(A):
    """An eigenvalue by fifty steps."""

    def step(v, _):
        w = A @ v
        return w / jnp.linalg.norm(w), None

    v, _ = jax.lax.scan(step, jnp.ones(len(A)), None, length=50)
    return v @ A @ v


def told_apart(x):
    """A reduction in 32 bits inside of a loop over what depends on the state."""
    return jax.lax.fori_loop(0, 3, lambda k, y: y + jnp.sum(jnp.full((100,), 0.1, F32)), x)


CONSTANTS = {
    "sum in 32 bits": lambda: jnp.sum(jnp.full((1000,), 0.1, F32)),
    "mean in 32 bits": lambda: jnp.mean(jnp.arange(7, dtype=F32) / 7),
    "digits that cancel in 32 bits": lambda: jnp.sum(jnp.array([1e8, 1.0, -1e8], F32)),
    "sum in 16 bits": lambda: jnp.sum(jnp.full((1000,), 0.1, F16)),
    "products in bfloat16": lambda: jnp.prod(jnp.full((9,), 1.1, B16)),
    "variance": lambda: variance(jnp.asarray(D)),
    "product of matrices in 32 bits": lambda: jnp.sum(jnp.asarray(M, F32) @ jnp.asarray(M, F32)),
    "determinant": lambda: jnp.linalg.det(jnp.asarray(M)),
    "softmax": lambda: jax.nn.softmax(jnp.asarray(D) * 1e-6)[3],
    "exponentials in 32 bits": lambda: jnp.sum(jnp.exp(jnp.arange(50, dtype=F32) / 7)),
    "eigenvalue": lambda: power_iteration(jnp.asarray(M @ M.T)),
    "sum of sines": lambda: jnp.sum(jnp.sin(jnp.arange(300.0))),
    "relu of a number": lambda: jax.nn.relu(0.5),
    "relu6 of a number": lambda: jax.nn.relu6(0.5),
    "logarithm of a sum of numbers": lambda: jnp.logaddexp(0.5, 1.0),
}

PARAMETERS = {
    "variance": variance,
    "standard deviation": jnp.std,
    "norm": jnp.linalg.norm,
    "softmax": lambda d: jax.nn.softmax(d)[3] * 1e3,
    "logarithm of a sum": jax.nn.logsumexp,
    "sum in 32 bits": lambda d: jnp.sum(d.astype(F32)).astype(float),
}


def assert_simulated(plant, compiled=True):
    """The certified set of one step from a point, against all ways to simulate it."""
    loop = rj.ClosedLoop(plant, STILL)
    X0, x = rj.Box([1.0], [1.0]), jnp.array([1.0])
    region = rj.reach(loop, X0, 1, rj.Template.box(1), rj.LinearBounds()).sets[1]
    found = [loop.simulate(x, 1)[1], jax.device_get(loop).step(np.asarray(x), 0)]
    if compiled:
        found.append(jax.jit(lambda x: loop.simulate(x, 1)[1])(x))
    for state in found:
        assert np.all(region.A @ np.asarray(state) <= region.b), (state, region.b)


@pytest.mark.parametrize("name", CONSTANTS)
@pytest.mark.costly
def test_constants_are_rounded_once(name):
    constant = CONSTANTS[name]
    assert_simulated(rj.NonlinearPlant(lambda x, u: x * constant(), states=1, inputs=1))


@pytest.mark.parametrize("name", PARAMETERS)
def test_what_parameters_make_is_rounded_once(name):
    made = PARAMETERS[name]
    function = Partial(lambda d, x, u: x * made(d), jnp.asarray(D))
    assert_simulated(rj.NonlinearPlant(function, states=1, inputs=1))


@pytest.mark.parametrize(
    "function",
    [
        told_apart,
        lambda x: jax.lax.scan(lambda c, k: (c + jnp.sum(k * jnp.arange(9, dtype=F32)), c), x[0],
                               jnp.arange(4, dtype=F32) / 7)[1][-1:],
        lambda x: jax.lax.cond(True, lambda y: y * jnp.mean(jnp.arange(7, dtype=F32) / 7),
                               lambda y: y, x),
        jax.jit(lambda y: y + jnp.sum(jnp.full((1000,), 0.1, F32))),
        jax.checkpoint(lambda y: y + jnp.sum(jnp.full((1000,), 0.1, F32))),
        jax.vmap(lambda y: y + jnp.sum(jnp.full((1000,), 0.1, F32))),
    ],
    ids=["fori_loop", "scan", "cond", "jit", "checkpoint", "vmap"],
)  # fmt: skip
def test_constants_inside_of_loops_calls_and_branches_are_rounded_once(function):
    plant = rj.NonlinearPlant(lambda x, u: jnp.asarray(function(x), float), states=1, inputs=1)
    assert_simulated(plant)


HUNDRED = {
    "whole numbers of a call": jax.jit(lambda d: jnp.sum(d).astype(int)),
    "truth values of a call": jax.jit(lambda d: jnp.where(jnp.sum(d) >= 100, 1, 2)),
    "a branch": lambda d: jax.lax.cond(
        True, lambda d: jnp.floor(jnp.sum(d)).astype(int), lambda d: 0, d
    ),
    "a condition": lambda d: jax.lax.while_loop(
        lambda k: k < jnp.sum(d) - F32(98.9995), lambda k: k + 1, 0
    ),
}


@pytest.mark.parametrize("name", HUNDRED)
def test_what_rounding_decides_is_decided_once(name):
    made = HUNDRED[name]
    d = jnp.full((1000,), 0.1, F32)
    assert_simulated(rj.NonlinearPlant(lambda x, u: x * made(d), states=1, inputs=1))


def counted(x):
    """Turns, as many as rounding decides, beside what depends on the state."""
    return jax.lax.while_loop(
        lambda c: c[0] < jnp.sum(jnp.full((1000,), 0.1, F32)) - F32(98.9995),
        lambda c: (c[0] + 1, 2 * c[1]),
        (0, x),
    )[1]


def test_a_condition_beside_states_is_rounded_once():
    assert_simulated(rj.NonlinearPlant(lambda x, u: counted(x), states=1, inputs=1))


KNOWN_OF_REAL_NUMBERS = {
    "branches": lambda p, x: jax.lax.cond(
        jnp.isfinite(x[0]), lambda: x * (p * 1.7), lambda: x * (p * 0.1)
    ),
    "no NaN": lambda p, x: x * (jnp.where(x == x, p, 0.0) * p) + x * (p * 1.7),
    "no infinity": lambda p, x: x * (jnp.where(x < jnp.inf, p, 0.0) * p) + x * (p * 1.7),
}


@pytest.mark.parametrize("name", KNOWN_OF_REAL_NUMBERS)
@pytest.mark.costly
def test_what_only_the_recording_knows_to_be_constant_takes_no_other_constants(name):
    """One reader takes one branch, the other both: each has its own numbers of parameters."""
    function = Partial(lambda p, x, u: KNOWN_OF_REAL_NUMBERS[name](p, x), jnp.array(0.7))
    loop = rj.ClosedLoop(rj.NonlinearPlant(function, states=1, inputs=1), STILL)
    X0, template = rj.Box([0.5], [1.0]), rj.Template.box(1)

    def bounds(loop):
        return rj.reach(loop, X0, 1, template, rj.LinearBounds()).sets[1].b

    ends = jax.vmap(lambda x: loop.simulate(x, 1)[1, 0])(jnp.array([[1.0], [0.5]]))
    expected = ends * jnp.array([1.0, -1.0])
    for found in (bounds(loop), jax.jit(bounds)(loop)):
        np.testing.assert_allclose(found, expected, rtol=1e-9)


FOUND_OUT = {
    "equal to itself": lambda p, x: jnp.where(x == x, p, 0.0) * p - 0.01,
    "finite": lambda p, x: jnp.where(jnp.isfinite(x), p, 0.0) * p - 0.01,
    "a branch": lambda p, x: jax.lax.cond(jnp.isfinite(x[0]), lambda: p, lambda: 0.0) * p - 0.01,
    "of numbers alone": lambda p, x: jnp.where(x == x, 0.1, 0.0) * 0.1 - 0.01,
    "twice": lambda p, x: (p + jnp.where(x < jnp.inf, p, 0.0)) * p - 0.02,
}
"""What only a reading of real numbers finds to be constant, with digits that cancel."""


@pytest.mark.parametrize("name", FOUND_OUT)
def test_what_is_found_to_be_constant_is_rounded_like_what_varies(name):
    made = FOUND_OUT[name]
    function = Partial(lambda p, x, u: x + 1e17 * made(p, x), jnp.array(0.1))
    assert_simulated(rj.NonlinearPlant(function, states=1, inputs=1))


def test_barriers_and_literals_are_passed_on():
    assert_simulated(
        rj.NonlinearPlant(lambda x, u: sum(jax.lax.optimization_barrier((x, u))), 1, 1)
    )


@pytest.mark.costly
def test_constants_of_parameters_have_derivatives():
    def bound(d):
        plant = rj.NonlinearPlant(
            Partial(lambda d, x, u: x * jnp.mean(d**2) + jnp.sin(x) * jnp.std(d), d), 1, 1
        )
        X0, template = rj.Box([1.0], [2.0]), rj.Template.box(1)
        return (
            rj.reach(rj.ClosedLoop(plant, STILL), X0, 2, template, rj.LinearBounds()).sets[2].b[0]
        )

    d, step = jnp.array([0.3, 0.2, 0.5]), 1e-6
    moved = [(bound(d + step * e) - bound(d - step * e)) / (2 * step) for e in jnp.eye(3)]
    np.testing.assert_allclose(jax.grad(bound)(d), moved, rtol=1e-7)
    np.testing.assert_allclose(jax.jit(jax.grad(bound))(d), moved, rtol=1e-7)


SCANNED = {
    "as numbers": lambda x: jax.lax.map(lambda m: m.astype(float), x > 0),
    "times numbers": lambda x: jax.lax.map(lambda m: m * 2.0, x > 0),
    "summed": lambda x: jax.lax.scan(lambda c, m: (c + m, c), 0.0, x > 0)[1],
    "indexed": lambda x: (x > 0)[:1].astype(float),
    "reversed": lambda x: jax.lax.rev(x > 0, (0,)).astype(float),
    "stacked": lambda x: jnp.concatenate([x > 0])[:1].astype(float),
    "reshaped": lambda x: (x > 0).reshape(1, 1)[0].astype(float),
}


@pytest.mark.parametrize("name", SCANNED)
def test_a_comparison_is_the_number_that_it_is_in_jax(name):
    plant = rj.NonlinearPlant(lambda x, u: SCANNED[name](x), states=1, inputs=1)
    loop, template = rj.ClosedLoop(plant, STILL), rj.Template.box(1)
    for X0 in (rj.Box([-1.0], [-0.5]), rj.Box([0.5], [1.0]), rj.Box([-1.0], [2.0])):
        upper, lower = rj.reach(loop, X0, 1, template, rj.LinearBounds()).sets[1].b
        values = np.asarray([SCANNED[name](end) for end in (X0.lower, X0.upper)], float)
        assert -lower <= values.min() <= values.max() <= upper
        assert upper + lower <= np.ptp(values) + 1e-9


def test_a_comparison_as_numbers_of_32_bits_is_refused():
    def step(x, u):
        return jax.lax.map(lambda m: m.astype(F32), x > 0).astype(float)

    with pytest.raises(TypeError, match="it rounds to float32"):
        rj.NonlinearPlant(step, states=1, inputs=1)


class Normalised(nnx.Module):
    """A network with a layer that keeps means of what it was given."""

    def __init__(self):
        rngs = nnx.Rngs(0)
        self.first, self.last = nnx.Linear(2, 4, rngs=rngs), nnx.Linear(4, 1, rngs=rngs)
        self.normal = nnx.BatchNorm(4, rngs=rngs)

    def __call__(self, x):
        return self.last(nnx.relu(self.normal(self.first(x))))


def test_a_module_in_training_mode_is_refused():
    network = Normalised()
    with pytest.raises(ValueError, match="evaluation mode"):
        rj.Network(network, inputs=2, outputs=1)
    network.eval()
    x = jnp.array([0.3, -0.2])
    np.testing.assert_allclose(rj.Network(network, inputs=2, outputs=1)(x), network(x), rtol=1e-12)
