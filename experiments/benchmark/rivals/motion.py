"""A point that is pushed to the origin, in the plane or in space, under a limit on the push.

The state is positions, then velocities; the input is the acceleration, held over each period. The
law is linear-quadratic feedback whose length is cut to `PUSH`, so it couples the axes.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.linalg import solve_discrete_are

import reachjax as rj
from experiments.benchmark.rivals.lesson import Lesson
from experiments.task import Task

PERIOD = 0.25
"""Seconds between two decisions."""
STEPS = 20
PUSH = 1.0
"""The longest acceleration, metres per second squared; of each axis too."""
FARTHEST, FASTEST = 4.0, 2.0
"""Where the law is imitated: of each position and each velocity."""
START = (3.0, -2.0, 1.0)
"""Positions at rest around which the tasks begin."""
GOAL = 1.5
"""The largest position allowed at the end."""
OBSTACLE = np.array([[-3.0, -3.0, -3.0], [-1.5, -1.5, -1.5]])
"""A box of positions that must not be entered."""


def plant(axes: int) -> rj.AffinePlant:
    """As many double integrators."""
    none, eye = np.zeros((axes, axes)), np.eye(axes)
    A, B = np.block([[none, eye], [none, none]]), np.vstack([none, eye])
    return rj.zero_order_hold(A, B, period=PERIOD)


def law(states: Float[ndarray, "c 2*axes"]) -> Float[ndarray, "c axes"]:
    """Accelerations at many states."""
    axes = states.shape[1] // 2
    wanted = -states @ _gain(axes).T
    length = np.linalg.norm(wanted, axis=1, keepdims=True)
    return wanted * np.minimum(1.0, PUSH / np.maximum(length, PUSH))


def _gain(axes: int) -> Float[ndarray, "axes 2*axes"]:
    """Of the linear-quadratic regulator with unit weights."""
    A, B = (np.asarray(part) for part in (plant(axes).A, plant(axes).B))
    P = solve_discrete_are(A, B, np.eye(2 * axes), np.eye(axes))
    return np.linalg.solve(np.eye(axes) + B.T @ P @ B, B.T @ P @ A)


def lesson(axes: int, hidden: tuple[int, ...], error: float) -> Lesson:
    """The law for a number of axes."""
    highest = (FARTHEST,) * axes + (FASTEST,) * axes
    lowest = tuple(-each for each in highest)
    name = "-".join(map(str, (2 * axes, *hidden, axes)))
    return Lesson(name, law, lowest, highest, hidden, error)


PLANE = lesson(2, (64, 64), error=0.015)
SPACE = lesson(3, (128, 128), error=0.02)


def pushed(lesson: Lesson, radius: float) -> Task:
    """The loop of a learned law, begun within a radius of rest, each coordinate for itself."""
    axes = len(lesson.lower) // 2
    limits = rj.Box(np.full(axes, -PUSH), np.full(axes, PUSH))
    loop = rj.ClosedLoop(plant(axes), rj.MLP.from_layers(lesson.layers()), limits)
    start = np.concatenate([START[:axes], np.zeros(axes)])
    return Task(
        loop,
        rj.Box(start - radius, start + radius),
        STEPS,
        rj.Template.box(2 * axes),
        goal=_positions(np.full(axes, -GOAL), np.full(axes, GOAL)),
        safe=rj.Box(np.array(lesson.lower), np.array(lesson.upper)),
        avoid=(_positions(*OBSTACLE[:, :axes]),),
    )


def _positions(lower: Float[ndarray, " axes"], upper: Float[ndarray, " axes"]) -> rj.Polytope:
    """The states with a position in a box, whatever their velocity: unbounded."""
    rows = np.eye(len(lower), 2 * len(lower))
    return rj.Polytope(np.vstack([-rows, rows]), np.concatenate([-lower, upper]))
