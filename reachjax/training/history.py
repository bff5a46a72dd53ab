"""What became of a controller in training, epoch by epoch."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, NamedTuple

from reachjax.sets.pictures import draw_curves
from reachjax.tubes.displays import display, picture, table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIZE = 12
"""So many of the last epochs are printed."""


class Epoch(NamedTuple):
    """Some steps of training, and what was decided after them.

    Attributes:
        stage: the number of the stage, from 0.
        steps: how many there were.
        skipped: how many of these had no finite gradient.
        task: the mean of the task's loss.
        penalty: the mean of the objective.
        status: of the verdict on the controller that is kept after the epoch.
        margin: the smallest certified margin; minus infinity where none is known.
        cells: how many that verdict is of.
        proved: how many of these are proved.
        seconds: since training began, of all runs together, at the end of the epoch.
    """

    stage: int
    steps: int
    skipped: int
    task: float
    penalty: float
    status: str
    margin: float
    cells: int
    proved: int
    seconds: float


@dataclasses.dataclass(frozen=True)
class TrainingHistory:
    """The epochs of a training; none where the controller is proved as it was given.

    Attributes:
        epochs: one after the other.
    """

    epochs: tuple[Epoch, ...] = ()

    def __len__(self) -> int:
        """The number of epochs."""
        return len(self.epochs)

    def __str__(self) -> str:
        headings = "epoch stage skipped/steps      task   penalty    margin  proved/cells  seconds"
        lines = [f"{headings}  verdict"]
        for k, e in list(enumerate(self.epochs))[-SIZE:]:
            lines.append(
                f"{k:5d} {e.stage:5d} {e.skipped:7d}/{e.steps:<5d} {e.task:9.3g} "
                f"{e.penalty:9.3g} {e.margin:9.3g}  "
                f"{e.proved:5d}/{e.cells:<5d} {e.seconds:9.1f}  {e.status}"
            )
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        rows = [[k, *epoch] for k, epoch in enumerate(self.epochs)]
        said = table(["epoch", *Epoch._fields], rows[-SIZE:])
        return display(f"TrainingHistory(epochs={len(self)})", said, picture(self.plot))

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the task's loss, the penalty and undecided cells over epochs, and where stages end.

        Args:
            ax: where to draw; a new figure by default.
        """
        each = self.epochs
        curves = {
            "task": ("tab:blue", [e.task for e in each]),
            "penalty": ("tab:orange", [e.penalty for e in each]),
            "cells not proved": ("tab:red", [float(e.cells - e.proved) for e in each]),
        }
        changes = [k - 0.5 for k in range(1, len(each)) if each[k].stage != each[k - 1].stage]
        proved = [k for k, e in enumerate(each) if e.status == "PROVED"]
        marks = {"next stage": ("tab:gray", changes), "proved": ("tab:green", proved)}
        return draw_curves(curves, marks, ax, "epoch")
