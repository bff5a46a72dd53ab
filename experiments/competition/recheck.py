"""A verdict's file of the competition, proved anew by the networks that are read again.

    python -m experiments.competition.recheck results/competition/verdicts/nav-robust.verdict PATH

What `python -m reachjax recheck FILE --loop MODULE:NAME` does where the loop is one of one's own.
"""

import dataclasses
import os
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read once, when numpy is imported

import jax
import rich
import tyro

import reachjax as rj
from experiments.benchmark.rivals.processes import workers
from experiments.command import require_options, run_experiment
from experiments.competition import study
from experiments.competition.instances import instances


@dataclass(frozen=True)
class Settings:
    """Prove a verdict of the competition anew, from its file and its networks."""

    file: tyro.conf.Positional[Path]
    """A verdict, named as its instance is."""
    path: tyro.conf.Positional[Path | None] = None
    """The clone of the benchmark repository that it was decided with; none for trained networks."""
    processes: int = dataclasses.field(default_factory=lambda: os.cpu_count() or 1)
    """That cells are proved in; 1 for none besides."""
    training_steps: int = 2000
    """Steps of Adam, where networks were trained."""

    def __post_init__(self):
        require_options(self, processes=1, training_steps=1)
        if self.file.stem not in instances():
            raise ValueError(f"FILE must be named as an instance is, but {self.file} arrived")


def main(settings: Settings) -> None:
    """Read, prove and print."""
    jax.config.update("jax_enable_x64", True)
    output = settings.file.resolve().parent.parent  # where trained networks are kept
    given = settings.path, settings.training_steps, output
    loop = study.loop_of(settings.file.stem, *given)
    with workers(settings.processes) as executor:
        found = rj.load(settings.file, loop, recheck=True, executor=executor)
    rich.get_console().print(found, markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    run_experiment(main, Settings, "nothing is stored")
