"""What a row of the benchmark is: a question, what is asked of its figures, and how to get them."""

import multiprocessing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.benchmark.cases import Settings
from experiments.benchmark.growth import peak_memory
from experiments.competition.instances import instances

Figures = dict[str, Any]
"""Numbers and words by their names."""

Measure = Callable[[Settings], Iterator[Figures]]
"""Figures of a row, as they are there, in a process in which nothing is compiled yet."""

MEMORY = "GB"
"""The figure that each row has: the most memory of its process, and of those that it began."""

HALF_HOUR = 1800.0


@dataclass(frozen=True)
class Row:
    """A question, and what is asked of its answer.

    Attributes:
        loop: by which name of `--loops` it is asked for.
        name: of the question.
        asked: of each figure the most that it may be, or the word that it must be; None where
            nothing is asked of it. Figures are shown in this order.
        measure: a function of a module's top level, or `functools.partial` of one.
        networks: titles of the competition's instances whose files it reads.
        patience: seconds between two figures, after which its process is ended.
    """

    loop: str
    name: str
    asked: Mapping[str, float | str | None]
    measure: Measure
    networks: tuple[str, ...] = ()
    patience: float = HALF_HOUR

    @property
    def title(self) -> str:
        """Loop and question in one line."""
        return f"{self.loop}: {self.name}"

    def files(self, folder: Path | None) -> list[Path]:
        """The files of its networks.

        Raises:
            FileNotFoundError: one is not there.
        """
        if self.networks and folder is None:
            raise FileNotFoundError("no --folder is given")
        every = instances()
        return [path for title in self.networks for path in every[title].paths(Path(folder or ""))]


def kept(asked: float | str | None, found: Any) -> bool | None:
    """Whether a figure is what is asked for, as it is shown; None where nothing is asked.

    Example:
        >>> kept(1.13, 1.1304), kept("PROVED", "UNKNOWN"), kept(None, 2.0)
        (True, False, None)
    """
    if asked is None or found is None:
        return None
    if isinstance(asked, str):
        return found == asked
    return not isinstance(found, str) and float(f"{found:.3g}") <= asked


def gigabytes() -> float:
    """The most memory that this process has held, and each of those that it began."""
    total = float(peak_memory())
    for process in multiprocessing.active_children():
        status = Path(f"/proc/{process.pid}/status")
        if status.exists():
            lines = dict(line.split(":", 1) for line in status.read_text().splitlines())
            total += 1024 * int(lines.get("VmHWM", "0 kB").split()[0])
    return total / 2**30
