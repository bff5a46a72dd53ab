"""The loops: plants, the laws that networks imitate, and what is asked."""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.linalg import solve_discrete_are

import reachjax as rj
from experiments.layers import Layers
from experiments.sampling import Samples
from experiments.task import Task

PERIOD = 0.1
"""Seconds between inputs of the pendulum, of TORA and of the oscillator."""

GRAVITY = 5.0
"""Of the pendulum, over its length, in 1/s^2: upright at the origin, and unstable."""

STRIDE = 0.2
"""Seconds between inputs of the car, which goes 1 m/s."""


@dataclass(frozen=True, eq=False)
class Problem:
    """A loop whose controller is to be learned.

    Attributes:
        name: of the loop.
        law: inputs `(c, n_u)` at many states `(c, n)`.
        lower: `(n,)`, states are drawn uniformly from here
        upper: `(n,)`, to here.
        hidden: neurons of each hidden layer.
        activation: `relu` or `tanh`.
        closed: the loop under a network.
        X0: where it begins.
        horizon: the number of steps.
        goal: where every state must be at the end, if anywhere.
        safe: where every state must be at all times, if anywhere.
        avoid: sets in which no state may be.
        plane: the coordinates that are drawn.
        axes: what they are.
        view: lower and upper limits of the drawing; None: those of the sets.
    """

    name: str
    law: Callable[[Float[ndarray, "c n"]], Float[ndarray, "c n_u"]]
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    hidden: tuple[int, ...]
    activation: str
    closed: Callable[[rj.MLP], rj.ClosedLoop]
    X0: rj.Box
    horizon: int
    goal: rj.PolyhedralSet | None = None
    safe: rj.PolyhedralSet | None = None
    avoid: tuple[rj.PolyhedralSet, ...] = ()
    plane: tuple[int, int] = (0, 1)
    axes: tuple[str, str] = ("$x_1$", "$x_2$")
    view: tuple[tuple[float, float], tuple[float, float]] | None = None

    def samples(self, count: int, seed: int) -> Samples:
        """What the law does at so many states."""
        rng = np.random.default_rng(seed)
        states = rng.uniform(self.lower, self.upper, (count, len(self.lower)))
        return Samples(states, self.law(states))

    def network(self, layers: Layers) -> rj.MLP:
        """Of these layers."""
        chosen = rj.Tanh() if self.activation == "tanh" else rj.ReLU()
        return rj.MLP.from_layers(layers, activation=chosen)

    def task(self, layers: Layers) -> Task:
        """What is asked of the loop under a network."""
        box, loop = rj.Template.box(self.X0.dimension), self.closed(self.network(layers))
        return Task(loop, self.X0, self.horizon, box, self.goal, self.safe, self.avoid)


def pendulum(goal: float = 0.05, gains: tuple[float, float] = (9.0, 4.0)) -> Problem:
    """An inverted pendulum: angle in rad, rate in rad/s, under 2-32-32-1 neurons of `tanh`.

    Args:
        goal: the half-width of where it must be after two seconds.
        gains: of the linear law that it learns.
    """

    def f(x, u):
        angle, rate = x
        return jnp.array([angle + PERIOD * rate, rate + PERIOD * (GRAVITY * jnp.sin(angle) + u[0])])

    return Problem(
        "pendulum",
        lambda x: -(x @ np.array(gains))[:, None],
        lower=(-0.8, -1.6),
        upper=(0.8, 1.6),
        hidden=(32, 32),
        activation="tanh",
        closed=lambda net: rj.ClosedLoop(rj.NonlinearPlant(f, 2, 1), net),
        X0=rj.Box([0.2, -0.1], [0.4, 0.1]),
        horizon=20,
        goal=rj.Box([-goal, -2 * goal], [goal, 2 * goal]),
        safe=rj.Box([-0.5, -1.0], [0.5, 1.0]),
        axes=("angle (rad)", "rate (rad/s)"),
    )


def car() -> Problem:
    """A car of constant speed that steers between three obstacles, under 20 + 20 ReLUs.

    Positions in m and a heading in rad; the input is the rate of the heading.
    """

    def f(x, u):
        px, py, heading = x
        ahead = jnp.array([jnp.cos(heading), jnp.sin(heading)])
        return jnp.array([px + STRIDE * ahead[0], py + STRIDE * ahead[1], heading + STRIDE * u[0]])

    def law(x):
        px, py, heading = x.T
        ahead = 0.6 * np.sin(np.pi / 2 * (px + 0.7))
        return np.clip(2.5 * (np.arctan2(ahead - py, 0.7) - heading), -2, 2)[:, None]

    return Problem(
        "car",
        law,
        lower=(-0.5, -1.2, -1.4),
        upper=(5.5, 1.2, 1.4),
        hidden=(20, 20),
        activation="relu",
        closed=lambda net: rj.ClosedLoop(rj.NonlinearPlant(f, 3, 1), net, rj.Box([-2.0], [2.0])),
        X0=rj.Box([0.0, -0.05, 0.5], [0.1, 0.05, 0.6]),
        horizon=24,
        goal=rj.Polytope(-np.eye(1, 3), [-4.0]),
        avoid=tuple(
            rj.Polytope(np.vstack([np.eye(2, 3), -np.eye(2, 3)]), [high, top, -low, -bottom])
            for low, high, bottom, top in (
                (0.7, 1.3, -0.6, 0.1),
                (2.7, 3.3, -0.1, 0.6),
                (1.7, 2.3, 0.5, 1.0),
            )
        ),
        axes=("$p_x$ (m)", "$p_y$ (m)"),
        view=((-0.2, 5.2), (-1.1, 1.1)),
    )


def tora() -> Problem:
    """A translational oscillator with a rotating actuator, under 3 x 100 ReLUs.

    Source: the benchmark of Jankovic, Fontaine, Kokotovic (1996) as Dutta, Jha, Sankaranarayanan,
    Tiwari (NFM 2018) state it, in Euler's steps of 0.1 s.
    """

    def flow(x, u):
        return jnp.array([x[1], -x[0] + 0.1 * jnp.sin(x[2]), x[3], u[0]])

    A = np.eye(4) + PERIOD * np.array([[0, 1, 0, 0], [-1, 0, 0.1, 0], [0, 0, 0, 1], [0, 0, 0, 0]])
    B = PERIOD * np.eye(4)[:, 3:]
    P = solve_discrete_are(A, B, np.diag([1.0, 1.0, 0.1, 0.1]), np.eye(1))
    gain = np.linalg.solve(np.eye(1) + B.T @ P @ B, B.T @ P @ A)
    return Problem(
        "TORA",
        lambda x: -x @ gain.T,
        lower=(-1.2,) * 4,
        upper=(1.2,) * 4,
        hidden=(100, 100, 100),
        activation="relu",
        closed=lambda net: rj.ClosedLoop(
            rj.NonlinearPlant(lambda x, u: x + PERIOD * flow(x, u), 4, 1), net
        ),
        X0=rj.Box([0.6, -0.7, -0.4, 0.5], [0.7, -0.6, -0.3, 0.6]),
        horizon=10,
        safe=rj.Box([-2.0] * 4, [2.0] * 4),
    )


def oscillator() -> Problem:
    """Van der Pol's, under 16 + 16 neurons of `tanh`, pushed by up to 0.1 at each step."""

    def f(x, u, w):
        rate = (1 - x[0] ** 2) * x[1] - x[0] + u[0] + w[0]
        return jnp.array([x[0] + PERIOD * x[1], x[1] + PERIOD * rate])

    return Problem(
        "oscillator",
        lambda x: -2.5 * x[:, 1:] - x[:, :1],
        lower=(-1.5, -1.5),
        upper=(1.5, 1.5),
        hidden=(16, 16),
        activation="tanh",
        closed=lambda net: rj.ClosedLoop(
            rj.NonlinearPlant(f, 2, 1, 1), net, disturbance=rj.Box([-0.1], [0.1])
        ),
        X0=rj.Box([0.6, 0.4], [0.8, 0.6]),
        horizon=20,
        goal=rj.Box([-0.3, -0.5], [0.5, 0.3]),
        safe=rj.Box([-1.0, -1.0], [1.0, 1.0]),
    )


PROBLEMS = {"pendulum": pendulum, "car": car, "tora": tora, "oscillator": oscillator}
