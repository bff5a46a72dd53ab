"""The library's minimum-volume ellipsoids are those of a program written from the paper alone.

Each set of a tube is compared with the reference's step from the library's set before it. The sets
are small enough for theorem 1 to prove smaller ones than intervals do: the library reports the box
of interval bounds, in an ellipsoid, where that is smaller.
"""

import math
from itertools import pairwise

import numpy as np
import pytest

import reachjax as rj
from tests.closed_loops import closed_loop, random_loop, recursion
from tests.networks import LoopData, plant, simulate
from tests.oracles.reference_ellipsoid import paper_ellipsoid_step

STEPS = 3
SIZE = 3e-4  # of the initial shape matrix
TOLERANCE = 2e-3  # in one dimension the repeated slopes leave Clarabel three digits; else 1e-4

# cvxpy warns of a stall before 1e-9; the reference accepts it where 1e-7 holds.
pytestmark = pytest.mark.filterwarnings("ignore:Solution may be inaccurate")


def ball(n):
    return math.pi ** (n / 2) / math.gamma(n / 2 + 1)


def ellipsoid(n):
    """(center, shape), tilted and of half-axes between 0.01 and 0.05."""
    rng = np.random.default_rng(n)
    G = rng.normal(size=(n, n))
    return rng.uniform(-1, 1, n), SIZE * (G @ G.T / n + 0.3 * np.eye(n))


@pytest.mark.parametrize(
    ("n_x", "boxed", "repeated", "seed"),
    [
        pytest.param(1, True, True, 0, marks=pytest.mark.long),
        (2, False, True, 1),
        (2, True, False, 3),
        (3, True, True, 4),
    ],
)
@pytest.mark.costly
def test_volumes_of_three_steps_are_those_of_the_paper(n_x, boxed, repeated, seed):
    data = random_loop(n_x, (5, 3), seed=seed, boxed=boxed)
    tube = recursion(
        closed_loop(data),
        rj.Ellipsoid(*ellipsoid(n_x)),
        STEPS,
        rj.EllipsoidTemplate(),
        rj.PaperQC(repeated=repeated),
    )
    for t, (before, after) in enumerate(pairwise(tube.sets)):
        center, shape = np.asarray(before.center), np.asarray(before.shape)
        step = paper_ellipsoid_step(data.layers, *data.at(t), center, shape, repeated)
        assert step.status.startswith("optimal")
        volume = ball(n_x) * math.sqrt(np.linalg.det(step.shape))
        np.testing.assert_allclose(after.volume(), volume, rtol=TOLERANCE)


@pytest.mark.parametrize("n_x", [1, 2, 3, 6])
def test_an_affine_loop_maps_ellipsoids_exactly(n_x):
    """Without units the successor is `A_cl x + c_cl`, and the ellipsoid's image is an ellipsoid."""
    rng = np.random.default_rng(n_x)
    n_u = min(n_x, 2)
    layers = [(rng.normal(size=(n_u, n_x)), rng.normal(size=n_u))]
    (W, b), (A, B, c) = layers[0], plant(n_x, n_u, seed=n_x)
    center, shape = ellipsoid(n_x)
    step = paper_ellipsoid_step(layers, A, B, c, None, None, center, shape)
    closed, constant = A + B @ W, c + B @ b
    np.testing.assert_allclose(step.center, closed @ center + constant, atol=1e-8)
    expected = closed @ shape @ closed.T
    np.testing.assert_allclose(step.shape, expected, atol=1e-6 * abs(expected).max())


@pytest.mark.parametrize("n_x", [1, 2, 3])
@pytest.mark.parametrize("boxed", [True, False])
def test_no_sampled_successor_leaves_the_ellipsoid(n_x, boxed):
    data = random_loop(n_x, (5, 3), seed=n_x + 1, boxed=boxed)
    center, shape = ellipsoid(n_x)
    step = paper_ellipsoid_step(data.layers, *data.at(0), center, shape)
    points = np.random.default_rng(0).normal(size=(20_000, n_x))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    one_step = LoopData(data.layers, *data.at(0))
    away = simulate(one_step, center + points @ np.linalg.cholesky(shape).T, 1)[1] - step.center
    levels = np.einsum("ki,ij,kj->k", away, np.linalg.inv(step.shape), away)
    assert levels.max() <= 1 + 1e-4
