"""Loops whose plants are differential equations, the laws that networks imitate, what is asked."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.linalg import solve_discrete_are

import reachjax as rj
from experiments.nonlinear import docking
from experiments.nonlinear.problems import GRAVITY, Layers, Problem

PERIOD = 0.1
"""Seconds between inputs of the pendulum and of the quadrotor."""

FAST = 0.05
"""Seconds between inputs of the cart-pole."""

STRIDE = 0.5
"""Seconds between inputs of the car, which goes 1 m/s: so many metres between samples, too."""

WEIGHT = 9.81
"""Of the quadrotor and of the pole, over their masses, in m/s^2."""


@dataclass(frozen=True, eq=False)
class Sampled:
    """A loop in continuous time.

    Attributes:
        problem: what is learned and asked.
        later: goals by spans of time, in seconds, besides.
        discrete: the plant in discrete time whose states are those at samples, if it is compared.
        cells: how many the initial set may be halved into; None for the default.
    """

    problem: Problem
    later: dict[Any, rj.Box] | None = None
    discrete: rj.NonlinearPlant | None = None
    cells: int | None = None

    @property
    def required(self) -> dict[str, Any]:
        """What `rj.decide` takes of it."""
        given = self.problem
        return {"goal": self.later or given.goal, "safe": given.safe, "avoid": given.avoid or None}

    def loop(self, layers: Layers) -> rj.ClosedLoop:
        """The loop under a network."""
        return self.problem.closed(self.problem.network(layers))


def _regulator(
    f: Any, n: int, m: int, period: float, Q: Float[ndarray, " n"], R: Float[ndarray, " m"]
) -> Float[ndarray, "m n"]:
    """The gain of the linear-quadratic regulator of a linearisation at zero, at samples."""
    x, u = jnp.zeros(n), jnp.zeros(m)
    step = rj.SampledPlant(f, n, m, period).propagate
    eye = 1e-6 * np.eye(n + m)
    columns = [(step(x + e[:n], u + e[n:]) - step(x - e[:n], u - e[n:])) / 2e-6 for e in eye]
    AB = np.stack(columns, axis=1)
    A, B = AB[:, :n], AB[:, n:]
    P = solve_discrete_are(A, B, np.diag(Q), np.diag(R))
    return np.linalg.solve(np.diag(R) + B.T @ P @ B, B.T @ P @ A)


def _linear(K: Float[ndarray, "m n"], x: Float[ndarray, "c n"]) -> Float[ndarray, "c m"]:
    return -x @ K.T


def pendulum() -> Sampled:
    """An inverted pendulum, under 2-32-32-1 neurons of `tanh`, safe at all times of two seconds."""

    def f(x, u):
        return jnp.array([x[1], GRAVITY * jnp.sin(x[0]) + u[0]])

    plant = rj.SampledPlant(f, 2, 1, PERIOD)
    return Sampled(
        Problem(
            "pendulum",
            functools.partial(_linear, np.array([[9.0, 4.0]])),
            lower=(-0.8, -1.6),
            upper=(0.8, 1.6),
            hidden=(32, 32),
            activation="tanh",
            closed=lambda net: rj.ClosedLoop(plant, net),
            X0=rj.Box([0.2, -0.1], [0.4, 0.1]),
            horizon=20,
            goal=rj.Box([-0.05, -0.1], [0.05, 0.1]),
            safe=rj.Box([-0.5, -1.0], [0.5, 1.0]),
            axes=("angle (rad)", "rate (rad/s)"),
        )
    )


def quadrotor() -> Sampled:
    """A quadrotor in a vertical plane: position, tilt and their rates, in m, rad and seconds.

    Inputs are the thrust beyond the weight, over the mass, and the angular acceleration.
    """

    def f(x, u):
        thrust, tilt = WEIGHT + u[0], x[2]
        ahead, up = -thrust * jnp.sin(tilt), thrust * jnp.cos(tilt) - WEIGHT
        return jnp.array([x[3], x[4], x[5], ahead, up, u[1]])

    plant = rj.SampledPlant(f, 6, 2, PERIOD)
    K = _regulator(f, 6, 2, PERIOD, np.array([1, 1, 1, 0.5, 0.5, 0.1]), np.array([0.3, 0.1]))
    size = 0.05
    return Sampled(
        Problem(
            "quadrotor",
            functools.partial(_linear, K),
            lower=(-0.8, -0.8, -0.5, -0.8, -0.8, -1.5),
            upper=(0.8, 0.8, 0.5, 0.8, 0.8, 1.5),
            hidden=(32, 32),
            activation="tanh",
            closed=lambda net: rj.ClosedLoop(plant, net),
            X0=rj.Box([0.4, 0.4, *[-size / 2] * 4], [0.4 + size, 0.4 + size, *[size / 2] * 4]),
            horizon=30,
            goal=rj.Box([-0.3, -0.3, *[-0.5] * 4], [0.3, 0.3, *[0.5] * 4]),
            safe=rj.Box([-0.8, -0.8, -0.6, -1.5, -1.5, -2.0], [0.8, 0.8, 0.6, 1.5, 1.5, 2.0]),
            axes=("$p_x$ (m)", "$p_z$ (m)"),
        )
    )


def cartpole() -> Sampled:
    """A pole of half a metre on a cart that is accelerated: ten seconds, of which the last count.

    From the eighth second on it must be near the middle and upright, which is proved where it comes
    back to a set, long before.
    """

    def f(x, u):
        _, speed, angle, rate = x
        turned = 2 * (WEIGHT * jnp.sin(angle) - u[0] * jnp.cos(angle))
        return jnp.array([speed, u[0], rate, turned])

    plant = rj.SampledPlant(f, 4, 1, FAST)
    K = _regulator(f, 4, 1, FAST, np.array([1.0, 0.1, 1.0, 0.1]), np.array([0.1]))
    small = rj.Box([-0.3, -0.3, -0.1, -0.3], [0.3, 0.3, 0.1, 0.3])
    return Sampled(
        Problem(
            "cart-pole",
            functools.partial(_linear, K),
            lower=(-0.6, -1.0, -0.35, -1.2),
            upper=(0.6, 1.0, 0.35, 1.2),
            hidden=(32, 32),
            activation="tanh",
            closed=lambda net: rj.ClosedLoop(plant, net),
            X0=rj.Box([-0.02, -0.02, 0.03, -0.02], [0.02, 0.02, 0.06, 0.02]),
            horizon=200,
            safe=rj.Box([-2.0, -3.0, -0.6, -3.0], [2.0, 3.0, 0.6, 3.0]),
            plane=(0, 2),
            axes=("position (m)", "angle (rad)"),
        ),
        later={(8.0, 10.0): small},
    )


@dataclass(frozen=True)
class RungeKutta:
    """One step of Runge and Kutta of `dx/dt = f(x, u)`, the input held.

    Other processes can be sent it where they can be sent `f`, as they cannot a closure.

    Attributes:
        f: the right-hand side.
        h: the length of the step.
    """

    f: Callable[..., Any]
    h: float

    def __call__(self, x: Any, u: Any) -> Any:
        """The state after the step."""
        f, h = self.f, self.h
        one = f(x, u)
        two = f(x + h / 2 * one, u)
        three = f(x + h / 2 * two, u)
        four = f(x + h * three, u)
        return x + h / 6 * (one + 2 * two + 2 * three + four)


def car() -> Sampled:
    """A car of constant speed that goes back to its lane, in which a thin wall is passed.

    At 1 m/s it is before the wall at one sample and behind it at the next one: nothing is in it at
    any sample.
    """

    def f(x, u):
        return jnp.array([jnp.cos(x[2]), jnp.sin(x[2]), u[0]])

    def law(x):
        return np.clip(-0.5 * x[:, 1:2] - 1.2 * x[:, 2:], -1, 1)

    def wall(low, high, bottom, top):
        rows = np.vstack([np.eye(2, 3), -np.eye(2, 3)])
        return rj.Polytope(rows, [high, top, -low, -bottom])

    limits = rj.Box([-1.0], [1.0])
    plant = rj.SampledPlant(f, 3, 1, STRIDE)
    return Sampled(
        Problem(
            "car",
            law,
            lower=(-0.5, -1.2, -0.8),
            upper=(6.0, 1.2, 0.8),
            hidden=(20, 20),
            activation="relu",
            closed=lambda net: rj.ClosedLoop(plant, net, limits),
            X0=rj.Box([0.0, 0.25, -0.05], [0.05, 0.35, 0.05]),
            horizon=10,
            goal=rj.Polytope(-np.eye(1, 3), [-4.0]),
            avoid=(
                wall(3.2, 3.3, -0.3, 0.3),
                wall(0.5, 1.5, 0.6, 1.0),
                wall(2.0, 4.5, -1.0, -0.6),
            ),
            axes=("$p_x$ (m)", "$p_y$ (m)"),
            view=((-0.2, 5.4), (-1.1, 1.1)),
        ),
        discrete=rj.NonlinearPlant(RungeKutta(f, STRIDE), 3, 1),
    )


def spacecraft(part: float) -> Sampled:
    """The docking of `experiments.nonlinear.docking`, whose speed limit is kept at all times.

    Args:
        part: of the initial set's widths, around its corner that is farthest away.
    """
    A, B = docking.equations()
    plant = rj.SampledPlant.affine(A, B, period=1.0)
    spread = np.array([78.0, 78.0, 0.46, 0.46])
    middle = np.array([70.0, 70.0, 0.0, 0.0])
    return Sampled(
        Problem(
            "docking",
            docking.law,
            lower=tuple(middle - spread),
            upper=tuple(middle + spread),
            hidden=(256, 256, 4),
            activation="tanh",
            closed=lambda net: rj.ClosedLoop(plant, net),
            X0=docking.initial(part),
            horizon=docking.HORIZON,
            safe=docking.limit(),
            plane=(2, 3),
            axes=("$v_1$ (m/s)", "$v_2$ (m/s)"),
        ),
        cells=1_000_000,
    )


PROBLEMS = {"pendulum": pendulum, "quadrotor": quadrotor, "cartpole": cartpole, "car": car}
