"""Claims about the part of a polytope that lies in an ellipsoid, in 1, 2 and 3 dimensions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.networks import simplex_region
from tests.sets.test_ellipsoid import ellipsoid


def intersection(n, seed=0):
    """A simplex, and an ellipsoid around its middle that cuts its corners off and its facets."""
    region = simplex_region(n, seed)
    spread = np.cov(region.corners.T).reshape(n, n)
    size = 0.7 if n > 1 else 0.3
    round_part = rj.Ellipsoid(region.corners.mean(axis=0), size * (spread + 0.02 * np.eye(n)))
    return rj.Intersection(rj.Polytope(region.A, region.b), round_part)


SIGMAS = 5.5
"""An estimate is farther off with probability 4e-8."""


def members(X, count=20_000):
    """Points of the bounding box that are in the set, by a route that its sampler does not take."""
    points = X.bounding_box().sample(jax.random.key(7), count)
    return points[X.contains(points)]


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.costly
def test_facts_hold_on_members_and_one_fails_on_every_other_point(n):
    X = intersection(n)
    points = np.asarray(X.polytope.bounding_box().sample(jax.random.key(0), 5000))
    padded = np.hstack([points, np.ones((len(points), 1))])
    cone = padded @ X.cone_facts().T
    holds = (padded @ X.facts().T >= 0).all(axis=1)
    holds &= np.linalg.norm(cone[:, 1:], axis=1) <= cone[:, 0]
    np.testing.assert_array_equal(X.contains(points), holds)
    assert 0 < holds.sum() < 5000
    limits = np.append(X.polytope.b, 1.0)
    np.testing.assert_array_equal((X.bounded_values(points) <= limits).all(axis=1), holds)
    surely = [X.surely_contains(point) for point in points[:100]]
    np.testing.assert_array_equal(surely, holds[:100])


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.costly
def test_no_member_is_beyond_support_box_or_volume(n):
    X, rng = intersection(n), np.random.default_rng(n)
    x, D = np.asarray(members(X)), rng.normal(size=(6, n))
    assert np.all(x @ D.T <= X.support(D))
    for part in X.parts:
        assert np.all(X.support(D) <= part.support(D))
        assert X.volume() <= part.volume()
    box, tried = X.bounding_box(), 20_000
    assert np.all((box.lower <= x) & (x <= box.upper))
    estimate = float(box.volume()) * len(x) / tried
    assert estimate <= X.volume() * (1 + 3 / np.sqrt(len(x)))


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.costly
def test_samples_are_uniform_and_reach_both_parts_of_the_surface(n):
    X = intersection(n)
    x, others = X.sample(jax.random.key(0), 5000), members(X)
    assert bool(X.contains(x, 1e-12).all())
    # moments of both are independent estimates, of which there may be few from the bounding box
    off = SIGMAS * np.sqrt(1 / len(x) + 1 / len(others))
    first = (x - others.mean(axis=0)) / x.std(axis=0)
    second = (x - x.mean(axis=0)) ** 2
    spread = second.std(axis=0) / second.mean(axis=0)
    assert np.all(abs(first.mean(axis=0)) <= off)
    assert np.all(abs(others.var(axis=0) / x.var(axis=0) - 1) <= off * spread)
    surface = X.sample_boundary(jax.random.key(1), 500)
    assert bool(X.contains(surface, 1e-9).all())
    at_facets = (X.polytope.bounded_values(surface) - X.polytope.b).max(axis=1) > -1e-9
    at_ellipsoid = X.ellipsoid.bounded_values(surface)[:, 0] > 1 - 1e-9
    assert bool((at_facets | at_ellipsoid).all())
    assert n == 1 or (bool(at_facets.any()) and bool(at_ellipsoid.any()))


def test_a_part_inside_the_other_is_the_set():
    inner, ball = rj.Box([0.1, 0.1], [0.2, 0.2]), rj.Ellipsoid([0.0, 0.0], np.eye(2))
    X = rj.Intersection(inner, ball)
    D = np.random.default_rng(0).normal(size=(5, 2))
    np.testing.assert_array_equal(X.support(D), inner.support(D))
    assert float(X.volume()) == pytest.approx(0.01)
    X = rj.Intersection(rj.Box([-2.0, -2.0], [2.0, 2.0]), ball)
    np.testing.assert_array_equal(X.support(D), ball.support(D))
    assert float(X.volume()) == pytest.approx(np.pi)


@pytest.mark.parametrize(
    "flat", [rj.Box([0.0, -2.0], [0.0, 2.0]), rj.Box([0.3, 0.4], [0.3, 0.4])], ids=["line", "point"]
)
@pytest.mark.costly
def test_a_flat_part_is_sampled_within_itself(flat):
    X = rj.Intersection(flat, rj.Ellipsoid([0.0, 0.0], np.eye(2)))
    for points in (X.sample(jax.random.key(0), 100), X.sample_boundary(jax.random.key(0), 100)):
        assert bool(flat.contains(points).all())
        assert bool(X.contains(points, 1e-12).all())
    assert float(X.volume()) == 0


@pytest.mark.costly
def test_parts_that_hardly_meet_are_not_sampled_and_parts_that_do_not_have_no_box():
    ball = rj.Ellipsoid([0.0, 0.0], np.eye(2))
    corner = rj.Intersection(rj.Box([0.7, 0.7], [5.0, 5.0]), ball)  # 1e-4 of either part
    with pytest.raises(RuntimeError, match="the intersection is empty, or too thin to be sampled"):
        corner.sample(jax.random.key(0), 10)
    with pytest.raises(ValueError, match="the polytope and the ellipsoid have no point in common"):
        rj.Intersection(rj.Box([2.0, 0.0], [3.0, 1.0]), ball).bounding_box()


@pytest.mark.costly
def test_volumes_and_boxes_have_derivatives_also_when_compiled():
    def measured(offsets, Q):
        X = rj.Intersection(rj.Template.box(2).polytope(offsets), rj.Ellipsoid([0.0, 0.0], Q))
        return jnp.stack([rj.volume(X), jnp.sum(rj.log_widths(X))])

    offsets, Q = jnp.array([3.0, 3.0, 0.5, 0.5]), jnp.diag(jnp.array([1.0, 4.0]))
    values = jax.jit(measured)(offsets, Q)
    np.testing.assert_allclose(values, measured(offsets, Q))
    np.testing.assert_allclose(values, [6.0, np.log(2.0)])  # the box is smaller; 2 by 1 around both
    of_offsets, of_shape = jax.jit(jax.jacrev(measured, (0, 1)))(offsets, Q)
    np.testing.assert_allclose(of_offsets, [[1, 1, 6, 6], [0, 0, 1, 1]], atol=1e-9)
    np.testing.assert_allclose(of_shape[1], [[0.5, 0.0], [0.0, 0.0]], atol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ((ellipsoid(2), ellipsoid(2)), TypeError, "polytope must be a Box or a Polytope, but an E"),
        (
            (rj.Box([0], [1]), rj.Box([0], [1])),
            TypeError,
            "ellipsoid must be an Ellipsoid, but a B",
        ),
        ((rj.Box([0], [1]), ellipsoid(2)), ValueError, "Intersection.ellipsoid has dimension 2"),
        ((rj.Box([[0], [0]], [[1], [1]]), ellipsoid(1)), ValueError, "polytope must be one box"),
    ],
)
def test_bad_parts_are_named(arguments, error, message):
    with pytest.raises(error, match=message):
        rj.Intersection(*arguments)
