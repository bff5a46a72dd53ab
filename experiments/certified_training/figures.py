"""Tables and the figure of the study of training until proved."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.table import Table

from experiments import report

if TYPE_CHECKING:
    from experiments.certified_training.study import Outcome

COLOURS = {
    "given": "black",
    "plain": "tab:gray",
    "samples": "tab:green",
    "forms": "tab:orange",
    "sharper": "tab:blue",
    "few cells": "tab:red",
}

NOTE = {
    "given": "networks before they are trained on; the other rows are after equal time.",
    "P/R/U": "so many networks are proved, refuted, unknown. A network counts as proved if its "
    "training, or the decision afterwards, proved it.",
    "good": f"so many are proved at an error of at most {report.WITHIN} times that of plain "
    "training.",
    "error": "the imitation error on held-out states, over that of plain training; the median.",
    "%": "the root of that error itself, in percent of the deviation of what is shown; the "
    "median. Demonstrations themselves err by 10.",
    "cells, s": "cells and seconds of the decision after training; medians over the networks that "
    "it proved, and a dash where it proved none. Seconds are fewer after a training whose own "
    "decisions compiled the call for many cells, so ways are to be compared by cells.",
    "first": "seconds to the end of the epoch of the first proof, compilation included; the median "
    "over the networks that are proved. Plain training is decided at its end only. A network that "
    "is proved as it was given needs the seconds of that decision at most.",
    "built": "the part of these that compiles, from empty caches, measured before clocks run.",
    "step": "milliseconds of training a step, decisions in between included; the median.",
    "box": "the volume of the largest box of initial states that is proved, over that after plain "
    "training; the median over the networks for which it was looked for, and a dash where no such "
    "box is known after plain training.",
}
"""The rows and columns of the tables, in sentences."""

ENOUGH = """Where the row of samples has as many proofs as those below it, at no larger error, \
samples are enough."""


def said() -> str:
    """The sentences under the tables."""
    return "\n".join([*(f"[bold]{name}[/]: {text}" for name, text in NOTE.items()), ENOUGH])


def median(values: Iterable[float], digits: int = 0) -> str:
    """The median of numbers that are known, in words; a dash of none."""
    known = [each for each in values if not np.isnan(each)]
    return f"{np.median(known):.{digits}f}" if known else "-"


def larger(outcomes: list[Outcome], plain: list[Outcome] | None) -> list[float]:
    """The volumes of the largest boxes over those of plain training, where there are both."""
    pairs = zip(outcomes, plain or (), strict=False)
    return [each.volume / other.volume for each, other in pairs if other.volume > 0]


def table(loop: str, group: dict[str, list[Outcome]]) -> Table:
    """A way a row."""
    rows = []
    for way, outcomes in group.items():
        proved = np.array([each.verdict == "PROVED" for each in outcomes])
        verdicts = [sum(each.verdict == name for each in outcomes) for name in report.COLOURS]
        error = report.ratios(outcomes, group.get("plain"))
        decided = [each for each in outcomes if each.decision == "PROVED"]
        rows.append(
            (
                way,
                "/".join(map(str, verdicts)),
                int(np.sum(proved & (error <= report.WITHIN))),
                median(error, 2),
                median((100 * np.sqrt(each.error) for each in outcomes), 2),
                median(each.cells for each in decided),
                median((each.deciding for each in decided), 1),
                median(
                    each.first + each.compiling for each in outcomes if each.verdict == "PROVED"
                ),
                median(each.compiling for each in outcomes),
                median((1e3 * each.training / each.steps for each in outcomes if each.steps), 1),
                median(larger(outcomes, group.get("plain")), 2),
            )
        )
    initials = "/".join(name[0] for name in report.COLOURS)
    times = "first", "built", "step"
    headings = initials, "good", "error", "%", "cells", "s", *times, "box"
    return report.table(loop, ("way",), headings, rows)


def draw(found: dict[str, dict[str, list[Outcome]]], path: Path) -> None:
    """Each network: its error over that of plain training; its first proof above, its cells below.

    Those that are not proved are drawn where their training ended.
    """
    figure, axes = report.panels(2, len(found), (3.2 * len(found), 6.4), sharey="row")
    for (above, below), (loop, group) in zip(axes.T, found.items(), strict=True):
        for way, outcomes in group.items():
            if way == "given":
                continue
            error = report.ratios(outcomes, group.get("plain") or group["given"])
            proved = np.array([each.verdict == "PROVED" for each in outcomes])
            first = np.array([each.first for each in outcomes])
            end = np.array([each.training for each in outcomes])
            compiling = np.array([each.compiling for each in outcomes])
            at = error, np.where(proved & ~np.isnan(first), first, end) + compiling
            report.draw_networks(above, at, proved, way, COLOURS[way])
            decided = np.array([each.decision == "PROVED" for each in outcomes])
            at = error, np.array([each.cells for each in outcomes])
            report.draw_networks(below, at, decided, way, COLOURS[way])
        report.over_plain(above, loop, "")
        base = "plain training" if "plain" in group else "the given network"
        report.over_plain(below, "", f"error / that of {base}")
        below.set_yscale("log")
        below.yaxis.set_major_formatter("{x:g}")
        below.yaxis.set_minor_formatter("")
    axes[1, 0].set_ylim(0.8, max(12.0, 1.3 * axes[1, 0].get_ylim()[1]))
    axes[0, 0].set_ylabel("seconds to the first proof")
    axes[1, 0].set_ylabel("cells of the decision")
    title = "way (filled: proved, below: by the decision after training; hollow: not)"
    columns = len(COLOURS) if len(found) > 1 else 2
    report.legend_below(figure, title=title, ncols=columns)
    report.save(figure, path)
