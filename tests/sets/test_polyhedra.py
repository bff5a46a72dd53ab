"""Claims about the linear programs and triangulations behind polytopes."""

from fractions import Fraction

import cvxpy as cp
import numpy as np
import pytest

from reachjax.sets import linear_programs
from reachjax.sets.linear_programs import separation_and_multipliers
from tests.networks import box_region, simplex_region

fractions = np.vectorize(Fraction, otypes=[object])


def cube(lower, upper):
    n = len(lower)
    return np.vstack([-np.eye(n), np.eye(n)]), np.r_[-np.asarray(lower), upper]


@pytest.fixture(params=[(n, kind) for n in (1, 2, 3, 6) for kind in ("box", "simplex")], ids=str)
def region(request):
    n, kind = request.param
    return simplex_region(n, n) if kind == "simplex" else box_region(n, n, rotated=n > 1)


def test_dual_multipliers_are_nonnegative_and_prove_the_support(region):
    for a in np.random.default_rng(0).normal(size=(10, region.A.shape[1])):
        y, x = linear_programs.maximiser(region.A, region.b, a)
        assert x @ a == pytest.approx((region.corners @ a).max(), abs=1e-9)
        assert (y >= 0).all()
        np.testing.assert_allclose(y @ region.A, a, atol=1e-12)
        assert y @ region.b == pytest.approx((region.corners @ a).max(), abs=1e-10)


@pytest.mark.parametrize("size", [1e-200, 1e200])
def test_supports_in_directions_whose_squares_are_no_numbers(region, size):
    D = np.random.default_rng(1).normal(size=(10, region.A.shape[1]))
    values = linear_programs.support(region.A, region.b, size * D)[0]
    np.testing.assert_allclose(
        values / size, linear_programs.support(region.A, region.b, D)[0], rtol=1e-9
    )


def test_bounds_hold_for_the_exact_corners_of_a_long_thin_triangle():
    # x <= 1, x + 1e6 y >= 0 and x - 1e6 y >= 0: corners (0, 0) and (1, -+1e-6), to rounding
    A, b = np.array([[1.0, 0.0], [-1.0, -1e6], [-1.0, 1e6]]), np.array([1.0, 0.0, 0.0])
    lower, upper = (fractions(part) for part in linear_programs.bounding_box(A, b)[:2])
    tip = 1 / Fraction(1e6)
    assert lower[0] <= 0
    assert lower[1] <= -tip
    assert upper[0] >= 1
    assert upper[1] >= tip
    assert max(-lower[0], upper[0] - 1, -tip - lower[1], upper[1] - tip) < 1e-8


def test_bounds_pay_for_inexact_multipliers(monkeypatch):
    A, b, inexact = *cube([-2, -1], [1, 3]), linear_programs.maximisers

    def sloppy(A, b, D):
        Y, points = inexact(A, b, D)
        return 0.99 * Y + 0.001, points

    monkeypatch.setattr(linear_programs, "maximisers", sloppy)
    monkeypatch.setattr(linear_programs, "_boxed", linear_programs._boxed.__wrapped__)  # not kept
    lower, upper, *_ = linear_programs.bounding_box(A, b)
    assert (lower <= [-2, -1]).all()
    assert (upper >= [1, 3]).all()
    directions = np.array([[1.0, 1.0], [-1.0, 0.5]])
    assert (linear_programs.support(A, b, directions)[0] >= [4.0, 3.5]).all()


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_the_largest_ball_in_a_cube_and_in_a_simplex(n):
    center, radius = linear_programs.chebyshev(*cube([1.0] * n, [1.5] * n))
    np.testing.assert_allclose(center, 1.25)
    assert radius == pytest.approx(0.25)
    A, b = np.vstack([-np.eye(n), np.ones((1, n))]), np.r_[np.zeros(n), 1.0]
    assert linear_programs.chebyshev(A, b)[1] == pytest.approx(1 / (n + np.sqrt(n)))


def test_the_largest_ball_of_an_unbounded_or_empty_polytope_is_refused():
    with pytest.raises(ValueError, match="unbounded"):
        linear_programs.chebyshev(np.array([[1.0, 0.0]]), np.array([1.0]))
    with pytest.raises(ValueError, match="empty"):
        linear_programs.chebyshev(np.array([[1.0], [-1.0]]), np.array([0.0, -1.0]))


@pytest.mark.parametrize(
    ("A", "b", "empty"),
    [
        ([[1.0, 0.0], [-1.0, 0.0]], [1.0, -2.0], True),
        ([[1.0, 0.0], [-1.0, 0.0]], [1.0, -1.0], False),  # a line
        ([[1.0, 0.0], [-1.0, 0.0]], [1.0, -1.0 - 1e-12], False),  # by less than programs tell
        ([[0.0, 0.0]], [-1.0], True),
        ([[1e9, 1e9], [-1e9, 0.0], [0.0, -1e9]], [-1.0, 0.0, 0.0], True),
        ([[1.0, 0.0]], [1.0], False),
        ([[1.0, 1e-9], [-1.0, 0.0]], [0.0, -1.0], False),  # far away there are points
    ],
)
def test_what_is_said_to_be_empty_surely_is(A, b, empty):
    assert linear_programs.is_empty(np.array(A), np.array(b)) == empty


# Boxes around the origin against a box whose nearest facet is `gap` away: margins are known.
@pytest.mark.parametrize("gap", [2.0, 0.25, 0.0, -0.5])
@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_the_margin_of_two_boxes_is_the_gap_between_their_facets(n, gap):
    A, b = cube([-1.0] * n, [1.0] * n)
    C, d = cube([1.0 + gap, *[-3.0] * (n - 1)], [5.0 + gap, *[3.0] * (n - 1)])
    margin = separation_and_multipliers(A, b, C, d)[0]
    assert Fraction(margin) <= Fraction(gap)
    assert margin == pytest.approx(gap, abs=1e-12)


def test_the_margin_is_a_distance_along_normals_not_between_corners():
    margin = separation_and_multipliers(*cube([0, 0], [1, 1]), *cube([2, 2], [3, 3]))[0]
    assert margin == pytest.approx(1.0, abs=1e-12)
    diagonal, offset = np.array([[-1.0, -1.0]]), np.array([-4.0])  # x + y >= 4
    margin = separation_and_multipliers(*cube([0, 0], [1, 1]), diagonal, offset)[0]
    assert margin == pytest.approx(np.sqrt(2), abs=1e-12)


@pytest.mark.parametrize("distance", [0.0, 0.7, 1.5, 4.0])
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("n", [2, 3])
def test_the_margin_is_that_of_a_convex_program(n, seed, distance):
    rng = np.random.default_rng(seed)
    first, second = simplex_region(n, seed), box_region(n, seed + 10, rotated=True)
    away = rng.normal(size=n)
    away = (
        first.corners.mean(axis=0)
        - second.corners.mean(axis=0)
        + distance * away / np.linalg.norm(away)
    )
    scales = rng.uniform(0.1, 10.0, len(second.b))  # facet normals need not have unit length
    C = second.A * scales[:, None]
    d = (second.b + second.A @ away) * scales
    x = cp.Variable(n)
    excess = cp.max(cp.multiply(1 / np.linalg.norm(C, axis=1), C @ x - d))
    expected = cp.Problem(cp.Minimize(excess), [first.A @ x <= first.b]).solve(solver="CLARABEL")
    margin = separation_and_multipliers(first.A, first.b, C, d)[0]
    assert margin == pytest.approx(expected, abs=1e-6)
    assert distance not in (0.0, 4.0) or (expected > 0) == (distance == 4.0)


@pytest.mark.parametrize(("lower", "upper"), [
    ([-1e150, -1e150], [1e150, 1e150]),
    ([0.0, 0.0], [1e60, 1e-60]),
    ([1e-30, 1e30], [1.1e-30, 1.1e30]),
    ([0.0, 1.0], [1e300, 1.5]),
    ([-1e-160, 1e-170], [1e-160, 2e-170]),
], ids=str)  # fmt: skip
@pytest.mark.parametrize("rows", [1.0, 1e155, 1e-170])
def test_boxes_of_any_scale_are_found_with_facets_of_any_length(lower, upper, rows):
    A, b = cube(lower, upper)
    logs = np.log10(np.where(b == 0, 1.0, abs(b))) + np.log10(rows)
    kept = (b == 0) | (abs(logs) < 300)  # offsets that floats hold
    A, b = np.vstack([A, A[kept] * rows]), np.r_[b, b[kept] * rows]
    found = linear_programs.bounding_box(A, b)
    size = 1e-12 * np.maximum(np.abs(lower), np.abs(upper))
    assert (found[0] <= lower).all()
    assert (found[1] >= upper).all()
    assert (found[0] >= lower - size).all()
    assert (found[1] <= upper + size).all()


def test_a_small_facet_tells_two_sets_apart():
    small = np.array([[1e-170, 0.0]]), np.array([-1e-165])  # x <= -1e5
    margin = separation_and_multipliers(*cube([-1, -1], [1, 1]), *small)[0]
    assert margin == pytest.approx(1e5 - 1)


@pytest.mark.parametrize("size", [1e-160, 1e-60, 1e60, 1e150])
def test_separations_and_supports_grow_with_their_sets(size):
    triangle, box = simplex_region(2, 3), cube([3.0, 3.0], [4.0, 5.0])
    once = separation_and_multipliers(triangle.A, triangle.b, *box)[0]
    scaled = separation_and_multipliers(triangle.A, size * triangle.b, box[0], size * box[1])[0]
    assert scaled == pytest.approx(size * once, rel=1e-9)
    D = np.array([[1.0, 2.0], [-1.0, 0.5]])
    values = linear_programs.support(triangle.A, size * triangle.b, D)[0]
    np.testing.assert_allclose(
        values, size * linear_programs.support(triangle.A, triangle.b, D)[0], 1e-9
    )
