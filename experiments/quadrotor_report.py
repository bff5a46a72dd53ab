"""What the quadrotor experiment reports of its tube: tables, a figure, and results as JSON."""

import dataclasses
import json
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from rich.table import Table

import reachjax as rj
from experiments.command import blank_table
from experiments.quadrotor_model import AXES, GOAL, POSITION_LIMITS, VELOCITY_LIMITS
from experiments.quadrotor_simulation import extremes, margin
from experiments.report import COLOURS

PLANES = ((0, 1), (0, 2))
"""Of the paper's two figures."""
NOTE = """\
|A x + b|: largest simulated value; at most 1 on the certified ellipsoid
beyond: excess of the certified range over the simulated one, at its looser end
actuator limits: hold by construction, as outputs are projected onto them"""


@dataclasses.dataclass(frozen=True)
class Analysis:
    """The certified tube of the loop under one relaxation, and simulated states to compare with."""

    relaxation: str
    tube: rj.ReachTube
    verdict: rj.Verdict
    states: Float[ndarray, "count steps+1 6"]
    seconds: float

    def steps(self) -> list[dict]:
        """Figures of each step: status, volume, largest simulated value, seconds, positions."""
        rows = []
        for t in range(1, self.tube.horizon + 1):
            region, certificate = self.tube.sets[t], self.tube.proof(t)
            reached = self.states[:, t, :3]
            rows.append(
                {
                    "step": t,
                    "status": certificate.statuses[0].name,
                    "volume": float(region.volume()),
                    "simulated": float(region.bounded_values(self.states[:, t]).max()),
                    "seconds": float(certificate.seconds.sum()),
                    "certified_positions": _ranges([region])[:, :3].tolist(),
                    "simulated_positions": [reached.min(0).tolist(), reached.max(0).tolist()],
                }
            )
        return rows

    def requirements(self) -> list[tuple[str, str, ndarray, ndarray]]:
        """Of each requirement and coordinate: the range certified and the range allowed.

        Actuator limits are not among them: no proof is needed.
        """
        goal, everywhere = _ranges(self.tube.sets[-1:]), _ranges(self.tube.sets)
        limited = "goal" not in self.verdict.margins
        first = everywhere[:, 3:] if limited else goal[:, :3]
        certified = np.hstack([first, everywhere[:, :3]]).T
        rows = extremes(self.tube.loop, self.states, velocity_limits=limited)
        return [
            (requirement, name, found, allowed)
            for (requirement, name, _, allowed), found in zip(rows, certified, strict=False)
        ]


def _ranges(sets) -> Float[ndarray, "2 6"]:
    """The smallest box around some sets."""
    boxes = [region.bounding_box() for region in sets]
    lower, upper = ([np.asarray(getattr(box, end)) for box in boxes] for end in ("lower", "upper"))
    return np.array([np.min(lower, axis=0), np.max(upper, axis=0)])


def goal_set() -> rj.Polytope:
    """All states whose position is in the goal."""
    return _positions(GOAL)


def safe_set(velocity_limits: bool) -> rj.PolyhedralSet:
    """All states within the position limits, and within the velocity limits if they are kept."""
    if velocity_limits:
        return rj.Box(*np.hstack([POSITION_LIMITS, VELOCITY_LIMITS]))
    return _positions(POSITION_LIMITS)


def _positions(box: Float[ndarray, "2 3"]) -> rj.Polytope:
    """The states with a position in a box, whatever their velocity: six facets, unbounded."""
    rows = np.eye(3, 6)
    return rj.Polytope(np.vstack([-rows, rows]), np.concatenate([-box[0], box[1]]))


def step_table(analysis: Analysis) -> Table:
    """A row a step: how the solver ended, the ellipsoid's size and how tight it is."""
    table = blank_table(f"certified ellipsoids, {analysis.relaxation}")
    for heading in ("t", "solver", "volume", "|A x + b|", "seconds"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in analysis.steps():
        cells = f"{row['volume']:.3e}", f"{row['simulated']:.5f}", f"{row['seconds']:.2f}"
        table.add_row(str(row["step"]), row["status"].lower(), *cells)
    return table


def position_table(analysis: Analysis) -> Table:
    """A row a step: where the quadrotor surely is, beside where it was simulated."""
    table = blank_table("certified positions, and how far beyond the simulated ones")
    table.add_column("t", justify="right", no_wrap=True)
    for name in AXES:
        table.add_column(name, no_wrap=True)
        table.add_column("beyond", justify="right", no_wrap=True)
    for row in analysis.steps():
        certified, simulated = (
            np.array(row[f"{kind}_positions"]) for kind in ("certified", "simulated")
        )
        beyond = np.maximum(simulated[0] - certified[0], certified[1] - simulated[1])
        cells = [str(row["step"])]
        for i in range(3):
            cells += [f"{certified[0, i]:.3f} .. {certified[1, i]:.3f}", f"{beyond[i]:.4f}"]
        table.add_row(*cells)
    return table


def requirement_table(analysis: Analysis) -> Table:
    """The certified ranges and their margins, under the verdict."""
    name = analysis.verdict.status.name
    title = f"[{COLOURS[name]}]{name}[/] with {analysis.relaxation}, {analysis.seconds:.1f} s"
    table = blank_table(title)
    for heading in ("requirement", "", "certified", "allowed", "margin"):
        table.add_column(heading, no_wrap=True)
    for requirement, coordinate, certified, allowed in analysis.requirements():
        ranges = (f"{lower:.4f} .. {upper:.4f}" for lower, upper in (certified, allowed))
        table.add_row(requirement, coordinate, *ranges, f"{margin(certified, allowed):.4f}")
    return table


def draw(analysis: Analysis, path: Path) -> None:
    """The paper's two figures: simulated states, certified ellipsoids' shadows, goal and limit."""
    import matplotlib.pyplot as plt

    from reachjax.tubes.plotting import plot_set, plot_tube

    figure, panels = plt.subplots(1, 2, figsize=(11, 4.8), layout="constrained")
    example = analysis.verdict.counterexample
    for ax, (i, j) in zip(panels, PLANES, strict=True):
        if "goal" in analysis.verdict.margins:
            goal = rj.Box(*GOAL[:, [i, j]])
            plot_set(goal, ax, edgecolor="none", facecolor="tab:green", alpha=0.3, label="goal")
        plot_tube(analysis.tube, ax, 10_000, (i, j))
        ax.axvline(POSITION_LIMITS[1, i], color="black", linewidth=1, label="$p_x \\leq 5$")
        if example is not None:
            ax.plot(*example.states[:, [i, j]].T, ".-", color="tab:orange", label="counterexample")
        ax.set(xlabel=f"${AXES[i]}$ [m]", ylabel=f"${AXES[j]}$ [m]")
        ax.margins(0.05)
        ax.autoscale_view()
    handles, labels = panels[0].get_legend_handles_labels()
    place = {"loc": "outside lower center", "ncols": len(labels)}
    figure.legend(handles, labels, **place, markerscale=3, frameon=False)
    figure.suptitle(f"ten steps, one second: {analysis.verdict.status.name}")
    figure.savefig(path, dpi=150)
    plt.close(figure)


def write(settings, analysis: Analysis, path: Path) -> None:
    """Settings, figures of each step, simulated and certified margins, and the verdict."""
    verdict, example = analysis.verdict, analysis.verdict.counterexample
    rows = extremes(
        analysis.tube.loop, analysis.states, velocity_limits="goal" not in verdict.margins
    )
    content = {
        "settings": {
            k: str(v) if isinstance(v, Path) else v for k, v in dataclasses.asdict(settings).items()
        },
        "verdict": verdict.status.name,
        "margins": {name: float(np.nanmin(values)) for name, values in verdict.margins.items()},
        "simulated_margins": {
            f"{requirement} {name}": margin(simulated, allowed)
            for requirement, name, simulated, allowed in rows
        },
        "certified_margins": {
            f"{requirement} {name}": margin(certified, allowed)
            for requirement, name, certified, allowed in analysis.requirements()
        },
        "counterexample": None if example is None else example.states.tolist(),
        "seconds": analysis.seconds,
        "steps": analysis.steps(),
    }
    path.write_text(json.dumps(content, indent=1))
