"""Tables and the figure of the study of training until proved."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.table import Table

from experiments import report

if TYPE_CHECKING:
    from experiments.certified_training.study import Outcome

COLOURS = {
    "plain": "tab:gray",
    "samples": "tab:green",
    "forms": "tab:orange",
    "sharper": "tab:blue",
}

NOTE = f"""\
P / R / U: proved, refuted, unknown;  as good: proved, error within {report.WITHIN - 1:.0%} of plain
error: on held-out states, over that of plain training, median;  cells, seconds: of the decision,
medians;  training: seconds until it ended, compilation included, median;  epochs: median"""


def table(loop: str, group: dict[str, list[Outcome]]) -> Table:
    """A way a row."""
    rows = []
    for way, outcomes in group.items():
        proved = np.array([each.verdict == "PROVED" for each in outcomes])
        verdicts = [sum(each.verdict == name for each in outcomes) for name in report.COLOURS]
        error = report.ratios(outcomes, group.get("plain"))

        def median(name: str, outcomes: Sequence[Outcome] = outcomes) -> float:
            return float(np.median([getattr(each, name) for each in outcomes]))

        rows.append(
            (
                way,
                " / ".join(map(str, verdicts)),
                int(np.sum(proved & (error <= report.WITHIN))),
                f"{np.median(error):.2f}",
                f"{median('cells'):.0f}",
                f"{median('deciding'):.1f}",
                f"{median('training'):.0f}",
                f"{median('epochs'):.0f}",
            )
        )
    initials = " / ".join(name[0] for name in report.COLOURS)
    headings = (initials, "as good", "error", "cells", "seconds", "training", "epochs")
    return report.table(loop, ("way",), headings, rows)


def draw(found: dict[str, dict[str, list[Outcome]]], path: Path) -> None:
    """Each network: its error over that of plain training, and the cells that are not proved."""
    figure, (axes,) = report.panels(1, len(found), (3.4 * len(found), 3.6))
    for ax, (loop, group) in zip(axes, found.items(), strict=True):
        for way, outcomes in group.items():
            proved = np.array([each.verdict == "PROVED" for each in outcomes])
            error = report.ratios(outcomes, group.get("plain") or next(iter(group.values())))
            at = error, np.array([each.training for each in outcomes])
            report.draw_networks(ax, at, proved, way, COLOURS[way])
        report.over_plain(ax, loop, "error / that of plain training")
    axes[0].set_ylabel("seconds of training")
    report.legend_below(figure, title="way (filled: proved, hollow: not)")
    report.save(figure, path)
