"""Tables and the figure of the quadrotor's tube."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from rich.table import Table

from experiments import report
from experiments.analysis import Analysis
from experiments.quadrotor import simulation
from experiments.quadrotor.model import AXES, GOAL, POSITION_LIMITS

PLANES = ((0, 1), (0, 2))
"""Of the paper's two figures."""
NOTE = """\
|A x + b|: largest simulated value; at most 1 on the certified ellipsoid
beyond: excess of the certified range over the simulated one, at its looser end
actuator limits: hold by construction, as outputs are projected onto them"""


def steps(analysis: Analysis) -> list[dict]:
    """Figures of each step: status, volume, largest simulated value, seconds, positions."""
    rows = []
    for t in range(1, analysis.tube.horizon + 1):
        region, certificate = analysis.tube.sets[t], analysis.tube.proof(t)
        reached = analysis.states[:, t, :3]
        rows.append(
            {
                "step": t,
                "status": certificate.statuses[0].name,
                "volume": float(region.volume()),
                "simulated": float(region.bounded_values(analysis.states[:, t]).max()),
                "seconds": float(certificate.seconds.sum()),
                "certified_positions": _ranges([region])[:, :3],
                "simulated_positions": np.array([reached.min(axis=0), reached.max(axis=0)]),
            }
        )
    return rows


def requirements(analysis: Analysis) -> list[tuple[str, str, ndarray, ndarray]]:
    """Of each requirement and coordinate: the range certified and the range allowed.

    Actuator limits are not among them: no proof is needed.
    """
    goal, everywhere = _ranges(analysis.tube.sets[-1:]), _ranges(analysis.tube.sets)
    first = everywhere[:, 3:] if _limited(analysis) else goal[:, :3]
    certified = np.hstack([first, everywhere[:, :3]]).T
    rows = _simulated(analysis)
    return [
        (requirement, name, found, allowed)
        for (requirement, name, _, allowed), found in zip(rows, certified, strict=False)
    ]


def _limited(analysis: Analysis) -> bool:
    """Whether velocities are limited, in place of the goal."""
    return "goal" not in analysis.verdict.margins


def _simulated(analysis: Analysis) -> list[tuple[str, str, ndarray, ndarray]]:
    limited = _limited(analysis)
    return simulation.extremes(analysis.tube.loop, analysis.states, velocity_limits=limited)


def _ranges(sets) -> Float[ndarray, "2 6"]:
    """The smallest box around some sets."""
    boxes = [region.bounding_box() for region in sets]
    lower, upper = ([np.asarray(getattr(box, end)) for box in boxes] for end in ("lower", "upper"))
    return np.array([np.min(lower, axis=0), np.max(upper, axis=0)])


def results(analysis: Analysis) -> dict:
    """What is written: the verdict, simulated and certified margins, and figures of each step."""
    return analysis.results() | {
        "simulated_margins": simulation.margins(_simulated(analysis)),
        "certified_margins": simulation.margins(requirements(analysis)),
        "steps": steps(analysis),
    }


def step_table(analysis: Analysis) -> Table:
    """A row a step: how the solver ended, the ellipsoid's size and how tight it is."""
    rows = [
        (
            row["step"],
            row["status"].lower(),
            f"{row['volume']:.3e}",
            f"{row['simulated']:.5f}",
            f"{row['seconds']:.2f}",
        )
        for row in steps(analysis)
    ]
    headings = ("t", "solver", "volume", "|A x + b|", "seconds")
    return report.table(f"certified ellipsoids, {analysis.relaxation}", (), headings, rows)


def position_table(analysis: Analysis) -> Table:
    """A row a step: where the quadrotor surely is, beside where it was simulated."""
    rows = []
    for row in steps(analysis):
        certified, simulated = row["certified_positions"], row["simulated_positions"]
        beyond = np.maximum(simulated[0] - certified[0], certified[1] - simulated[1])
        cells = [
            (f"{lower:.3f} .. {upper:.3f}", f"{excess:.4f}")
            for lower, upper, excess in zip(*certified, beyond, strict=True)
        ]
        rows.append([row["step"], *(cell for pair in cells for cell in pair)])
    headings = ["t", *(heading for name in AXES for heading in (name, "beyond"))]
    title = "certified positions, and how far beyond the simulated ones"
    return report.table(title, (), headings, rows)


def requirement_table(analysis: Analysis) -> Table:
    """The certified ranges and their margins, under the verdict."""
    verdict = report.coloured(analysis.verdict.status.name)
    title = f"{verdict} with {analysis.relaxation}, {analysis.seconds:.1f} s"
    return simulation.table(title, "certified", requirements(analysis))


def draw(analysis: Analysis, path: Path) -> None:
    """The paper's two figures: simulated states, certified ellipsoids' shadows, goal and limit."""
    figure, axes = report.panels(1, 2, (11, 4.8))
    example = analysis.verdict.counterexample
    for ax, (i, j) in zip(axes[0], PLANES, strict=True):
        goal = None if _limited(analysis) else GOAL[:, [i, j]]
        report.draw_tube(ax, analysis.tube, goal, example, (i, j), samples=10_000)
        ax.axvline(POSITION_LIMITS[1, i], color="black", linewidth=1, label="$p_x \\leq 5$")
        ax.set(xlabel=f"${AXES[i]}$ [m]", ylabel=f"${AXES[j]}$ [m]")
    report.legend_below(figure, markerscale=3)
    figure.suptitle(f"ten steps, one second: {analysis.verdict.status.name}")
    report.save(figure, path)
