"""Choices by comparisons are continuous functions, exactly, or errors."""

from fractions import Fraction

import equinox
import flax.linen
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.loops.tracing.rationals import Rationals, evaluated
from reachjax.loops.units import Cos, Exp, Log, ReLU, Sin, Sqrt
from reachjax.numerics.rounding import Ball
from reachjax.programs.affine import AffineForms
from tests.loops.traced import assert_sound, interval, network

LOWER, UPPER = np.array([-2.0, -0.3]), np.array([1.5, 2.0])
Partial = jax.tree_util.Partial
S, T = jnp.array([1.0, -2.0]), jnp.array([0.5, 0.2])


def prelu():
    module = flax.linen.PReLU()
    return Partial(module.apply, module.init(jax.random.key(0), jnp.zeros(2)))


CONTINUOUS = {
    "leaky": lambda x: jnp.where(x <= 0, 0.1 * x, x),
    "steeper below": lambda x: jnp.where(-2 * x + 1 > 0, 3 * x, x + 1),
    "several slopes": lambda x: jnp.where(S * x > T, 2 * S * x - T, S * x),
    "of two numbers": lambda x: jnp.where(x[:1] + x[1:] > 1, x[:1] + 2 * x[1:] - 1, x[1:] + 0),
    "constants that are rounded": lambda x: jnp.where(x > 0.1, 4 * x - 0.3, x),
    "saturated": lambda x: jnp.where(x > 1, 1.0, x),
    "hard tanh": lambda x: jnp.where(x > 1, 1.0, jnp.where(x < -1, -1.0, x)),
    "nested": lambda x: jnp.where(x > 0, jnp.where(x > 1, 1.0, x), 0.0),
    "smooth above": lambda x: jnp.where(x > 0, jnp.tanh(x), 0.0),
    "smooth below": lambda x: jnp.where(x <= 0.5, 0.5 * x * x, 0.5 * x - 0.125),
    "smooth twice": lambda x: jnp.where(x > 0, jnp.sin(x), jnp.expm1(x) / 3),
    "opposite": lambda x: jnp.where(~(x > 0), -0.1 * x, x),
    "of another shape": lambda x: jnp.where((x > 0)[:, None], x[:, None], 2 * x[:, None])[:, 0],
    "of one entry": lambda x: jnp.where(x[0] > 0, x[:1], 2 * x[:1]),
    "a learned slope": Partial(lambda s, x: jax.nn.leaky_relu(x, s), 0.3),
    "learned slopes": Partial(lambda s, x: jnp.where(x >= 0, s[0] * x, s[1] * x), S),
    "learned slopes of equinox": equinox.nn.PReLU(0.2),
    "learned slopes of linen": prelu(),
}


@pytest.mark.parametrize("name", CONTINUOUS)
def test_continuous_choices_are_sound(name):
    assert_sound(CONTINUOUS[name], LOWER, UPPER)


def test_one_rectifier_is_enough():
    for function in (jax.nn.elu, CONTINUOUS["a learned slope"]):
        loop = rj.ClosedLoop(rj.AffinePlant(np.eye(2), np.eye(2)), rj.Network(function, 2, 2))
        assert [layer.unit for layer in loop.unit_layers].count(ReLU()) == 1


def test_a_learned_slope_has_a_derivative():
    net = rj.Network(Partial(lambda s, x: jax.nn.leaky_relu(x, s), 0.3), 2, 2)
    x = jnp.array([-1.0, 2.0])
    slope = jax.grad(lambda net: net.propagate(x, lambda unit, *y: unit(*y)).sum())(net)
    np.testing.assert_allclose(jax.tree.leaves(slope), [-1.0])


def test_what_rounded_constants_jump_by_is_in_the_bounds():
    """`4 fl(0.1) - fl(0.3) - fl(0.1)` is not zero."""
    net = network(CONTINUOUS["constants that are rounded"])
    low, _ = interval(net, 0.1 + 0 * UPPER, UPPER)
    assert np.all(low <= 0.1 - 6e-17)


def test_rational_values_of_units():
    y = Rationals.of(np.array([0.0, 1.0, 2.25, -1.0]))
    values = {
        unit: evaluated(unit, y).numbers for unit in (Exp(), Log(), Sqrt(), Sin(), Cos(), ReLU())
    }
    assert values[Exp()] == [1, None, None, None]
    assert values[Log()] == [None, 0, None, None]
    assert values[Sqrt()] == [0, 1, Fraction(3, 2), None]
    assert values[Sin()] == [0, None, None, None]
    assert values[Cos()] == [1, None, None, None]
    assert values[ReLU()] == [0, 1, Fraction(9, 4), 0]


def exactly(ball, k):
    mid, rad = Fraction(float(ball.mid[k])), Fraction(float(ball.rad[k]))
    return mid - rad, mid + rad


DIVIDED = np.array([3.0, 7.0, 49.0, 1.1, -10.0])


def kinds(x):
    """Numbers as a ball, and as affine forms, both of radius zero; and how to read these."""
    rows = np.stack([x, x], axis=1)
    forms = AffineForms(rows, np.zeros((len(x), 2)))
    return [
        (Ball.exact(x), lambda ball: ball),
        (forms, lambda forms: Ball(forms.rows[:, 0], forms.radii[:, 0])),
        (forms, lambda forms: Ball(forms.rows[:, 1], forms.radii[:, 1])),
    ]


@pytest.mark.parametrize("kind", range(3))
def test_a_quotient_is_that_of_real_numbers(kind):
    net = jax.device_get(network(lambda x: x / jnp.asarray(DIVIDED), 5))
    for seed in range(20):
        x = np.random.default_rng(seed).normal(size=5)
        number, read = kinds(x)[kind]
        found = read(net.propagate(number, None))
        for k in range(5):
            low, high = exactly(found, k)
            assert low <= Fraction(x[k]) / Fraction(DIVIDED[k]) <= high


@pytest.mark.parametrize("kind", range(3))
def test_what_is_left_of_constants_is_an_error_of_every_kind_of_number(kind):
    net = jax.device_get(network(CONTINUOUS["constants that are rounded"]))
    number, read = kinds(np.array([0.1, 0.2]))[kind]

    def unit(unit, y):
        ball = read(y)
        assert np.all(ball.rad < 1e-15)
        return y

    found = read(net.propagate(number, unit))
    jump = abs(3 * Fraction(0.1) - Fraction(0.3))
    low, high = exactly(found, 0)
    assert low <= Fraction(0.1) - jump
    assert Fraction(0.1) + jump <= high


def test_a_logarithm_that_rounds_to_one_is_none():
    """`math.log(math.e)` is 1.0, but the number next to e has a smaller one."""
    net = jax.device_get(network(lambda x: jnp.asarray(np.e) ** x))
    seen = []

    def unit(unit, y):
        seen.append(y)
        return y

    net.propagate(Ball.exact(np.array([1.0, 2.0])), unit)
    assert np.all(seen[0].rad > 0)
