"""What an experiment with planar tubes reports: tables, a figure, and results as JSON."""

import dataclasses
import json
from pathlib import Path

import numpy as np
from rich.table import Table
from scipy.spatial import ConvexHull, QhullError

import reachjax as rj
from experiments.command import blank_table
from experiments.imitation import Fit

NOTE = """\
area, hull: of the certified set, and of the convex hull of simulated states
gap: the worst facet's bound less its witness;  solver: all facets of the step
goal, constraint: smallest certified margin, in the units of the state"""
COLOURS = {"PROVED": "green", "REFUTED": "red", "UNKNOWN": "yellow"}


@dataclasses.dataclass(frozen=True)
class Analysis:
    """A certified tube of one controller under one relaxation."""

    controller: str
    relaxation: str
    tube: rj.ReachTube
    verdict: rj.Verdict
    states: np.ndarray
    seconds: float

    def steps(self) -> list[dict]:
        """Figures of each step: areas, the worst gap, solver time and statuses."""
        rows = []
        for t in range(1, self.tube.horizon + 1):
            certificate = self.tube.proof(t)
            rows.append(
                {
                    "step": t,
                    "area": float(self.tube.sets[t].volume()),
                    "hull": _hull_area(self.states[:, t]),
                    "gap": float(certificate.gaps.max()),
                    "seconds": float(certificate.seconds.sum()),
                    "offsets": certificate.bounds.tolist(),
                    "statuses": [status.name for status in certificate.statuses],
                }
            )
        return rows


def _hull_area(points: np.ndarray) -> float:
    try:
        return float(ConvexHull(points).volume)
    except QhullError:  # points on a line
        return 0.0


def step_table(analyses: list[Analysis]) -> Table:
    """Controllers side by side, a row a step."""
    table = blank_table(analyses[0].relaxation)
    table.add_column("\nt", justify="right")
    for analysis in analyses:
        for k, column in enumerate(("area", "hull", "gap", "solver")):
            heading = analysis.controller if k == 0 else ""
            table.add_column(f"{heading}\n{column}", justify="right", no_wrap=True)
    for rows in zip(*(analysis.steps() for analysis in analyses), strict=True):
        cells = [str(rows[0]["step"])]
        for row in rows:
            cells += [f"{row[key]:.4f}" for key in ("area", "hull", "gap")]
            cells += [f"{row['seconds']:.2f} s"]
        table.add_row(*cells)
    return table


def verdict_table(analyses: list[Analysis]) -> Table:
    """What each relaxation decides of each controller, with the smallest margins."""
    table = blank_table("verdicts")
    for heading in ("controller", "relaxation", "verdict"):
        table.add_column(heading, no_wrap=True)
    for heading in ("goal", "constraint", "reach"):
        table.add_column(heading, justify="right", no_wrap=True)
    for analysis in sorted(analyses, key=lambda a: a.controller):
        verdict = analysis.verdict
        name = verdict.status.name
        margins = [f"{np.nanmin(verdict.margins[part]):+.4f}" for part in ("goal", "safe")]
        table.add_row(
            analysis.controller,
            analysis.relaxation,
            f"[{COLOURS[name]}]{name}[/]",
            *margins,
            f"{analysis.seconds:.1f} s",
        )
    return table


def draw(analyses: list[Analysis], goal: np.ndarray, safe: np.ndarray, path: Path) -> None:
    """One panel a controller: samples, certified sets, goal, constraint and counterexample."""
    import matplotlib.pyplot as plt

    from reachjax.tubes.plotting import plot_set, plot_tube

    figure, axes = plt.subplots(
        1, len(analyses), figsize=(11, 4.8), sharey=True, squeeze=False, layout="constrained"
    )
    for ax, analysis in zip(axes[0], analyses, strict=True):
        plot_set(
            rj.Box(*goal), ax, edgecolor="none", facecolor="tab:green", alpha=0.3, label="goal"
        )
        plot_tube(analysis.tube, ax)
        ax.axhline(safe[0, 1], color="black", linewidth=1, label="$x_2 \\geq -1$")
        example = analysis.verdict.counterexample
        if example is not None:
            ax.plot(
                *example.states.T, ".-", color="tab:orange", linewidth=1, label="counterexample"
            )
        ax.set_title(f"{analysis.controller}: {analysis.verdict.status.name}")
        ax.margins(0.05)
        ax.autoscale_view()
    axes[0, 1 if len(analyses) > 1 else 0].set_ylabel("")
    found = {
        label: handle
        for ax in axes[0]
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        found.values(),
        found.keys(),
        loc="outside lower center",
        ncols=len(found),
        markerscale=3,
        frameon=False,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def write(settings, fits: dict[str, Fit], analyses: list[list[Analysis]], path: Path) -> None:
    """Settings, imitation errors, figures of each step and verdicts."""
    content = {
        "settings": {
            k: str(v) if isinstance(v, Path) else v for k, v in dataclasses.asdict(settings).items()
        },
        "imitation": {
            name: {"training": fit.training_error, "validation": fit.validation_error}
            for name, fit in fits.items()
        },
        "analyses": [_plain(analysis) for pair in analyses for analysis in pair],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1))


def _plain(analysis: Analysis) -> dict:
    verdict, example = analysis.verdict, analysis.verdict.counterexample
    smallest = {name: float(np.nanmin(margin)) for name, margin in verdict.margins.items()}
    return {
        "controller": analysis.controller,
        "relaxation": analysis.relaxation,
        "verdict": verdict.status.name,
        "margins": smallest,
        "simulated": {name: float(np.nanmin(m)) for name, m in verdict.simulated.items()},
        "counterexample": None
        if example is None
        else {
            "requirement": example.requirement,
            "time": example.time,
            "violation": example.violation,
            "states": example.states.tolist(),
            "inputs": example.inputs.tolist(),
        },
        "seconds": analysis.seconds,
        "steps": analysis.steps(),
    }
