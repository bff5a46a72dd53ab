"""Tubes: what they contain, what they keep, and that nothing is lost between steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.closed_loops import closed_loop, one_step, random_loop, recursion
from tests.networks import box_region, simulate

RELAXATIONS = [rj.PaperQC(repeated=False), rj.PaperQC(), rj.LocalBounds()]


def tube_of(n_x, relaxation=RELAXATIONS[-1], horizon=3, scale=1.0, seed=None, **options):
    seed = n_x if seed is None else seed
    data, region = random_loop(n_x, seed=seed, **options), box_region(n_x, seed=seed)
    center = region.corners.mean(axis=0)
    corners = center + scale * (region.corners - center)
    X0 = rj.Box(corners.min(axis=0), corners.max(axis=0))
    template = rj.Template.octagonal(n_x) if n_x < 3 else rj.Template.box(n_x)
    tube = recursion(closed_loop(data), X0, horizon, template, relaxation)
    return data, corners, tube


@pytest.fixture(scope="module")
def planar():
    """A tube of three steps in the plane."""
    return tube_of(2)[2]


@pytest.mark.parametrize("n_x", [1, 2, 3])
def test_without_a_template_sets_are_octagons_in_the_plane_and_boxes_elsewhere(n_x):
    region = box_region(n_x, seed=n_x)
    X0 = rj.Box(region.corners.min(axis=0), region.corners.max(axis=0))
    loop, forms = closed_loop(random_loop(n_x, seed=n_x)), rj.LinearBounds()
    template = rj.Template.octagonal(2) if n_x == 2 else rj.Template.box(n_x)
    given = {"template": template, "relaxation": forms}

    def outcomes(**options):
        yield rj.reach(loop, X0, 2, **options).sets
        yield rj.reach_step(loop, X0, **options)[0]
        yield rj.reach_partitioned(loop, X0, 1, cells=2, **options).sets(1)
        yield rj.volume_penalty(loop, X0, 1, **options)
        yield rj.specification_penalty(loop, X0, 1, safe=X0, **options)

    expected = [jax.tree.leaves(each) for each in outcomes(**given)]
    for options in ({}, {"template": None}):
        found = map(jax.tree.leaves, outcomes(relaxation=forms, **options))
        jax.tree.map(np.testing.assert_array_equal, [*found], expected)


@pytest.mark.parametrize(("n_x", "boxed"), [(1, True), (3, True), (3, False), (6, False)])
@pytest.mark.costly
def test_local_bounds_hold_every_sample_of_loops_that_vary_or_have_no_input_box(n_x, boxed):
    data, corners, tube = tube_of(n_x, boxed=boxed, steps=3 if boxed else None)
    weights = np.random.default_rng(0).dirichlet(0.3 * np.ones(len(corners)), size=100_000)
    for t, reached in enumerate(simulate(data, np.vstack([corners, weights @ corners]), 3)):
        if t > 0:
            size = 1e-14 * max(1, abs(reached).max())  # the simulation rounds
            assert np.all(tube.sets[t].contains(reached, size))


@pytest.mark.costly
def test_a_start_time_shifts_a_time_varying_loop():
    data, region = random_loop(2, steps=5), box_region(2, seed=0)
    X0, template = rj.Polytope(region.A, region.b), rj.Template.box(2)
    loop = closed_loop(data)
    late = recursion(loop, X0, 2, template, start=3)
    cut = rj.ClosedLoop(
        rj.AffinePlant(data.A[3:], data.B[3:], data.c[3:]),
        loop.controller,
        rj.Box(data.u_lower[3:], data.u_upper[3:]),
    )
    early = recursion(cut, X0, 2, template)
    np.testing.assert_allclose(late.sets[2].b, early.sets[2].b, rtol=1e-12)
    np.testing.assert_array_equal(late.simulate(10), early.simulate(10))


@pytest.mark.costly
def test_relaxations_with_more_products_are_tighter():
    """Strictly so for one of four loops at least: of thirteen that were drawn, twelve show it."""
    bounds = np.array(
        [[tube_of(2, each, 1, seed=k)[2].sets[1].b for each in RELAXATIONS] for k in range(4)]
    )
    gains = bounds[:, :-1] - bounds[:, 1:]
    assert np.all(gains >= -1e-7)
    assert np.all(gains.max(axis=(0, 2)) > 1e-3)


@pytest.mark.parametrize("n_x", [1, 2, 3])
@pytest.mark.costly
def test_an_affine_loop_without_units_is_exact(n_x):
    rng = np.random.default_rng(n_x)
    A, B, K = rng.normal(size=(n_x, n_x)), rng.normal(size=(n_x, 1)), rng.normal(size=(1, n_x))
    loop = rj.ClosedLoop(rj.AffinePlant(A, B), rj.MLP.from_layers([(K, [0.1])]))
    X, template = rj.Box(-np.ones(n_x), np.ones(n_x)), rj.Template.octagonal(n_x)
    following, certificate = one_step(loop, X, template)
    successors = np.asarray(loop.simulate(X.vertices(), 1)[:, 1])
    exact = (successors @ np.asarray(template.directions).T).max(axis=0)
    np.testing.assert_allclose(following.b, exact, atol=1e-7)
    assert np.all(certificate.gaps >= 0)


@pytest.mark.costly
def test_one_step_equals_the_first_step_of_a_tube(planar):
    following, certificate = one_step(planar.loop, planar.sets[0], planar.template)
    np.testing.assert_array_equal(following.b, planar.sets[1].b)
    assert certificate.gaps.shape == (len(planar.template),)


@pytest.mark.costly
def test_a_tube_continued_from_its_last_set_is_the_longer_tube(planar):
    short = recursion(planar.loop, planar.sets[0], 2, planar.template)
    more = recursion(planar.loop, short.sets[2], 1, planar.template)
    np.testing.assert_allclose(more.sets[1].b, planar.sets[3].b, rtol=1e-12)


@pytest.mark.costly
def test_progress_wraps_the_steps(planar):
    seen = []

    def progress(steps):
        for k in steps:
            seen.append(k)
            yield k

    recursion(planar.loop, planar.sets[0], 2, planar.template, progress=progress)
    assert seen == [0, 1]


@pytest.mark.costly
def test_progress_does_not_choose_the_steps(planar):
    turned = recursion(planar.loop, planar.sets[0], 2, planar.template, progress=reversed)
    np.testing.assert_array_equal(turned.sets[2].b, planar.sets[2].b)


@pytest.mark.costly
def test_networks_from_flax_certify_like_the_same_layers():
    from flax import nnx

    model = nnx.Sequential(
        nnx.Linear(2, 4, rngs=nnx.Rngs(0)), nnx.relu, nnx.Linear(4, 1, rngs=nnx.Rngs(1))
    )
    loop = rj.ClosedLoop(rj.AffinePlant(np.eye(2), np.ones((2, 1))), rj.MLP.from_flax(model))
    X0 = rj.Box([-0.1, 0.2], [0.1, 0.3])
    following, _ = one_step(loop, X0, rj.Template.box(2))
    states = X0.sample(jax.random.key(0), 1000)
    u = np.asarray(jax.vmap(model)(states.astype(jnp.float32)), dtype=float)
    # flax computes in single precision
    assert np.all(following.contains(np.asarray(states) + u, 1e-6))


@pytest.mark.costly
def test_a_bound_holds_where_the_compiler_rounds_one_interval_in_two_ways():
    """Weights and states at which midpoint and radius once came from differently rounded ends."""
    low, high, x, width = (
        -0.7649749052306714,
        -0.6883266959269972,
        -122253.08195867075,
        1862861.6770764177,
    )
    net = rj.MLP.from_layers([([[1.0]], [0.0])])
    loop = rj.ClosedLoop(rj.AffinePlant([[0.0]], [[1.0]]), net, rj.Box([low], [high]))
    for solver in (rj.Clarabel(max_iterations=1), rj.Clarabel()):
        for relaxation in RELAXATIONS:
            tube = recursion(
                loop, rj.Box([x], [x + width]), 1, rj.Template.box(1), relaxation, solver=solver
            )
            assert tube.proof(1).bounds[0] >= high  # attained: the input is clipped there
            assert tube.proof(1).bounds[1] >= -low
