"""Tables and figures of loops in continuous time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table

import reachjax as rj
from experiments import report
from experiments.nonlinear.figures import draw_sets
from experiments.nonlinear.problems import Problem

if TYPE_CHECKING:
    from experiments.sampled.study import Result

NOTE = """\
at: when it is broken, in units of time; or the step at which it closes, and after how many more
outside: how far a simulated state, also in between, is beyond its set, in parts of a width"""


def table(results: Mapping[str, Result]) -> Table:
    """A loop a row."""
    rows = []
    for name, result in results.items():
        found, samples = result.numbers(), result.at_samples
        closed = found["closed"]
        when = found["instant"] if closed is None else f"{closed[0]} + {closed[1]}"
        alone = "" if samples is None else report.coloured(samples.status.name)
        cells = [name, report.coloured(found["verdict"]), alone, f"{result.seconds:.1f}"]
        rows.append([*cells, "" if when is None else when, f"{result.beyond:+.0e}"])
    headings = "s", "at", "outside"
    words = "loop", "at all times", "at samples alone"
    shown = report.table("loops in continuous time", words, headings, rows)
    shown.caption = NOTE
    shown.caption_justify = "left"
    return shown


def draw(problem: Problem, result: Result, path: Path) -> None:
    """What holds states at all times, and at samples, over trajectories; what is required."""
    figure, ((ax,),) = report.panels(1, 1, (6.4, 4.8))
    rj.plot_tube(result.tube, ax, samples=200, coordinates=problem.plane)
    draw_sets(ax, problem, result.verdict.counterexample)
    ax.set(title=f"{problem.name}, at all times: {result.verdict.status.value}")
    report.legend_below(figure, ncols=3)
    report.save(figure, path)
