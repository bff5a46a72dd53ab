"""Loops with disturbances and noise: nothing that may enter them leaves a tube, and it is tight."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from experiments.tightness.exact import exact_tube
from tests.disturbed_loops import (
    STEPS,
    attacked,
    disturbance_set,
    disturbed_loop,
    double_integrator,
)

KINDS = ["box", "varying box", "polytope", "ellipsoid", "intersection"]
ROUNDING = 1e-9


def initial(n):
    return rj.Box(np.full(n, -0.1), np.full(n, 0.4))


def beyond(tube, states):
    """By how much states `(c, h + 1, n_x)` are beyond what sets bound, at most."""
    each = (
        np.max(np.asarray(region.bounded_values(states[:, k])) - np.asarray(region.limits))
        for k, region in enumerate(tube.sets)
    )
    return max(each)


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.costly
def test_no_scenario_leaves_a_tube_by_forms_or_branches(n, kind):
    V = disturbance_set(KINDS[(KINDS.index(kind) + n) % len(KINDS)], n, seed=3)
    loop, X0 = disturbed_loop(n, disturbance_set(kind, n), V, seed=1), initial(n)
    states, template = attacked(loop, X0, STEPS), rj.Template.octagonal(n)
    for relaxation in (rj.LinearBounds(), rj.BranchAndCut()):  # a wide gap: no products
        tube = rj.reach(loop, X0, STEPS, template, relaxation, samples=100, gap=0.5)
        assert beyond(tube, states) < ROUNDING


@pytest.mark.costly
def test_time_varying_loops_from_a_later_time():
    W, n = disturbance_set("varying box", 2), 2
    loop = disturbed_loop(n, W, seed=1, steps=STEPS)
    E = np.random.default_rng(0).normal(size=(STEPS, n, n))
    loop = loop.replace(plant=loop.plant.replace(E=E))
    tube = rj.reach(loop, initial(n), 2, rj.Template.box(n), start=1)
    states = np.asarray(tube.simulate(2000))
    assert beyond(tube, states) < ROUNDING
    assert max(np.max(tube.proof(k).gaps) for k in (1, 2)) < 1e-3
    with pytest.raises(ValueError, match="given for 3 time steps"):
        rj.reach(loop, initial(n), 3, rj.Template.box(n), start=1)


@pytest.mark.costly
def test_sets_are_as_large_as_what_is_reached():
    """Against mixed-integer programs over initial states, disturbances and noise."""
    loop, X0 = double_integrator()
    template = rj.Template.regular(8)
    tube = rj.reach(loop, X0, 6, template)
    exact = exact_tube(loop, X0, 6, template.directions)
    exact.require_sharp()
    for k in range(1, 7):
        reached, offsets = exact.values[k - 1], np.asarray(tube.sets[k].b)
        assert np.all(offsets >= reached - 1e-7)
        assert tube.sets[k].volume() <= 1.001 * rj.Polytope(template.directions, reached).volume()
        assert np.all(tube.proof(k).witnesses >= reached - 1e-4)
        # without disturbances there is less
        assert tube.sets[k].volume() > rj.reach(*_quiet(loop, X0), k, template).sets[k].volume()


def _quiet(loop, X0):
    return loop.replace(plant=loop.plant.replace(E=None), disturbance=None, noise=None), X0


@pytest.mark.costly
def test_of_an_affine_loop_what_disturbances_add_is_known():
    """`x+ = x / 2 + w` from a point: after k steps `|x| <= 2 (1 - 2^-k)` of an ellipsoid `W`."""
    plant = rj.AffinePlant(np.eye(2) / 2, np.zeros((2, 1)), E=np.eye(2))
    net = rj.MLP.from_layers([(np.zeros((1, 2)), np.zeros(1))])
    X0 = rj.Box([0.0, 0.0], [0.0, 0.0])
    template = rj.Template.octagonal(2)
    diagonal = np.argmax(np.asarray(template.directions) @ np.ones(2))
    length = np.linalg.norm(template.directions[diagonal])
    for W, size in ((rj.Box([-1, -1], [1, 1]), 1.0), (rj.Ellipsoid([0, 0], np.eye(2)), 1.02)):
        offsets = rj.reach(rj.ClosedLoop(plant, net, disturbance=W), X0, 3, template).sets[3].b
        exact = 1.75 * length * (np.sqrt(2) if isinstance(W, rj.Box) else 1.0)
        assert exact - 1e-9 <= offsets[diagonal] <= size * exact + 1e-9


@pytest.mark.costly
def test_noise_alone_and_disturbances_without_width():
    loop = disturbed_loop(2, None, disturbance_set("box", 2), seed=1)
    tube = rj.reach(loop, initial(2), 2, rj.Template.box(2))
    assert beyond(tube, attacked(loop, initial(2), 2)) < ROUNDING
    flat = disturbed_loop(2, rj.Box([0.1, -0.1], [0.1, 0.1]), seed=1)
    tube = rj.reach(flat, initial(2), 2, rj.Template.box(2))
    assert max(np.max(tube.proof(k).gaps) for k in (1, 2)) < 1e-3
    still = flat.replace(disturbance=rj.Box([0.0, 0.0], [0.0, 0.0]))
    tube, other = (
        rj.reach(each, initial(2), 2, rj.Template.box(2)) for each in (still, _quiet(flat, None)[0])
    )
    np.testing.assert_allclose(tube.sets[2].b, other.sets[2].b, atol=1e-9)


@pytest.mark.costly
def test_a_compiled_gradient_is_the_same():
    loop, X0 = double_integrator()

    def value(loop):
        return rj.volume_penalty(loop, X0, 2, rj.Template.box(2))

    plain, compiled = jax.grad(value)(loop), jax.jit(jax.grad(value))(loop)
    for one, other in zip(jax.tree.leaves(plain), jax.tree.leaves(compiled), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)
    assert float(jnp.sum(plain.disturbance.upper)) > 0
    assert float(jnp.sum(plain.noise.upper)) != 0


@pytest.mark.costly
def test_verdicts_and_their_counterexamples():
    loop, X0 = double_integrator()
    tube = rj.reach(loop, X0, 4, rj.Template.box(2))
    lower, upper = (np.asarray(end) for end in _box(tube.sets[4]))
    proved = rj.Box(lower - 1e-3, upper + 1e-3)
    assert rj.verify(tube, goal=proved).status is rj.VerdictStatus.PROVED
    assert rj.decide(loop, X0, 4, goal=proved).status is rj.VerdictStatus.PROVED
    broken = rj.Box(lower, upper - np.array([2e-3, 0.0]))
    for verdict in (rj.verify(tube, goal=broken), rj.decide(loop, X0, 4, goal=broken)):
        assert verdict.status is rj.VerdictStatus.REFUTED
        found = verdict.counterexample
        assert found.disturbances.shape == found.noises.shape == (4, 2)
        assert "disturbances" in str(verdict)
        assert "noises" in str(verdict)
        assert loop.disturbance.contains(found.disturbances).all()
        assert loop.noise.contains(found.noises).all()
        again = loop.simulate(
            found.states[0], 4, disturbances=found.disturbances, noises=found.noises
        )
        np.testing.assert_allclose(again, found.states, atol=1e-12)
        assert again[4, 0] > broken.upper[0]
        inputs = [loop.input(x, v=v) for x, v in zip(again, found.noises, strict=False)]
        np.testing.assert_allclose(inputs, found.inputs, atol=1e-12)
    # no disturbance, no counterexample
    assert rj.decide(*_quiet(loop, X0), 4, goal=broken).status is rj.VerdictStatus.PROVED


def _box(region):
    return -region.support(-np.eye(2)), region.support(np.eye(2))


@pytest.mark.costly
def test_partitions_and_longer_tubes_are_those_of_one_call():
    loop, X0 = double_integrator()
    template = rj.Template.box(2)
    tube = rj.reach(loop, X0, 3, template)
    cells = rj.reach_partitioned(loop, X0, 3, template, cells=(2, 1))
    np.testing.assert_allclose(cells.bounds(3), tube.proof(3).bounds, atol=1e-3)
    assert np.all(cells.gaps(3) > -ROUNDING)
    longer = rj.reach(loop, X0, 2, template).extended(1)
    for one, other in zip(longer.sets, tube.sets, strict=True):
        np.testing.assert_array_equal(one.facets[1], other.facets[1])


@pytest.mark.costly
def test_simulations_of_a_tube_are_under_disturbances():
    loop, X0 = double_integrator()
    tube = rj.reach(loop, X0, 3, rj.Template.box(2))
    states = np.asarray(tube.simulate(500))
    assert beyond(tube, states) < ROUNDING
    still = np.asarray(loop.simulate(states[:, 0], 3))
    assert np.ptp(states[:, 3] - still[:, 3], axis=0).min() > 0.05
    found = loop.split(tube.proof(3).witness_states)
    ends = loop.simulate(found.states, 3, disturbances=found.disturbances, noises=found.noises)
    reached = np.sum(np.asarray(ends[:, 3]) * np.asarray(tube.template.directions), axis=1)
    np.testing.assert_allclose(reached, tube.proof(3).witnesses, atol=1e-12)


PLANT = rj.AffinePlant(np.eye(2), np.ones((2, 1)), E=np.eye(2))
NET = rj.MLP.from_layers([(np.zeros((1, 2)), np.zeros(1))])
UNIT = rj.Box([-1.0, -1.0], [1.0, 1.0])


def loop_with(W=UNIT, V=None, plant=PLANT):
    return rj.ClosedLoop(plant, NET, disturbance=W, noise=V)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (
            lambda: loop_with(None),
            ValueError,
            r"plant has 2 disturb.*ClosedLoop\.disturbance is No",
        ),
        (lambda: loop_with(plant=PLANT.replace(E=None)), ValueError, "but the plant has no distur"),
        (
            lambda: loop_with(rj.Box([0], [1])),
            ValueError,
            "dimension of disturbance is 1, but .* 2",
        ),
        (lambda: loop_with(V=rj.Box([0], [1])), ValueError, "dimension of noise is 1, but .* is 2"),
        (lambda: loop_with(0.1), TypeError, r"ClosedLoop\.disturbance must be a set such as Box"),
        (lambda: loop_with(V=[0.1]), TypeError, r"ClosedLoop\.noise must be a set such as Box"),
        (
            lambda: loop_with(rj.Polytope(np.eye(2), np.ones(2))),
            ValueError,
            r"ClosedLoop\.disturbance cannot be used: .*unbounded",
        ),
        (
            lambda: loop_with(V=rj.Polytope(np.vstack([np.eye(2), -np.eye(2)]), -np.ones(4))),
            ValueError,
            r"ClosedLoop\.noise cannot be used: .*empty",
        ),
        (lambda: PLANT.replace(E=np.eye(3)), ValueError, r"AffinePlant\.E must have 2 rows"),
        (
            lambda: loop_with(
                rj.Box(-np.ones((3, 2)), np.ones((3, 2))), rj.Box(-np.ones((4, 2)), np.ones((4, 2)))
            ),
            ValueError,
            "that of noise is 4, but disturbance.* number of time steps is 3",
        ),
        (
            lambda: rj.change_of_basis(loop_with()),
            TypeError,
            "loops without disturbances and noise",
        ),
        (
            lambda: loop_with().simulate(np.zeros(2), 3, disturbances=np.zeros((2, 2))),
            ValueError,
            r"disturbances must have shape \(3, 2\).* \(2, 2\) arrived",
        ),
        (
            lambda: loop_with().simulate(np.zeros(2), 3, noises=np.zeros((3, 2))),
            ValueError,
            "noises arrived, but the loop has none",
        ),
    ],
)
def test_mistakes_are_named(call, error, message):
    with pytest.raises(error, match=message):
        call()


@pytest.mark.costly
def test_no_scenarios_are_split_into_parts_of_none():
    loop, _ = double_integrator()
    states, w, v = loop.split(np.zeros((0, 2 + 3 * 4)))
    assert (states.shape, w.shape, v.shape) == ((0, 2), (0, 3, 2), (0, 3, 2))
