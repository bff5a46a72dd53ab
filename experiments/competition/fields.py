"""The plants of the competition, as their definitions have them.

Each is a function of a state and an input, and of disturbances if it has any: the derivative of the
state of a differential equation, the next state of a discrete one. States and inputs are in the
order of the definitions. Where a published equation is read in two ways, both are here.

Source: the benchmark repository of ARCH-COMP AINNCS, and the category's reports.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import reachjax as rj

State = Float[Array, " n_x"]
Input = Float[Array, " n_u"]

FRICTION = 1e-4
"""Of both cars."""

LEAD = -2.0
"""Acceleration that the car ahead asks for, in m/s^2."""

MASS, MOTION = 12.0, 0.001027
"""Of the spacecraft in kg, and the mean motion of its target in 1/s."""

G = 32.2
"""Of the vertical collision avoidance, in ft/s^2."""


def cruise_control(x: State, u: Input) -> State:
    """A car behind another one that brakes: position, velocity, acceleration of both."""
    ahead = 2 * (LEAD - x[2]) - FRICTION * x[1] ** 2
    behind = 2 * (u[0] - x[5]) - FRICTION * x[4] ** 2
    return jnp.array([x[1], x[2], ahead, x[4], x[5], behind])


def seen_ahead(x: State) -> Float[Array, " 5"]:
    """What cruise control sees: speed and time gap that are set, own speed, distance, approach."""
    return jnp.array([30.0, 1.4, x[4], x[0] - x[3], x[1] - x[4]])


def oscillator(x: State, u: Input) -> State:
    """A translational oscillator with a rotating actuator (TORA)."""
    return jnp.array([x[1], -x[0] + 0.1 * jnp.sin(x[2]), x[3], u[0]])


def unicycle(x: State, u: Input, w: Float[Array, " 1"] | None = None) -> State:
    """A car in the plane: position, heading, speed; perhaps its acceleration is disturbed."""
    pushed = u[0] if w is None else u[0] + w[0]
    return jnp.array([x[3] * jnp.cos(x[2]), x[3] * jnp.sin(x[2]), u[1], pushed])


def pendulum(x: State, u: Input) -> State:
    """An inverted pendulum of 0.5 kg and 0.5 m without friction, gravity 1: angle and rate."""
    return jnp.array([x[1], 2 * jnp.sin(x[0]) + 8 * u[0]])


def double_pendulum(x: State, u: Input) -> State:
    """Two links of 0.5 kg and 0.5 m, gravity 1, a torque at each: two angles and their rates."""
    apart = x[0] - x[1]
    sine, cosine = jnp.sin(apart), jnp.cos(apart)
    first = 4 * u[0] + 2 * jnp.sin(x[0]) - x[3] ** 2 * sine / 2
    second = sine * x[2] ** 2 + 8 * u[1] + 2 * jnp.sin(x[1]) - cosine * first
    inertia = cosine**2 / 2 - 1
    return jnp.array([x[2], x[3], first + cosine * second / (2 * inertia), -second / inertia])


def _turned(
    roll: Array, pitch: Array, yaw: Array, v: Float[Array, " 3"]
) -> tuple[Array, Array, Array]:
    """A vector of the body in the world's axes: rolled, pitched, then yawed."""
    across = jnp.cos(roll) * v[1] - jnp.sin(roll) * v[2]
    up = jnp.sin(roll) * v[1] + jnp.cos(roll) * v[2]
    along = jnp.cos(pitch) * v[0] + jnp.sin(pitch) * up
    x = jnp.cos(yaw) * along - jnp.sin(yaw) * across
    y = jnp.sin(yaw) * along + jnp.cos(yaw) * across
    return x, y, jnp.cos(pitch) * up - jnp.sin(pitch) * v[0]


def airplane(x: State, u: Input) -> State:
    """A rigid body of unit mass and inertias under forces and moments, gravity 1.

    Position, velocity, Euler angles (roll, pitch, yaw), rates about z, x and y.
    """
    v, (roll, pitch, yaw), (r, p, q) = x[3:6], x[6:9], x[9:12]
    along, across, up = _turned(roll, pitch, yaw, v)
    turning = (jnp.sin(roll) * q + jnp.cos(roll) * r) / jnp.cos(pitch)
    return jnp.array(
        [
            along,
            across,
            up,
            -jnp.sin(pitch) + u[0] - q * v[2] + r * v[1],
            jnp.cos(pitch) * jnp.sin(roll) + u[1] - r * v[0] + p * v[2],
            jnp.cos(pitch) * jnp.cos(roll) + u[2] - p * v[1] + q * v[0],
            p + jnp.sin(pitch) * turning,
            jnp.cos(roll) * q - jnp.sin(roll) * r,
            turning,
            u[5],
            u[3],
            u[4],
        ]
    )


def attitude(x: State, u: Input) -> State:
    """A rigid body that turns: rates, and Rodrigues' parameters of where it has turned."""
    w, p = x[:3], x[3:]
    square = p[0] ** 2 + p[1] ** 2 + p[2] ** 2
    return jnp.array(
        [
            0.25 * (u[0] + w[1] * w[2]),
            0.5 * (u[1] - 3 * w[0] * w[2]),
            u[2] + 2 * w[0] * w[1],
            0.5 * (w[1] * (square - p[2]) + w[2] * (square + p[1]) + w[0] * (square + 1)),
            0.5 * (w[0] * (square + p[2]) + w[2] * (square - p[0]) + w[1] * (square + 1)),
            0.5 * (w[0] * (square - p[1]) + w[1] * (square + p[0]) + w[2] * (square + 1)),
        ]
    )


def quadrotor(x: State, u: Input) -> State:
    """A drone, its altitude upwards and its velocity's third entry downwards.

    Position, velocity of the body, Euler angles, rates; thrust above that of hovering, and torques
    of roll and pitch. As the physics has it: two terms of the published file are misprints.

    Source: Beard, Quadrotor dynamics and control (2008).
    """
    g, mass, inertia, upright = 9.81, 1.4, 0.054, 0.104
    v, (roll, pitch, yaw), (p, q, r) = x[3:6], x[6:9], x[9:12]
    along, across, down = _turned(roll, pitch, yaw, v)
    turning = (jnp.sin(roll) * q + jnp.cos(roll) * r) / jnp.cos(pitch)
    part = (inertia - upright) / inertia
    return jnp.array(
        [
            along,
            across,
            -down,
            r * v[1] - q * v[2] - g * jnp.sin(pitch),
            p * v[2] - r * v[0] + g * jnp.cos(pitch) * jnp.sin(roll),
            q * v[0] - p * v[1] + g * jnp.cos(pitch) * jnp.cos(roll) - g - u[0] / mass,
            p + jnp.sin(pitch) * turning,
            jnp.cos(roll) * q - jnp.sin(roll) * r,
            turning,
            part * q * r + u[1] / inertia,
            -part * p * r + u[2] / inertia,
            0 * r,
        ]
    )


def docking() -> tuple[np.ndarray, np.ndarray]:
    """A spacecraft beside its target in the plane (Clohessy and Wiltshire): `A` and `B`."""
    n = MOTION
    A = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [3 * n**2, 0, 0, 2 * n], [0, 0, -2 * n, 0]])
    return A, np.vstack([np.zeros((2, 2)), np.eye(2) / MASS])


def navigation(x: State, u: Input) -> State:
    """A robot in the plane: position, speed, heading."""
    return jnp.array([x[2] * jnp.cos(x[3]), x[2] * jnp.sin(x[3]), u[0], u[1]])


def cart_pole(x: State, u: Input) -> State:
    """A pole on a cart that is pushed: position and velocity of the cart, angle and rate."""
    push = 2 * u[0]
    torque = 0.08 * 0.41 * (9.8 * jnp.sin(x[2]) - push * jnp.cos(x[2])) - 0.0021 * x[3]
    return jnp.array([x[1], push, x[3], torque / 0.0105])


CHOICES = G * np.array(
    [
        [-1 / 8, 0, 1 / 8],
        [-1 / 3, -7 / 24, -1 / 4],
        [1 / 4, 7 / 24, 1 / 3],
        [-1 / 3, -7 / 24, -1 / 4],
        [1 / 4, 7 / 24, 1 / 3],
        [-1 / 3] * 3,
        [1 / 3] * 3,
        [-1 / 3] * 3,
        [1 / 3] * 3,
    ]
)
"""Accelerations among which a pilot chooses after each advisory, in ft/s^2."""

DOWN, UP = -1.0, 1.0
COMPLIES = (
    (0.0, np.inf),
    (DOWN, 0.0),
    (UP, 0.0),
    (DOWN, -25.0),
    (UP, 25.0),
    (DOWN, -25.0),
    (UP, 25.0),
    (DOWN, -2500 / 60),
    (UP, 2500 / 60),
)
"""Which way each advisory sends, and the rate of climb in ft/s from which on it is complied with;
"clear of conflict" never is."""


def avoidance(worst: bool) -> Callable[..., State]:
    """A step of a second of two aircraft, one of which climbs or descends as it is advised.

    The state is the intruder's relative altitude in ft, the rate of climb in ft/s, seconds until
    both meet, and nine entries of which that of the last advisory is 1. The input is the next
    advisory, in the same form.

    Args:
        worst: whether the pilot may take any of the accelerations, or takes the middle one.
    """
    return functools.partial(_avoiding, worst)


def _avoiding(worst: bool, x: State, u: Input, w: Float[Array, " 3"] | None = None) -> State:
    h, v, left, last = x[0], x[1], x[2], x[3:]
    a = 0.0
    for k, ((way, rate), options) in enumerate(zip(COMPLIES, CHOICES, strict=True)):
        taken = options[1]
        if worst and options[0] != options[2]:
            assert w is not None
            taken = rj.one_of(options[:, None], w)[0]
        if np.isfinite(rate):
            same = last[k] * jnp.where(way * (v - rate) >= 0, 1.0, 0.0)
            taken = (1 - same) * taken
        a = a + u[k] * taken
    return jnp.concatenate([jnp.array([h - v - a / 2, v + a, left - 1]), u])


def seen_intruder(x: State) -> Float[Array, " 3"]:
    """What collision avoidance sees; files divide the rate of climb by 200."""
    return x[:3] * jnp.array([1.0, 200 / 5000, 1.0])


def last_advisory(x: State) -> Array:
    """Which advisory acts: its network gives the next one."""
    return jnp.argmax(x[3:])


def best_of(scores: Float[Array, " 9"]) -> Float[Array, " 9"]:
    """The advisory of the highest score, as the plant takes it."""
    return jax.nn.one_hot(jnp.argmax(scores), 9)
