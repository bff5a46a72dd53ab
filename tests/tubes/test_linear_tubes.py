"""Tubes by affine forms: they hold trajectories, have derivatives, compile, can be rechecked."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.activations import CONTROLLERS, controlled
from tests.closed_loops import autonomous, closed_loop, initial_set, random_loop
from tests.networks import directions

HORIZON, START = 5, 2
ROUNDING = 1e-13
"""Of what is simulated, as a part of its size."""


def tube_of(loop, X0, template, horizon=HORIZON, **options):
    return rj.reach(loop, X0, horizon, template, rj.LinearBounds(), **options)


def assert_holds(tube, start=0):
    trajectories = np.asarray(tube.simulate(2000))
    for t in range(1, tube.horizon + 1):
        values = trajectories[:, t] @ np.asarray(tube.sets[t].A).T
        slack = ROUNDING * abs(values).max()
        assert (values <= np.asarray(tube.sets[t].b) + slack).all()
        assert (tube.proof(t).gaps >= -slack).all()


def test_plants_may_vary_in_time_without_an_input_box():
    loop = closed_loop(random_loop(2, boxed=False, steps=START + HORIZON))
    given = initial_set("box", 2), rj.Template.octagonal(2)
    tube = tube_of(loop, *given, start=START)
    assert_holds(tube)
    tight = rj.reach(loop, given[0], HORIZON, given[1], start=START)
    for one, other in zip(tube.sets[1:], tight.sets[1:], strict=True):
        assert (one.b >= other.b - 1e-7).all()


@pytest.mark.parametrize(("place", "n_x"), [(1, 1), (1, 3), (2, 3), (2, 6), (3, 1), (3, 6)])
@pytest.mark.costly
def test_no_trajectory_is_outside_in_oblique_directions(place, n_x):
    """Controllers and states of which the table of the laws has no row."""
    loop = controlled(**CONTROLLERS[place], n_x=n_x, seed=n_x).loop
    assert_holds(tube_of(loop, initial_set("box", n_x, n_x), rj.Template(directions(n_x, 0, 3))))


@pytest.mark.parametrize("kind", ["simplex", "ellipsoid", "intersection", "far intersection"])
@pytest.mark.costly
def test_no_trajectory_from_any_set_is_outside_in_oblique_directions(kind):
    loop = closed_loop(random_loop(3, seed=1))
    assert_holds(tube_of(loop, initial_set(kind, 3, 1), rj.Template(directions(3, 0, 3))))


@pytest.mark.parametrize("width", [0.0, 1e-12])
@pytest.mark.parametrize("flat", [1, 2])
@pytest.mark.costly
def test_flat_sets_stay_flat(flat, width):
    box = initial_set("box", 2)
    upper = np.where(np.arange(2) < flat, box.lower + width, box.upper)
    loop = closed_loop(random_loop(2))
    tube = tube_of(loop, rj.Box(box.lower, upper), rj.Template.box(2))
    assert_holds(tube)
    if flat == 2:
        assert (rj.log_widths(tube.sets[-1]) < np.log(1e-10)).all()


@pytest.mark.costly
def test_affine_loops_are_exact():
    A = np.array([[0.9, 0.4], [-0.4, 0.9]])
    X0, D = initial_set("ellipsoid", 2), directions(2)
    tube = tube_of(autonomous(A), X0, rj.Template(D), 20)
    exact = X0.support(D @ np.linalg.matrix_power(A, 20))
    np.testing.assert_allclose(tube.sets[20].b, exact, rtol=1e-12, atol=1e-12)


@pytest.mark.costly
def test_cells_are_tighter():
    loop, X0 = closed_loop(random_loop(2, seed=1)), initial_set("box", 2, 1)
    template = rj.Template.octagonal(2)
    whole = tube_of(loop, X0, template)
    cells = rj.reach_partitioned(loop, X0, HORIZON, template, rj.LinearBounds(), cells=(2, 2))
    assert (cells.bounds(HORIZON) <= np.asarray(whole.sets[-1].b) + 1e-12).all()


def penalty(loop, X0):
    tube = tube_of(loop, X0, rj.Template.octagonal(2))
    widths = jnp.stack([region.b[0:4:2] + region.b[1:4:2] for region in tube.sets[1:]])
    return jnp.sum(jnp.log(widths))


@pytest.mark.costly
def test_a_training_step_compiles_once_whatever_switches():
    traced = []

    @jax.jit
    def step(loop, X0):
        traced.append(1)
        return jax.value_and_grad(penalty)(loop, X0)

    loop, X0 = closed_loop(random_loop(2)), initial_set("box", 2)
    for shift in (-5.0, 0.0, 5.0):  # all off, some switch, all on
        layers = [(W, b + shift) for W, b in loop.controller.layers]
        value, gradient = step(loop.replace(controller=rj.MLP.from_layers(layers)), X0)
        assert np.isfinite(value)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert len(traced) == 1


@pytest.mark.costly
def test_loops_whose_plants_and_input_boxes_differ_are_mapped_over():
    loops, X0 = [closed_loop(random_loop(2, seed=seed)) for seed in range(3)], initial_set("box", 2)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *loops)
    values = jax.vmap(penalty, in_axes=(0, None))(stacked, X0)
    np.testing.assert_allclose(values, [float(penalty(loop, X0)) for loop in loops], rtol=1e-9)


@pytest.mark.costly
def test_penalties_take_it():
    loop, X0, template = closed_loop(random_loop(2)), initial_set("box", 2), rj.Template.box(2)
    options = {"relaxation": rj.LinearBounds()}
    volume = jax.jit(lambda X0: rj.volume_penalty(loop, X0, 2, template, **options))(X0)
    np.testing.assert_allclose(volume, rj.volume_penalty(loop, X0, 2, template, **options))
    goal = rj.Box([-0.1, -0.1], [0.1, 0.1])
    missed = jax.grad(
        lambda X0: rj.specification_penalty(loop, X0, 2, template, goal=goal, **options)
    )
    assert any(np.any(leaf != 0) for leaf in jax.tree.leaves(missed(X0)))


def test_what_overflows_has_no_bound():
    loop = autonomous(1e200 * np.eye(2))
    X0, template = rj.Box([1.0, 1.0], [2.0, 2.0]), rj.Template.box(2)
    with pytest.raises(ValueError, match="states at t = 2 overflow"):
        tube_of(loop, X0, template, 3)
    found = jax.jit(lambda loop: tube_of(loop, X0, template, 3).sets[3].b)(loop)
    assert np.isnan(found).all()


@pytest.mark.parametrize("template", [rj.EllipsoidTemplate(), rj.MixedTemplate(rj.Template.box(2))])
def test_ellipsoids_need_another_relaxation(template):
    with pytest.raises(TypeError, match=r"bounds facets.*CuttingPlanes\(\)"):
        tube_of(closed_loop(random_loop(2)), initial_set("box", 2), template)


def test_a_step_and_a_bar():
    loop, X0, template = closed_loop(random_loop(2)), initial_set("box", 2), rj.Template.box(2)
    first, proof = rj.reach_step(loop, X0, template, relaxation=rj.LinearBounds())
    seen = []
    tube = tube_of(loop, X0, template, progress=lambda steps: (seen.append(t) or t for t in steps))
    assert seen == list(range(HORIZON))
    np.testing.assert_array_equal(first.b, tube.sets[1].b)
    assert proof.k == 1
    with pytest.raises(ValueError, match="progress must pass on each of the 5 steps"):
        tube_of(loop, X0, template, progress=lambda steps: steps[:3])


def test_what_was_proved_without_programs_is_proved_anew_without_them(tmp_path):
    plant = rj.NonlinearPlant(lambda x, u: x + 0.3 * jnp.arctan(3 * x[::-1]) + u, 2, 2)
    loop = rj.ClosedLoop(plant, rj.Network(lambda x: -0.4 * jnp.tanh(x), 2, 2))
    corner = rj.Polytope([[1.0, 0], [-1, 0], [0, 1], [0, -1], [1, 1]], [0.8, 0.6, 0.9, 0.5, 0.7])
    given = loop, corner, 3, rj.Template.box(2)
    loose, tight = (rj.reach(*given, rj.LinearBounds(programs=each)) for each in (False, True))
    assert np.any(loose.proof(3).bounds > tight.proof(3).bounds + 1e-3)
    for name, tube in (("loose", loose), ("tight", tight)):
        path = tmp_path / f"{name}.npz"
        tube.save(path)
        again = rj.load(path, loop=loop, recheck=True)
        for k in range(1, 4):
            proof = tube.proof(k)
            np.testing.assert_array_equal(proof.recheck(), proof.bounds)
            np.testing.assert_allclose(again.proof(k).recheck(), proof.bounds, rtol=1e-12)
