"""What products say of themselves holds in exact fractions, and does not depend on scales."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import reachjax as rj
from reachjax.loops.tracing.limits import Limits
from reachjax.loops.units import Bilinear, Lines
from reachjax.numerics.rounding import Ball
from reachjax.programs.bounds import successor_box
from tests.loops.traced import interval, network

mpmath.mp.dps = 60

SIZES = 10.0 ** np.array([-300, -160, -20, -6, -1, 0, 1, 6, 20, 150])


def exactly(numbers):
    return [Fraction(each) for each in np.asarray(numbers, float).tolist()]


def ranges(seed, terms, count=40):
    """Ends of `count` sums' factors, of all sizes: points, intervals that begin at zero, others."""
    rng = np.random.default_rng(seed)
    middle, radius = rng.normal(size=(2, 2 * terms * count)) * rng.choice(SIZES, 2 * terms * count)
    radius = abs(radius) * rng.choice([0.0, 1e-9, 1.0], len(radius))
    lower, upper = middle - radius, middle + radius
    touching = rng.uniform(size=len(lower)) < 0.1
    return np.where(touching, 0.0, lower), np.where(touching, abs(upper), upper)


def points(lower, upper, seed):
    """A point of each range, many of them ends."""
    rng = np.random.default_rng([seed, 1])
    inside = np.clip(lower + (upper - lower) * rng.uniform(size=len(lower)), lower, upper)
    return np.where(rng.uniform(size=len(lower)) < 0.6, rng.choice([lower, upper]), inside)


def sums(unit, y):
    """The exact values of sums of products."""
    one, other = np.split(np.array(exactly(y), object), 2)
    return (one * other).reshape(unit.terms, -1).sum(axis=0)


@pytest.mark.parametrize("compiled", [False, True], ids=["host", "compiled"])
@pytest.mark.parametrize("terms", [1, 3])
def test_intervals_and_planes_hold_every_value(terms, compiled):
    unit = Bilinear(terms)
    interval = jax.jit(unit.interval) if compiled else unit.interval
    lines = jax.jit(unit.lines) if compiled else unit.lines
    for seed in range(30):
        lower, upper = ranges(seed, terms)
        low, high = map(exactly, interval(lower, upper))
        below, above = lines(lower, upper)
        assert not np.any(Lines(below, above).affine)
        for turn in range(5):
            y = points(lower, upper, [seed, turn])
            found = sums(unit, y)
            assert np.all(low <= found)
            assert np.all(found <= high)
            for line, sign in ((below, 1), (above, -1)):
                slope = np.array(exactly(line.slope), object) * exactly(y)
                values = slope.reshape(unit.inputs, -1).sum(axis=0) + exactly(line.offset)
                assert np.all(sign * values <= sign * found)


def test_intervals_are_the_least_and_the_largest_product():
    lower, upper = ranges(0, 1)
    moderate = np.all(abs(np.log10(np.maximum(abs(lower), abs(upper)).reshape(2, -1))) < 30, axis=0)
    low, high = Bilinear().interval(lower, upper)
    ends = np.stack([lower, upper]).reshape(2, 2, -1)
    corners = np.stack([ends[i, 0] * ends[j, 1] for i in (0, 1) for j in (0, 1)])
    size = abs(corners).max(axis=0)
    assert np.all((corners.min(axis=0) - low <= 1e-14 * size)[moderate])
    assert np.all((high - corners.max(axis=0) <= 1e-14 * size)[moderate])


def test_a_factor_that_is_zero_makes_a_product_that_is_zero():
    low, high = Bilinear().interval(np.array([0.0, -2.0]), np.array([0.0, 5.0]))
    assert low == high == 0.0


@pytest.mark.parametrize("bad", [(-np.inf, 1.0), (1.0, np.inf), (np.nan, 1.0)], ids=str)
def test_what_is_said_of_unbounded_factors_is_infinite(bad):
    for one in (bad, (0.0, 0.0)):
        lower, upper = map(np.array, zip(one, bad, strict=True))
        low, high = Bilinear().interval(lower, upper)
        assert not low > -np.inf
        assert not high < np.inf
        below, above = Bilinear().lines(lower, upper)
        assert below.offset[0] == -np.inf
        assert above.offset[0] == np.inf
        assert not below.slope.any()


@pytest.mark.parametrize("terms", [1, 2])
def test_facts_are_not_negative_and_leave_one_value_at_each_corner(terms):
    unit = Bilinear(terms)
    for seed in range(30):
        rng = np.random.default_rng(seed)
        lower = rng.normal(size=8 * terms) * 10.0 ** rng.integers(-6, 7, 8 * terms)
        upper = lower + abs(lower) * rng.choice([1e-6, 0.5], 8 * terms)
        y = points(lower, upper, seed)
        exact = np.array([mpmath.mpf(each) for each in y.tolist()], object)
        z = np.array([mpmath.fraction(each.numerator, each.denominator) for each in sums(unit, y)])
        blocks = unit.facts(exact, z + mpmath.mpf(0), lower, upper).blocks
        assert len(blocks) == 4
        assert all(np.all(block.rows >= 0) for block in blocks)
        corner = np.concatenate([lower[: 4 * terms], upper[4 * terms :]])
        for off in (-1e-3, 1e-3):
            z = unit(*np.split(corner, 2)) * (1 + off)
            rows = [block.rows for block in unit.facts(corner, z, lower, upper).blocks]
            assert np.all(np.min(rows, axis=0) < 0)


def test_products_of_multiples_of_one_number_are_squares():
    for function in (
        lambda x: (2 * x) * (3 * x),
        lambda x: -x * x,
        lambda x: (x / 3) * (5 * x),
        lambda x: jnp.abs(x) * jnp.abs(x),
    ):
        low, high = interval(network(function))
        assert np.all(low >= -1e-12) or np.all(high <= 1e-12)


def test_limits_of_products_are_known():
    found = Bilinear(2)(
        Limits(np.array([0.0, -1.0]), np.array([np.inf, 1.0])),
        Limits(np.array([2.0, -3.0]), np.array([3.0, 3.0])),
    )
    assert (found.least[0], found.most[0]) == (pytest.approx(-3.0), np.inf)


def test_a_ball_is_joined_of_several():
    found = Ball.joined([Ball.exact(np.ones(2)), Ball(np.zeros(1), np.ones(1))])
    assert (found.mid.tolist(), found.rad.tolist()) == ([1.0, 1.0, 0.0], [0.0, 0.0, 1.0])


SCALED = {
    "product": lambda x, s: (jnp.sin(x[0]) / s) * (s * jnp.sin(x[1])),
    "square": lambda x, s: (s * jnp.sin(x[0])) ** 2 / s**2,
    "cube": lambda x, s: (s * jnp.sin(x[0])) ** 3 / s**3,
    "quotient": lambda x, s: (s * jnp.sin(x[0])) / (s * (1 + x[1] ** 2)),
    "quotient of unlike ones": lambda x, s: s * (jnp.sin(x[0]) / (s * jnp.exp(x[1]))),
    "power": lambda x, s: (s * (1 + x[0])) ** 1.5 / s**1.5,
    "norm": lambda x, s: jnp.linalg.norm(s * (x + 1)) / s,
    "length": lambda x, s: jnp.hypot(s * (x[0] + 1), s * x[1]) / s,
    "logarithm": lambda x, s: jnp.log((x[0] + 1) * s * (x[1] + 2)) - jnp.log(s),
    "matrix": lambda x, s: ((s * jnp.outer(x, jnp.sin(x))) @ (jnp.cos(x) / s)).sum(),
    "tangent": lambda x, s: (jnp.tan(x[0]) / s) * (s * x[1]),
    "angle": lambda x, s: jnp.arctan2(s * x[0], s * (x[1] + 0.5)),
}


def bounds_of(function):
    """Bounds of a function of two states over a box, by forms."""
    plant = rj.NonlinearPlant(lambda x, u: jnp.array([function(x), x[1]]) + 0 * u, 2, 2)
    net = rj.MLP.from_layers([(np.zeros((2, 2)), np.zeros(2))])
    X0, box = rj.Box([0.1, 0.2], [0.9, 0.8]), rj.Template.box(2)
    tube = rj.reach(rj.ClosedLoop(plant, net), X0, 1, box, rj.LinearBounds())
    around = tube.sets[1].bounding_box()
    return np.array([around.lower[0], around.upper[0]])


@pytest.mark.parametrize("name", SCALED)
def test_scaling_factors_changes_bounds_by_rounding_only(name):
    expected = bounds_of(lambda x: SCALED[name](x, 1.0))
    for s in (1e-6, 1e-2, 3e3, 1e6):
        found = bounds_of(lambda x, s=s: SCALED[name](x, s))
        np.testing.assert_allclose(found, expected, rtol=2e-9, atol=2e-9)


def test_products_of_unlike_sizes_are_tight():
    low, high = bounds_of(lambda x: SCALED["product"](x, 1e6))
    assert high - low <= 1.13 * (np.sin(0.9) * np.sin(0.8) - np.sin(0.1) * np.sin(0.2))


def polynomial(p, x, u):
    y = p[:2] @ x + p[2]
    z = y[0] * y[1]
    return p[3] * jnp.array([z * x[0] + y[1], z - x[1] * y[0] + (x @ y) ** 2]) + 0 * u


def exact_runs(p, states, steps):
    """Trajectories of the polynomial in fractions."""
    p, found = np.array([exactly(row) for row in p], object), []
    for state in states:
        x, run = np.array(exactly(state), object), []
        for _ in range(steps):
            y = p[:2] @ x + p[2]
            z = y[0] * y[1]
            x = p[3] * np.array([z * x[0] + y[1], z - x[1] * y[0] + (x @ y) ** 2], object)
            run.append(x)
        found.append(run)
    return np.array(found, object)


def offsets(p, X0):
    """Upper bounds of the states and of their negatives after each of three steps."""
    plant = rj.NonlinearPlant(jax.tree_util.Partial(polynomial, p), 2, 2)
    net = rj.MLP.from_layers([(np.zeros((2, 2)), np.zeros(2))])
    template = rj.Template(np.vstack([np.eye(2), -np.eye(2)]))
    tube = rj.reach(rj.ClosedLoop(plant, net), X0, 3, template, rj.LinearBounds())
    return jnp.stack([X.facets[1] for X in tube.sets[1:]])


def test_successors_of_points_are_enclosed_closely():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        p, x = rng.normal(size=(4, 2)), rng.normal(size=2)
        plant = rj.NonlinearPlant(jax.tree_util.Partial(polynomial, p), 2, 2)
        net = rj.MLP.from_layers([(np.zeros((2, 2)), np.zeros(2))])
        found = successor_box(rj.ClosedLoop(plant, net), rj.Box(x, x), 0)
        (((successor,),),) = (exact_runs(p, [x], 1),)
        assert np.all(exactly(found.lower) <= successor)
        assert np.all(successor <= exactly(found.upper))
        assert np.all(found.upper - found.lower <= 1e-10)  # terms of some hundreds


@pytest.mark.costly
def test_no_state_of_a_polynomial_is_outside_in_exact_arithmetic():
    compiled = jax.jit(offsets)
    for seed in range(60):
        rng = np.random.default_rng(seed)
        p = rng.normal(size=(4, 2))
        scale = 10.0 ** rng.integers(-6, 7)
        p[0], p[2, 0] = p[0] * scale, p[2, 0] * scale
        p[1], p[2, 1] = p[1] / scale, p[2, 1] / scale
        p[3] = [0.5, 0.5 * min(scale, 1 / scale) ** 2]
        middle, radius = rng.normal(size=2), rng.choice([0.0, 1e-9, 0.1, 0.5], 2)
        X0 = rj.Box(middle - radius, middle + radius)
        lower, upper = np.asarray(X0.lower), np.asarray(X0.upper)
        corners = np.array([[a, b] for a in (lower[0], upper[0]) for b in (lower[1], upper[1])])
        inside = np.clip(lower + (upper - lower) * rng.uniform(size=(6, 2)), lower, upper)
        runs = exact_runs(p, np.concatenate([corners, inside]), 3)
        both = np.concatenate([runs, -runs], axis=2)
        for bounds in (offsets(p, X0), compiled(p, X0)):
            most = np.asarray(bounds)
            held = [
                not np.isfinite(most[k, i]) or Fraction(float(most[k, i])) >= both[:, k, i].max()
                for k, i in np.ndindex(most.shape)
            ]
            assert all(held), seed


@pytest.mark.parametrize("factor", [2.0, -0.5, 0.3])
def test_limits_of_products_with_rounded_factors_hold_those_with_what_was_rounded(factor):
    """Also of powers of two, products with which are exact where the factor is."""
    x, off = 1.7, Fraction(3, 2**53)
    found = Limits(np.array([x]), np.array([x])).nearly_times(factor)
    for true in (Fraction(factor) * (1 - off), Fraction(factor) * (1 + off)):
        assert Fraction(found.least[0]) <= true * Fraction(x) <= Fraction(found.most[0])
