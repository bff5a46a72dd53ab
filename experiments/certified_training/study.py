"""What training until proved gives: five loops, ten seeds, four ways, equal time.

Networks imitate a law and break what is asked, or come close to it. Each is trained on in four ways
by `rj.train`, for equally many seconds with compilation: by imitation alone, with a penalty on
simulated trajectories, on affine forms over sixteen cells, and on these from coarse to fine after
simulations. A run that is proved goes on as long as that lowers its loss. All are judged alike:
imitation error on held-out samples, the verdict of `decide`, and how many cells and seconds that
takes.
"""

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import optax
import rich

import reachjax as rj
from experiments import report, stored
from experiments.certified_training import figures
from experiments.certified_training.problems import MARGIN, PROBLEMS, imitation, required
from experiments.command import bar, configure_jax, require_options
from experiments.imitation import train_networks
from experiments.nonlinear.problems import Layers, Problem
from reachjax.training.until_proved import STAGES


def nothing(batch: rj.TrainingBatch) -> jnp.ndarray:
    """The objective of plain training."""
    return jnp.zeros(())


WAYS: dict[str, tuple[rj.Stage, ...]] = {
    "plain": (rj.Stage(nothing),),
    "samples": (rj.Stage(rj.Simulated(), cells=16),),
    "forms": (rj.Stage(rj.Certified(), cells=16),),
    "sharper": STAGES,
}
SMALL = 0.005
"""A margin, in the units of the state, where none is named."""

HELD_OUT = 2000
"""States at which errors are measured."""


@dataclass(frozen=True)
class Settings:
    """Train controllers in four ways for equal time until they are proved, and decide.

    Everything is kept under `output`; an interrupted run continues with what is there.
    """

    only: tuple[str, ...] = tuple(PROBLEMS)
    """Which loops."""
    ways: tuple[str, ...] = tuple(WAYS)
    """Which ways."""
    seeds: int = 2
    """Networks of each loop, from different random weights."""
    pretraining_steps: int = 1000
    """Steps of Adam on imitation alone, before the ways part."""
    seconds: float = 60.0
    """That each network is then trained for, compilation and decisions included."""
    learning_rate: float = 1e-3
    """Of Adam."""
    decide: float = 30.0
    """Seconds that a verdict may take."""
    cells: int = 1000
    """Into how many an initial set may be cut for it."""
    samples: int = 5000
    """State-input pairs of a law."""
    output: Path = Path("results/certified_training")
    """Where everything is written."""

    def __post_init__(self):
        counts = ("seeds", "pretraining_steps", "cells", "samples")
        require_options(self, "seconds", "learning_rate", "decide", **dict.fromkeys(counts, 1))
        for name, given, known in (("only", self.only, PROBLEMS), ("ways", self.ways, WAYS)):
            unknown = [each for each in given if each not in known]
            if unknown or not given:
                raise ValueError(f"--{name} must be some of {list(known)}, but {unknown} arrived")


@dataclass(frozen=True)
class Outcome:
    """What became of one network.

    Attributes:
        verdict: its name.
        error: the imitation loss on held-out states.
        cells: that the decision looked at.
        proved: how many of them are proved.
        deciding: seconds of the decision.
        training: seconds of the training.
        epochs: of the training.
    """

    verdict: str
    error: float
    cells: int
    proved: int
    deciding: float
    training: float
    epochs: int


def networks(problem: Problem, settings: Settings) -> list[Layers]:
    """Networks that imitate the law, from different random weights."""
    fits = train_networks(
        problem.samples(settings.samples, 0),
        problem.hidden,
        penalty=1e-5,
        steps=settings.pretraining_steps,
        learning_rate=3e-3,
        restarts=settings.seeds,
        standardise=True,
        activation=problem.activation,
        path=settings.output / f"{problem.name}.npz",
    )
    return [fit.layers for fit in fits]


class Study:
    """One loop, whose networks are trained in all ways; what is compiled serves all of them."""

    def __init__(self, name: str, settings: Settings):
        self.name, self.settings, self.problem = name, settings, PROBLEMS[name]()
        shown = self.problem.samples(settings.samples, 0).states[:1000]
        self.task = imitation(self.problem, shown)
        self.held_out = imitation(self.problem, self.problem.samples(HELD_OUT, 1).states)
        self.optimizer = optax.adam(settings.learning_rate)
        self.networks = networks(self.problem, settings)

    def run(self, way: str, seed: int) -> Outcome:
        """Train a network in a way and decide it; or take that from its file."""
        chosen = {"way": way, "seed": seed}
        shared = ("pretraining_steps", "seconds", "learning_rate", "decide", "cells", "samples")
        chosen |= {name: getattr(self.settings, name) for name in shared}
        path = self.settings.output / self.name.replace(" ", "_") / f"{way}_{seed}.npz"
        kept = stored.load(path, chosen)
        if kept is None:
            outcome = self._trained(way, seed)
            kept = {name: np.asarray(value) for name, value in asdict(outcome).items()}
            stored.save(path, chosen, **kept)
        return Outcome(**{name: value.item() for name, value in kept.items()})

    def _trained(self, way: str, seed: int) -> Outcome:
        problem, settings = self.problem, self.settings
        loop = problem.closed(problem.network(self.networks[seed]))
        asked: dict[str, Any] = required(problem) | {"cells": settings.cells}
        began = time.monotonic()
        found = rj.train(
            loop,
            problem.X0,
            problem.horizon,
            self.task,
            **asked,
            optimizer=self.optimizer,
            stages=WAYS[way],
            margin=MARGIN.get(self.name, SMALL),
            epochs=100_000,
            seed=seed,
            steps=50,
            time_limit=settings.seconds,
        )
        training, began = time.monotonic() - began, time.monotonic()
        verdict = rj.decide(
            found.loop, problem.X0, problem.horizon, **asked, time_limit=settings.decide
        )
        deciding = time.monotonic() - began
        proved = sum(cell.status is rj.VerdictStatus.PROVED for cell in verdict.cells)
        error = float(self.held_out(found.loop, None))
        counts = len(verdict.cells), proved, deciding, training, len(found.history)
        return Outcome(verdict.status.name, error, *counts)


def studied(settings: Settings) -> dict[str, dict[str, list[Outcome]]]:
    """What became of all networks, loop by loop and way by way."""
    found: dict[str, dict[str, list[Outcome]]] = {}
    with bar() as shown:
        total = len(settings.only) * settings.seeds * len(settings.ways)
        task = shown.add_task("training until proved", total=total)
        for name in settings.only:
            study, group = Study(name, settings), dict[str, list[Outcome]]()
            for way in settings.ways:
                for seed in range(settings.seeds):
                    group.setdefault(way, []).append(study.run(way, seed))
                    shown.advance(task)
            found[name] = group
    return found


def main(settings: Settings) -> None:
    """Train, decide, print, and write the figure and results."""
    configure_jax(settings.output)
    found = studied(settings)
    for name, group in found.items():
        rich.print(figures.table(name, group))
    rich.print(figures.NOTE)
    figures.draw(found, settings.output / "certified_training.png")
    outcomes = {
        name: {way: [asdict(each) for each in every] for way, every in group.items()}
        for name, group in found.items()
    }
    report.write(settings.output / "results.json", settings, outcomes=outcomes)
    rich.print(f"written: {settings.output}/certified_training.png and results.json")
