"""Loops of smooth units: no state is outside, sets are tight, and their sizes have derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.networks import he_network

HORIZON = 3


def pendulum(p, x, u):
    return jnp.array([x[0] + 0.1 * x[1], x[1] + 0.1 * (p * jnp.sin(x[0]) - 0.2 * x[1] + u[0])])


def van_der_pol(x, u):
    return x + 0.1 * jnp.array([x[1], (1 - x[0] ** 2) * x[1] - x[0] + u[0]])


def car(x, u):
    return x + 0.2 * jnp.array([jnp.cos(x[2]), jnp.sin(x[2]), u[0] / (1 + x[0] ** 2)])


def scalar(x, u):
    return 0.5 * x + jnp.exp(-(x**2)) / 3 + 0.1 * u


def tank(x, u):
    return x + 0.1 * jnp.array([u[0] - jnp.sqrt(x[0]), jnp.sqrt(x[0]) - jnp.sqrt(x[1])])


def tanh_net(states, inputs, seed=0, hidden=(6,), activation=None):
    layers = he_network((states, *hidden, inputs), seed)
    return rj.MLP.from_layers(layers, activation=activation or rj.Tanh())


def loops():
    """Names, loops and initial sets."""
    law = jax.tree_util.Partial(lambda p, x: -jnp.tanh(p @ x) * 2, jnp.array([[1.5, 1.0]]))
    swing = rj.NonlinearPlant(jax.tree_util.Partial(pendulum, 5.0), 2, 1)
    line = rj.AffinePlant([[1.0, 1.0], [0.0, 1.0]], [[0.5], [1.0]])
    oscillator = rj.NonlinearPlant(van_der_pol, 2, 1)
    small = rj.Box([0.2, -0.3], [0.4, -0.1])
    ball = rj.Ellipsoid([0.3, -0.2], [[0.01, 0.002], [0.002, 0.02]])
    corner = rj.Polytope([[-1.0, 0], [0, -1], [1, 1]], [-0.2, 0.3, 0.2])
    unit = rj.Box([-1.0], [1.0])
    return {
        "pendulum": (rj.ClosedLoop(swing, tanh_net(2, 1)), small),
        "boxed": (rj.ClosedLoop(swing, rj.Network(law, 2, 1), unit), small),
        "sigmoid": (rj.ClosedLoop(line, tanh_net(2, 1, 1, (5, 4), rj.Sigmoid())), small),
        "rectified": (rj.ClosedLoop(swing, tanh_net(2, 1, 2, (4, 3), rj.ReLU()), unit), small),
        "ball": (rj.ClosedLoop(swing, tanh_net(2, 1)), ball),
        "oscillator": (rj.ClosedLoop(oscillator, tanh_net(2, 1, 3)), small),
        "polytope": (rj.ClosedLoop(oscillator, tanh_net(2, 1, 3)), corner),
        "car": (
            rj.ClosedLoop(rj.NonlinearPlant(car, 3, 1), tanh_net(3, 1, 4, (4,), rj.ReLU())),
            rj.Box([0.0, 0.0, 0.2], [0.1, 0.2, 0.5]),
        ),
        "scalar": (
            rj.ClosedLoop(rj.NonlinearPlant(scalar, 1, 1), tanh_net(1, 1, 5)),
            rj.Box([-1.0], [0.5]),
        ),
        "tank": (
            rj.ClosedLoop(rj.NonlinearPlant(tank, 2, 1), tanh_net(2, 1, 6)),
            rj.Box([1.0, 0.8], [1.3, 1.0]),
        ),
        "a point": (rj.ClosedLoop(swing, tanh_net(2, 1)), rj.Box([0.2, -0.3], [0.2, -0.3])),
        "wide": (rj.ClosedLoop(swing, tanh_net(2, 1)), rj.Box([-2.0, -2.0], [3.0, 1.0])),
    }


LOOPS = loops()


def trajectories(loop, X0, count=3000):
    try:
        states = jnp.concatenate([X0.corners(), X0.sample(jax.random.key(0), count)])
    except RuntimeError:
        states = X0.corners()
    return np.asarray(loop.simulate(states, HORIZON))


RELAXATIONS = [rj.LinearBounds(), rj.BranchAndCut(), rj.LocalBounds(repeated=False)]


@pytest.mark.parametrize(
    ("name", "most"),
    [
        ("pendulum", 1.01),
        ("sigmoid", 1.01),
        ("boxed", 1.03),
        ("tank", 1.01),
        ("oscillator", 1.01),
        ("car", 1.25),
    ],
)
@pytest.mark.costly
def test_sets_are_tight(name, most):
    loop, X0 = LOOPS[name]
    tube = rj.reach(loop, X0, HORIZON, rj.Template.box(loop.states))
    runs = trajectories(loop, X0, 20_000)
    for t in range(1, HORIZON + 1):
        offsets = np.asarray(tube.sets[t].b)
        widths = offsets[::2] + offsets[1::2]
        assert np.all(widths <= most * np.ptp(runs[:, t], axis=0))


def test_a_remainder_that_is_infinite_says_where_and_what_to_do():
    loop = rj.ClosedLoop(
        rj.NonlinearPlant(lambda x, u: 1 / x + u, 1, 1), rj.Network(lambda x: 0 * x, 1, 1)
    )
    message = r"Reciprocal .in .*test_nonlinear.* at t = 0 has inputs in .-.*, .*cells"
    for relaxation in RELAXATIONS[:2]:
        with pytest.raises(ValueError, match=message):
            rj.reach(loop, rj.Box([-1.0], [1.0]), 1, rj.Template.box(1), relaxation)
    whole = rj.BranchAndCut(cells=1)
    with pytest.raises(ValueError, match=message):
        rj.decide(loop, rj.Box([-1.0], [1.0]), 1, goal=rj.Box([-1e9], [1e9]), relaxation=whole)
