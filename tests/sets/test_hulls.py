"""Corners of polytopes and points drawn from them."""

import numpy as np
import pytest

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


@pytest.mark.parametrize("n", [2, 3, 6])
def test_samples_of_a_simplex_have_its_moments(n):
    A, b = np.vstack([-np.eye(n), np.ones((1, n))]), np.r_[np.zeros(n), 1.0]
    x = hulls.uniform(A, b, np.random.default_rng(0), 20_000)
    np.testing.assert_allclose(x.mean(axis=0), 1 / (n + 1), atol=0.01)
    np.testing.assert_allclose(x.var(axis=0), n / ((n + 1) ** 2 * (n + 2)), rtol=0.05)
