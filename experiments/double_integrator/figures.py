"""Tables and the figure of the double integrator's tubes."""

from pathlib import Path

import numpy as np
from rich.table import Table
from scipy.spatial import ConvexHull, QhullError

from experiments import report
from experiments.analysis import Analysis
from experiments.double_integrator.problem import GOAL_BOX, STATE_BOX

NOTE = """\
area, hull: of the certified set, and of the convex hull of simulated states
gap: the worst facet's bound less its witness;  solver: all facets of the step
goal, constraint: smallest certified margin, in the units of the state"""


def steps(analysis: Analysis) -> list[dict]:
    """Figures of each step: areas, the worst gap, solver time and statuses."""
    rows = []
    for t in range(1, analysis.tube.horizon + 1):
        certificate = analysis.tube.proof(t)
        rows.append(
            {
                "step": t,
                "area": float(analysis.tube.sets[t].volume()),
                "hull": hull_area(analysis.states[:, t]),
                "gap": float(certificate.gaps.max()),
                "seconds": float(certificate.seconds.sum()),
                "offsets": certificate.bounds.tolist(),
                "statuses": [status.name for status in certificate.statuses],
            }
        )
    return rows


def hull_area(points: np.ndarray) -> float:
    """The area of the convex hull of points `(count, 2)`."""
    try:
        return float(ConvexHull(points).volume)
    except QhullError:  # points on a line
        return 0.0


def step_table(analyses: list[Analysis]) -> Table:
    """Controllers side by side, a row a step."""
    names = [analysis.controller for analysis in analyses]
    rows = [
        [found[0]["step"], *(cell for row in found for cell in _cells(row))]
        for found in zip(*map(steps, analyses), strict=True)
    ]
    headings = report.grouped(names, ("area", "hull", "gap", "solver"))
    return report.table(analyses[0].relaxation, [], ["\nt", *headings], rows)


def _cells(row: dict) -> list[str]:
    return [f"{row[key]:.4f}" for key in ("area", "hull", "gap")] + [f"{row['seconds']:.2f} s"]


def verdict_table(analyses: list[Analysis]) -> Table:
    """What each relaxation decides of each controller, with the smallest margins."""
    rows = []
    for analysis in sorted(analyses, key=lambda each: each.controller):
        found = analysis.results()
        margins = [f"{found['margins'][part]:+.4f}" for part in ("goal", "safe")]
        names = found["controller"], found["relaxation"], report.coloured(found["verdict"])
        rows.append([*names, *margins, f"{found['seconds']:.1f} s"])
    left, right = ("controller", "relaxation", "verdict"), ("goal", "constraint", "reach")
    return report.table("verdicts", left, right, rows)


def draw(analyses: list[Analysis], path: Path) -> None:
    """One panel a controller: samples, certified sets, goal, constraint and counterexample."""
    figure, axes = report.panels(1, len(analyses), (11, 4.8), sharey=True)
    for ax, analysis in zip(axes[0], analyses, strict=True):
        report.draw_tube(ax, analysis.tube, GOAL_BOX, analysis.verdict.counterexample)
        ax.axhline(STATE_BOX[0, 1], color="black", linewidth=1, label="$x_2 \\geq -1$")
        ax.set_title(f"{analysis.controller}: {analysis.verdict.status.name}")
        ax.label_outer()
    report.legend_below(figure, markerscale=3)
    report.save(figure, path)
