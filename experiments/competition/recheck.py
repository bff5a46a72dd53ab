"""A verdict's file of the competition, proved anew by the networks that are read again.

    python -m experiments.competition.recheck results/competition/verdicts/nav-robust.verdict

For a loop of one's own there is `python -m reachjax recheck FILE --loop MODULE:NAME`.
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
    """A verdict, in the folder in which it was written."""
    path: tyro.conf.Positional[Path | None] = None
    """The clone of the benchmark repository, if it is no longer where it was."""
    processes: int = dataclasses.field(default_factory=lambda: os.cpu_count() or 1)
    """That cells are proved in; 1 for none besides."""

    def __post_init__(self):
        require_options(self, processes=1)
        if self.file.suffix != ".verdict" or self.file.stem not in instances():
            raise ValueError(
                f"FILE must be a verdict that is named as an instance is, but {self.file} arrived"
            )
        if not self.file.is_file():
            raise ValueError(f"FILE must be there, but there is no {self.file}")

    @property
    def of_study(self) -> study.Settings:
        """The settings by which it was decided."""
        output = self.file.resolve().parent.parent
        rows = {row["title"]: row for row in study.stored(output / "results.json")}
        row = rows.get(self.file.stem)
        if row is None:
            raise ValueError(
                f"FILE must stand where it was written, but no results.json in {output} says of "
                "what networks it is"
            )
        path = self.path or (row["path"] and Path(row["path"]))
        return study.Settings(path, training_steps=row["training_steps"], output=output)


def main(settings: Settings) -> None:
    """Read, prove and print."""
    jax.config.update("jax_enable_x64", True)
    loop = study.loop_of(settings.file.stem, settings.of_study)
    with workers(settings.processes) as executor:
        found = rj.load(settings.file, loop, recheck=True, executor=executor)
    rich.get_console().print(found, markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    run_experiment(main, Settings, "nothing is stored")
