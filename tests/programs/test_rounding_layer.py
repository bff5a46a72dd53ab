"""Rounding is a layer: without it numbers are the same but for rounding, and none of it stays."""

import itertools
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.numerics.rounding import gamma, is_counted, rounding
from reachjax.programs.affine_steps import step_columns
from reachjax.programs.unrolled import unrolled_at_once
from tests.networks import directions
from tests.programs.test_merging import pendulum


def cart(x, u):
    s, c = jnp.sin(x[2]), jnp.cos(x[2])
    push = (u[0] + 0.05 * x[3] ** 2 * s) / 1.1
    turn = (9.8 * s - c * push) / (0.5 * (4 / 3 - 0.1 * c**2 / 1.1))
    return x + 0.02 * jnp.array([x[1], push - 0.05 * turn * c / 1.1, x[3], turn])


def loop_of(kind):
    if kind == "pendulum":
        return pendulum()
    rng, n = np.random.default_rng(3), 4 if kind == "cart-pole" else 3
    layers = [(0.5 * rng.normal(size=(5, n)), 0.1 * rng.normal(size=5))]
    layers += [(0.5 * rng.normal(size=(1, 5)), np.zeros(1))]
    activation = rj.ReLU() if kind == "relu" else rj.Sigmoid()
    net = rj.MLP.from_layers(layers, activation=activation)
    if kind == "cart-pole":
        plant = rj.NonlinearPlant(cart, states=4, inputs=1)
    else:
        plant = rj.AffinePlant(0.5 * rng.normal(size=(n, n)), rng.normal(size=(n, 1)))
    X0 = rj.Box(np.full(n, -0.1), np.full(n, 0.2))
    if kind == "ellipsoid":
        return rj.ClosedLoop(plant, net), rj.Ellipsoid(np.zeros(n), 0.01 * np.eye(n))
    box = rj.Box([-0.2], [0.1]) if kind == "relu" else None
    return rj.ClosedLoop(plant, net, box), X0


KINDS = ["pendulum", "relu", "ellipsoid", pytest.param("cart-pole", marks=pytest.mark.costly)]


@pytest.mark.parametrize("kind", KINDS)
def test_sets_without_rounding_are_the_certified_ones_but_for_rounding(kind):
    loop, X0 = loop_of(kind)
    rows = np.broadcast_to(directions(loop.states), (5, *directions(loop.states).shape))

    def total(net, counted):
        given = loop.replace(controller=net), X0, X0.bounding_box(), rows
        found = unrolled_at_once(*given, counted=counted).offsets
        return found[-1].sum(), found

    values = jax.value_and_grad(total, has_aux=True)
    (_, proved), slopes = values(loop.controller, True)
    (_, plain), other = values(loop.controller, False)
    np.testing.assert_allclose(plain, proved, rtol=1e-9, atol=1e-9)
    for one, another in zip(jax.tree.leaves(slopes), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(another, one, rtol=1e-6, atol=1e-8)


def random_layers(rng, *sizes):
    return [
        (rng.normal(size=(k, n)) / np.sqrt(n), 0.1 * rng.normal(size=k))
        for n, k in itertools.pairwise(sizes)
    ]


def branches(parameters, x):
    """A controller of two branches, whose units are multiplied."""
    (W, b), (V, c) = parameters
    y, z = jnp.tanh(W @ x + b), jnp.maximum(V @ x + c, 0.0)
    return jnp.sum(y * jnp.maximum(z - 0.5 * y, 0.0), keepdims=True) - x[:1]


def of_products(rng):
    parameters = [random_layers(rng, 2, 3)[0] for _ in range(2)]
    return rj.Network(jax.tree_util.Partial(branches, jax.tree.map(jnp.asarray, parameters)), 2, 1)


OF_ONE_OUTPUT = {
    "three layers": lambda rng: rj.MLP.from_layers(random_layers(rng, 2, 5, 4, 3, 1)),
    "tanh": lambda rng: rj.MLP.from_layers(random_layers(rng, 2, 5, 4, 1), rj.Tanh()),
    "residual": lambda rng: rj.Residual(
        rj.MLP.from_layers([*random_layers(rng, 2, 4, 4, 1)]), rng.normal(size=(1, 2))
    ),
    "products": of_products,
}


@pytest.mark.parametrize("kind", OF_ONE_OUTPUT)
def test_few_columns_lose_nothing_of_one_input(kind):
    """What units of any kind leave out of one number is one column of it, however many they are."""
    rows = np.broadcast_to(directions(2), (3, *directions(2).shape))
    plant = rj.AffinePlant([[1.0, 0.1], [0.1, 0.9]], [[0.1], [0.3]])

    def offsets(columns, net, X0):
        given = rj.ClosedLoop(plant, net), X0, X0, rows
        return unrolled_at_once(*given, counted=False, columns=columns).offsets

    found = jax.jit(offsets, static_argnums=0, compiler_options=rj.compiler_options())
    for seed in range(4):
        rng = np.random.default_rng(seed)
        net, lower = OF_ONE_OUTPUT[kind](rng), rng.uniform(-0.5, 0.3, 2)
        X0 = rj.Box(lower, lower + rng.uniform(0.1, 0.5, 2))
        few = np.asarray(found(1000, net, X0))
        np.testing.assert_allclose(few, found(None, net, X0), rtol=1e-9, atol=1e-9)
        states = X0.sample(jax.random.key(seed), 200)
        runs = rj.ClosedLoop(plant, net).simulate(states, 3)[:, 1:]
        reached = np.einsum("cti,tmi->ctm", runs, rows).max(axis=0)
        assert (reached <= few + 1e-9).all()


@pytest.mark.parametrize("activation", [rj.ReLU(), rj.Tanh()])
def test_a_step_adds_few_columns_however_many_neurons_there_are(activation):
    plant = rj.AffinePlant(np.eye(2), [[0.0], [0.1]])
    for neurons in (3, 20):
        layers = random_layers(np.random.default_rng(0), 2, neurons, neurons, 1)
        loop = rj.ClosedLoop(plant, rj.MLP.from_layers(layers, activation))
        with rounding(False):
            assert step_columns(loop, few=True) == (1, 0)


def test_what_is_proved_within_a_scope_without_rounding_counts_it():
    """Whatever is compiled within such a scope is found again by those who prove."""
    loop, X0 = pendulum()
    rows = np.broadcast_to(directions(2), (3, *directions(2).shape))
    with rounding(False):
        within = unrolled_at_once(loop, X0, X0, rows).offsets
        assert not is_counted()
    plain = unrolled_at_once(loop, X0, X0, rows, counted=False).offsets
    np.testing.assert_array_equal(within, unrolled_at_once(loop, X0, X0, rows).offsets)
    assert (within >= plain).all()
    assert (within > plain).any()


def test_rounding_counts_again_after_an_error():
    with pytest.raises(ZeroDivisionError), rounding(False):
        raise ZeroDivisionError
    assert is_counted()
    assert gamma(1) > 0


def test_penalties_without_rounding_have_no_bits_in_their_graph():
    """Nor seals, nor certificates: a step of training is for numbers alone."""
    loop, X0 = pendulum()
    goal = rj.Box([-0.01, -0.01], [0.01, 0.01])

    def penalty(net):
        given = loop.replace(controller=net), X0, 5, rj.Template.box(2)
        return rj.specification_penalty(*given, goal=goal)

    text = str(jax.make_jaxpr(jax.grad(penalty))(loop.controller))
    assert "bitcast" not in text
    assert "callback" not in text


@pytest.mark.parametrize("first", [True, False])
def test_what_is_compiled_in_one_scope_does_not_serve_the_other(first):
    """However deep it is, and whoever asks for it first."""
    inner = jax.jit(lambda x: x + gamma(5) * 1e16)
    outer = jax.jit(lambda x: 2.0 * inner(x))

    def found(counted, within=True):
        with rounding(within), rounding(counted):
            return [float(each(1.0)) for each in (inner, outer)]

    for counted in (first, not first, first):
        for within in (first, not first):
            once, twice = found(counted, within)
            assert (once > 1.5, twice > 3.0) == (counted, counted)


def exactly(rows):
    return [[Fraction(float(entry)) for entry in row] for row in np.asarray(rows)]


@pytest.mark.parametrize("kind", ["box", "ellipsoid"])
def test_supports_that_were_asked_for_without_rounding_are_rounded_later(kind):
    """What is compiled is kept: whoever asks first must not decide what it is worth."""
    rng = np.random.default_rng(11)
    rows, center = rng.normal(size=(23, 3)), rng.normal(size=3)
    X = rj.Box(center - 0.5, center + 0.5) if kind == "box" else rj.Ellipsoid(center, np.eye(3))
    with rounding(False):
        X.support(rows)
    for row, value in zip(exactly(rows), np.asarray(X.support(rows)).tolist(), strict=True):
        if kind == "box":
            both = zip(row, *exactly((X.lower, X.upper)), strict=True)
            ends = [max(a * lower, a * upper) for a, lower, upper in both]
            assert Fraction(value) >= sum(ends)
        else:
            (middle,) = exactly(X.center[None])
            room = Fraction(value) - sum(a * b for a, b in zip(row, middle, strict=True))
            assert room >= 0
            assert room**2 >= sum(a * a for a in row)


DRAWN = {
    "ellipsoid": lambda size: rj.Ellipsoid(np.zeros(2), 0.01 * size * jnp.eye(2)),
    "intersection": lambda size: rj.Intersection(
        rj.Polytope([[1.0, 0.0], [0.0, 1.0], [-1.0, -1.0]], size * jnp.full(3, 0.05)),
        rj.Ellipsoid(np.zeros(2), 0.01 * jnp.eye(2)),
    ),
}


@pytest.mark.parametrize("kind", DRAWN)
@pytest.mark.costly
def test_penalties_of_loops_with_sets_of_noise(kind):
    """Of any kind of set, and compiled the same as not, up to rounding."""
    rng = np.random.default_rng(5)
    layers = [(0.3 * rng.normal(size=(3, 2)), np.zeros(3)), (0.3 * rng.normal(size=(1, 3)), [0.1])]
    plant = rj.AffinePlant([[0.9, 0.1], [0.0, 0.8]], [[0.0], [1.0]])
    loop = rj.ClosedLoop(plant, rj.MLP.from_layers(layers), noise=DRAWN[kind](1.0))
    X0, safe = rj.Box([-0.1, -0.1], [0.1, 0.1]), rj.Box([-0.12, -0.05], [0.12, 0.05])

    def penalty(loop):
        return rj.specification_penalty(loop, X0, 2, rj.Template.box(2), safe=safe)

    np.testing.assert_allclose(jax.jit(penalty)(loop), penalty(loop), rtol=1e-9)
