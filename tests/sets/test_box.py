"""Claims about boxes, in 1, 2, 3 and 6 dimensions."""

from fractions import Fraction
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj

DIMENSIONS = [1, 2, 3, 6]
fractions = np.vectorize(Fraction, otypes=[object])


def random_box(n, flat=()):
    """Bounds of a box that does not hold the origin; the coordinates `flat` have one value."""
    rng = np.random.default_rng(n)
    lower = rng.uniform(-3.0, 1.0, n)
    upper = lower + rng.uniform(0.5, 2.0, n)
    upper[list(flat)] = lower[list(flat)]
    return lower, upper


def corners(lower, upper):
    return np.array(list(product(*zip(lower, upper, strict=True))))


@pytest.fixture(params=[(n, flat) for n in DIMENSIONS for flat in ((), (n - 1,))])
def bounds(request):
    return random_box(*request.param)


def points_around(lower, upper):
    """Points of the box, its corners, and points beyond one facet each."""
    rng = np.random.default_rng(0)
    inside = rng.uniform(lower, upper, (200, len(lower)))
    beyond = [
        np.where(np.arange(len(lower)) == i, bound + side * 1e-6, x)
        for i in range(len(lower))
        for side, bound in ((-1, lower[i]), (1, upper[i]))
        for x in inside[:10]
    ]
    return np.vstack([inside, corners(lower, upper), beyond])


def test_facts_are_nonnegative_exactly_on_members(bounds):
    lower, upper = bounds
    box = rj.Box(lower, upper)
    x = points_around(lower, upper)
    members = np.all((lower <= x) & (x <= upper), axis=1)
    assert 0 < members.sum() < len(x)
    facts = np.hstack([x, np.ones((len(x), 1))]) @ np.asarray(box.facts()).T
    assert facts.shape == (len(x), 2 * len(lower))
    np.testing.assert_array_equal(np.all(facts >= 0, axis=1), members)
    np.testing.assert_array_equal(box.contains(x), members)


def test_a_tolerance_enlarges_the_box(bounds):
    lower, upper = bounds
    box = rj.Box(lower, upper)
    assert box.contains(upper + 0.9e-3, tolerance=1e-3)
    assert not box.contains(upper + 1.1e-3, tolerance=1e-3)
    assert not box.contains(lower - 1.1e-3, tolerance=1e-3)


def test_the_support_is_the_largest_value_at_a_corner_and_never_below_it(bounds):
    lower, upper = bounds
    directions = np.random.default_rng(1).normal(size=(50, len(lower)))
    support = np.asarray(rj.Box(lower, upper).support(directions))
    exact = (fractions(corners(lower, upper)) @ fractions(directions).T).max(axis=0)
    assert (fractions(support) >= exact).all()
    np.testing.assert_allclose(support, exact.astype(float), rtol=0, atol=1e-13)


def test_the_support_along_an_axis_is_the_bound_itself(bounds):
    lower, upper = bounds
    axes = np.vstack([np.eye(len(lower)), -np.eye(len(lower))])
    np.testing.assert_array_equal(rj.Box(lower, upper).support(axes), np.r_[upper, -lower])


def test_vertices_are_all_combinations_of_bounds(bounds):
    lower, upper = bounds
    vertices = np.asarray(rj.Box(lower, upper).vertices())
    assert sorted(map(tuple, vertices)) == sorted(map(tuple, corners(lower, upper)))


@pytest.mark.parametrize("on_host", [False, True])
def test_samples_lie_inside_and_fill_the_box(bounds, on_host):
    lower, upper = bounds
    box = rj.Box(lower, upper)
    samples = box.drawn(2000, 0) if on_host else np.asarray(box.sample(jax.random.key(0), 2000))
    assert samples.shape == (2000, len(lower))
    assert box.contains(samples).all()
    # the standard deviation of the mean of 2000 uniform draws is 0.0065 of the width
    np.testing.assert_allclose(samples.mean(axis=0), (lower + upper) / 2, atol=0.03 * 2)
    np.testing.assert_allclose(np.ptp(samples, axis=0), upper - lower, rtol=0.01)


def test_what_is_drawn_on_the_host_hangs_on_the_seed_alone(bounds):
    """The first points are the same however many are drawn."""
    lower, upper = bounds
    box = rj.Box(lower, upper)
    np.testing.assert_array_equal(box.drawn(30, 3)[:7], box.drawn(7, 3))
    np.testing.assert_array_equal((box.drawn(7, 3) != box.drawn(7, 4)).any(0), lower < upper)


def test_the_volume_is_the_product_of_the_widths(bounds):
    lower, upper = bounds
    assert float(rj.Box(lower, upper).volume()) == pytest.approx(np.prod(upper - lower))


def test_the_bounding_box_is_the_box(bounds):
    box = rj.Box(*bounds).bounding_box()
    np.testing.assert_array_equal(box.lower, bounds[0])
    np.testing.assert_array_equal(box.upper, bounds[1])


def test_center_and_widths():
    box = rj.Box([1.0, -2.0], [4.0, -1.0])
    np.testing.assert_array_equal(box.center, [2.5, -1.5])
    np.testing.assert_array_equal(box.widths, [3.0, 1.0])


def test_a_time_varying_box_gives_the_box_of_each_time():
    box = rj.Box([[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]], [[1.0, 2.0], [4.0, 6.0], [8.0, 10.0]])
    assert (box.steps, box.dimension) == (3, 2)
    np.testing.assert_array_equal(box.at(1).lower, [2.0, 3.0])
    np.testing.assert_array_equal(jax.jit(lambda t: box.at(t).upper)(2), [8.0, 10.0])


def test_a_constant_box_is_itself_at_every_time():
    box = rj.Box([0.0], [1.0])
    assert box.steps is None
    assert box.at(7) is box


def test_a_box_with_too_many_corners_says_so():
    with pytest.raises(ValueError, match="dimension 17 has 131072 corners"):
        rj.Box(jnp.zeros(17), jnp.ones(17)).vertices()


def test_supports_are_upper_bounds_whatever_underflows_or_overflows():
    box, D = rj.Box([-1e-160, 1e-170], [1e-160, 1e200]), [[1e-200, 0.0], [1e300, 1e-300]]
    for row, value in zip(D, np.asarray(box.support(D)), strict=True):
        ends = [(-1e-160, 1e-160), (1e-170, 1e200)]
        exact = sum(
            max(Fraction(a) * Fraction(end) for end in each)
            for a, each in zip(row, ends, strict=True)
        )
        assert Fraction(float(value)) >= exact
        assert float(value) <= float(exact) * (1 + 1e-12) + 1e-307


def test_a_term_that_is_lost_beside_another_is_rounded_up():
    """The largest one is exact, and the other by more than all powers of two smaller."""
    box = rj.Box([0.0, 0.0], [2.0**300, 2.0**-800])
    (value,) = np.asarray(box.support([[1.0, 1.0]]))
    assert Fraction(2**300) + Fraction(2.0**-800) <= Fraction(float(value))
    assert value <= 2.0**300 * (1 + 1e-12)
    assert float(box.support([[1.0, 0.0]])[0]) == 2.0**300


def test_a_point_beside_a_set_by_less_than_products_can_tell_is_not_in_it():
    region = rj.Polytope([[1e-170, 0.0]], [0.0])
    assert not region.surely_contains([1e-170, 0.0])
    assert region.surely_contains([-1e-100, 0.0])
    assert rj.Polytope([[1e-170, 0.0]], [1e200]).surely_contains([1e300, 0.0])
    assert not rj.Box([0.0], [1.0]).surely_contains([-1e-310])


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_supports_are_rounded_up_where_ends_are_zero_or_one(n):
    rng = np.random.default_rng(n)
    for _ in range(50):
        upper = rng.choice([0.0, 1.0, rng.uniform()], size=n)
        lower = np.minimum(upper, rng.choice([0.0, -1.0, -rng.uniform()], size=n))
        row = rng.choice([0.0, 1.0, -1.0, rng.uniform(-1, 1)], size=n)
        ends = np.where(row > 0, upper, lower)
        exact = sum(Fraction(a) * Fraction(b) for a, b in zip(row, ends, strict=True))
        assert Fraction(float(rj.Box(lower, upper).support(row[None])[0])) >= exact
