"""Claims about the loop: projection, simulation, and the times it is given for."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.networks import (
    LoopData,
    controller,
    he_network,
    input_box,
    plant,
    saturating_network,
    simulate,
)

STATES = [1, 2, 3, 6]
STEPS = 5


def loop_data(n_x, boxed=True, plant_steps=None, box_steps=None, network=saturating_network):
    n_u = min(n_x, 2)
    box = input_box(n_u, n_x, box_steps) if boxed else (None, None)
    return LoopData(network((n_x, 5, 4, n_u), n_x + 8), *plant(n_x, n_u, n_x, plant_steps), *box)


def closed_loop(data):
    box = None if data.u_lower is None else rj.Box(data.u_lower, data.u_upper)
    return rj.ClosedLoop(
        rj.AffinePlant(data.A, data.B, data.c), rj.MLP.from_layers(data.layers), box
    )


def states(n_x, count=200):
    return np.random.default_rng(0).normal(size=(count, n_x))


@pytest.mark.parametrize("n_x", STATES)
def test_the_projection_is_the_clip_to_the_input_box(n_x):
    data, x = loop_data(n_x), states(n_x)
    v = controller(data.layers, x)
    low, high = v.min(axis=0), v.max(axis=0)
    lower, upper = low + 0.3 * (high - low), low + 0.7 * (high - low)  # some are on either side
    assert (v < lower).any()
    assert (v > upper).any()
    loop = closed_loop(data).replace(input_box=rj.Box(lower, upper))
    u = np.asarray(jax.vmap(loop.input)(x))
    np.testing.assert_allclose(u, np.clip(v, lower, upper), rtol=0, atol=1e-13)


@pytest.mark.parametrize("n_x", STATES)
def test_without_an_input_box_the_input_is_the_networks_output(n_x):
    data, x = loop_data(n_x, boxed=False), states(n_x)
    u = jax.vmap(closed_loop(data).input)(x)
    np.testing.assert_allclose(u, controller(data.layers, x), rtol=0, atol=1e-13)


def test_a_time_varying_box_projects_onto_the_box_of_each_time():
    data, x = loop_data(3, box_steps=STEPS), states(3)
    loop, v = closed_loop(data), controller(data.layers, x)
    for t in range(STEPS):
        u = jax.vmap(lambda x, t=t: loop.input(x, t))(x)
        expected = np.clip(v, data.u_lower[t], data.u_upper[t])
        np.testing.assert_allclose(u, expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    ("boxed", "plant_steps", "box_steps"),
    [(b, p, q) for b, p, q in product([True, False], *[[None, STEPS]] * 2) if b or q is None],
)
@pytest.mark.parametrize("n_x", STATES)
def test_simulation_is_an_independent_numpy_loop(n_x, boxed, plant_steps, box_steps):
    data = loop_data(n_x, boxed, plant_steps, box_steps)
    loop, x = closed_loop(data), states(n_x)
    assert loop.steps == (plant_steps or box_steps)
    expected = simulate(data, x, STEPS)
    assert np.ptp(expected[-1], axis=0).max() > 0.1
    batch = loop.simulate(x, STEPS)
    assert batch.shape == (len(x), STEPS + 1, n_x)
    np.testing.assert_allclose(batch, expected.swapaxes(0, 1), rtol=1e-12, atol=1e-12)
    single = loop.simulate(x[7], STEPS)
    np.testing.assert_allclose(single, expected[:, 7], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("start", [1, 3])
def test_simulation_may_start_later(start):
    data = loop_data(2, plant_steps=STEPS, box_steps=STEPS)
    loop, x = closed_loop(data), states(2, 1)[0]
    whole = loop.simulate(x, STEPS)
    later = loop.simulate(whole[start], STEPS - start, start=start)
    np.testing.assert_allclose(later, whole[start:], rtol=1e-12, atol=1e-12)
    assert not np.allclose(loop.simulate(whole[start], STEPS - start), later)


@pytest.mark.parametrize(("horizon", "start"), [(STEPS + 1, 0), (STEPS, 1), (1, STEPS)])
@pytest.mark.parametrize(("plant_steps", "box_steps"), [(STEPS, None), (None, STEPS)])
def test_a_time_varying_loop_cannot_be_simulated_beyond_its_end(
    plant_steps, box_steps, horizon, start
):
    loop = closed_loop(loop_data(2, plant_steps=plant_steps, box_steps=box_steps))
    with pytest.raises(ValueError, match=f"given for {STEPS} time steps .*, but start {start} and"):
        loop.simulate(jnp.zeros(2), horizon, start)


def test_a_step_takes_a_traced_time():
    data = loop_data(3, plant_steps=STEPS, box_steps=STEPS)
    x, traces = states(3, 1), []

    @jax.jit
    def step(loop, x, t):
        traces.append(t)
        return loop.step(x, t)

    expected = [simulate_one(data, x, t) for t in range(STEPS)]
    actual = [step(closed_loop(data), x[0], t) for t in range(STEPS)]
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-12)
    assert len(traces) == 1


def simulate_one(data, x, t):
    A, B, c, lower, upper = data.at(t)
    return (x @ A.T + np.clip(controller(data.layers, x), lower, upper) @ B.T + c)[0]


@pytest.mark.parametrize(("boxed", "units"), [(True, 5 + 4 + 2 * 2), (False, 5 + 4)])
def test_units_are_hidden_neurons_and_two_for_each_projected_input(boxed, units):
    loop = closed_loop(loop_data(3, boxed, network=he_network))
    assert (loop.states, loop.units) == (3, units)
    linear = rj.MLP.from_layers(he_network((3, 2), seed=0))
    assert loop.replace(controller=linear).units == units - 9


def test_the_derivative_of_a_trajectory_is_a_central_difference():
    data = loop_data(2, boxed=False, network=he_network)
    loop, x = closed_loop(data), states(2, 1)[0]

    def last(b):
        *hidden, (W, _) = loop.controller.layers
        moved = loop.replace(controller=rj.MLP.from_layers([*hidden, (W, b)]))
        return moved.simulate(x, 3)[-1].sum()

    b, h = loop.controller.layers[-1][1], 1e-6
    difference = [(last(b + h * e) - last(b - h * e)) / (2 * h) for e in np.eye(len(b))]
    np.testing.assert_allclose(jax.grad(last)(b), difference, rtol=1e-7)
