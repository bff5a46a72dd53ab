"""What the study of tightness runs on: its options, and groups of loops that belong together."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

import reachjax as rj
from experiments.benchmark.cases import RANDOM_BOX, he_network
from experiments.command import require_options
from experiments.double_integrator import study as double_integrator
from experiments.double_integrator.problem import INITIAL_BOX, closed_loop, template
from experiments.quadrotor import study as quadrotor
from experiments.quadrotor.model import STEPS, initial_set

TINY = (2, 4, 4, 1)
HORIZONS = {"trained": 6, "tiny": 4, "quadrotor": STEPS}
SMALL = 10
"""Neurons a layer of random networks up to which two steps are affordable with lambda_ij."""
DENSE = "lambda_ij of 70 units, many minutes a tube"
GRID = "4^6 cells"
CELLS = "31 tubes"
LARGEST = {
    "guided cells": (10, "31 tubes for each network"),
    "grid of cells": (20, "16 tubes for each network"),
    "paper": (20, "2016 lambda_ij, minutes a tube"),
    "local bounds": (20, "2016 lambda_ij, minutes a tube"),
}
"""The widest random networks that a method is run on, and why on none that is wider."""


@dataclass(frozen=True)
class Settings:
    """Compare methods that bound reachable sets: how tight, step by step, and in what time.

    Every measurement is kept under `output`; an interrupted run continues with what is there.
    """

    loops: tuple[Literal["trained", "tiny", "random", "quadrotor"], ...] = (
        "trained",
        "tiny",
        "random",
        "quadrotor",
    )
    """The double integrator with a trained 2-10-5-1 network, with tiny ones whose reachable sets
    are computed exactly, with larger random ones, and the quadrotor with its trained 6-32-32-3."""
    methods: tuple[str, ...] = ()
    """Names of methods as the tables have them; all without any."""
    horizon: int | None = None
    """Steps of every tube; without it each loop has its own."""
    widths: tuple[int, ...] = (10, 20, 32)
    """Neurons in each of the two hidden layers of random networks."""
    seeds: int = 3
    """Networks of each random kind."""
    samples: int = 20_000
    """Trajectories simulated for the largest values known, besides those that ascents add."""
    exact_units: int = 48
    """Exact maxima by mixed-integer programming for loops with no more units in all steps."""
    repetitions: int = 1
    """Warm calls of which the median is taken."""
    patience: float = 60.0
    """Seconds after which a tube is not computed again."""
    clock: Literal["wall", "cpu"] = "wall"
    """What a second is; the processor's own depend less on other jobs."""
    output: Path = Path("results/tightness")
    """Where everything is written."""

    def __post_init__(self):
        counts = dict.fromkeys(("horizon", "widths", "seeds", "samples"), 1)
        sizes = dict.fromkeys(("exact_units", "repetitions", "patience"), 0)
        require_options(self, **counts, **sizes)
        if not self.loops:
            raise ValueError("--loops must name at least one kind, but none arrived")


@dataclass(frozen=True, eq=False)
class Group:
    """Loops of one size, from one initial set, with one template: a table and a row of panels.

    Attributes:
        name: what tables and panels are called.
        loops: one, or one for each seed.
        X0: the initial set.
        template: what the sets look like.
        horizon: the number of steps.
        left_out: names of methods that are not run, and why.
    """

    name: str
    loops: tuple[rj.ClosedLoop, ...]
    X0: rj.Box | rj.Ellipsoid
    template: rj.Template
    horizon: int
    left_out: dict[str, str] = field(default_factory=dict)

    @cached_property
    def units(self) -> int:
        """How many one trajectory has."""
        return self.loops[0].units * self.horizon


def groups(settings: Settings) -> list[Group]:
    """The loops asked for; trained networks come from their files where they are there."""
    made = {"trained": trained, "tiny": tiny, "random": random, "quadrotor": flying}
    return [group for name in dict.fromkeys(settings.loops) for group in made[name](settings)]


def trained(settings: Settings) -> list[Group]:
    """The controller of `experiments.double_integrator` that learned with a margin."""
    options = double_integrator.Settings(output=settings.output)
    layers = double_integrator.controller("with margin", options.margin, options).layers
    return [_planar("trained 2-10-5-1", [layers], INITIAL_BOX, _horizon("trained", settings))]


def tiny(settings: Settings) -> list[Group]:
    """Random networks so small that their loops are solved exactly."""
    name = f"random {'-'.join(map(str, TINY))}"
    return [_random(name, TINY, _horizon("tiny", settings), settings)]


def random(settings: Settings) -> list[Group]:
    """Random networks near whose kinks the initial set is."""
    found = []
    for width in settings.widths:
        horizon = settings.horizon or (2 if width <= SMALL else 1)
        left_out = {name: why for name, (widest, why) in LARGEST.items() if width > widest}
        if horizon <= 3:
            left_out["cuts, window 3"] = "no more steps, so it is as one shot"
        if horizon == 1:
            left_out["cuts, one shot"] = "one step, so it is as window 1"
        group = _random(f"random 2x{width}", (2, width, width, 1), horizon, settings)
        found.append(replace(group, left_out=left_out))
    return found


def flying(settings: Settings) -> list[Group]:
    """The quadrotor with the committed network."""
    loop = quadrotor.closed_loop(quadrotor.Settings(output=settings.output / "quadrotor"))
    left_out = {
        "paper": DENSE,
        "local bounds": DENSE,
        "grid of cells": GRID,
        "guided cells": CELLS,
    }
    facets, horizon = rj.Template.box(6), _horizon("quadrotor", settings)
    return [Group("quadrotor 6-32-32-3", (loop,), initial_set(), facets, horizon, left_out)]


def _horizon(name: str, settings: Settings) -> int:
    return settings.horizon or HORIZONS[name]


def _random(name: str, sizes: tuple[int, ...], horizon: int, settings: Settings) -> Group:
    layers = [he_network(sizes, seed) for seed in range(settings.seeds)]
    return _planar(name, layers, RANDOM_BOX, horizon)


def _planar(name: str, networks: list, initial: np.ndarray, horizon: int) -> Group:
    """The double integrator with its input box, under each of the networks."""
    loops = tuple(closed_loop(rj.MLP.from_layers(layers)) for layers in networks)
    return Group(name, loops, rj.Box(*initial), template(), horizon)
