"""Adaptive cruise control: a car that follows another one, which brakes.

The state is `[p_l, v_l, a_l, p_e, v_e, a_e, c]`: position, velocity and acceleration of the lead
and of the ego car, in metres and seconds, and the lead's command, which stays what it is.
Accelerations follow commands `c` and `u`,

    da_l/dt = -2 a_l + 2 c,    da_e/dt = -2 a_e + 2 u,

and `u` is held over each period. The network sees five numbers: the set speed, the time gap to
keep, the ego car's velocity, the distance, and how fast it grows. They are affine in the state, and
folded into its first layer.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

import reachjax as rj
from experiments.benchmark.rivals.lesson import Layers, Lesson
from experiments.task import Task

PERIOD = 0.1
"""Seconds between two decisions."""
STEPS = 50
SET_SPEED, TIME_GAP, STANDSTILL = 30.0, 1.4, 10.0
"""The speed wanted, and the distance `STANDSTILL + TIME_GAP v_e` that must be kept."""
COMMANDS = (-3.0, 2.0)
"""The hardest braking, and the hardest acceleration."""
CENTER = np.array([100.0, 32.0, 0.0, 10.0, 30.0, 0.0, -2.0])
"""Of the initial box: both cars drive, and the lead has just been told to brake."""
RADII = np.array([1.0, 0.5, 0.0, 1.0, 0.5, 0.0, 0.0])
DISTANCE = np.array([1.0, 0, 0, -1, 0, 0, 0])
EGO_SPEED = np.eye(7)[4]
ROOM = DISTANCE - TIME_GAP * EGO_SPEED
"""What must stay above `STANDSTILL`."""


def plant(period: float = PERIOD) -> rj.AffinePlant:
    """Both cars, over a period in seconds."""
    A, B = np.zeros((7, 7)), np.zeros((7, 1))
    for first in (0, 3):
        A[first, first + 1] = A[first + 1, first + 2] = 1.0
        A[first + 2, first + 2] = -2.0
    A[2, 6] = B[5, 0] = 2.0
    return rj.zero_order_hold(A, B, period=period)


def law(seen: Float[ndarray, "c 5"]) -> Float[ndarray, "c 1"]:
    """The ego car's command: the smaller one of holding the speed and of keeping the gap."""
    speed, gap, velocity, distance, growth = seen.T
    holding = 0.5 * (speed - velocity)
    keeping = 0.06 * (distance - STANDSTILL - gap * velocity) + 0.5 * growth
    return np.clip(np.minimum(holding, keeping), *COMMANDS)[:, None]


LESSON = Lesson(
    "cruise_control",
    law,
    lower=(28.0, 1.3, 18.0, 10.0, -15.0),
    upper=(32.0, 1.5, 34.0, 130.0, 8.0),
    hidden=(20,) * 5,
    error=0.01,
    penalty=1e-4,
)


def folded(layers: Layers) -> Layers:
    """The network of the state, of which the lesson's sees five numbers."""
    rows = np.vstack([np.zeros((2, 7)), EGO_SPEED, DISTANCE, np.eye(7)[1] - EGO_SPEED])
    (W, b), *others = layers
    return [(W @ rows, b + W[:, :2] @ np.array([SET_SPEED, TIME_GAP])), *others]


def following(ahead: float = 0.0) -> Task:
    """The loop, its lead so many metres farther ahead; it is unsafe from somewhere below 0."""
    loop = rj.ClosedLoop(plant(), rj.MLP.from_layers(folded(LESSON.layers())))
    rows = np.vstack([np.eye(7), ROOM])
    center = CENTER + ahead * np.eye(7)[0]
    return Task(
        loop,
        rj.Box(center - RADII, center + RADII),
        STEPS,
        rj.Template(np.vstack([rows, -rows])),
        safe=rj.Polytope(-ROOM[None], [-STANDSTILL]),
    )
