"""Ascents stay in the set, never lose, and find the maximum where it is known."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.loops.scenarios import Scenarios
from reachjax.methods.witnesses import Simulations, ascended
from tests.closed_loops import autonomous, closed_loop, initial_set, random_loop
from tests.networks import plant, simulate
from tests.quick_cases import some

HORIZON, STARTS = 2, 6
DIMENSIONS = (1, 2, 3, 6)
SETS = ["box", "polytope", "simplex", "ellipsoid", "intersection", "far intersection"]
EDGE = 1e-8
"""Ascents end 1e-9 of the way from the edge of a set that is no box, on both ends of a range."""


def climbed(loop, X, k=HORIZON, starts=None, horizon=HORIZON, start=0):
    """Begin and end of ascents in the axes' directions, `STARTS` for each, and their values."""
    n_x = X.dimension
    states = np.asarray(X.sample(jax.random.key(0), 2 * n_x * STARTS))
    begin = states if starts is None else starts
    region = rj.Template.box(n_x).polytope(jnp.zeros(2 * n_x))
    which = np.arange(len(begin)) % (2 * n_x)
    scenarios, middle = Scenarios.of(loop, X, horizon, start), states.mean(axis=0)
    end = ascended(loop, scenarios, X.scale(), middle, begin, region, which, k, horizon, start)

    def values(points):
        after = loop.simulate(jnp.asarray(points), horizon, start)[:, k]
        return np.asarray(region.bounded_values(after))[np.arange(len(begin)), which]

    return begin, np.asarray(end), values(begin), values(end)


# every kind of set in two dimensions
@pytest.mark.parametrize(
    ("n_x", "kind"),
    some(
        product(DIMENSIONS, SETS), lambda n_x, kind: (n_x in (1, 3)) == bool(SETS.index(kind) % 2)
    ),
)
@pytest.mark.costly
def test_an_ascent_never_leaves_the_set_and_never_loses(n_x, kind):
    loop = closed_loop(random_loop(n_x, seed=1))
    for seed in range(2):
        X = initial_set(kind, n_x, seed)
        _, end, before, after = climbed(loop, X)
        assert np.asarray(X.contains(end)).all()
        # what begins on the edge is brought inside first
        assert np.all(after >= before - EDGE * np.ptp(after))
        assert after.max() > before.max()


@pytest.mark.parametrize("kind", ["box", "polytope", "ellipsoid"])
@pytest.mark.parametrize("n_x", DIMENSIONS)
@pytest.mark.costly
def test_of_an_affine_loop_ascents_find_the_support(n_x, kind):
    W, (A, B, c) = np.random.default_rng(n_x).normal(size=(1, n_x)), plant(n_x, 1, seed=n_x)
    loop = rj.ClosedLoop(rj.AffinePlant(A, B, c), rj.MLP.from_layers([(W, [0.1])]))
    X, M = initial_set(kind, n_x, seed=n_x), np.linalg.matrix_power(A + B @ W, HORIZON)
    signed = np.asarray(rj.Template.box(n_x).directions)
    _, end, *_ = climbed(loop, X)
    values = np.sum((end @ M.T).reshape(STARTS, 2 * n_x, n_x) * signed, axis=2)
    largest, opposite = X.support(signed @ M), X.support(-signed @ M)
    assert np.all(values.max(axis=0) >= largest - EDGE * (largest + opposite))


@pytest.mark.costly
def test_the_surface_of_an_ellipsoid_has_its_closed_form():
    n_x = 3
    X = initial_set("ellipsoid", n_x, seed=4)
    loop = autonomous(np.eye(n_x))
    begin, end, *_ = climbed(loop, X, k=1, horizon=1)
    rows = np.asarray(rj.Template.box(n_x).directions)[np.arange(len(begin)) % (2 * n_x)]
    Q = np.asarray(X.shape)
    touching = X.center + rows @ Q / np.sqrt(np.sum(rows @ Q * rows, axis=1))[:, None]
    # a state is off by the root of what its value lacks
    np.testing.assert_allclose(end, touching, atol=1e-4)


@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.costly
def test_values_are_those_after_so_many_steps(k):
    data, X = random_loop(2, seed=2), initial_set("box", 2)
    begin, end, _, after = climbed(closed_loop(data), X, k=k, horizon=3)
    rows = np.asarray(rj.Template.box(2).directions)[np.arange(len(begin)) % 4]
    simulated = np.sum(simulate(data, end, 3)[k] * rows, axis=1)
    np.testing.assert_allclose(after, simulated, atol=1e-12)
    sampled = simulate(data, np.asarray(X.sample(jax.random.key(1), 20_000)), 3)[k] @ rows[:4].T
    best = after.reshape(-1, 4).max(axis=0)
    # the best of six ascents is about as good as 20,000 samples
    assert np.all(best >= sampled.max(axis=0) - 0.01 * np.ptp(sampled, axis=0))


@pytest.mark.costly
def test_a_time_varying_loop_is_climbed_from_its_start():
    data, X = random_loop(2, seed=3, steps=4), initial_set("box", 2, seed=3)
    A, B, c, lower, upper = (
        part[2:] for part in (data.A, data.B, data.c, data.u_lower, data.u_upper)
    )
    later = rj.ClosedLoop(
        rj.AffinePlant(A, B, c), rj.MLP.from_layers(data.layers), rj.Box(lower, upper)
    )
    shifted, expected = climbed(closed_loop(data), X, start=2), climbed(later, X)
    np.testing.assert_allclose(shifted[1], expected[1], atol=1e-12)
    assert not np.allclose(shifted[1], climbed(closed_loop(data), X)[1])


@pytest.mark.parametrize("kind", ["box", "polytope", "ellipsoid", "intersection"])
@pytest.mark.costly
def test_starts_outside_are_brought_inside(kind):
    X = initial_set(kind, 2)
    away = 10 * np.random.default_rng(0).normal(size=(4 * STARTS, 2))
    _, end, *_ = climbed(closed_loop(random_loop(2, seed=1)), X, starts=away)
    assert np.asarray(X.contains(end)).all()


@pytest.mark.costly
def test_a_point_stays_where_it_is():
    X = initial_set("box", 2)
    X = X.replace(upper=X.lower)
    begin, end, *_ = climbed(closed_loop(random_loop(2, seed=1)), X)
    np.testing.assert_array_equal(end, begin)


@pytest.mark.parametrize("kind", SETS[:-1])
@pytest.mark.costly
def test_simulations_keep_what_ascents_find_and_tolerate_what_is_no_number(kind):
    data, X, n_x = random_loop(3, seed=2), initial_set(kind, 3, seed=1), 3
    simulations = Simulations(closed_loop(data), X, HORIZON, 0, samples=50, seed=0)
    region, which = rj.Template.box(n_x).polytope(jnp.zeros(6)), np.arange(6)
    before, _ = simulations.attained(HORIZON, region)
    states = np.full((6, 3), np.nan)
    states[1], states[2] = np.inf, 1e6
    simulations.climb(HORIZON, region, which, states)
    again, found = simulations.attained(HORIZON, region)
    assert np.all(again >= before)
    if kind in ("ellipsoid", "intersection"):  # of others a corner may be best
        assert np.any(again > before)
    assert np.asarray(X.contains(found, 1e-14)).all()  # corners of polytopes are rounded
    ends = simulate(data, found, HORIZON)[-1]
    np.testing.assert_allclose(
        np.asarray(region.bounded_values(ends)).diagonal(), again, atol=1e-12
    )
    best = simulations.best(HORIZON, region, 0, 3)
    np.testing.assert_array_equal(best[0], found[0])


# a segment whose points are no floats, and one of whose facets' squares underflow
ROUNDED = (
    [[-0.44658797, 0.89473973], [0.89473973, 0.44658797], [0.44658797, -0.89473973],
     [-0.89473973, -0.44658797], [1.43458478, 0.53879141]],
    [-21995.332933, 113.035396, 21996.894733, -113.035396, 3660.71452],
)  # fmt: skip
SHORT = (
    1e-170 * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]]),
    1e-170 * np.array([-0.918, -2.051, 0.918, 2.923]),
)


@pytest.mark.parametrize("facets", [ROUNDED, SHORT])
def test_projections_onto_a_set_without_interior_are_points_of_it(facets):
    X = rj.Polytope(*facets)
    states = np.asarray(X.sample(jax.random.key(0), 400))
    middle, box = states.mean(axis=0), X.bounding_box()
    scale = np.diag(np.asarray(box.upper - box.lower) / 2)
    moved = states + np.random.default_rng(1).normal(size=states.shape) @ scale
    project = jax.jit(jax.vmap(lambda state: X.brought_inside(state, middle, scale)))
    # where both ends of the way are outside, equally far, a share of it would be 0 / 0
    found = np.asarray(project(moved))
    away = (found @ np.asarray(X.A).T - X.b) / np.linalg.norm(X.A / abs(X.A).max(), axis=1)
    assert np.all(away <= 1e-8 * abs(X.A).max() * abs(middle).max())
