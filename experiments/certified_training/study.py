"""What training until proved gives: five loops, ten seeds, five ways, equal time.

Networks imitate demonstrations of a law, which err by a tenth of its deviation, and break what is
asked, or come close to it. Each is trained on in five ways for equally many seconds: by imitation
alone; and by `rj.train`, with a penalty on simulated trajectories, on affine forms over sixteen
cells, on these from coarse to fine after simulations, and for few cells, with a penalty on how much
forms are wider than trajectories. A run that is proved goes on to the end of its time, and keeps
what is proved at the least loss. All are judged alike: imitation error on held-out samples, the
verdict of `decide`, how many cells and seconds that takes, and for some networks the largest box of
initial states that is proved.

Compilation takes from ten seconds to more than a minute, longer than some trainings would. So a
decision and a step of each stage's objective are compiled before a clock runs, from empty caches.
How many seconds that takes is kept by itself, for each way of what it needs, and added to those to
the first proof: no way gains by a step that another one has compiled. What only some networks need,
such as the call that bounds many cells at once, is compiled within the clock of the first of them.

All five loops with ten seeds take about two hours in one process: half a minute a network and
way. Processes may share the loops by `--only`, with the same `--output`: each writes what all have
done by then, and a last call for all loops collects what is stored.
"""

import functools
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import optax
import rich

import reachjax as rj
from experiments import report, stored
from experiments.certified_training import figures
from experiments.certified_training.problems import (
    PROBLEMS,
    demonstrations,
    fingerprint,
    imitation,
    margin,
    required,
)
from experiments.command import bar, require_folder, require_options
from experiments.imitation import train_network
from experiments.nonlinear.problems import Layers
from reachjax.training.until_proved import STAGES


@dataclass(frozen=True)
class Way:
    """A way to train.

    Attributes:
        stages: of `rj.train`; without any, a network is trained on the task alone.
        cells: into how many decisions in between may cut the initial set.
    """

    stages: tuple[rj.Stage, ...] = ()
    cells: int = 1000


NARROW = rj.Certified(remainder=0.1)
"""The objective of training for few cells."""

WAYS = {
    "plain": Way(),
    "samples": Way((rj.Stage(rj.Simulated(), cells=16),)),
    "forms": Way((rj.Stage(rj.Certified(), cells=16),)),
    "sharper": Way(STAGES),
    "few cells": Way(
        (rj.Stage(rj.Simulated(), cells=16, epochs=5), rj.Stage(NARROW, cells=4)),
        cells=10,
    ),
}
GIVEN = "given"
"""The row of networks before any of the ways."""

HELD_OUT = 2000
"""States at which errors are measured."""

BATCH = 16
"""Cells that `rj.train` takes at a step, at most: steps of as many are compiled once."""

STEPS = 50
"""Steps of an epoch; of plain training, those between two looks at the clock."""

SMALLER = 0.25
"""The part of the initial set, about its center, from which the search for a larger one begins."""


@dataclass(frozen=True)
class Settings:
    """Train controllers in five ways for equal time until they are proved, and decide.

    Everything is kept under `output`; an interrupted run continues with what is there.
    """

    only: tuple[str, ...] = tuple(PROBLEMS)
    """Which loops are run; of others what is stored is shown, if all of it is there."""
    ways: tuple[str, ...] = tuple(WAYS)
    """Which ways."""
    seeds: int = 10
    """Networks of each loop, from different random weights."""
    sized: int = 2
    """Of how many of these the largest set is looked for."""
    pretraining_steps: int = 3000
    """Steps of Adam on imitation alone, before the ways part."""
    seconds: float = 20.0
    """That each network is then trained for, decisions in between included."""
    learning_rate: float = 1e-3
    """Of Adam."""
    decide: float = 15.0
    """Seconds that a verdict may take."""
    cells: int = 20_000
    """Into how many an initial set may be cut for it."""
    growing: float = 5.0
    """Seconds for the largest set."""
    samples: int = 5000
    """Demonstrations of a law."""
    output: Path = Path("results/certified_training")
    """Where everything is written."""

    def __post_init__(self):
        counts = dict.fromkeys(("seeds", "pretraining_steps", "cells", "samples"), 1)
        positive = "seconds", "learning_rate", "decide", "growing"
        require_options(self, *positive, sized=0, **counts)
        for name, given, known in (("only", self.only, PROBLEMS), ("ways", self.ways, WAYS)):
            unknown = [each for each in given if each not in known]
            if unknown or not given:
                raise ValueError(f"--{name} must be some of {list(known)}, but {unknown} arrived")


@dataclass(frozen=True)
class Outcome:
    """What became of one network.

    Attributes:
        verdict: its name: PROVED if the training or the decision afterwards proved it.
        error: the imitation loss on held-out states.
        decision: the name of the verdict of that decision by itself.
        cells: that it looked at.
        proved: how many of them are proved.
        deciding: its seconds.
        first: seconds to the end of the epoch that found the first proof, or of the decision
            that did, compilation excluded; NaN where the network is not proved.
        compiling: seconds for a decision and for a step of each stage, from empty caches.
        training: seconds of the training.
        steps: of the training.
        volume: of the largest box that is proved; zero where none is found, NaN if not looked for.
    """

    verdict: str
    error: float
    decision: str
    cells: int
    proved: int
    deciding: float
    first: float
    compiling: float
    training: float
    steps: int
    volume: float


class Study:
    """One loop, whose networks are trained in all ways.

    Args:
        name: of the loop.
        settings: of the study.
    """

    def __init__(self, name: str, settings: Settings):
        self._settings, self._problem = settings, PROBLEMS[name]()
        self._folder = settings.output / name.replace(" ", "_")
        self._samples = demonstrations(self._problem, settings.samples, 0)
        self._task = imitation(self._samples)
        self._held_out = imitation(demonstrations(self._problem, HELD_OUT, 1))
        self._optimizer = optax.adam(settings.learning_rate)
        self._margin, self._problem_key = margin(self._problem), fingerprint(self._problem)
        self._compiled: dict[object, float] = {}

    def kept(self, way: str, seed: int) -> Outcome | None:
        """What became of a network, if its file is there and of the same study."""
        path, key = self._file(way, seed), self._key(way, seed)
        if stored.settings_of(path) != key:
            return None
        arrays = stored.load(path, key)
        if arrays is None:
            return None
        return Outcome(**{name: value.item() for name, value in arrays.items()})

    def run(self, way: str, seed: int) -> Outcome:
        """Train a network in a way and judge it; or take that from its file."""
        outcome = self.kept(way, seed)
        if outcome is None:
            outcome = self._trained(way, seed)
            arrays = {name: np.asarray(value) for name, value in asdict(outcome).items()}
            stored.save(self._file(way, seed), self._key(way, seed), **arrays)
        return outcome

    def _file(self, way: str, seed: int) -> Path:
        """The file of an outcome."""
        return self._folder / f"{way.replace(' ', '_')}_{seed}.npz"

    def _key(self, way: str, seed: int) -> dict[str, Any]:
        """All that an outcome depends on, in words and numbers."""
        names = "pretraining_steps", "seconds", "learning_rate", "decide", "cells", "samples"
        shared = {name: getattr(self._settings, name) for name in names}
        sized = self._settings.growing if seed < self._settings.sized else 0.0
        chosen = {"way": way, "seed": seed, "trained": repr(WAYS.get(way)), "steps": STEPS}
        asked = {"problem": self._problem_key, "margin": float(f"{self._margin:.6g}")}
        return shared | chosen | asked | {"growing": sized}

    def _given(self, seed: int) -> rj.ClosedLoop:
        """The loop under a network that imitates the law, from random weights."""
        layers: Layers = train_network(
            self._samples,
            self._problem.hidden,
            seed,
            penalty=1e-5,
            steps=self._settings.pretraining_steps,
            learning_rate=3e-3,
            restarts=1,
            standardise=True,
            activation=self._problem.activation,
            path=self._folder / f"network_{seed}.npz",
            progress=False,
        ).layers
        return self._problem.closed(self._problem.network(layers))

    def _asked(self, cells: int) -> dict[str, Any]:
        """What is required, as `rj.train` and `rj.decide` take it."""
        return required(self._problem) | {"cells": cells}

    def _trained(self, way: str, seed: int) -> Outcome:
        """Train a network in a way and judge it."""
        given, compiling = self._given(seed), self._compilation(way, seed)
        began, first, proved, steps, loop = time.monotonic(), float("nan"), False, 0, given
        if way == "plain":
            loop, steps = self._imitating(given, self._settings.seconds)
        elif way != GIVEN:
            limits = {"epochs": 1_000_000, "steps": STEPS, "time_limit": self._settings.seconds}
            found = self._until_proved(given, WAYS[way].stages, WAYS[way].cells, seed, **limits)
            loop, proved, epochs = found.loop, found.proved, found.history.epochs
            steps = sum(epoch.steps for epoch in epochs)
            first = next((e.seconds for e in epochs if e.status == "PROVED"), first)
        training = time.monotonic() - began
        judged = self._judged(loop, proved, sized=seed < self._settings.sized)
        if judged["verdict"] == "PROVED" and np.isnan(first):
            first = training + judged["deciding"]
        before = None if way in (GIVEN, "plain") else self.run(GIVEN, seed)
        if before is not None and "PROVED" == before.verdict == judged["verdict"]:
            first = float(np.nanmin([first, before.deciding]))
        clocks = {"first": first, "compiling": compiling, "training": training}
        return Outcome(**judged, **clocks, steps=steps)

    def _until_proved(
        self,
        loop: rj.ClosedLoop,
        stages: tuple[rj.Stage, ...],
        cells: int,
        seed: int,
        **limits: Any,
    ) -> rj.Trained:
        """The result of `rj.train`, which goes on after a proof to the end of its limits."""
        return rj.train(
            loop,
            self._problem.X0,
            self._problem.horizon,
            self._task,
            **self._asked(cells),
            optimizer=self._optimizer,
            stages=stages,
            margin=self._margin,
            seed=seed,
            batch=BATCH,
            gain=0.0,
            **limits,
        )

    def _imitating(self, loop: rj.ClosedLoop, seconds: float) -> tuple[rj.ClosedLoop, int]:
        """The loop after so many seconds of Adam on the task's loss alone, and the steps."""
        net: Any = loop.controller
        began, steps = time.monotonic(), 0
        state = self._optimizer.init(net)
        while time.monotonic() - began < seconds:
            for _ in range(STEPS):
                net, state = self._advance(loop, net, state)
            net = jax.block_until_ready(net)
            steps += STEPS
        return loop.replace(controller=net), steps

    @functools.partial(jax.jit, static_argnums=0)
    def _advance(self, loop: rj.ClosedLoop, net: Any, state: Any) -> tuple[Any, Any]:
        """A network and the optimizer's state after a step on the task's loss."""
        slopes = jax.grad(lambda net: self._task(loop.replace(controller=net), None))(net)
        updates, state = self._optimizer.update(slopes, state, net)
        return optax.apply_updates(net, updates), state

    def _compilation(self, way: str, seed: int) -> float:
        """Seconds in which all that a way needs is compiled, each part once for all ways.

        What a part takes is what its first call takes longer than its second one.
        """
        loop = self._given(seed)
        if not self._compiled:
            jax.clear_caches()
        parts: dict[object, Callable[[], object]] = {
            GIVEN: lambda: self._decision(loop, self._settings.decide)
        }
        if way == "plain":
            parts[way] = lambda: self._imitating(loop, 1e-9)
        for stage in WAYS.get(way, Way()).stages:
            cells, limits = min(BATCH, stage.cells), {"epochs": 1, "steps": 1}
            parts[stage.objective, cells] = functools.partial(
                self._until_proved, loop, (stage.replace(cells=cells),), 1, seed, **limits
            )
        for name, part in parts.items():
            if name not in self._compiled:
                first, second = seconds(part), seconds(part)
                self._compiled[name] = max(0.0, first - second)
        return sum(self._compiled[name] for name in parts)

    def _decision(self, loop: rj.ClosedLoop, seconds: float) -> rj.Verdict:
        """The verdict on a loop within so many seconds."""
        asked = self._asked(self._settings.cells)
        return rj.decide(loop, self._problem.X0, self._problem.horizon, **asked, time_limit=seconds)

    def _judged(self, loop: rj.ClosedLoop, proved: bool, sized: bool) -> dict[str, Any]:
        """What is said of a loop after training, which may have proved it."""
        began = time.monotonic()
        verdict = self._decision(loop, self._settings.decide)
        deciding, decision = time.monotonic() - began, verdict.status.name
        whole = proved or verdict.proved
        return {
            "verdict": "PROVED" if whole else decision,
            "error": float(self._held_out(loop, None)),
            "decision": decision,
            "cells": len(verdict.cells),
            "proved": sum(cell.status is rj.VerdictStatus.PROVED for cell in verdict.cells),
            "deciding": deciding,
            "volume": self._volume(loop, whole) if sized else float("nan"),
        }

    def _volume(self, loop: rj.ClosedLoop, proved: bool) -> float:
        """The volume of the largest box that is proved: one that is found, or the initial set."""
        X0, limit = self._problem.X0, self._settings.growing
        half = SMALLER / 2 * X0.widths
        begun, asked = rj.Box(X0.center - half, X0.center + half), required(self._problem)
        try:
            found = rj.largest_set(loop, begun, self._problem.horizon, **asked, time_limit=limit)
        except ValueError:  # nothing is proved
            boxes = []
        else:
            boxes = [found.region.bounding_box()]
        wide = np.asarray(X0.widths) > 0
        boxes += [X0] if proved else []
        return max((float(np.prod(np.asarray(box.widths)[wide])) for box in boxes), default=0.0)


def seconds(call: Callable[[], object]) -> float:
    """The seconds that a call takes."""
    began = time.monotonic()
    call()
    return time.monotonic() - began


Group = dict[str, list[Outcome]]


def studied(settings: Settings) -> dict[str, Group]:
    """What became of all networks, loop by loop and way by way."""
    found, ways = dict[str, Group](), (GIVEN, *settings.ways)
    with bar() as shown:
        total = len(settings.only) * settings.seeds * len(ways)
        task = shown.add_task("training until proved", total=total)
        for name in settings.only:
            study, group = Study(name, settings), Group()
            for way in ways:
                for seed in range(settings.seeds):
                    group.setdefault(way, []).append(study.run(way, seed))
                    shown.advance(task)
            found[name] = group
    return found


def collected(settings: Settings, found: dict[str, Group]) -> dict[str, Group]:
    """What was found, and of other loops what is stored, where none of it is missing."""
    groups = dict[str, Group]()
    for name in PROBLEMS:
        group = found.get(name)
        if group is None and (settings.output / name.replace(" ", "_")).exists():
            study, seeds = Study(name, settings), range(settings.seeds)
            kept = {way: [study.kept(way, k) for k in seeds] for way in (GIVEN, *settings.ways)}
            group = {way: [each for each in row if each] for way, row in kept.items()}
            group = group if all(len(row) == settings.seeds for row in group.values()) else None
        if group is not None:
            groups[name] = group
    return groups


def written(path: Path, write: Callable[[Path], None]) -> None:
    """Write a file under another name first, as another process may write it at the same time."""
    unfinished = path.with_name(f"{os.getpid()}_{path.name}")
    write(unfinished)
    os.replace(unfinished, path)


def main(settings: Settings) -> None:
    """Train, decide, print, and write the figure and results.

    Compilations are not kept on disk, since their time is measured.
    """
    require_folder(settings.output)
    jax.config.update("jax_enable_x64", True)
    found = collected(settings, studied(settings))
    for name, group in found.items():
        rich.print(figures.table(name, group))
    rich.print(figures.said())
    outcomes = {
        name: {way: [asdict(each) for each in every] for way, every in group.items()}
        for name, group in found.items()
    }
    output = settings.output
    written(output / "certified_training.png", lambda path: figures.draw(found, path))
    written(output / "results.json", lambda path: report.write(path, settings, outcomes=outcomes))
    rich.print(f"written: {output}/certified_training.png and results.json")
