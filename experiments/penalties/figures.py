"""Tables and the figure of the study of penalties."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from rich.table import Table

from experiments import report
from experiments.penalties.training import Outcome

COLOURS = {
    "none": "tab:gray",
    "samples": "tab:green",
    "LinearBounds": "tab:orange",
    "LocalBounds": "tab:purple",
    "default": "tab:blue",
}
NOTE = f"""\
P / R / U: proved, refuted, unknown;  as good: proved, error within {report.WITHIN - 1:.0%} of plain
error: on held-out samples, over that of plain training, median
sets, hulls: certified and simulated widths over those of plain training, medians
penalties: steps that had one, of all, medians;  first: seconds of first calls, largest"""


def shrunk(
    outcomes: Sequence[Outcome],
    plain: Sequence[Outcome],
    widths: Callable[[Outcome], Float[ndarray, "horizon d"]],
) -> Float[ndarray, " seeds"]:
    """Geometric means of widths over those of plain training, network by network."""
    pairs = [(widths(each), widths(other)) for each, other in zip(outcomes, plain, strict=True)]
    return np.array([np.exp(np.mean(np.log(a[b > 0] / b[b > 0]))) for a, b in pairs])


def table(loop: str, group: dict[str, list[Outcome]]) -> Table:
    """A way a row."""
    plain, rows = group["none"], []
    for way, outcomes in group.items():
        proved = np.array([each.verdict == "PROVED" for each in outcomes])
        verdicts = [sum(each.verdict == name for each in outcomes) for name in report.COLOURS]
        error = report.ratios(outcomes, plain)
        certified = shrunk(outcomes, plain, lambda each: each.certified)
        simulated = shrunk(outcomes, plain, lambda each: each.simulated)
        penalised, steps = (
            np.median([getattr(each, name) for each in outcomes]) for name in ("penalised", "steps")
        )
        rows.append(
            (
                way,
                " / ".join(map(str, verdicts)),
                int(np.sum(proved & (error <= report.WITHIN))),
                f"{np.median(error):.2f}",
                f"{np.median(certified):.2f}",
                f"{np.median(simulated):.2f}",
                "-" if way == "none" else f"{penalised:.0f}/{steps:.0f}",
                f"{max(each.first for each in outcomes):.1f}",
            )
        )
    initials = " / ".join(name[0] for name in report.COLOURS)
    headings = (
        *(initials, "as good", "error", "sets", "hulls"),
        *("penalties", "first"),
    )
    return report.table(loop, ("penalty",), headings, rows)


def draw(found: dict[str, dict[str, list[Outcome]]], path: Path) -> None:
    """Each network: imitation error and certified widths, over those of plain training."""
    figure, (axes,) = report.panels(1, len(found), (4.4 * len(found), 4.2))
    for ax, (loop, group) in zip(axes, found.items(), strict=True):
        plain = group["none"]
        for way, outcomes in group.items():
            proved = np.array([each.verdict == "PROVED" for each in outcomes])
            at = (
                report.ratios(outcomes, plain),
                shrunk(outcomes, plain, lambda each: each.certified),
            )
            report.draw_networks(ax, at, proved, way, COLOURS[way])
        report.over_plain(ax, loop, "imitation error / that of plain training")
    axes[0].set_ylabel("certified widths / those of plain training")
    report.legend_below(figure, title="penalty (filled: proved, hollow: not)")
    report.save(figure, path)
