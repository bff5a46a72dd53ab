"""Claims about ellipsoids, in 1, 2, 3 and 6 dimensions."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj

DIMENSIONS = [1, 2, 3, 6]


def ellipsoid(n, seed=0, scale=1.0):
    rng = np.random.default_rng([n, seed])
    factor = scale * rng.normal(size=(n, n))
    return rj.Ellipsoid(rng.normal(size=n), factor @ factor.T + 0.1 * scale**2 * np.eye(n))


@pytest.mark.parametrize("n", DIMENSIONS)
@pytest.mark.costly
def test_the_cone_fact_holds_exactly_on_members(n):
    E = ellipsoid(n)
    x = np.asarray(E.sample_boundary(jax.random.key(0), 500) - E.center)
    rows = np.asarray(E.cone_facts())
    for factor, inside in ((0.5, True), (1 - 1e-9, True), (1 + 1e-9, False), (2.0, False)):
        points = np.asarray(E.center) + factor * x
        padded = np.hstack([points, np.ones((500, 1))]) @ rows.T
        holds = np.linalg.norm(padded[:, 1:], axis=1) <= padded[:, 0]
        assert np.all(holds == inside)
        np.testing.assert_array_equal(E.contains(points), holds)
    assert len(E.facts()) == 0


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.costly
def test_the_cone_fact_is_sound_in_exact_arithmetic(n):
    # with a shape and points of large dynamic range, and rational arithmetic to decide
    E = rj.Ellipsoid(1e3 * np.arange(1, n + 1), np.diag(10.0 ** -np.arange(2, n + 2)) + 1e-6)
    Q = [[Fraction(float(v)) for v in row] for row in E.shape]
    x = np.asarray(E.sample_boundary(jax.random.key(1), 200))
    rows = [[Fraction(float(v)) for v in row] for row in E.cone_facts()]
    members = 0
    for point in x:
        exact = [Fraction(float(v)) for v in point]
        if (
            quadratic_form(
                Q, [a - Fraction(float(q)) for a, q in zip(exact, E.center, strict=True)]
            )
            > 1
        ):
            assert not E.surely_contains(point)
            continue
        members += 1
        values = [
            sum(a * b for a, b in zip(row, [*exact, Fraction(1)], strict=True)) for row in rows
        ]
        assert sum(v**2 for v in values[1:]) <= values[0] ** 2
    assert members > 20


def quadratic_form(Q, d):
    """`d' Q^-1 d` by Cramer's rule."""

    def determinant(M):
        if len(M) == 1:
            return M[0][0]
        minors = ([row[:j] + row[j + 1 :] for row in M[1:]] for j in range(len(M)))
        return sum((-1) ** j * M[0][j] * determinant(minor) for j, minor in enumerate(minors))

    n, whole = len(d), determinant(Q)
    solved = [
        determinant([[d[i] if k == j else Q[i][k] for k in range(n)] for i in range(n)]) / whole
        for j in range(n)
    ]
    return sum(a * b for a, b in zip(d, solved, strict=True))


@pytest.mark.parametrize("n", DIMENSIONS)
@pytest.mark.costly
def test_the_support_is_attained_and_never_exceeded(n):
    E = ellipsoid(n)
    D = np.random.default_rng(n).normal(size=(5, n))
    values = np.asarray(E.support(D))
    Q, q = np.asarray(E.shape), np.asarray(E.center)
    attained = q + D @ Q / np.sqrt(np.einsum("mi,ij,mj->m", D, Q, D))[:, None]
    np.testing.assert_allclose(np.sum(D * attained, axis=1), values, rtol=1e-12)
    x = np.asarray(E.sample_boundary(jax.random.key(0), 20_000))
    assert np.all(x @ D.T <= values)
    box = E.bounding_box()
    assert np.all((box.lower <= x) & (x <= box.upper))


@pytest.mark.parametrize("n", DIMENSIONS)
@pytest.mark.costly
def test_samples_are_uniform_in_the_set_and_on_its_surface(n):
    E = ellipsoid(n)
    x = E.sample(jax.random.key(0), 20_000)
    assert bool(jnp.all(E.contains(x, 1e-12)))
    # the covariance of the uniform distribution is Q / (n + 2)
    np.testing.assert_allclose(
        np.cov(x.T) * (n + 2), E.shape, atol=0.05 * float(abs(E.shape).max())
    )
    half = float(jnp.mean(E.contains(E.center + 2 ** (1 / n) * (x - E.center), 0.0)))
    assert half == pytest.approx(0.5, abs=0.02)
    surface = E.sample_boundary(jax.random.key(0), 100)
    A, b = E.normal_form
    np.testing.assert_allclose(jnp.linalg.norm(surface @ A.T + b, axis=1), 1, rtol=1e-9)


@pytest.mark.costly
def test_volumes_of_balls():
    for n, expected in ((1, 2.0), (2, np.pi), (3, 4 * np.pi / 3), (6, np.pi**3 / 6)):
        assert float(rj.Ellipsoid(np.zeros(n), 4 * np.eye(n)).volume()) == pytest.approx(
            2**n * expected
        )
    assert float(rj.log_volume(rj.Ellipsoid([0.0], [[1.0]]))) == pytest.approx(np.log(2))
    gradient = jax.grad(lambda Q: rj.log_volume(rj.Ellipsoid([0.0, 0.0], Q)))(
        jnp.diag(jnp.array([1.0, 4.0]))
    )
    np.testing.assert_allclose(gradient, np.diag([0.5, 0.125]), atol=1e-12)


@pytest.mark.parametrize("coordinates", [(0, 1), (4, 2), (5,)])
@pytest.mark.costly
def test_a_projection_is_the_shadow_of_the_samples(coordinates):
    E = ellipsoid(6)
    shadow = E.projection(*coordinates)
    x = E.sample_boundary(jax.random.key(0), 5000)[:, list(coordinates)]
    assert bool(jnp.all(shadow.contains(x, 1e-9)))
    D = np.random.default_rng(0).normal(size=(4, len(coordinates)))
    lifted = np.zeros((4, 6))
    lifted[:, list(coordinates)] = D
    np.testing.assert_allclose(shadow.support(D), E.support(lifted), rtol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0.0], np.eye(2)), "Ellipsoid.shape has a number of rows of 2"),
        (([0.0, 0.0], np.ones((2, 3))), "must be square: its number of columns is 3"),
        (([0.0, 0.0], [[1.0, 0.5], [0.0, 1.0]]), "must be symmetric"),
        (([0.0, 0.0], [[1.0, 1.0], [1.0, 1.0]]), "must be positive definite, but its eigenvalues"),
        (([0.0], [[-1.0]]), "must be positive definite"),
        (([0.0], [[np.nan]]), "shape must be finite"),
    ],
)
def test_bad_ellipsoids_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        rj.Ellipsoid(*arguments)


@pytest.mark.parametrize(
    ("act", "error", "message"),
    [
        (lambda E: E.projection(0, 2), ValueError, r"distinct and among 0 \.\. 1, but \(0, 2\)"),
        (lambda E: E.projection(1, 1), ValueError, r"distinct and among 0 \.\. 1, but \(1, 1\)"),
        (lambda E: E.projection((0, 1)), TypeError, "a coordinate must be a whole number"),
        (lambda E: E.sample(jax.random.key(0), -1), ValueError, "count must be at least 1"),
        (lambda E: E.sample_boundary(jax.random.key(0), 1.5), TypeError, "count must be a whole"),
        (
            lambda E: E.surely_contains([[0.0, 0.0]]),
            ValueError,
            r"point must be one of shape \(n,\)",
        ),
        (lambda E: E.enclosing(E.normal_form, 0.0), ValueError, "level must be above 0"),
        (
            lambda E: E.enclosing(E.normal_form, -1.0),
            ValueError,
            "level must be above 0, but -1",
        ),
        (
            lambda E: E.enclosing(E.normal_form._replace(A=np.ones((2, 2)))),
            ValueError,
            "form.A must be invertible",
        ),
        (lambda E: E.replace(shape=1j * E.shape), TypeError, "its entries are complex"),
    ],
)
def test_mistakes_with_an_ellipsoid_are_named(act, error, message):
    with pytest.raises(error, match=message):
        act(ellipsoid(2))


def test_a_shape_that_is_not_quite_symmetric_in_its_own_units_is_refused():
    with pytest.raises(ValueError, match="must be symmetric"):
        rj.Ellipsoid([0.0, 0.0], [[1.0, 0.0], [0.9e-12, 1e-24]])
    rounded = rj.Ellipsoid([0.0, 0.0], [[1.0, 0.1 + 1e-17], [0.1, 1.0]])
    np.testing.assert_array_equal(rounded.shape, rounded.shape.T)


@pytest.mark.parametrize("axes", [(1e150, 1e-150), (1e150, 1e150), (1e-150, 1e-150), (1e20, 1.0)])
@pytest.mark.parametrize("length", [1e-155, 1.0, 1e155])
def test_supports_of_ellipsoids_of_any_scale_in_directions_of_any_length(axes, length):
    region = rj.Ellipsoid([0.0, 0.0], np.diag(np.square(axes)))
    values = np.asarray(region.support(length * np.eye(2)))
    with np.errstate(over="ignore"):
        expected = length * np.array(axes)
    assert (values >= expected).all()
    kept = expected > 1e-300
    np.testing.assert_allclose(values[kept], expected[kept], rtol=1e-12)
    np.testing.assert_array_equal(region.support(np.zeros((1, 2))), 0.0)
