"""Any JAX function is a network or a plant: its values, its units, and what it cannot contain."""

import equinox
import flax.linen
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import reachjax as rj
from reachjax.loops.batches import Batch
from reachjax.loops.units import ReLU, evaluate
from reachjax.numerics.rounding import Ball
from tests.loops.traced import on_batches

W = np.random.default_rng(0).normal(size=(3, 2))


def scanned(x):
    def step(carry, row):
        carry = jnp.tanh(carry + row @ x)
        return carry, carry

    return jnp.concatenate(jax.lax.scan(step, jnp.zeros(()), jnp.asarray(W))[1:])


FUNCTIONS = {
    "affine": lambda x: W @ x + 1.0,
    "entries": lambda x: jnp.stack([x[1], 2 * x[0] - x[1], jnp.flip(x)[0]]),
    "reshaped": lambda x: (jnp.outer(jnp.ones(3), x).T @ W).reshape(-1)[:3],
    "convolved": lambda x: jnp.convolve(x, jnp.array([1.0, -2.0])),
    "padded": lambda x: jnp.pad(x, (0, 1)) + jnp.cumsum(jnp.append(x, 1.0)),
    "products": lambda x: jnp.array([x[0] * x[1], x @ x, x[0] * x[0]]),
    "quadratic form": lambda x: jnp.array([x @ (W[:2] @ x), jnp.sum(x), jnp.mean(x * x)]),
    "powers": lambda x: jnp.array([x[0] ** 3, x[1] ** 4, (2 + x[0]) ** -2.0]),
    "roots": lambda x: jnp.array([jnp.sqrt(2 + x[0]), (3 + x[1]) ** 0.5, (2 + x[0]) ** 1.5]),
    "quotients": lambda x: jnp.array([x[0] / (2 + x[1]), 1 / (3 + x[0]), x[1] / 3]),
    "exponentials": lambda x: jnp.array([jnp.exp(x[0]), jnp.log(2 + x[1]), jnp.expm1(x[0])]),
    "logarithms": lambda x: jnp.array(
        [jnp.log1p(x[0] / 2), jnp.exp2(x[1]), jax.lax.rsqrt(2 + x[0])]
    ),
    "angles": lambda x: jnp.array([jnp.sin(x[0]), jnp.cos(x[1]), jnp.tan(x[0] / 2)]),
    "atan": lambda x: jnp.arctan(W @ x),
    "tanh": lambda x: jnp.tanh(W @ x),
    "logistic": lambda x: jax.nn.sigmoid(W @ x),
    "silu": lambda x: jax.nn.silu(W @ x),
    "gelu": lambda x: jax.nn.gelu(W @ x),
    "softplus": lambda x: jax.nn.softplus(W @ x),
    "relu": lambda x: jax.nn.relu(W @ x),
    "relu6": lambda x: jax.nn.relu6(5 * W @ x),
    "leaky": lambda x: jax.nn.leaky_relu(W @ x + 0.1),
    "clip": lambda x: jnp.clip(W @ x, -0.5, 0.5),
    "extremes": lambda x: jnp.array([jnp.max(x), jnp.minimum(x[0], x[1]), jnp.min(jnp.abs(x))]),
    "where": lambda x: jnp.where(W @ x < 0, -(W @ x), W @ x),
    "chosen": lambda x: jnp.where(jnp.array([True, False, True]), W @ x, 1.0),
    "norm": lambda x: jnp.append(jnp.zeros(2), jnp.linalg.norm(x + 2)),
    "scan": lambda x: jnp.append(scanned(x), 1.0)[:3],
    "constant": lambda x: jnp.ones(3),
    "jitted": jax.jit(lambda x: jnp.tanh(jax.jit(lambda y: W @ y)(x))),
    "mapped": lambda x: jax.vmap(lambda row: jnp.sin(row @ x))(jnp.asarray(W)),
}


@pytest.fixture(params=FUNCTIONS)
def traced(request):
    function = FUNCTIONS[request.param]
    return function, rj.Network(function, inputs=2, outputs=3)


def points(count=200):
    return np.random.default_rng(1).uniform(-1, 1, size=(count, 2))


def test_every_kind_of_number_has_the_values_of_the_function(traced):
    function, net = traced
    x = points()
    expected = jax.vmap(function)(x)
    np.testing.assert_allclose(jax.vmap(net)(x), expected, atol=1e-15)
    seen = jax.vmap(lambda x: net.propagate(x, lambda unit, *y: unit(*y)))(x)
    np.testing.assert_allclose(seen, expected, atol=1e-14)
    on_host = jax.device_get(net).propagate(Batch(x), on_batches)
    assert isinstance(on_host.values, np.ndarray)
    np.testing.assert_allclose(
        np.broadcast_to(on_host.values, expected.shape), expected, atol=1e-14
    )


@pytest.mark.costly
def test_intervals_hold_the_values(traced):
    function, net = traced
    middle, radius = np.array([0.2, -0.3]), np.array([0.3, 0.2])

    def unit(unit, *given):
        y = Ball.joined(given)
        return Ball.between(*unit.interval(y.lower, y.upper))

    found = net.propagate(Ball(jnp.asarray(middle), jnp.asarray(radius)), unit)
    values = jax.vmap(function)(middle + radius * points())
    assert np.all(found.lower <= values.min(axis=0))
    assert np.all(found.upper >= values.max(axis=0))
    assert np.isfinite(found.upper).all()


def flax_module():
    return nnx.Sequential(
        nnx.Linear(2, 4, rngs=nnx.Rngs(0)), nnx.tanh, nnx.Linear(4, 1, rngs=nnx.Rngs(1))
    )


def linen_function():
    module = flax.linen.Sequential([flax.linen.Dense(4), flax.linen.silu, flax.linen.Dense(1)])
    return jax.tree_util.Partial(module.apply, module.init(jax.random.key(0), jnp.zeros(2)))


def equinox_module():
    return equinox.nn.MLP(2, 1, 4, 2, activation=jax.nn.sigmoid, key=jax.random.key(0))


@pytest.mark.parametrize("made", [flax_module, linen_function, equinox_module])
@pytest.mark.costly
def test_modules_are_functions_whose_parameters_have_derivatives(made):
    module = made()
    net = rj.Network(module, inputs=2, outputs=1)
    x = points()
    np.testing.assert_allclose(jax.vmap(net)(x), jax.vmap(module)(x), atol=1e-6)
    slope = jax.grad(lambda net: net(x[0])[0])(net)
    leaves = jax.tree.leaves(slope)
    assert sum(leaf.size for leaf in leaves) > 12
    assert all(leaf.dtype == np.float64 for leaf in leaves)
    assert any(np.any(leaf != 0) for leaf in leaves)


def test_a_bend_with_traced_parameters_is_one_of_a_rectifier():
    net = rj.Network(
        jax.tree_util.Partial(
            lambda p, x: jax.nn.leaky_relu(p["W"] @ x + p["b"]), {"W": W, "b": W[:, 0]}
        ),
        inputs=2,
        outputs=3,
    )
    loop = rj.ClosedLoop(rj.AffinePlant(np.eye(2), np.ones((2, 3))), net)
    assert [(layer.unit, layer.size) for layer in loop.unit_layers] == [(ReLU(), 3)]
    jax.grad(lambda net: net.propagate(jnp.ones(2), lambda unit, *y: unit(*y)).sum())(net)


def cut(x):
    return x.astype(int) * 1.0


def rounded(x):
    return x.astype(jnp.float32)


def unknown(x):
    return jax.lax.lgamma(x)


def repeated(x):
    return jax.lax.while_loop(lambda x: x[0] < 5, lambda x: x + 1, x)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (cut, r"'convert_element_type' \(in cut, .*test_tracing\.py:\d+\).* clip these first"),
        (rounded, r"'convert_element_type' \(in rounded, .*rounds to float32"),
        (unknown, r"'lgamma' \(in unknown, .*test_tracing\.py:\d+\).* no bounds for it"),
        (repeated, r"'while' \(in repeated"),
    ],
)
def test_what_cannot_be_certified_is_named_with_its_line(function, message):
    with pytest.raises(TypeError, match=message):
        rj.Network(function, inputs=2, outputs=2)


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        ((3, 2, 1), TypeError, r"Network\.f must be a function, but 3 arrived"),
        ((lambda x: x, 0, 1), ValueError, r"Network\.inputs must be at least 1"),
        ((lambda x: x, 2), TypeError, r"Network\.outputs must be a whole number, but None"),
        (
            (lambda x: x, 2, 1),
            ValueError,
            r"Network\.f must return one array of shape \(1,\), .*but \(2,\) arrived",
        ),
        (
            (lambda x: x[0], 2, 1),
            ValueError,
            r"must return one array of shape \(1,\), .*but \(\) arrived",
        ),
        ((lambda x, y: x, 2, 2), ValueError, r"cannot be called with vectors of sizes \[2\]"),
        ((lambda x: W.T @ x, 2, 2), ValueError, r"cannot be called with vectors of sizes \[2\]"),
    ],
)
def test_a_function_of_another_shape_is_refused(given, error, message):
    with pytest.raises(error, match=message):
        rj.Network(*given)


def test_a_plant_is_a_function_of_state_and_input():
    plant = rj.NonlinearPlant(lambda x, u: x + u[0] * jnp.sin(x), states=2, inputs=1)
    x, u = jnp.array([0.3, -0.4]), jnp.array([0.5])
    np.testing.assert_allclose(plant.propagate(x, u), x + 0.5 * jnp.sin(x))
    seen = plant.propagate(x, u, 0, lambda unit, *y: unit(*y))
    np.testing.assert_allclose(seen, x + 0.5 * jnp.sin(x), atol=1e-15)
    assert (plant.states, plant.inputs, plant.steps) == (2, 1, None)
    assert repr(plant) == "NonlinearPlant(states=2, inputs=1)"
    with pytest.raises(
        ValueError, match=r"NonlinearPlant\.f must return one array of shape \(3,\)"
    ):
        rj.NonlinearPlant(lambda x, u: x[:2], states=3, inputs=1)
    with pytest.raises(ValueError, match=r"the controller's number of outputs is 2"):
        rj.ClosedLoop(plant, rj.Network(lambda x: x, 2, 2))


def test_functions_are_traced_when_they_are_given_and_differ_in_parameters():
    calls = []

    def function(p, x):
        calls.append(1)
        return p * x

    nets = [rj.Network(jax.tree_util.Partial(function, p), 2, 2) for p in (1.0, 2.0, 3.0)]
    before = len(calls)
    for net in nets:
        net.propagate(np.ones(2), lambda unit, *y: unit(*y))
    assert len(calls) == before == 3
    assert nets[1].replace().propagate(np.ones(2), evaluate)[0] == 2.0
