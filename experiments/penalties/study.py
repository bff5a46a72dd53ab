"""Which penalty to train with: equal time, ten networks, three loops.

Networks imitate a teacher whose copies break the specification or come close to it. Each is then
trained on for equally many seconds of the processor in five ways: with no penalty, with a penalty
on simulated violations, and with penalties on certified sets of rising price: `LinearBounds`,
`LocalBounds`, and `reach` in default settings. All are judged alike: imitation error on held-out
samples, the verdict of `decide`, and how wide the certified and the simulated sets are.
"""

import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import rich

from experiments import report
from experiments.command import bar, configure_jax, require_options
from experiments.penalties import figures
from experiments.penalties.loops import LOOPS
from experiments.penalties.training import PENALTIES, Outcome, Trainer, Way

EVERY = {"LocalBounds": 10, "default": 10}
"""Dear penalties are computed at one step in so many."""

Group = dict[str, list[Outcome]]
Name = Literal["double integrator", "quadrotor", "cruise control"]


@dataclass(frozen=True)
class Settings:
    """Train with penalties of several prices for equal time, and decide.

    Everything is kept under `output`; an interrupted run continues with what is there.
    """

    loops: tuple[Name, ...] = ("double integrator", "quadrotor", "cruise control")
    """Which are studied."""
    seeds: int = 10
    """Networks of each loop, from different random weights."""
    pretraining_steps: int = 5000
    """Steps of Adam on imitation alone, before the ways part."""
    seconds: float = 10.0
    """Of the processor, that each network is then trained for; first calls not counted."""
    learning_rate: float = 1e-3
    """At their start; it decays to 0 along a cosine."""
    decide: float = 20.0
    """Seconds that a verdict may take, and then a tube."""
    simulations: int = 10_000
    """Trajectories simulated for widths and counterexamples."""
    workers: int = os.cpu_count() or 1
    """Processes side by side."""
    output: Path = Path("results/penalties")
    """Where everything is written."""

    def __post_init__(self):
        counts = ("seeds", "pretraining_steps", "simulations", "workers")
        require_options(self, "seconds", "learning_rate", "decide", **dict.fromkeys(counts, 1))

    def way(self, penalty: str) -> Way:
        """How a penalty is trained with."""
        every = EVERY.get(penalty, 1)
        return Way(penalty, every, self.seconds, self.learning_rate, self.decide, self.simulations)

    def folder(self, loop: str) -> Path:
        """Where a loop's results are."""
        return self.output / loop.replace(" ", "_")


def trained(loop: str, penalty: str, settings: Settings) -> list[Outcome]:
    """All networks of a loop in one way."""
    studied, folder = LOOPS[loop](), settings.folder(loop)
    samples = studied.samples(folder)
    networks = studied.networks(samples, settings.seeds, settings.pretraining_steps, folder)
    trainer = Trainer(studied, samples, settings.way(penalty))
    jobs = enumerate(networks)
    return [trainer.run(layers, k, folder / penalty / f"{k}.npz") for k, layers in jobs]


def studied(settings: Settings) -> Iterator[tuple[str, Group]]:
    """Loop by loop what became of its networks, in processes side by side."""
    for loop in settings.loops:  # what processes share is made before there are several
        made, folder = LOOPS[loop](), settings.folder(loop)
        samples = made.samples(folder)
        made.networks(samples, settings.seeds, settings.pretraining_steps, folder)
    pool = ProcessPoolExecutor(
        settings.workers,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=configure_jax,
        initargs=(settings.output,),
    )
    with bar() as shown, pool:
        jobs = {
            pool.submit(trained, loop, penalty, settings): (loop, penalty)
            for loop in settings.loops
            for penalty in PENALTIES
        }
        task = shown.add_task("training with penalties", total=len(jobs))
        try:
            for done in as_completed(jobs):
                done.result()
                shown.advance(task)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    outcomes = {job: done.result() for done, job in jobs.items()}
    for loop in settings.loops:
        yield loop, {penalty: outcomes[loop, penalty] for penalty in PENALTIES}


def main(settings: Settings) -> None:
    """Train, decide, print, and write the figure and results."""
    configure_jax(settings.output)
    found = dict(studied(settings))
    for loop, group in found.items():
        rich.print(figures.table(loop, group))
    rich.print(figures.NOTE)
    figures.draw(found, settings.output / "penalties.png")
    report.write(
        settings.output / "results.json",
        settings,
        outcomes={
            loop: {way: [vars(each) for each in outcomes] for way, outcomes in group.items()}
            for loop, group in found.items()
        },
    )
    rich.print(f"written: {settings.output}/penalties.png and results.json")
