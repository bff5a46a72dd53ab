"""Bounding boxes, supports and separations: their derivatives, compiled and in batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.networks import simplex_region


def simplex(n, seed):
    region = simplex_region(n, seed=seed)
    return jnp.asarray(region.A), jnp.asarray(region.b)


def box_ends(A, b):
    box = rj.Polytope(A, b).bounding_box()
    return jnp.concatenate([box.lower, box.upper])


def supports(A, b, D):
    return rj.Polytope(A, b).support(D)


def ranges(A, b, D):
    return jnp.concatenate(rj.Polytope(A, b).row_ranges(D))


def separations(A, b, C, d):
    return rj.Polytope(A, b).separation(rj.Polytope(C, d))[None]


def arguments(name, n):
    A, b = simplex(n, seed=n)
    if name == "box":
        return A, b
    if name in ("supports", "ranges"):
        return A, b, jnp.asarray(np.random.default_rng(n).normal(size=(3, n)))
    far, offset = simplex(n, seed=n + 7)
    return A, b, 3.0 * far, 3.0 * (offset + far @ jnp.full(n, 2.0))


FUNCTIONS = {
    "box": box_ends,
    "supports": supports,
    "ranges": ranges,
    "separations": separations,
}


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_derivative_is_the_central_difference_in_every_argument(name, n):
    f, args = FUNCTIONS[name], arguments(name, n)
    weights = jnp.linspace(1.0, 2.0, len(f(*args)))
    weighed = lambda *args: weights @ f(*args)  # noqa: E731
    gradients = jax.jit(jax.grad(weighed, argnums=tuple(range(len(args)))))(*args)
    rng, h = np.random.default_rng(0), 2e-5
    for k, gradient in enumerate(gradients):
        move = jnp.asarray(rng.normal(size=args[k].shape))
        at = lambda s, k=k, move=move: weighed(*args[:k], args[k] + s * h * move, *args[k + 1 :])  # noqa: E731
        difference = (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * h)
        assert float(jnp.vdot(gradient, move)) == pytest.approx(float(difference), rel=1e-6)


def test_a_batch_of_sets_is_one_set_at_a_time():
    A, b, C, d = arguments("separations", 2)  # pyright: ignore[reportAssignmentType]
    scales = jnp.array([0.5, 1.0, 1.5])
    batch = jax.jit(jax.vmap(lambda s: separations(A, s * b, C, d)))(scales)
    single = jnp.stack([separations(A, s * b, C, d) for s in scales])
    np.testing.assert_allclose(batch, single, rtol=1e-12)


def test_supports_of_a_box_and_of_the_same_polytope_agree():
    box = rj.Box([-1.0, 2.0], [0.5, 3.0])
    D = jnp.array([[1.0, 2.0], [-3.0, 0.5], [0.0, -1.0]])
    polytope = rj.Polytope(*box.facets)
    np.testing.assert_allclose(box.support(D), polytope.support(D), rtol=1e-12)
    gradient = jax.grad(lambda u: rj.Box(box.lower, u).support(D)[0])(box.upper)
    np.testing.assert_allclose(gradient, [1.0, 2.0])


def test_where_a_whole_face_attains_a_range_its_derivative_is_that_at_a_corner():
    box, rows = rj.Box([-1.0, 2.0], [0.5, 3.0]), jnp.eye(2)
    A, b = box.facets
    np.testing.assert_allclose(rj.Polytope(A, b).row_ranges(rows), [box.lower, box.upper])
    upper = lambda A, b: rj.Polytope(A, b).row_ranges(rows)[1][0]  # noqa: E731
    normals, offsets = jax.grad(upper, argnums=(0, 1))(A, b)
    # x_1 <= 1/2 turned about a corner: by -x_2 for that corner's x_2
    assert float(normals[2, 0]) == pytest.approx(-0.5)
    assert float(normals[2, 1]) in (pytest.approx(-2.0), pytest.approx(-3.0))
    assert not normals[jnp.array([0, 1, 3])].any()
    np.testing.assert_allclose(offsets, [0.0, 0.0, 1.0, 0.0], atol=1e-12)
