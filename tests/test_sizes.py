"""Sizes of sets and their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
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


def test_a_flat_set_has_volume_zero_and_no_derivative_to_speak_of():
    flat = jnp.array([1.0, -1.0, 2.0, 0.0])

    def area(b):
        return rj.volume(rj.Template.box(2).polytope(b))

    assert area(flat) == 0
    np.testing.assert_array_equal(jax.grad(area)(flat), 0)


def test_beyond_four_dimensions_the_bounding_box_is_measured():
    template = rj.Template.box(6)
    offsets = jnp.arange(1.0, 13.0)
    widths = offsets[::2] + offsets[1::2]
    assert float(rj.volume(template.polytope(offsets))) == pytest.approx(float(jnp.prod(widths)))
    gradient = jax.grad(lambda b: rj.log_volume(template.polytope(b)))(offsets)
    np.testing.assert_allclose(gradient, jnp.repeat(1 / widths, 2), rtol=1e-9)


def test_the_log_volume_of_a_tube_sums_its_steps():
    net = rj.MLP.from_layers([(np.zeros((1, 2)), [0.0])])
    loop = rj.ClosedLoop(rj.AffinePlant(np.eye(2) / 2, np.zeros((2, 1))), net)
    tube = rj.reach(loop, rj.Box([0.0, 0.0], [1.0, 1.0]), 2, rj.Template.box(2))
    assert float(rj.log_volume(tube)) == pytest.approx(-6 * np.log(2), abs=1e-6)
    np.testing.assert_allclose(rj.log_widths(tube.sets[1]), -np.log(2), atol=1e-6)
