"""Figures as the competition asks for: which coordinates over which."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

import reachjax as rj
from experiments import report
from experiments.competition.instances import Instance

DRAWN = 300
"""So many trajectories are drawn."""


def draw(
    instance: Instance,
    runs: Float[np.ndarray, "c t n"],
    tubes: Sequence[rj.ReachTube],
    verdict: rj.Verdict,
    path: Path,
) -> None:
    """Sampled trajectories, boxes around all states, regions, and what refutes the specification.

    Args:
        instance: the instance.
        runs: trajectories at samples.
        tubes: boxes at samples, which together hold all states; none where there are no bounds.
        verdict: what is decided.
        path: of the figure.
    """
    planes = instance.planes
    figure, (axes,) = report.panels(1, len(planes), (5 * len(planes), 4))
    for ax, (one, other) in zip(axes, planes, strict=True):
        x, y = (_along(runs[:DRAWN], k) for k in (one, other))
        for k, X in ((k, X) for tube in tubes for k, X in enumerate(tube.sets)):
            _box(ax, X.bounding_box(), k, (one, other), x, y)
        ax.plot(x.T, y.T, color="tab:blue", linewidth=0.4, alpha=0.5)
        if one:
            _regions(ax, instance, (one, other))
        if verdict.counterexample is not None:
            broken = verdict.counterexample.states[None]
            a, b = (_along(broken, k) for k in (one, other))
            ax.plot(a.T, b.T, ".-", color="tab:red", linewidth=1, label="counterexample")
            ax.legend(fontsize="small")
        ax.set(xlabel=f"$x_{{{one}}}$" if one else "period", ylabel=f"$x_{{{other}}}$")
        ax.set_title(f"{instance.benchmark} {instance.name}: {verdict.status.name}", fontsize=9)
    report.save(figure, path)


def _along(runs: Float[np.ndarray, "c t n"], k: int) -> Float[np.ndarray, "c t"]:
    """A coordinate, counted from 1, or the time."""
    if k:
        return runs[..., k - 1]
    return np.broadcast_to(np.arange(runs.shape[1], dtype=float), runs.shape[:2])


def _box(ax: Any, box: rj.Box, k: int, plane: tuple[int, int], x: Any, y: Any) -> None:
    """A box in the plane, if it is no hundred times as large as what is sampled."""
    ends = [(k, k) if not j else (float(box.lower[j - 1]), float(box.upper[j - 1])) for j in plane]
    (left, right), (low, high) = ends
    if high - low > 100 * max(np.ptp(y), 1e-9) or right - left > 100 * max(np.ptp(x), 1e-9):
        return
    ax.fill([left, right, right, left], [low, low, high, high], color="gold", alpha=0.5)
    ax.plot([left, right, right, left, left], [low, low, high, high, low], color="goldenrod", lw=1)


def _regions(ax: Any, instance: Instance, plane: tuple[int, int]) -> None:
    """Goals and sets to be avoided, where they are boxes in the plane."""
    required = instance.required
    goal, avoid = required.get("goal"), required.get("avoid", [])
    goals = [] if goal is None or isinstance(goal, dict) else [goal]
    avoided = [] if isinstance(avoid, dict) else avoid
    for regions, colour in ((goals, "tab:green"), (avoided, "tab:red")):
        for region in regions:
            ends = _ends(region, plane)
            if np.isfinite(ends).all():
                (left, low), (right, high) = ends
                corners = [left, right, right, left], [low, low, high, high]
                ax.fill(*corners, color=colour, alpha=0.2)


def _ends(region: rj.PolyhedralSet, plane: tuple[int, int]) -> Float[np.ndarray, "2 2"]:
    """Least and largest values in the plane, by facets along the axes; infinite without."""
    A, b = map(np.asarray, region.facets)
    found = np.array([[-np.inf, -np.inf], [np.inf, np.inf]])
    for row, end in zip(A, b, strict=True):
        (there,) = np.nonzero(row)
        for place, k in enumerate(plane):
            if len(there) == 1 and there[0] == k - 1:
                side = int(row[k - 1] > 0)
                found[side, place] = end / row[k - 1]
    return found
