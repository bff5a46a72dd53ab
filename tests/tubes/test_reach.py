"""Tubes: what they contain, what they keep, and that nothing is lost between steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.closed_loops import closed_loop, one_step, random_loop, recursion
from tests.networks import box_region, he_network, simplex_region, simulate

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


@pytest.mark.parametrize("boxed", [True, False])
@pytest.mark.parametrize("n_x", [1, 2, 3, 6])
def test_the_default_relaxation_contains_every_sampled_state(n_x, boxed):
    steps = 3 if boxed else None
    data, corners, tube = tube_of(n_x, boxed=boxed, steps=steps)
    rng = np.random.default_rng(0)
    weights = rng.dirichlet(0.3 * np.ones(len(corners)), size=100_000)
    states = np.vstack([corners, weights @ corners])
    for t, reached in enumerate(simulate(data, states, 3)):
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


@pytest.mark.parametrize("relaxation", RELAXATIONS, ids=str)
@pytest.mark.costly
def test_sets_grow_when_the_initial_set_grows(relaxation):
    small, large = (tube_of(2, relaxation, 2, scale)[2] for scale in (0.5, 1.0))
    for t in (1, 2):
        assert np.all(small.sets[t].b <= large.sets[t].b + 1e-7)


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


def test_certificates_stand_beside_their_sets(planar):
    assert planar.horizon == 3
    assert planar.certificates[0] is None
    for t in (1, 2, 3):
        certificate = planar.certificates[t]
        np.testing.assert_array_equal(planar.sets[t].b, certificate.bounds)
        np.testing.assert_array_equal(certificate.recheck(), certificate.bounds)
        assert np.all(certificate.gaps >= 0)
        assert set(certificate.statuses) == {rj.SolverStatus.SOLVED}
    with pytest.raises(ValueError, match=r"t = 1 \.\. 3, but 0 was asked for"):
        planar.proof(0)


def test_witnesses_are_attained_by_their_initial_states(planar):
    directions = planar.template.directions
    for t in (1, 2, 3):
        certificate = planar.certificates[t]
        assert np.all(planar.sets[0].contains(certificate.witness_states))
        reached = planar.loop.simulate(jnp.asarray(certificate.witness_states), 3)[:, t]
        attained = np.einsum("fi,fi->f", reached, directions)
        np.testing.assert_allclose(attained, certificate.witnesses, rtol=1e-12)


def test_other_multipliers_are_rechecked_from_the_certificate(planar):
    certificate = planar.certificates[1]
    rng = np.random.default_rng(0)
    others = rng.normal(size=certificate.multipliers.shape)
    loose = certificate.replace(multipliers=others).recheck()
    assert np.all(loose >= certificate.witnesses)
    with pytest.raises(ValueError, match="NaN"):
        certificate.replace(multipliers=np.nan * others).recheck()


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
def test_polytopes_and_boxes_may_start_a_tube_in_three_dimensions():
    data, region = random_loop(3), simplex_region(3, seed=0)
    X0 = rj.Polytope(region.A, region.b)
    tube = recursion(closed_loop(data), X0, 2, rj.Template.box(3))
    states = np.vstack([region.corners, region.sample(10_000, seed=0)])
    assert np.all(tube.sets[2].contains(simulate(data, states, 2)[2]))


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


@pytest.mark.parametrize("scale", [1e-10, 1e-6, 1e-2, 1e3, 1e6])
@pytest.mark.costly
def test_bounds_are_as_tight_for_small_and_large_units_of_the_state(scale):
    layers = he_network((2, 6, 1), seed=1)
    scaled = [(layers[0][0] / scale, layers[0][1]), (scale * layers[1][0], scale * layers[1][1])]
    B, box = np.array([[0.1], [0.5]]), rj.Box([-0.4 * scale], [0.3 * scale])
    loop = rj.ClosedLoop(
        rj.AffinePlant([[1.0, 0.5], [0.0, 1.0]], B), rj.MLP.from_layers(scaled), box
    )
    X0 = rj.Box([-0.2 * scale, 0.1 * scale], [0.3 * scale, 0.4 * scale])
    tube = recursion(loop, X0, 2, rj.Template.octagonal(2))
    one = recursion(
        rj.ClosedLoop(loop.plant, rj.MLP.from_layers(layers), rj.Box([-0.4], [0.3])),
        rj.Box([-0.2, 0.1], [0.3, 0.4]),
        2,
        rj.Template.octagonal(2),
    )
    for t in (1, 2):
        np.testing.assert_allclose(tube.sets[t].b / scale, one.sets[t].b, rtol=1e-5, atol=1e-6)
        assert np.all(tube.proof(t).gaps >= -1e-12 * scale)
