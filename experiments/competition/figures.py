"""Figures as the competition asks for: which coordinates over which."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

import reachjax as rj
from experiments import report
from experiments.competition.instances import Instance

DRAWN = 300
"""So many trajectories are drawn."""

STYLES: dict[str, dict[str, Any]] = {
    "goal": {"facecolor": "tab:green", "alpha": 0.25},
    "safe": {"edgecolor": "tab:green", "fill": False, "linestyle": "--"},
    "avoid": {"facecolor": "tab:red", "alpha": 0.25},
}
"""How regions are drawn, by what they are for."""

CERTIFIED = "certified at samples"
"""The name of certified boxes and intervals in the legend."""

ORDER = "sampled states", CERTIFIED, *STYLES, "counterexample"
"""The order of names in the legend."""


def draw(
    instance: Instance,
    period: float | None,
    runs: Float[np.ndarray, "c t n"],
    tubes: Sequence[rj.ReachTube],
    verdict: rj.Verdict,
    path: Path,
) -> None:
    """Sampled trajectories, boxes around all states, regions, and what refutes the specification.

    Args:
        instance: the instance.
        period: of its plant, in its units of time; None in discrete time.
        runs: trajectories at samples.
        tubes: boxes at samples, which together hold all states; none where there are no bounds.
        verdict: what is decided.
        path: of the figure.
    """
    planes = instance.planes
    figure, (axes,) = report.panels(1, len(planes), (5 * len(planes), 4.4))
    for ax, (one, other) in zip(axes, planes, strict=True):
        x, y = (_along(runs[:DRAWN], k) for k in (one, other))
        if one:
            for box in (X.bounding_box() for tube in tubes for X in tube.sets):
                _box(ax, box, (one, other), x, y)
        else:
            _intervals(ax, tubes, other, y)
        lines = ax.plot(x.T, y.T, color="tab:blue", linewidth=0.4, alpha=0.5)
        lines[0].set_label("sampled states")
        if verdict.counterexample is not None:
            broken = verdict.counterexample.states[None]
            a, b = (_along(broken, k)[0] for k in (one, other))
            style = {"color": "tab:red", "linewidth": 1, "zorder": 4}
            ax.plot(a, b, ".-", label="counterexample", **style)
        _regions(ax, instance, period, (one, other))
        ax.set(xlabel=f"$x_{{{one}}}$" if one else "period", ylabel=f"$x_{{{other}}}$")
    figure.suptitle(f"{instance.benchmark} {instance.name}: {verdict.status.name}", fontsize=10)
    report.legend_below(figure, ORDER, fontsize="small", ncols=3)
    report.save(figure, path)


def _along(runs: Float[np.ndarray, "c t n"], k: int) -> Float[np.ndarray, "c t"]:
    """A coordinate, counted from 1, or the time."""
    if k:
        return runs[..., k - 1]
    return np.broadcast_to(np.arange(runs.shape[1], dtype=float), runs.shape[:2])


def _box(ax: Any, box: rj.Box, plane: tuple[int, int], x: Any, y: Any) -> None:
    """A box in the plane, if it is no hundred times as large as what is sampled."""
    (left, right), (low, high) = ((float(box.lower[j - 1]), float(box.upper[j - 1])) for j in plane)
    if _far(right - left, x) or _far(high - low, y):
        return
    around = [left, right, right, left, left], [low, low, high, high, low]
    ax.fill(*around, color="gold", alpha=0.5, label=CERTIFIED)
    ax.plot(*around, color="goldenrod", linewidth=1)


def _intervals(ax: Any, tubes: Sequence[rj.ReachTube], k: int, y: Any) -> None:
    """Intervals of a coordinate over time, above the trajectories, if they are not far larger."""
    found: dict[int, list[tuple[float, float]]] = {}
    for step, X in ((step, X) for tube in tubes for step, X in enumerate(tube.sets)):
        box = X.bounding_box()
        low, high = float(box.lower[k - 1]), float(box.upper[k - 1])
        if not _far(high - low, y):
            found.setdefault(step, []).append((low, high))
    rows = [(step, *ends) for step, each in found.items() for ends in joined(each)]
    if rows:
        steps, low, high = np.array(rows).T
        style: dict[str, Any] = {"color": "darkorange", "capsize": 3, "zorder": 3}
        ax.errorbar(steps, low, [0 * low, high - low], fmt="none", label=CERTIFIED, **style)


def joined(intervals: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The union of intervals, as intervals that are apart.

    Example:
        >>> joined([(2.0, 3.0), (0.0, 1.0), (0.5, 1.5)])
        [(0.0, 1.5), (2.0, 3.0)]
    """
    found: list[tuple[float, float]] = []
    for low, high in sorted(intervals):
        if found and low <= found[-1][1]:
            found[-1] = found[-1][0], max(high, found[-1][1])
        else:
            found.append((low, high))
    return found


def _far(width: float, sampled: Float[np.ndarray, "..."]) -> bool:
    """Whether it is a hundred times as wide as what is sampled."""
    return width > 100 * max(np.ptp(sampled), 1e-9)


def _regions(ax: Any, instance: Instance, period: float | None, plane: tuple[int, int]) -> None:
    """What is required, where facets along the axes bound it in the plane.

    A set at one sample is drawn half a period to both sides of it.
    """
    seen, shown = set(), np.array([ax.get_xlim(), ax.get_ylim()]).T
    for name, region, first, last in regions_by_time(instance, period):
        ends, over_time = _ends(region, plane), not plane[0]
        if not np.isfinite(ends).any() or (not over_time and (name, id(region)) in seen):
            continue
        seen.add((name, id(region)))
        if over_time:
            ends[:, 0] = (first - 0.5, last + 0.5) if first == last else (first, last)
        (left, low), (right, high) = np.where(np.isfinite(ends), ends, shown)
        ax.fill([left, right, right, left], [low, low, high, high], label=name, **STYLES[name])


def regions_by_time(
    instance: Instance, period: float | None
) -> Iterator[tuple[str, rj.PolyhedralSet, float, float]]:
    """Each region that is required: its name in `rj.decide`, the set, its first and last period.

    Args:
        instance: the instance.
        period: of its plant, in its units of time; None in discrete time.
    """
    for name, given in instance.required.items():
        for when, regions in given.items() if isinstance(given, Mapping) else [(None, given)]:
            if when is None:
                first, last = instance.horizon if name == "goal" else 0, instance.horizon
            else:
                first, last = when if isinstance(when, tuple) else (when, when)
            if isinstance(when, tuple | float):  # in units of time
                assert period is not None
                first, last = first / period, last / period
            for region in regions if isinstance(regions, Sequence) else [regions]:
                yield name, region, first, last


def _ends(region: rj.PolyhedralSet, plane: tuple[int, int]) -> Float[np.ndarray, "2 2"]:
    """Least and largest values in the plane, by facets along the axes; infinite without."""
    A, b = map(np.asarray, region.facets)
    found = np.array([[-np.inf, -np.inf], [np.inf, np.inf]])
    for row, end in zip(A, b, strict=True):
        (there,) = np.nonzero(row)
        for place, k in enumerate(plane):
            if len(there) == 1 and there[0] == k - 1:
                side = int(row[k - 1] > 0)
                tighter = (max, min)[side]
                found[side, place] = tighter(found[side, place], end / row[k - 1])
    return found
