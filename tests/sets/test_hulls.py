"""Corners of polytopes and points drawn from them."""

import itertools

import numpy as np
import pytest
import scipy.stats

from reachjax.sets import hulls


def test_vertices_of_an_interval_come_in_order():
    corners = hulls.vertices(np.array([[2.0], [-4.0]]), np.array([1.0, 4.0]))
    np.testing.assert_allclose(corners, [[-1.0], [0.5]], rtol=1e-13)


def test_samples_are_uniform_although_triangles_are_not_of_one_size():
    # a rectangle of area 10 with a tip of area 0.5 at its left end
    A = np.array([[0.0, 1.0], [0.0, -1.0], [1.0, 0.0], [-1.0, 1.0], [-1.0, -1.0]])
    b = np.array([0.5, 0.5, 10.0, 0.5, 0.5])
    tip = 0.25
    x = hulls.uniform(A, b, np.random.default_rng(0), 20_000)
    assert (x @ A.T <= b + 1e-12).all()
    # standard deviations of these estimates: 0.0011, 0.021 and 0.002
    assert np.mean(x[:, 0] < 0) == pytest.approx(tip / (10 + tip), abs=0.005)
    assert np.mean(x[:, 0]) == pytest.approx((10 * 5 - tip / 6) / (10 + tip), abs=0.1)
    assert np.mean(x[:, 1]) == pytest.approx(0.0, abs=0.01)


def _simplex(n):
    """Facets of a simplex; along each axis its mean, and its second and fourth central moments."""
    A, b = np.vstack([-np.eye(n), np.ones((1, n))]), np.r_[np.zeros(n), 1.0]
    return A, b, 1 / (n + 1), [_of_beta(order, 1, n) for order in (2, 4)]


def _cube(n):
    return np.vstack([-np.eye(n), np.eye(n)]), np.ones(2 * n), 0.0, [1 / 3, 1 / 5]


def _cross(n):
    A = np.array(list(itertools.product([-1.0, 1.0], repeat=n)))
    second, fourth = 2 / ((n + 1) * (n + 2)), 24 / np.prod(np.arange(n + 1, n + 5))
    return A, np.ones(len(A)), 0.0, [second, fourth]


def _of_beta(order, a, b):
    """The central moment of a beta distribution, which a coordinate of a simplex has."""
    return scipy.stats.beta(a, b).expect(lambda x: (x - a / (a + b)) ** order)


SIGMAS = 5.5
"""An estimate is farther off with probability 4e-8, over all the estimates here 5e-6."""


@pytest.mark.parametrize("shape", [_simplex, _cube, _cross])
@pytest.mark.parametrize("n", [2, 3, 6])
def test_samples_have_the_moments_of_uniform_ones(shape, n):
    # in six dimensions they are ends of walks
    count, (A, b, mean, (second, fourth)) = 20_000, shape(n)
    x = hulls.uniform(A, b, np.random.default_rng(0), count)
    assert (x @ A.T <= b + 1e-12).all()
    off = SIGMAS / np.sqrt(count)
    np.testing.assert_allclose(x.mean(axis=0), mean, rtol=0, atol=off * np.sqrt(second))
    spread = np.sqrt(fourth - second**2)
    np.testing.assert_allclose(np.mean((x - mean) ** 2, axis=0), second, rtol=0, atol=off * spread)


def test_volumes_and_corners_of_a_box_whose_sides_are_of_different_scales():
    A, b = np.vstack([np.eye(2), -np.eye(2)]), np.array([1e60, 1e-60, 0.0, 0.0])
    assert hulls.volume(A, b) == pytest.approx(1.0)
    corners = hulls.vertices(A, b)
    assert {tuple(row) for row in np.round(corners / [1e60, 1e-60], 9) + 0.0} == {
        (0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)
    }  # fmt: skip
    np.testing.assert_allclose(hulls.facet_areas(A, b)[1], [1e-60, 1e60, 1e-60, 1e60])


def test_an_interval_without_points_is_refused():
    with pytest.raises(ValueError, match="empty"):
        hulls.volume(np.array([[1.0], [-1.0]]), np.array([0.0, -1.0]))
    with pytest.raises(ValueError, match="unbounded"):
        hulls.vertices(np.array([[1.0]]), np.array([0.0]))


ROWS = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, -0.0], [-0.0, -1.0], [1.9e-6, -3.0]])


@pytest.mark.parametrize(
    "point", [[0.0, 0.0], [0.1, -1 / 3], [5e3, 0.0], [1e7 / 3, -1e-7 / 3], [1e-300, 0.0]]
)
def test_a_polytope_of_one_point_has_one_corner(point):
    b = np.r_[point, np.negative(point), ROWS[-1] @ point + 0.1 + abs(ROWS[-1]) @ np.abs(point)]
    for size in (1.0, 0.3, np.r_[0.1, 7.0, 0.3, 1.1, 300.0]):  # which round both ends apart
        A, d = ROWS * np.reshape(size * np.ones(5), (5, 1)), b * size
        np.testing.assert_allclose(hulls.vertices(A, d), [point], rtol=1e-14, atol=1e-280)
        assert hulls.volume(A, d) == 0.0
        assert hulls.uniform(A, d, np.random.default_rng(0), 3).shape == (3, 2)


def test_points_are_drawn_from_a_segment_far_away():
    A = np.array([[0.8, 0.6], [-0.6, 0.8], [-0.8, -0.6], [0.6, -0.8]])
    b = np.array([1e8, 0.1, -1e8 + 1, -0.1])
    x = hulls.uniform(A, b, np.random.default_rng(0), 5)
    assert np.all(x @ A.T <= b + 1e-6)
    assert np.ptp(x @ A[0]) > 0.1
