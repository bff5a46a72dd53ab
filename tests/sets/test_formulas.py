"""Sizes that are formulas, beside those of linear programs and Qhull."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from reachjax.sets import Box, Polytope, Template, hulls, supports


def polygon(seed):
    """Facets around a point, some of them redundant and some twice there."""
    rng = np.random.default_rng(seed)
    angles = np.r_[0.0, 2.1, 4.2, rng.uniform(0, 2 * np.pi, rng.integers(0, 9))]
    A = np.c_[np.cos(angles), np.sin(angles)] * rng.uniform(0.1, 10, (len(angles), 1))
    lengths = np.linalg.norm(A, axis=1)
    size = 10 ** rng.uniform(-3, 3)
    b = A @ (rng.normal(size=2) * 10 ** rng.uniform(-3, 3)) + rng.uniform(0.01, 1, len(A)) * (
        size * lengths
    )
    return A, b, lengths


@pytest.mark.parametrize("seed", range(20))
def test_the_area_and_its_derivatives_are_those_of_qhull(seed):
    A, b, lengths = polygon(seed)
    area, areas, centroids = hulls.facet_areas(A, b)
    value, (by_normals, by_offsets) = jax.value_and_grad(supports.area, argnums=(0, 1))(A, b)
    assert float(value) == pytest.approx(area, rel=1e-8)
    swept = areas / lengths
    np.testing.assert_allclose(by_offsets, swept, atol=1e-7 * swept.max())
    expected = -swept[:, None] * centroids
    np.testing.assert_allclose(by_normals, expected, atol=1e-7 * abs(expected).max())


def test_facets_that_are_there_twice_count_once():
    A, b, _ = polygon(3)
    twice = supports.area(np.r_[A, 2 * A], np.r_[b, 2 * b])
    assert float(twice) == pytest.approx(hulls.volume(A, b), rel=1e-8)


@pytest.mark.parametrize(
    ("A", "b"),
    [
        ([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], [1.0, -2.0, 1.0, 1.0]),
        ([[1.0, 0.0], [0.0, 1.0], [-1.0, -1.0]], [0.0, 0.0, -1.0]),
        ([[1.0, 0.0], [0.0, 1.0]], [1.0, 1.0]),
        ([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0]], [1.0, 1.0, 1.0]),
    ],
    ids=["empty box", "empty triangle", "a quadrant", "half a strip"],
)
def test_what_is_empty_or_unbounded_has_no_area_and_no_derivative(A, b):
    value, slope = jax.value_and_grad(supports.area, argnums=1)(jnp.array(A), jnp.array(b))
    assert np.isnan(value)
    assert np.isnan(slope).any()


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_boxes_are_told_apart_and_their_ends_are_exact(n):
    box = Box(-np.arange(1.0, n + 1) / 3, np.arange(n) + 1 / 7)
    A, b = (np.asarray(part) for part in Template.box(n).polytope(jnp.zeros(2 * n)).facets)
    b = np.asarray(box.support(A))
    ends = supports.box_ends(A, b)
    assert ends is not None
    lower, upper = ends
    np.testing.assert_array_equal(lower, box.lower)
    np.testing.assert_array_equal(upper, box.upper)
    assert supports.box_ends(2 * A, b) is None  # b / 2 would have to be rounded outwards
    assert supports.box_ends(A[1:], b[1:]) is None  # unbounded
    if n > 1:
        octagonal = np.asarray(Template.octagonal(n).directions)
        assert supports.box_ends(octagonal, octagonal[:, 0]) is None


def test_the_inner_one_of_two_facets_bounds_a_box_and_an_empty_one_has_no_ends():
    A = np.array([[1.0], [1.0], [-1.0]])

    def widths(b):
        ends = supports.box_ends(A, b)
        assert ends is not None
        return (ends[1] - ends[0])[0]

    assert float(widths(jnp.array([2.0, 1.0, 0.0]))) == 1.0
    np.testing.assert_array_equal(jax.grad(widths)(jnp.array([2.0, 1.0, 0.0])), [0, 1, 1])
    value, slope = jax.value_and_grad(widths)(jnp.array([2.0, 1.0, -1.5]))
    assert np.isnan(value)
    assert np.isnan(slope).any()


@pytest.mark.costly
def test_ends_and_areas_have_derivatives_in_normals():
    """A facet of a box, turned about its middle."""
    b = jnp.ones(4)

    def sizes(A):
        box = Polytope(A, b).bounding_box()
        return jnp.array([box.upper[0], Polytope(A, b).size()])

    A = Template.box(2).directions
    for compiled in (False, True):
        slopes = jax.jacrev(jax.jit(sizes) if compiled else sizes)(A)
        (first,) = np.flatnonzero((np.asarray(A) == [1, 0]).all(axis=1))
        np.testing.assert_allclose(slopes[0, first, 0], -1.0, atol=1e-9)  # x <= b / a
        np.testing.assert_allclose(slopes[1, first], [-2.0, 0.0], atol=1e-9)


@pytest.mark.parametrize("template", [Template.box(3), Template.octagonal(2), Template.regular(5)])
def test_compiled_sizes_and_boxes_are_those_of_plain_arrays(template):
    A = template.directions
    b = jnp.asarray(np.random.default_rng(0).uniform(0.5, 1.0, len(A)))

    def sizes(b):
        region = Polytope(A, b)
        box = region.bounding_box()
        return region.size(), box.lower, box.upper

    for compiled, plain in zip(jax.jit(sizes)(b), sizes(b), strict=True):
        np.testing.assert_allclose(compiled, plain, rtol=1e-12)


def test_offsets_along_facets_bound_the_support_and_are_found_by_direction_alone():
    A = np.array([[2.0, 0.0], [0.0, 1.0], [-1.0, -1.0], [1.0, 0.0], [3.0, 3.0]])
    b = np.array([2.0, 1.0, 1.0, 0.5, 30.0])
    wanted = np.array([[4.0, 0.0], [-0.5, -0.5], [1.0, 1.0]])
    found, known = (np.asarray(part) for part in supports.offsets_along(A, b, wanted))
    assert known.all()
    np.testing.assert_allclose(found, [2.0, 0.5, 10.0])  # the least of two; the last is redundant
    assert np.all(found >= np.asarray(Polytope(A, b).support(wanted)) * (1 - 1e-12))
    for others in (np.array([[1.0, 2.0]]), np.zeros((1, 2))):
        offsets, known = supports.offsets_along(A, b, others)
        assert np.isinf(offsets).all()
        assert not known.any()
    traced = jax.jit(supports.offsets_along)(A, b, wanted)
    np.testing.assert_array_equal(traced[0], found)
    np.testing.assert_array_equal(traced[1], True)


def test_bounds_are_offsets_along_facets_and_supports_elsewhere():
    A, b, _ = polygon(5)
    bounds = jax.jit(lambda b, D: Polytope(A, b).bounds_along(D))
    elsewhere = np.array([[0.3, -0.8]])
    np.testing.assert_allclose(bounds(b, elsewhere), Polytope(A, b).support(elsewhere), rtol=1e-9)
    slopes = jax.jacobian(lambda b: Polytope(A, b).bounds_along(A[:1]))(jnp.asarray(b))
    np.testing.assert_array_equal(slopes, np.eye(len(b))[:1])


@pytest.mark.parametrize("seed", range(5))
def test_boxes_are_as_far_apart_as_linear_programs_say_with_the_same_slopes(seed):
    rng = np.random.default_rng(seed)
    lower, other = rng.normal(size=(2, 3))
    upper, last = lower + rng.uniform(0.1, 1, 3), other + rng.uniform(0.1, 1, 3)

    def apart(lower, upper):
        return Box(lower, upper).separation(Box(other, last))

    compiled = jax.jit(jax.value_and_grad(apart, argnums=(0, 1)))
    assert "callback" not in str(jax.make_jaxpr(compiled)(lower, upper))
    value, (by_lower, by_upper) = compiled(lower, upper)
    exact = np.maximum(lower - last, other - upper).max()
    assert exact - 1e-12 <= float(value) <= exact
    assert float(value) == pytest.approx(float(apart(lower, upper)), rel=1e-9, abs=1e-12)
    assert np.count_nonzero(by_lower) + np.count_nonzero(by_upper) == 1
    assert by_lower.sum() - by_upper.sum() == 1


@pytest.mark.parametrize("seed", range(5))
def test_overlapping_boxes_are_as_deep_in_one_another_as_linear_programs_say(seed):
    """The other box may have no point left before its facets have left the one."""
    rng = np.random.default_rng(seed)
    one = Box(*np.sort(rng.normal(size=(2, 2)) * 3, axis=0))
    middle = np.asarray(one.center)
    other = Box(middle - rng.uniform(0.1, 4, 2), middle + rng.uniform(0.1, 4, 2))
    value = jax.jit(lambda box: box.separation(other))(one)
    assert value < 0
    assert float(value) == pytest.approx(float(one.separation(other)), rel=1e-9)
