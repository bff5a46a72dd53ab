"""Sizes of sets and their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.closed_loops import recursion
from tests.networks import simplex_region


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_the_derivative_of_a_volume_is_the_central_difference(n):
    region, rng = simplex_region(n, seed=n), np.random.default_rng(n)
    # cut a corner off, and add a facet that bounds nothing
    A = np.vstack([region.A, rng.normal(size=n), rng.normal(size=n)])
    middle = region.corners.mean(axis=0)
    reach = (region.corners @ A[-2:].T).max(axis=0)
    b = np.r_[region.b, (0.3 * A[-2] @ middle + 0.7 * reach[0]), reach[1] + 1.0]
    args = (jnp.asarray(A), jnp.asarray(b))

    def of(A, b):
        return rj.volume(rj.Polytope(A, b))

    dA, db = jax.jit(jax.grad(of, argnums=(0, 1)))(*args)
    assert of(*args) == pytest.approx(rj.Polytope(A, b).volume(), rel=1e-9)
    assert db[-1] == 0
    h = 1e-4
    for _ in range(3):
        dA_move, db_move = (jnp.asarray(rng.normal(size=part.shape)) for part in args)
        f = [float(of(A + s * h * dA_move, b + s * h * db_move)) for s in (-2, -1, 1, 2)]
        difference = (8 * (f[2] - f[1]) - (f[3] - f[0])) / (12 * h)
        exact = float(jnp.vdot(dA, dA_move) + jnp.vdot(db, db_move))
        assert exact == pytest.approx(difference, rel=1e-5, abs=1e-8)


@pytest.mark.parametrize("template", [rj.Template.box(2), rj.Template.octagonal(2)])
def test_a_flat_set_has_volume_zero_and_sweeps_its_length_outwards(template):
    directions = np.asarray(template.directions)
    flat = jnp.asarray((np.array([[1.0, 0.0], [1.0, 2.0]]) @ directions.T).max(axis=0))

    def area(b):
        return rj.volume(template.polytope(b))

    assert area(flat) == 0
    across = (np.abs(directions) == [1, 0]).all(axis=1)
    np.testing.assert_allclose(jax.grad(area)(flat), 2.0 * across)


@pytest.mark.costly
def test_beyond_four_dimensions_the_bounding_box_is_measured():
    template = rj.Template.box(6)
    offsets = jnp.arange(1.0, 13.0)
    widths = offsets[::2] + offsets[1::2]
    assert float(rj.volume(template.polytope(offsets))) == pytest.approx(float(jnp.prod(widths)))
    gradient = jax.grad(lambda b: rj.log_volume(template.polytope(b)))(offsets)
    np.testing.assert_allclose(gradient, jnp.repeat(1 / widths, 2), rtol=1e-9)


@pytest.mark.costly
def test_the_log_volume_of_a_tube_sums_its_steps():
    net = rj.MLP.from_layers([(np.zeros((1, 2)), [0.0])])
    loop = rj.ClosedLoop(rj.AffinePlant(np.eye(2) / 2, np.zeros((2, 1))), net)
    tube = recursion(loop, rj.Box([0.0, 0.0], [1.0, 1.0]), 2, rj.Template.box(2))
    assert float(rj.log_volume(tube)) == pytest.approx(-6 * np.log(2), abs=1e-6)
    np.testing.assert_allclose(rj.log_widths(tube.sets[1]), -np.log(2), atol=1e-6)


@pytest.mark.parametrize("beyond", [2.0, 5.0])
def test_of_parallel_facets_the_inner_one_bounds_the_volume(beyond):
    A = jnp.array([[1.0, 0.0], [2.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])

    def area(b):
        return rj.volume(rj.Polytope(A, b))

    slopes = jax.grad(area)(jnp.array([beyond, 2.0, 0.0, 3.0, 0.0]))  # x <= beyond, 2 x <= 2
    np.testing.assert_allclose(slopes, [0.0, 1.5, 3.0, 1.0, 1.0], atol=1e-9)


def test_what_is_no_set_is_named():
    net = rj.MLP.from_layers([(np.zeros((1, 1)), [0.0])])
    tube = recursion(
        rj.ClosedLoop(rj.AffinePlant([[0.5]], [[1.0]]), net),
        rj.Box([0.0], [1.0]),
        1,
        rj.Template.box(1),
    )
    with pytest.raises(
        TypeError, match=r"X must be a set .* but a ReachTube arrived: .*tube\.sets"
    ):
        rj.volume(tube)
    with pytest.raises(TypeError, match=r"X must be a set .* but None arrived"):
        rj.log_volume(None)


def test_inside_jit_an_empty_or_unbounded_set_is_nan_and_outside_an_error():
    A = jnp.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    area = lambda b: rj.volume(rj.Polytope(A, b))  # noqa: E731
    empty = jnp.array([1.0, -2.0, 1.0, 0.0])
    value, slopes = jax.jit(jax.value_and_grad(area))(empty)
    assert np.isnan(value)
    assert np.isnan(slopes).all()
    with pytest.raises(ValueError, match="empty"):
        area(empty)
