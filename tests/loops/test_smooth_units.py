"""What smooth units say of themselves holds, as numbers of 60 digits tell, rounding included."""

import math
from dataclasses import dataclass
from functools import cache

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from mpmath import mpf

import reachjax as rj
from reachjax.loops.units import Mark, SmoothUnit
from reachjax.loops.units.smooth import SLACK
from reachjax.numerics.rounding import TINY

mpmath.mp.dps = 60


@dataclass(frozen=True)
class Truth:
    """A function, its first and third derivatives, and where it is defined.

    That is on both sides of 0, on its right, on one of them, or in `[-1, 1]`.
    """

    value: object
    derivative: object
    third: object
    side: str = "both"
    largest: float = 1e12


def third_of_sinc(y):
    """Of `sin y / y`; near zero from its series, as sixty digits would cancel."""
    if abs(y) < mpf(10) ** -6:
        return y / 5 - y**3 / 42
    first = (mpmath.cos(y) - mpmath.sinc(y)) / y
    return (-mpmath.cos(y) + 3 * (mpmath.sinc(y) + 2 * first / y)) / y


TRUTHS: dict[SmoothUnit, Truth] = {
    rj.Tanh(): Truth(
        mpmath.tanh,
        lambda y: mpmath.sech(y) ** 2,
        lambda y: -2 * mpmath.sech(y) ** 2 * (1 - 3 * mpmath.tanh(y) ** 2),
    ),
    rj.Sin(): Truth(mpmath.sin, mpmath.cos, lambda y: -mpmath.cos(y)),
    rj.Cos(): Truth(mpmath.cos, lambda y: -mpmath.sin(y), mpmath.sin),
    rj.Sinc(): Truth(
        mpmath.sinc,
        lambda y: (mpmath.cos(y) - mpmath.sinc(y)) / y if y else mpf(0),
        third_of_sinc,
    ),
    rj.Atan(): Truth(
        mpmath.atan, lambda y: 1 / (1 + y**2), lambda y: (6 * y**2 - 2) / (1 + y**2) ** 3
    ),
    rj.Exp(): Truth(mpmath.exp, mpmath.exp, mpmath.exp, largest=200.0),
    rj.Log(): Truth(mpmath.log, lambda y: 1 / y, lambda y: 2 / y**3, "right"),
    rj.Square(): Truth(lambda y: y**2, lambda y: 2 * y, lambda y: mpf(0)),
    rj.Sqrt(): Truth(
        mpmath.sqrt, lambda y: 1 / (2 * mpmath.sqrt(y)), lambda y: 3 / (8 * y**2.5), "right"
    ),
    rj.Reciprocal(): Truth(lambda y: 1 / y, lambda y: -1 / y**2, lambda y: -6 / y**4, "one"),
    rj.Erf(): Truth(
        mpmath.erf,
        lambda y: 2 / mpmath.sqrt(mpmath.pi) * mpmath.exp(-(y**2)),
        lambda y: 2 / mpmath.sqrt(mpmath.pi) * (4 * y**2 - 2) * mpmath.exp(-(y**2)),
    ),
    rj.Asin(): Truth(
        mpmath.asin,
        lambda y: 1 / mpmath.sqrt((1 - y) * (1 + y)) if abs(y) < 1 else mpf("inf"),
        lambda y: (1 + 2 * y**2) / (1 - y**2) ** 2.5 if abs(y) < 1 else mpf("inf"),
        "inside",
    ),
    rj.Asinh(): Truth(
        mpmath.asinh,
        lambda y: 1 / mpmath.sqrt(1 + y**2),
        lambda y: (2 * y**2 - 1) / (1 + y**2) ** 2.5,
    ),
    rj.ISRU(): Truth(
        lambda y: y / mpmath.sqrt(1 + y**2),
        lambda y: (1 + y**2) ** -1.5,
        lambda y: (12 * y**2 - 3) / (1 + y**2) ** 3.5,
    ),
    rj.Softplus(): Truth(
        lambda y: max(y, 0) + mpmath.log1p(mpmath.exp(-abs(y))),
        lambda y: 1 / (1 + mpmath.exp(-y)),
        lambda y: mpmath.exp(-abs(y)) * (1 - mpmath.exp(-abs(y))) / (1 + mpmath.exp(-abs(y))) ** 3,
    ),
    rj.XLogX(): Truth(
        lambda y: y * mpmath.log(y) if y else mpf(0),
        lambda y: 1 + mpmath.log(y),
        lambda y: -1 / y**2,
        "right",
    ),
}


def usual(unit, numbers):
    """Numbers between 0 and 4, brought to where a unit is defined."""
    return numbers * (0.2 if TRUTHS[unit].side == "inside" else 1.0)


each_unit = pytest.mark.parametrize("unit", TRUTHS, ids=str)
on_both = pytest.mark.parametrize("compiled", [False, True], ids=["numpy", "compiled"])
exactly = np.vectorize(mpf, otypes=[object])


@cache
def intervals(unit):
    """Ends `(2, k)` of intervals: of all sizes, wide and thin, and of no width."""
    truth, rng = TRUTHS[unit], np.random.default_rng(0)
    ends = rng.normal(size=(150, 2)) * 10.0 ** rng.uniform(-12, 6, size=(150, 2))
    usual = rng.normal(size=(80, 1)) + rng.exponential(size=(80, 2)) * [-1, 1]
    long = rng.uniform(-50, 50, size=(20, 2))
    near = rng.normal(size=(40, 1)) * 10.0 ** rng.uniform(-3, 3, size=(40, 1))
    narrow = near * (1 + 10.0 ** rng.uniform(-15, -2, size=(40, 1)) * [-1, 1])
    thin = np.hstack([near, np.nextafter(near, np.inf)])
    huge = [[-1e200, 1e200], [1.0, 1e200], [1e199, 1e200], [-1e5, 1e5], [9e4, 1e5]]
    ends = np.vstack([ends, usual, long, narrow, thin, np.hstack([near, near]), huge])
    ends = np.clip(ends, -truth.largest, truth.largest) if truth.largest < 1e9 else ends
    if truth.side != "both":
        ends = np.vstack([abs(ends), [[1e-300, 1.0], [1e-20, 1e20]]])
        ends[np.all(ends == ends[:, :1], axis=1)] += 0.5
    if truth.side == "inside":
        edges = [[-1.0, 1.0], [0.3, 1.0], [-1.0, -1 + 1e-9], [1 - 1e-14, 1.0], [-1.0, 0.0]]
        ends = np.vstack([ends * 10.0 ** -np.ceil(np.log10(abs(ends).max(axis=1))[:, None]), edges])
    ends = np.sort(ends, axis=1)
    if truth.side == "one":
        ends[::2] = -ends[::2, ::-1]
    return ends.T


@cache
def inside(unit):
    """Exact numbers `(m, k)` of these intervals, ends among them, and their values."""
    lower, upper = map(exactly, intervals(unit))
    parts = [0, 1, mpf(1) / 3, mpf(1) / 2, mpf(5) / 6, mpf(1) / 1000, 1 - mpf(1) / 1000]
    y = np.stack([lower + (upper - lower) * part for part in parts])
    y = np.concatenate([y, np.clip(mpf(0), lower, upper)[None]])
    return y, np.vectorize(TRUTHS[unit].value, otypes=[object])(y)


WIDTH = 512
"""How many intervals compiled code takes: it is compiled once a unit."""


@cache
def compiled_of(unit):
    """All that a unit says, compiled together."""

    def found(slope, lower, upper):
        ends = lower, upper
        said = {name: getattr(unit, name)(*ends) for name in ("interval", "lines", "quadratic")}
        return {**said, "third": unit.third(*ends), "remainder": unit.remainder(slope, *ends)}

    return jax.jit(found)


def said(unit, what, compiled, lower, upper, *slope):
    """What a unit says of intervals: in numpy, or in compiled code."""
    if not compiled:
        found = getattr(unit, what)(*slope, lower, upper)
        assert not any(isinstance(each, jax.Array) for each in jax.tree.leaves(found))
        return found
    size = len(lower)
    given = np.ones((3, WIDTH))
    for row, numbers in zip(given, (*(slope or (1.0,)), lower, upper), strict=True):
        row[:size] = numbers
    found = jax.device_get(compiled_of(unit)(*map(jnp.asarray, given))[what])
    return jax.tree.map(lambda part: part[:size], found)


def holds(low, values, high):
    return np.all(exactly(low) <= values) and np.all(values <= exactly(high))


@each_unit
def test_values_and_derivatives_are_those_of_the_function(unit):
    y = np.unique(intervals(unit).ravel())
    y = y[(abs(y) < 1e5) & (abs(y) > 1e-20) & (abs(y) != 1)]
    truth = TRUTHS[unit]
    for own, exact in ((unit, truth.value), (unit.derivative, truth.derivative)):
        expected = np.array([float(exact(mpf(each))) for each in y])
        for compiled in (False, True):
            found = jax.jit(own)(jnp.asarray(y)) if compiled else own(y)
            np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-300)


@on_both
@each_unit
def test_intervals_hold_every_value_and_are_sharp(unit, compiled):
    lower, upper = said(unit, "interval", compiled, *intervals(unit))
    _, values = inside(unit)
    assert holds(lower, values, upper)
    usual = np.all(abs(intervals(unit)) < 1e5, axis=0)
    attained = [np.array(f(values, axis=0), float)[usual] for f in (np.min, np.max)]
    size = 1e-13 * np.maximum(*map(abs, attained)) + 1e-150
    if not isinstance(unit, rj.Sin | rj.Cos | rj.Sinc | rj.XLogX):  # attained at ends or at 0
        assert np.all(attained[0] - lower[usual] <= size)
        assert np.all(upper[usual] - attained[1] <= size)


@on_both
@each_unit
def test_a_remainder_holds_for_any_slope(unit, compiled):
    ends, (y, values) = intervals(unit), inside(unit)
    truth, rng = TRUTHS[unit], np.random.default_rng(1)
    part = rng.uniform(size=ends.shape[1])
    inner = np.clip(ends[0] + part * (ends[1] - ends[0]), *ends)
    tangent = np.array([float(truth.derivative(mpf(each))) for each in inner])
    sizes = 10.0 ** rng.uniform(-12, 12, size=len(part))
    for slope in (
        tangent,
        rng.normal(size=len(part)),
        rng.normal(size=len(part)) * sizes,
        np.zeros(len(part)),
        np.full(len(part), 1e-310),
    ):
        low, high = said(unit, "remainder", compiled, *ends, slope)
        assert holds(low, values - exactly(slope) * y, high)
        # where the function touches this slope, too, which is extreme if it is neither end
        point = exactly(inner)
        value = np.vectorize(truth.value, otypes=[object])(point)
        assert holds(low, value - exactly(slope) * point, high)


@on_both
@each_unit
def test_the_steepest_slopes_are_met_where_they_are(unit, compiled):
    """Next to where a derivative is largest a digit of the slope is half of those of the point."""
    truth, rng = TRUTHS[unit], np.random.default_rng(2)
    if truth.side in ("right", "one"):
        return
    y = 10.0 ** rng.uniform(-9, -5, size=300)
    ends = np.stack([y / 1000, 10 * y])
    slope = np.array([float(truth.derivative(mpf(each))) for each in y])
    low, high = said(unit, "remainder", compiled, *ends, slope)
    for part in (1, 0.3, 0.9, 1.1, 3):
        point = exactly(y) * mpf(part)
        values = np.vectorize(truth.value, otypes=[object])(point)
        assert holds(low, values - exactly(slope) * point, high)


@on_both
@each_unit
def test_lines_are_below_and_above_every_value_and_never_the_same(unit, compiled):
    lines = said(unit, "lines", compiled, *intervals(unit))
    y, values = inside(unit)
    below, above = (exactly(slope) * y + exactly(offset) for slope, offset in lines)
    assert np.all(below <= values)
    assert np.all(values <= above)
    assert not lines.affine.any()


@on_both
@each_unit
def test_quadratics_are_no_farther_from_every_value_than_they_say(unit, compiled):
    ends, (y, values) = intervals(unit), inside(unit)
    found = said(unit, "quadratic", compiled, *ends)
    known = np.isfinite(found.gap)
    assert all(np.isfinite(part).all() for part in found[:4])
    assert known[np.all(abs(ends) < 1e5, axis=0)].all() or unit == rj.Exp()
    center, offset, slope, curvature, gap = (exactly(part[known]) for part in found)
    off = y[:, known] - center
    polynomial = offset + slope * off + curvature * off * off
    assert np.all(abs(values[:, known] - polynomial) <= gap)
    (slope, low), (_, high) = (
        (part[known] for part in line) for line in said(unit, "lines", compiled, *ends)
    )
    size = abs(slope * found.center[known]) + abs(low) + abs(high)
    size = 1e-14 * size + 4 * TINY * abs(found.center[known]) + 1e-150  # no worse than the lines
    assert np.all(found.gap[known] <= (high - low) / 2 * (1 + 1e-12) + size)


@each_unit
def test_quadratics_close_in_with_the_cube_of_the_width(unit):
    width = np.array([1e-1, 1e-2, 1e-3])
    middle = usual(unit, 1.3)
    gap = unit.quadratic(middle - width, middle + width).gap
    third = unit.third(middle - width, middle + width)
    assert np.all(gap <= width**3 / 24 * third * 1.01 + 100 * SLACK)


@on_both
@each_unit
def test_third_derivatives_are_bounded(unit, compiled):
    bounds = said(unit, "third", compiled, *intervals(unit))
    y, _ = inside(unit)
    sizes = abs(np.vectorize(TRUTHS[unit].third, otypes=[object])(y))
    assert np.all(sizes <= exactly(bounds))
    # and where they are extreme
    for at in (0.0, 1.0, 1.1462158347805889, math.pi / 2, math.pi):
        at = usual(unit, at if TRUTHS[unit].side in ("both", "inside") else 0.3 + at)
        bound = said(unit, "third", compiled, np.array([at - 0.1]), np.array([at + 0.2]))
        size = max(abs(TRUTHS[unit].third(mpf(at) + mpf(k) / 100)) for k in range(-10, 20))
        assert size <= mpf(bound[0]) <= size * mpf(1.2) + mpf(1e-12)


@on_both
@each_unit
def test_what_is_said_of_nothing_is_infinite_and_never_a_wrong_number(unit, compiled):
    inf, nan = math.inf, math.nan
    ends = np.array([[-inf, inf], [1.0, inf], [nan, 1.0], [1.0, nan], [nan, nan]]).T
    slope = np.full(5, 0.5)
    for low, high in (
        said(unit, "remainder", compiled, *ends, slope),
        [line.offset for line in said(unit, "lines", compiled, *ends)],
    ):
        assert np.all(low == -inf)
        assert np.all(high == inf)
    found = said(unit, "quadratic", compiled, *ends)
    assert np.all(found.gap == inf)
    assert not any(part.any() for part in found[:4])
    low, high = said(unit, "interval", compiled, *ends)
    assert np.isnan([low[2:], high[2:]]).all()
    assert np.all((low[:2] <= -1) | (low[:2] == unit.image[0]))
    assert np.all(high[:2] == unit.image[1])
    for wrong in (inf, -inf, nan):
        low, high = said(unit, "remainder", compiled, np.ones(1), 2 * np.ones(1), np.array([wrong]))
        assert low == -inf
        assert high == inf


OUTSIDE = {
    rj.Log(): [[-1.0, 2.0], [0.0, 1.0], [-2.0, -1.0], [1e-310, 1.0]],
    rj.Sqrt(): [[-1.0, 2.0], [-1e-300, 1.0], [-2.0, -1.0]],
    rj.XLogX(): [[-1.0, 2.0], [-1e-300, 1.0], [-2.0, -1.0]],
    rj.Asin(): [[-1.5, 0.5], [0.0, 1 + 2e-16], [2.0, 3.0]],
    rj.Reciprocal(): [[-1.0, 2.0], [0.0, 1.0], [-1.0, 0.0], [1e-310, 1.0], [0.0, 0.0]],
}


@on_both
@pytest.mark.parametrize("unit", OUTSIDE, ids=str)
def test_outside_of_the_domain_bounds_are_infinite(unit, compiled):
    ends = np.array(OUTSIDE[unit]).T
    low, high = said(unit, "remainder", compiled, *ends, np.zeros(ends.shape[1]))
    assert np.all(low == -math.inf)
    assert np.all(high == math.inf)
    low, high = said(unit, "interval", compiled, *ends)
    assert np.all(low == unit.image[0])
    assert np.all(high == unit.image[1])
    lines, found = (said(unit, what, compiled, *ends) for what in ("lines", "quadratic"))
    assert not lines.above.slope.any()
    assert np.all(lines.above.offset == math.inf)
    assert np.all(lines.below.offset == -math.inf)
    assert np.all(found.gap == math.inf)
    assert not any(part.any() for part in found[:4])


@pytest.mark.parametrize("unit", [rj.Sin(), rj.Cos()], ids=str)
def test_waves_of_large_arguments_are_any_numbers_of_size_one(unit):
    lower, upper = np.array([1e6, -1e200]), np.array([1e6, 3e200])
    np.testing.assert_array_equal(unit.interval(lower, upper), [[-1, -1], [1, 1]])
    low, high = unit.remainder(np.array([2.0, 1e-200]), lower, upper)
    np.testing.assert_allclose([low, high], [[-2e6 - 1, -4], [-2e6 + 1, 2]])
    np.testing.assert_allclose(unit.quadratic(lower, upper).gap, 1)


@each_unit
@pytest.mark.costly
def test_remainders_and_quadratics_have_derivatives(unit):
    lower, upper = jnp.array([[0.5, 0.7, 1e-7, 1.0, 2.0], [0.9, 3.0, 2e-7, 1.0, 2.0 + 1e-9]])
    lower, upper = usual(unit, lower), usual(unit, upper)
    if unit == rj.Sqrt():
        lower = lower.at[2].set(0.0)

    def total(lower, upper, slope):
        parts = (
            *unit.interval(lower, upper),
            *unit.remainder(slope, lower, upper),
            *jax.tree.leaves(unit.lines(lower, upper)),
            *unit.quadratic(lower, upper),
        )
        weights = 1 + jnp.arange(len(parts))  # so that nothing cancels
        each = weights @ jnp.stack(parts)
        return each.sum(), each

    given = lower, upper, jnp.array([1.0, 0.5, 0.0, -1.0, 2.0])
    value_and_grad = jax.jit(jax.value_and_grad(total, (0, 1, 2), has_aux=True))
    _, found = value_and_grad(*given)
    assert jnp.isfinite(jnp.stack(found)).all()
    step, k = 1e-6, 1  # a central difference where nothing is thin
    for of in range(3):
        moved = [
            tuple(g.at[k].add(sign * step) if i == of else g for i, g in enumerate(given))
            for sign in (-1, 1)
        ]
        before, after = (value_and_grad(*point)[0][1][k] for point in moved)
        difference = (after - before) / (2 * step)
        np.testing.assert_allclose(found[of][k], difference, rtol=1e-5, atol=1e-6)


@each_unit
def test_facts_are_not_negative_and_hold_of_no_far_value(unit):
    lower, upper = (usual(unit, np.array(ends)) for ends in ([0.4, 1.0, 1.3], [0.5, 2.0, 4.0]))
    y = lower + (upper - lower) / 3
    facts = unit.facts(y, unit(y), lower, upper)
    for point in (lower, y, upper):
        facts = unit.facts(point, unit(point), lower, upper)
        assert [block.mark for block in facts.blocks] == [Mark.BOUND, Mark.BOUND]
        assert np.all(facts["under"] >= 0)
        assert np.all(facts["over"] >= 0)
        assert {name for product in facts.products for name in product[:2]} == {"under", "over"}
    width = facts["under"] + facts["over"]  # both lines have one slope
    assert np.all(unit.facts(y, unit(y) + 1.01 * width, lower, upper)["under"] < 0)
    assert np.all(unit.facts(y, unit(y) - 1.01 * width, lower, upper)["over"] < 0)


@each_unit
def test_units_that_are_nonexpansive_are(unit):
    y = usual(unit, np.linspace(0.01, 3, 1000))
    within = abs(np.diff(unit(y))) <= np.diff(y) * (1 + 1e-9)
    assert within.all() == unit.nonexpansive
    assert rj.ReLU().nonexpansive


def test_a_sigmoid_is_the_logistic_function():
    y = np.linspace(-30, 30, 601)
    np.testing.assert_allclose(rj.Sigmoid()(y), 1 / (1 + np.exp(-y)), atol=1e-15)
