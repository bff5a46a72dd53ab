"""Loops in continuous time, decided at all times: at samples, and in between.

Each controller imitates a law. A pendulum and a planar quadrotor are safe at all times and arrive;
a cart-pole is near the middle from the eighth second on, which is proved where it comes back to a
set; a car drives through a wall between two samples, which nobody sees who looks at these; a
spacecraft keeps its speed limit.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import rich

import reachjax as rj
from experiments import report
from experiments.command import configure_jax, require_options
from experiments.imitation import train_network
from experiments.nonlinear.problems import Layers
from experiments.sampled import figures
from experiments.sampled.problems import PROBLEMS, Sampled, spacecraft

DENSE = 8
"""States that are simulated in each period, to attack what holds them."""

DRAWN = 30
"""So many periods of a long horizon have sets, which are drawn."""


@dataclass(frozen=True)
class Settings:
    """Train controllers of loops in continuous time, and decide what is required at all times.

    Networks are kept under `output`; an interrupted run continues with what is there.
    """

    loops: tuple[str, ...] = (*PROBLEMS, "docking")
    """Which ones: pendulum, quadrotor, cartpole, car, docking."""
    samples: int = 20_000
    """State-input pairs of the law that each network learns from."""
    training_steps: int = 5000
    """Steps of Adam on imitation."""
    simulations: int = 2000
    """Trajectories that attack the certified sets, at all times."""
    time_limit: float = 600.0
    """Seconds for each decision."""
    part: float = 1.0
    """Of the widths of docking's initial set, around its corner that is farthest away."""
    seed: int = 0
    """Of samples and initial weights."""
    output: Path = Path("results/sampled")
    """Where everything is written."""

    def __post_init__(self):
        require_options(self, "time_limit", training_steps=1, simulations=1, samples=10, seed=0)
        names = (*PROBLEMS, "docking")
        unknown = [name for name in self.loops if name not in names]
        if unknown or not self.loops:
            raise ValueError(f"--loops must be some of {list(names)}, but {unknown} arrived")
        if not 0 < self.part <= 1:
            raise ValueError(f"--part must be above 0 and at most 1, but {self.part} arrived")


@dataclass(frozen=True, eq=False)
class Result:
    """What is found of one loop.

    Attributes:
        verdict: on what is required at all times.
        seconds: of the decision.
        at_samples: on the same of its samples alone, where that is asked; None elsewhere.
        tube: of some periods.
        states: `(c, periods * DENSE + 1, n)`, simulated.
        beyond: how far a simulated state is outside of what holds it, in parts of a width.
    """

    verdict: rj.Verdict
    seconds: float
    at_samples: rj.Verdict | None
    tube: rj.ReachTube
    states: np.ndarray
    beyond: float

    def numbers(self) -> dict[str, Any]:
        """All that a file of results keeps."""
        example, closed = self.verdict.counterexample, self.verdict.recurrence
        found: dict[str, Any] = {"verdict": self.verdict.status.name, "seconds": self.seconds}
        found |= {"beyond": self.beyond, "cells": len(self.verdict.cells)}
        found["instant"] = None if example is None else example.instant
        found["closed"] = None if closed is None else [closed.step, closed.period]
        found["at_samples"] = None if self.at_samples is None else self.at_samples.status.name
        return found


def problem_of(name: str, settings: Settings) -> Sampled:
    """The loop of this name."""
    return spacecraft(settings.part) if name == "docking" else PROBLEMS[name]()


def learned(sampled: Sampled, name: str, settings: Settings) -> Layers:
    """A network that imitates the law."""
    fit = train_network(
        sampled.problem.samples(settings.samples, settings.seed),
        sampled.problem.hidden,
        settings.seed,
        penalty=1e-5,
        steps=settings.training_steps,
        learning_rate=3e-3,
        restarts=1,
        standardise=True,
        activation=sampled.problem.activation,
        path=settings.output / f"{name}.npz",
    )
    return fit.layers


def analysed(sampled: Sampled, layers: Layers, settings: Settings) -> Result:
    """Decide what is required of a loop, bound its first periods, and attack the sets."""
    loop, given = sampled.loop(layers), sampled.problem
    options = {"cells": sampled.cells, "time_limit": settings.time_limit}
    began = time.perf_counter()
    verdict = rj.decide(loop, given.X0, given.horizon, **sampled.required, **options)
    seconds, at_samples = time.perf_counter() - began, None
    if sampled.discrete is not None:
        discrete = loop.replace(plant=sampled.discrete)
        at_samples = rj.decide(discrete, given.X0, given.horizon, **sampled.required, **options)
    periods, box = min(given.horizon, DRAWN), rj.Template.box(given.X0.dimension)
    tube = rj.reach(loop, given.X0, periods, box, rj.LinearBounds())
    begun = given.X0.sample(jax.random.key(settings.seed), settings.simulations)
    states = np.asarray(loop.simulate(begun, periods, parts=DENSE))
    return Result(verdict, seconds, at_samples, tube, states, _beyond(tube, states))


def _beyond(tube: rj.ReachTube, states: np.ndarray) -> float:
    """How far a state is outside of the set of its period, in parts of the set's width."""
    found = []
    for k, span in enumerate(tube.spans):
        A, b = (np.asarray(part) for part in span.facets)
        most = (states[:, k * DENSE : (k + 1) * DENSE + 1] @ A.T).max(axis=(0, 1))
        widths = np.ptp(states[:, k * DENSE : (k + 1) * DENSE + 1] @ A.T, axis=(0, 1))
        found.append(((most - b) / np.where(widths > 0, widths, 1.0)).max())
    return float(max(found))


def main(settings: Settings) -> None:
    """Train, decide, print, and write figures and results."""
    configure_jax(settings.output)
    results = {}
    for name in settings.loops:
        sampled = problem_of(name, settings)
        rich.print(f"{sampled.problem.name} ...")
        layers = learned(sampled, name, settings)
        results[name] = analysed(sampled, layers, settings)
        rich.print(results[name].verdict)
        figures.draw(sampled.problem, results[name], settings.output / f"{name}.png")
    rich.print(figures.table(results))
    numbers = {name: result.numbers() for name, result in results.items()}
    report.write(settings.output / "results.json", settings, results=numbers)
    rich.print(f"written: figures, networks and results.json under {settings.output}")
