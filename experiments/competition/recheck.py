"""A verdict's file of the competition, proved anew by the networks that are read again.

    python -m experiments.competition.recheck results/competition/verdicts/nav-robust.verdict

For a loop of one's own there is `python -m reachjax recheck FILE --loop MODULE:NAME`.
"""

import dataclasses
import json
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
        named = self.file.suffix == ".verdict" and self.file.stem in instances()
        if not named or not self.file.is_file():
            raise ValueError(
                f"FILE must be a verdict that is named as an instance is, but {self.file} arrived"
            )

    @property
    def of_study(self) -> study.Settings:
        """The settings by which it was decided."""
        output = self.file.resolve().parent.parent
        kept = output / "results.json"
        if not kept.is_file():
            raise ValueError(
                f"FILE must stand where it was written, but there is no {kept}, which says of what "
                "networks it is"
            )
        given = json.loads(kept.read_text())["settings"]
        path = self.path or (given["path"] and Path(given["path"]))
        return study.Settings(path, training_steps=given["training_steps"], output=output)


def main(settings: Settings) -> None:
    """Read, prove and print."""
    jax.config.update("jax_enable_x64", True)
    loop = study.loop_of(settings.file.stem, settings.of_study)
    with workers(settings.processes) as executor:
        found = rj.load(settings.file, loop, recheck=True, executor=executor)
    rich.get_console().print(found, markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    run_experiment(main, Settings, "nothing is stored")
