"""Affine differential equations are sampled exactly, whatever their rates."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from mpmath import mpf

import reachjax as rj
from reachjax.loops.flows.linear import exponential
from reachjax.numerics.host import in_numpy
from reachjax.numerics.rounding import Ball, rounding
from reachjax.programs.affine import AffineForms
from reachjax.programs.flows import flowed_forms
from reachjax.programs.initial import InitialColumns


def exact_exponential(M) -> list[list[mpf]]:
    """The exponential in arithmetic of 60 digits."""
    mpmath.mp.dps = 60
    found = mpmath.expm(mpmath.matrix(np.asarray(M).tolist()), method="taylor")
    return [[found[i, j] for j in range(len(M))] for i in range(len(M))]


@pytest.mark.parametrize("size", [1, 2, 3, 6])
@pytest.mark.parametrize("scale", [1e-8, 0.3, 5.0, 40.0])
def test_an_exponential_is_enclosed_thinly(size, scale):
    rng = np.random.default_rng(size)
    M = scale * (rng.normal(size=(size, size)) - np.eye(size))
    exact = exact_exponential(M)
    for kind in (np.asarray, jnp.asarray):
        found = exponential(kind(M))
        mid, rad = np.asarray(found.mid), np.asarray(found.rad)
        for i, j in np.ndindex(size, size):
            assert abs(mpf(float(mid[i, j])) - exact[i][j]) <= mpf(float(rad[i, j]))
        assert np.all(rad <= 1e-9 * np.max(abs(mid)))


def test_an_exponential_that_is_too_large_is_not_known():
    assert not np.isfinite(exponential(jnp.full((2, 2), 1e4)).rad).any()


def plants(held=True):
    """The same plant as matrices, and as a function."""
    A, B, c = np.array([[0.1, 1.0], [-2.0, -0.3]]), np.array([[0.0], [1.0]]), np.array([0.2, -0.1])
    E = np.array([[0.5], [0.1]])
    affine = rj.SampledPlant.affine(A, B, c, period=0.4, E=E, held=held)
    f = rj.SampledPlant(
        lambda x, u, w: A @ x + B @ u + c + E @ w, 2, 1, 0.4, disturbances=1, held=held
    )
    return jax.device_get(affine), jax.device_get(f)


@pytest.mark.parametrize("held", [True, False])
def test_a_plant_of_matrices_is_that_of_its_function(held):
    given = [Ball(np.array([0.3, -0.2]), np.full(2, 0.1)), Ball(np.ones(1), np.full(1, 0.2))]
    W = Ball(np.zeros(1), np.full(1, 0.3))
    affine, f = plants(held)
    one, other = (plant.propagate(*given, w=W) for plant in (affine, f))
    np.testing.assert_allclose(one.mid, other.mid, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(one.rad, other.rad, rtol=1e-2)
    x, u, w = np.array([0.3, -0.2]), np.ones(1), np.full(1, 0.1)
    np.testing.assert_allclose(affine.propagate(x, u, w=w), f.propagate(x, u, w=w), rtol=1e-9)


def test_in_between_samples_a_plant_of_matrices_is_that_of_its_function():
    bounds, box = [], jax.device_get(rj.Box([0.2, -0.3], [0.4, -0.1]))
    start = InitialColumns.of(box, box, curved=True)
    x = AffineForms.beginning(start)
    directions = np.concatenate([np.eye(2), -np.eye(2)])
    for plant in plants():
        given = x, np.array([[0.3, -1.0]]) @ x, np.array([[0.0, 0.0]]) @ x
        _, between = flowed_forms(plant.flow, given, start, between=True)
        bounds.append(between.bounds(directions, start).max(axis=0))
    np.testing.assert_allclose(*bounds, atol=1e-2)


def test_fast_plants_of_matrices_are_enclosed():
    rate = 1e4
    plant = jax.device_get(rj.SampledPlant.affine([[-rate]], [[rate]], period=1.0))
    found = plant.propagate(Ball.exact(np.full(1, 2.0)), Ball.exact(np.ones(1)))
    assert abs(found.mid[0] - 1) <= found.rad[0] <= 1e-6


def test_errors_of_a_plant_of_matrices_name_what_is_wrong():
    with pytest.raises(ValueError, match="B must have 2 rows"):
        rj.SampledPlant.affine(np.eye(2), np.ones((3, 1)), period=0.1)
    with pytest.raises(ValueError, match="period must be above 0"):
        rj.SampledPlant.affine(np.eye(2), np.ones((2, 1)), period=0.0)


def test_what_is_computed_without_rounding_is_kept_for_no_proof():
    given, (kept, other) = (np.array([0.2, 0.1]), np.array([0.5])), (slow_plant(), slow_plant())
    assert kept.flow is kept.flow
    with rounding(False):
        kept.flow.prepared()
        kept.prepared().flow.enclosed(tuple(map(Ball.exact, given)))
    found, expected = (
        plant.flow.enclosed(tuple(map(Ball.exact, given))) for plant in (kept, other)
    )
    assert (found.rad > 0).all()
    assert (found.rad == expected.rad).all()


def slow_plant():
    A, B = [[0.0, 1.0], [-3.0, -0.4]], [[0.0], [1.0]]
    return in_numpy(rj.SampledPlant.affine(A, B, period=0.3))
