"""A table of each group, the rows of numbers, and the figure of the study of tightness."""

import csv
from pathlib import Path

import numpy as np
from rich.table import Table

from experiments import report
from experiments.tightness.reference import Result

MOST_STEPS = 6
"""Columns of a table."""
FLOOR = 1e-5
"""Of the figure's logarithmic axis: what is tighter is drawn here."""
DODGE = 0.04
"""Steps by which methods stand apart, so that equal ones are all seen."""
STYLES = {
    "paper": ("tab:brown", "s"),
    "paper, no lambda": ("tab:pink", "p"),
    "local bounds": ("tab:gray", "D"),
    "local, no lambda": ("black", "x"),
    "cuts, window 1": ("tab:orange", "^"),
    "cuts, window 3": ("tab:red", "v"),
    "cuts, one shot": ("tab:green", "o"),
    "grid of cells": ("tab:cyan", "P"),
    "guided cells": ("tab:purple", "*"),
}
NOTE = """\
t: size of the certified set over that of the tightest set of its template, the
   median over loops; in the plane the area, else the worst of the box's widths
gap: the worst bound less the method's own witness, over facets, steps and loops
s/tube: of a warm call, the median over loops;  first: of the first call, which
   compiles what no row above has compiled;  * first, longer than --patience
lambda: lambda_ij;  cuts: cutting planes, from local bounds without lambda_ij
cells: 4 x 4, or 16 split where gaps are worst; as local, no lambda"""


def table(result: Result) -> Table:
    """A method a row, with what was left out and the soundness of all of them below."""
    group, steps, rows = result.group, _shown(result.group.horizon), []
    for name, each in result.measured.items():
        ratios = 1 + np.median(result.excess(name), axis=0)
        cold = "*" if each.seconds[0] == each.first else ""
        gap = (each.bounds - each.witnesses).max()
        seconds = cold + _seconds(np.median(each.seconds)), _seconds(each.first)
        rows.append([name, *(_ratio(ratios[t - 1]) for t in steps), f"{gap:.1e}", *seconds])
    against = "exact maxima" if result.reference.exact else "the largest simulated values"
    count = "" if len(group.loops) == 1 else f", {len(group.loops)} networks"
    headings = (*map(str, steps), "gap", "s/tube", "first")
    shown = report.table(f"{group.name}{count}: sizes over {against}", ("t",), headings, rows)
    shown.padding = 0  # ten columns are to fit in eighty characters
    slacks = result.slacks()
    least = min(slacks, key=lambda name: slacks[name])
    verdict = "sound" if result.sound else "[red]NOT SOUND[/red]"
    lines = [f"{verdict}: smallest bound less largest value {slacks[least]:+.1e} ({least})"]
    lines += [f"{name} left out: {why}" for name, why in group.left_out.items()]
    shown.caption, shown.caption_justify = "\n".join(lines), "left"
    return shown


def _shown(horizon: int) -> list[int]:
    """At most so many steps, the first and the last among them."""
    return np.unique(np.linspace(1, horizon, min(horizon, MOST_STEPS)).round().astype(int)).tolist()


def _ratio(value: float) -> str:
    return f"{value:.3f}" if value < 9.9995 else f"{value:.4g}"


def _seconds(value: float) -> str:
    return f"{value:.2f}" if value < 9.995 else f"{value:.1f}"


def write(results: list[Result], path: Path) -> None:
    """A row for each group, loop, method and step."""
    heading = ("group", "loop", "method", "t", "ratio", "gap", "seconds", "first", "exact")
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(heading)
        for result in results:
            for name, each in result.measured.items():
                ratios = 1 + result.excess(name)
                gaps = (each.bounds - each.witnesses).max(axis=-1)
                for (loop, t), ratio in np.ndenumerate(ratios):
                    first = each.first if loop == 0 else ""
                    numbers = ratio, gaps[loop, t], each.seconds[loop], first
                    row = (result.group.name, loop, name, t + 1, *numbers, result.reference.exact)
                    writer.writerow(row)


def _power(value: float, _) -> str:
    """The label of a power of ten."""
    return ("≤ " if value <= FLOOR else "") + f"$10^{{{np.log10(value):.0f}}}$"


def _decades(values: np.ndarray) -> tuple[float, float]:
    """Powers of ten around some values, not too close to them."""
    ends = np.log10([values.min() / 1.1, values.max() * 1.1])
    return 10.0 ** np.floor(ends[0]), 10.0 ** np.ceil(ends[1])


def draw(results: list[Result], *paths: Path) -> None:
    """A row of two panels a group: how loose at each step, and at the last against seconds."""
    figure, panels = report.panels(len(results), 2, (10, 1.2 + 2.5 * len(results)))
    seconds = [each.seconds for result in results for each in result.measured.values()]
    limits = _decades(np.concatenate(seconds))
    for (left, right), result in zip(panels, results, strict=True):
        right.sharey(left)
        steps = np.arange(1, result.group.horizon + 1)
        tightest = "exact" if result.reference.exact else "simulated"
        for name, each in result.measured.items():
            colour, marker = STYLES[name]
            excess = np.maximum(result.excess(name), FLOOR)
            style = {"color": colour, "marker": marker, "markersize": 6, "clip_on": False}
            aside = steps + DODGE * (list(STYLES).index(name) - (len(STYLES) - 1) / 2)
            left.plot(aside, np.median(excess, axis=0), label=name, linewidth=1.2, **style)
            right.plot(each.seconds, excess[:, -1], linestyle="none", **style)
        left.set(
            yscale="log", xticks=steps, ylabel=f"size / {tightest} - 1", title=result.group.name
        )
        right.set(
            xscale="log", xlim=limits, title=f"{result.group.name}, t = {result.group.horizon}"
        )
        for ax in (left, right):
            ax.axhspan(FLOOR, 2 * FLOOR, color="tab:green", alpha=0.15, linewidth=0)
            ax.grid(alpha=0.3)
        left.set(xlim=(0.5, result.group.horizon + 0.5), ylim=(FLOOR, None))
        left.yaxis.set_major_formatter(_power)
        right.tick_params(labelleft=False)
    panels[-1, 0].set_xlabel("step t")
    panels[-1, 1].set_xlabel("seconds a tube, warm")
    report.legend_below(figure, list(STYLES), ncols=5)
    report.save(figure, *paths)
