"""The loops that rivals are compared on."""

from collections.abc import Callable

import numpy as np

import reachjax as rj
from experiments.benchmark.cases import Settings, he_network
from experiments.benchmark.rivals import cruise_control, motion
from experiments.double_integrator import study as double_integrator
from experiments.double_integrator.problem import (
    GOAL_BOX,
    HORIZON,
    INITIAL_BOX,
    STATE_BOX,
    closed_loop,
    template,
)
from experiments.quadrotor import study as quadrotor
from experiments.quadrotor.model import STEPS, goal_set, initial_set, safe_set
from experiments.task import Task


def planar(hidden: tuple[int, ...], settings: Settings) -> Task:
    """The paper's double integrator under a network that learned with a margin."""
    options = double_integrator.Settings(hidden=hidden, output=settings.output, seed=settings.seed)
    name = "with margin" if hidden == double_integrator.Settings.hidden else f"hidden {hidden}"
    layers = double_integrator.controller(name, options.margin, options).layers
    return Task(
        closed_loop(rj.MLP.from_layers(layers)),
        rj.Box(*INITIAL_BOX),
        HORIZON,
        template(),
        goal=rj.Box(*GOAL_BOX),
        safe=rj.Box(*STATE_BOX),
    )


def flying(settings: Settings) -> Task:
    """The paper's quadrotor with the committed network, from the box around its ellipsoid."""
    loop = quadrotor.closed_loop(quadrotor.Settings(output=settings.output / "quadrotor"))
    box, goal, safe = initial_set().bounding_box(), goal_set(), safe_set(velocity_limits=False)
    return Task(loop, box, STEPS, rj.Template.box(6), goal=goal, safe=safe)


def random_planar(width: int, settings: Settings) -> Task:
    """One step of the double integrator under random weights, from the box of radius 1."""
    layers = he_network((2, width, width, 1), settings.seed)
    X0 = rj.Box(-np.ones(2), np.ones(2))
    return Task(closed_loop(rj.MLP.from_layers(layers)), X0, 1, template())


def random_pushed(settings: Settings) -> Task:
    """One step of a point in the plane under random weights, from the box of radius 0.5.

    The push has no limit: one that cuts it off would make the bounds easy.
    """
    layers = he_network((4, 32, 32, 2), settings.seed)
    loop = rj.ClosedLoop(motion.plant(2), rj.MLP.from_layers(layers))
    return Task(loop, rj.Box(np.full(4, -0.5), np.full(4, 0.5)), 1, rj.Template.box(4))


TASKS: dict[str, Callable[[Settings], Task]] = {
    "2-10-5-1": lambda settings: planar((10, 5), settings),
    "2-15-10-1": lambda settings: planar((15, 10), settings),
    "quadrotor": flying,
    "cruise control": lambda _: cruise_control.following(),
    "4-64-64-2": lambda _: motion.pushed(motion.PLANE, radius=0.1),
    "6-128-128-3": lambda _: motion.pushed(motion.SPACE, radius=0.01),
    "random 2x20": lambda settings: random_planar(20, settings),
    "random 2x32": lambda settings: random_planar(32, settings),
    "random 4-32-32-2": random_pushed,
}
"""By the names that tables have. Trained networks come from their files where they are there."""


def tasks(settings: Settings) -> dict[str, Task]:
    """The loops asked for, all without any.

    Raises:
        ValueError: there is none of this name.
    """
    for name in settings.loops:
        if name not in TASKS:
            raise ValueError(f"--loops must be of {', '.join(TASKS)}, but {name!r} arrived")
    return {name: TASKS[name](settings) for name in TASKS if name in (settings.loops or TASKS)}
