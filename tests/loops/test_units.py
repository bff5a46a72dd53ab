"""What units say of themselves holds: values, intervals, lines and facts, rounding included."""

from fractions import Fraction
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import reachjax as rj
from reachjax.loops.units import Mark
from tests.activations import ACTIVATIONS, UNITS

exactly = np.vectorize(Fraction, otypes=[object])
POINTS = np.concatenate([np.linspace(-3, 3, 601), [1e-300, -1e-300, 1e200, -1e200]])


def intervals():
    """Ends of intervals: of all sizes and signs, of no width, and with an end at zero."""
    rng = np.random.default_rng(0)
    ends = np.sort(rng.normal(size=(400, 2)) * 10.0 ** rng.uniform(-12, 12, size=(400, 2)), axis=1)
    near = rng.normal(size=50)
    thin = np.stack([near, np.nextafter(near, np.inf)], axis=1)
    points, zero = np.stack([near, near], axis=1), np.zeros((1, 2))
    touching = [[0.0, 2.0], [-2.0, 0.0], [-1e-9, 1.0], [-1.0, 1e-9], [-1.0, 1.0]]
    return np.concatenate([ends, thin, points, zero, touching]).T


def inside(lower, upper):
    """Exact numbers (9, k) of these intervals, both ends among them, and zero where it is one."""
    low, high = exactly(lower), exactly(upper)
    between = [low + (high - low) * Fraction(i, 7) for i in range(8)]
    return np.stack([*between, np.clip(exactly(np.zeros(len(low))), low, high)])


@pytest.mark.parametrize("activation", ACTIVATIONS, ids=str)
def test_values_are_those_of_the_function(activation):
    np.testing.assert_allclose(activation(POINTS), ACTIVATIONS[activation](POINTS), atol=1e-15)


@pytest.mark.parametrize("unit", UNITS, ids=str)
def test_intervals_hold_every_value(unit):
    ends = intervals()
    lower, upper = map(exactly, unit.interval(*map(jnp.asarray, ends)))
    values = UNITS[unit](inside(*ends))
    assert np.all(lower <= values)
    assert np.all(values <= upper)


@pytest.mark.parametrize("compiled", [False, True], ids=["plain", "compiled"])
@pytest.mark.parametrize("unit", UNITS, ids=str)
@pytest.mark.costly
def test_lines_are_below_and_above_every_value_and_coincide_where_the_unit_is_affine(
    unit, compiled
):
    ends = intervals()
    lines = (jax.jit(unit.lines) if compiled else unit.lines)(*map(jnp.asarray, ends))
    y = inside(*ends)
    below, above = (exactly(slope) * y + exactly(offset) for slope, offset in lines)
    values = UNITS[unit](y)
    assert np.all(below <= values)
    assert np.all(values <= above)
    affine = np.asarray(lines.affine)
    assert np.all(below[:, affine] == values[:, affine])
    assert 0 < affine.sum() < len(affine)
    assert np.all(abs(lines.above.slope[affine]) <= 1)
    # of an interval across zero neither line leaves out more than the other's end
    assert np.all((above - below).max(axis=0) <= exactly(ends[1] - ends[0]) * Fraction(1.001))


@pytest.mark.parametrize("unit", UNITS, ids=str)
def test_facts_are_not_negative_and_complementarities_are_zero(unit):
    lower, upper = intervals()
    for y in inside(lower, upper).astype(float):
        facts = unit.facts(y, np.asarray(unit(y)), lower, upper)
        size = 1e-15 * np.maximum(abs(lower), abs(upper))
        for block in facts.blocks:
            assert np.all(block.rows >= -size), block.name
        for left, right in facts.zero:
            assert np.all(abs(facts[left] * facts[right]) <= size * abs(y))


@pytest.mark.parametrize("unit", UNITS, ids=str)
def test_without_bounds_and_with_them_the_facts_leave_one_value(unit):
    """The complementarities determine `z`: no other value has facts that are not negative."""
    y = np.array([-2.0, -0.3, 0.4, 1.5])
    for off in (-0.1, 0.1):
        facts = unit.facts(y, UNITS[unit](y) + off, np.full(4, -3.0), np.full(4, 3.0))
        sectors = [block.rows for block in facts.blocks if block.mark is Mark.SECTOR]
        broken = [facts[left] * facts[right] != 0 for left, right in facts.zero]
        assert np.all(np.any([*(rows < 0 for rows in sectors), *broken], axis=0))


@pytest.mark.parametrize("unit", UNITS, ids=str)
def test_products_and_complementarities_name_blocks_that_there_are(unit):
    facts = unit.facts(*jnp.zeros((2, 3)), -jnp.ones(3), jnp.ones(3))
    names = [block.name for block in facts.blocks]
    assert len(set(names)) == len(names)
    assert {name for pair in facts.zero for name in pair} <= set(names)
    assert {name for product in facts.products for name in product[:2]} <= set(names)


@pytest.mark.parametrize("unit", UNITS, ids=str)
def test_units_are_nonexpansive(unit):
    y = np.sort(np.random.default_rng(0).normal(size=1000))
    assert np.all(abs(np.diff(unit(y))) <= np.diff(y) * (1 + 1e-12))


def test_an_activation_is_the_structure_of_a_network_and_not_a_number_of_it():
    layers = [([[1.0]], [0.0]), ([[1.0]], [0.0])]
    nets = [rj.MLP.from_layers(layers, activation=a) for a in ACTIVATIONS]
    assert len({jax.tree.structure(net) for net in nets}) == len(nets)
    assert len(jax.tree.leaves(nets[1])) == 4
    one, other = (rj.MLP.from_layers(layers, activation=rj.LeakyReLU(0.1)) for _ in range(2))
    assert jax.tree.structure(one) == jax.tree.structure(other)


@pytest.mark.parametrize(
    ("slope", "error", "message"),
    [
        (1.0, ValueError, r"LeakyReLU\.slope must be below 1, but 1\.0 arrived"),
        (-0.1, ValueError, r"LeakyReLU\.slope must be finite and at least 0"),
        ("0.1", TypeError, r"LeakyReLU\.slope must be a number"),
    ],
)
def test_a_slope_that_is_none_is_refused(slope, error, message):
    with pytest.raises(error, match=message):
        rj.LeakyReLU(slope)


@pytest.mark.parametrize(
    ("function", "activation"),
    [
        (nnx.relu, rj.ReLU()),
        (nnx.leaky_relu, rj.LeakyReLU(0.01)),
        (partial(nnx.leaky_relu, negative_slope=0.3), rj.LeakyReLU(0.3)),
        (nnx.hard_tanh, rj.HardTanh()),
        (nnx.tanh, rj.Tanh()),
        (nnx.sigmoid, rj.Sigmoid()),
    ],
)
@pytest.mark.costly
def test_flax_functions_are_read_as_the_activation_that_computes_them(function, activation):
    first, last = (nnx.Linear(*sizes, rngs=nnx.Rngs(0)) for sizes in ((2, 5), (5, 1)))
    module = nnx.Sequential(first, function, last)
    net = rj.MLP.from_flax(module, activation=function)
    assert type(net.activation) is type(activation)
    x = 3 * np.random.default_rng(0).normal(size=(50, 2))
    np.testing.assert_allclose(jax.vmap(net)(x), module(x), rtol=1e-4, atol=1e-5)
    same = rj.MLP.from_flax(module, activation=activation)
    np.testing.assert_allclose(jax.vmap(same)(x), module(x), rtol=1e-4, atol=1e-5)


def test_a_function_that_is_no_activation_is_named():
    module = nnx.Sequential(nnx.Linear(2, 1, rngs=nnx.Rngs(0)))
    with pytest.raises(ValueError, match=r"what one of ReLU, HardTanh.* does, but .*softplus"):
        rj.MLP.from_flax(module, activation=nnx.softplus)
