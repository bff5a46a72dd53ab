"""Claims about polytopes: known shapes, sheared by integer matrices so that corners are exact."""

import contextlib
import itertools
from fractions import Fraction
from math import factorial

import jax
import numpy as np
import pytest

import reachjax as rj
from reachjax.sets.unusable import ThinSetError

DIMENSIONS = [1, 2, 3, 6]
fractions = np.vectorize(Fraction, otypes=[object])


def cube(n):
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=n)))
    return np.vstack([np.eye(n), -np.eye(n)]), np.ones(2 * n), corners


def simplex(n):
    A = np.vstack([-np.eye(n), np.ones((1, n))])
    return A, np.r_[np.zeros(n), 1.0], np.vstack([np.zeros((1, n)), np.eye(n)])


def cross_polytope(n):
    A = np.array(list(itertools.product((-1.0, 1.0), repeat=n)))
    return A, np.ones(2**n), np.vstack([np.eye(n), -np.eye(n)])


SHAPES = {"cube": cube, "simplex": simplex, "cross-polytope": cross_polytope}
VOLUMES = {
    "cube": lambda n: 2.0**n,
    "simplex": lambda n: 1 / factorial(n),
    "cross-polytope": lambda n: 2.0**n / factorial(n),
}


def sheared(A, b, corners):
    """The image under `x -> U x + s`, `U` integer with determinant one and `s` integer."""
    n = A.shape[1]
    rng = np.random.default_rng(n)
    U = np.eye(n) + np.triu(rng.integers(-2, 3, (n, n)), 1)
    shift = rng.integers(-5, 6, n).astype(float)
    A = np.round(A @ np.linalg.inv(U))
    return A, b + A @ shift, corners @ U.T + shift


@pytest.fixture(params=[(name, n) for name in SHAPES for n in DIMENSIONS], ids=str)
def shape(request):
    """(A, b, corners), all integers."""
    name, n = request.param
    return sheared(*SHAPES[name](n))


def same_points(actual, expected, tolerance):
    """Both sets of points are the same, in any order and without repetition."""
    distance = np.linalg.norm(np.asarray(actual)[:, None] - expected[None], axis=2)
    assert distance.shape[0] == distance.shape[1]
    assert distance.min(axis=0).max() <= tolerance
    assert distance.min(axis=1).max() <= tolerance


def test_facts_are_nonnegative_exactly_on_members(shape):
    A, b, corners = shape
    polytope = rj.Polytope(A, b)
    rng = np.random.default_rng(0)
    center = corners.mean(axis=0)
    inside = center + 0.99 * (rng.dirichlet(np.ones(len(corners)), 100) @ corners - center)
    outside = center + 1.01 * (corners - center)
    facts = np.asarray(polytope.facts())
    assert np.all(np.hstack([inside, np.ones((100, 1))]) @ facts.T >= 0)
    assert np.all(np.hstack([corners, np.ones((len(corners), 1))]) @ facts.T >= 0)
    assert np.all(np.min(np.hstack([outside, np.ones((len(outside), 1))]) @ facts.T, axis=1) < 0)
    assert polytope.contains(np.vstack([inside, corners])).all()
    assert not polytope.contains(outside).any()


def test_the_support_is_the_largest_value_at_a_corner_and_never_below_it(shape):
    A, b, corners = shape
    directions = np.random.default_rng(1).normal(size=(20, A.shape[1]))
    directions = np.vstack([directions, A[:4]])
    support = np.asarray(rj.Polytope(A, b).support(directions))
    exact = (fractions(corners) @ fractions(directions).T).max(axis=0)
    assert (fractions(support) >= exact).all()
    np.testing.assert_allclose(support, exact.astype(float), rtol=1e-11, atol=1e-11)


def test_the_bounding_box_holds_every_corner_and_touches_them(shape):
    A, b, corners = shape
    box = rj.Polytope(A, b).bounding_box()
    assert (np.asarray(box.lower) <= corners.min(axis=0)).all()
    assert (np.asarray(box.upper) >= corners.max(axis=0)).all()
    np.testing.assert_allclose(box.lower, corners.min(axis=0), rtol=0, atol=1e-11)
    np.testing.assert_allclose(box.upper, corners.max(axis=0), rtol=0, atol=1e-11)


def test_vertices_are_the_corners(shape):
    A, b, corners = shape
    same_points(rj.Polytope(A, b).vertices(), corners, 1e-9)


def test_samples_lie_inside_and_differ(shape):
    A, b, _ = shape
    polytope = rj.Polytope(A, b)
    samples = np.asarray(polytope.sample(jax.random.key(0), 500))
    assert polytope.contains(samples, tolerance=1e-9).all()
    assert len(np.unique(samples, axis=0)) == 500
    again, other = (polytope.sample(jax.random.key(seed), 500) for seed in (0, 1))
    np.testing.assert_array_equal(samples, again)
    assert not np.array_equal(samples, other)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 6])
@pytest.mark.parametrize("name", SHAPES)
def test_the_volume_is_that_of_the_shape(name, n):
    A, b, _ = sheared(*SHAPES[name](n))
    assert rj.Polytope(A, b).volume() == pytest.approx(VOLUMES[name](n), rel=1e-9)


def test_redundant_and_repeated_facets_change_nothing(shape):
    A, b, corners = shape
    n = A.shape[1]
    plain = rj.Polytope(A, b)
    more = rj.Polytope(np.vstack([A, 3 * A, A]), np.r_[b, 3 * b, b + 50])
    same_points(more.vertices(), corners, 1e-9)
    assert more.volume() == pytest.approx(plain.volume(), rel=1e-9)
    axes = np.vstack([np.eye(n), -np.eye(n)])
    np.testing.assert_allclose(more.support(axes), plain.support(axes), atol=1e-11)


def test_lengths_of_facet_normals_do_not_matter():
    Q = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    A, b = np.vstack([Q, -Q]), np.r_[1.0, 2.0, 3.0, 1.0, 2.0, 3.0] + 0.1
    expected = rj.Polytope(A, b).bounding_box()
    same = (np.full(b.shape, length) for length in (1e-12, 1e-9, 1e-4, 1e4, 1e9, 1e12))
    for lengths in (*same, 10.0 ** np.arange(-6, 6)[::2]):
        polytope = rj.Polytope(A * lengths[:, None], b * lengths)
        np.testing.assert_allclose(polytope.bounding_box().upper, expected.upper, rtol=1e-9)
        assert polytope.volume() == pytest.approx(2.2 * 4.2 * 6.2, rel=1e-9)


def flat_cuboid(half_widths, skew):
    """A cuboid, some of whose half-widths are zero, along the axes or in skew directions."""
    n = len(half_widths)
    rng = np.random.default_rng(n)
    Q = np.linalg.qr(rng.normal(size=(n, n)))[0] if skew else np.eye(n)
    center, h = rng.uniform(-2.0, 2.0, n), np.asarray(half_widths, dtype=float)
    A = np.vstack([Q, -Q])
    corners = center + np.array(list(itertools.product(*[sorted({-w, w}) for w in h]))) @ Q
    return rj.Polytope(A, A @ center + np.r_[h, h]), corners


FLAT = [(0, 1), (0, 0), (0,), (0, 1, 2), (0, 0, 2), (0, 0, 0), (0, 1, 1, 0, 2, 0)]


@pytest.mark.parametrize("skew", [False, True], ids=["along axes", "skew"])
@pytest.mark.parametrize("half_widths", FLAT, ids=str)
def test_flat_polytopes_have_corners_samples_and_volume_zero(half_widths, skew):
    polytope, corners = flat_cuboid(half_widths, skew)
    same_points(np.unique(np.round(polytope.vertices(), 9), axis=0), corners, 1e-8)
    assert polytope.volume() <= 1e-12
    samples = polytope.sample(jax.random.key(0), 200)
    assert polytope.contains(samples, tolerance=1e-9).all()
    spread, rank = np.ptp(samples, axis=0).max(), sum(w > 0 for w in half_widths)
    assert (spread > 0.1) == (rank > 0)
    assert np.linalg.matrix_rank(samples - samples.mean(axis=0), tol=1e-6) == rank


UNANSWERED = {
    "support": lambda P: P.support(np.array([[1.0, 0.5]])),
    "bounding box": lambda P: P.bounding_box(),
    "vertices": lambda P: P.vertices(),
    "volume": lambda P: P.volume(),
    "samples": lambda P: P.sample(jax.random.key(0), 3),
}


@pytest.mark.parametrize("ask", UNANSWERED.values(), ids=UNANSWERED.keys())
def test_an_empty_polytope_says_so(ask):
    strip = rj.Polytope([[1, 0], [-1, 0]], [0, -1])
    triangle = rj.Polytope([[1, 0], [0, 1], [-1, -1]], [0, 0, -1])
    for polytope in (strip, triangle):
        with pytest.raises(ValueError, match="is empty"):
            ask(polytope)


@pytest.mark.parametrize("ask", [*UNANSWERED.values()][1:], ids=[*UNANSWERED.keys()][1:])
def test_a_polytope_that_a_linear_program_calls_infeasible_is_not_said_to_be_empty(ask):
    A = [[0.04278881913116914, 0, 0], [0, 88.75759809568211, 0], [0, 0, 1932.6254809933992]]
    A += [[-1.416967214416641, 0, 0], [0, -995.8051198913226, 0], [0, 0, -54.792655654112764]]
    A += [[2063.407565280635, 1209.9649586781413, 526.7145036912622]]
    A += [[0.1355315913783207, -0.31707284467892216, -0.08470070074143014]]
    b = [81.29697988440091, -248455.7037955008, -45033003.822574005, -2692.176863671695]
    b += [2787518.6712358524, 1276750.7739225973, -11739842.594842771, 3118.7281105908028]
    ends = [[Fraction(b[row]) / Fraction(A[row][i]) for row in (i, i + 3)] for i in range(3)]
    points = itertools.product(*ends)
    exact = [[Fraction(a) for a in row] for row in A]
    assert any(
        all(
            sum(a * x for a, x in zip(row, point, strict=True)) <= c
            for row, c in zip(exact, b, strict=True)
        )
        for point in points
    )
    with contextlib.suppress(ThinSetError):  # a ValueError would say that there is no point
        ask(rj.Polytope(A, b))


@pytest.mark.parametrize("ask", UNANSWERED.values(), ids=UNANSWERED.keys())
def test_a_half_space_is_a_set_until_something_finite_is_asked_of_it(ask):
    half_space = rj.Polytope([[1.0, 1.0]], [1.0])
    assert half_space.contains([-100.0, 0.0])
    assert not half_space.contains([1.0, 0.1])
    np.testing.assert_array_equal(half_space.facts(), [[-1.0, -1.0, 1.0]])
    with pytest.raises(ValueError, match="is unbounded in direction"):
        ask(half_space)


def test_samples_in_six_dimensions_are_uniform():
    rng = np.random.default_rng(0)
    sides, turn = (
        np.array([1.0, 1.0, 1e-3, 1.0, 1.0, 100.0]),
        np.linalg.qr(rng.normal(size=(6, 6)))[0],
    )
    A, center = np.vstack([turn.T, -turn.T]), rng.normal(size=6)
    polytope = rj.Polytope(A, A @ center + np.tile(sides, 2))
    samples = np.asarray(polytope.sample(jax.random.key(0), 4000))
    along = (samples - center) @ turn / sides
    assert polytope.contains(samples, tolerance=1e-9).all()
    np.testing.assert_allclose(along.mean(axis=0), 0.0, atol=0.06)  # 1/sqrt(3 * 4000) is 0.009
    np.testing.assert_allclose(np.cov(along.T), np.eye(6) / 3, atol=0.04)
