"""Pictures of sets and tubes: Axes in, Axes out. matplotlib is imported when it is needed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from reachjax.numerics.checks import require_kind
from reachjax.numerics.flags import lenient
from reachjax.sets import AbstractSet
from reachjax.sets.unusable import ThinSetError
from reachjax.tubes.partitions import PartitionedTube
from reachjax.tubes.reach import ReachTube
from reachjax.tubes.verdicts import Verdict, VerdictStatus
from reachjax.tubes.winning_sets import WinningSet

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SET = {"facecolor": "none", "edgecolor": "tab:red", "linewidth": 1.4}
CELL_COLORS = {
    VerdictStatus.PROVED: "tab:green",
    VerdictStatus.UNKNOWN: "tab:gray",
    VerdictStatus.REFUTED: "tab:red",
}
ABOVE = {"loc": "lower center", "bbox_to_anchor": (0.5, 1), "ncols": 3, "frameon": False}
"""A legend that covers nothing."""

SPAN = {"facecolor": "tab:red", "edgecolor": "none", "alpha": 0.15}
"""Sets that hold all states of a period."""

LINE = {"color": "tab:blue", "linewidth": 0.4, "alpha": 0.6}

LINES, LINE_PARTS = 40, 4
"""So many trajectories are lines, with so many points a period."""

SAMPLE_STYLE = {"s": 1.0, "color": "tab:blue", "linewidths": 0, "rasterized": True}


@lenient
def plot_set(
    region: AbstractSet,
    ax: Axes | None = None,
    coordinates: tuple[int, int] | None = None,
    **style: Any,
) -> Axes:
    """Draw the outline of a bounded set, or of its shadow on two coordinates.

    Of an intersection, it is what the shadows of its two parts have in common.

    Args:
        region: a set of two or more dimensions.
        ax: where to draw; a new figure by default.
        coordinates: the two to draw, counted from 0: the horizontal axis, then the vertical one. A
            set of more than two dimensions needs them.
        style: keyword arguments of `matplotlib.patches.Polygon`.

    Raises:
        TypeError: the region is no set.
        ValueError: the set has one dimension, or is unbounded, or the coordinates are not two of
            its own.

    Example:
        >>> from reachjax import Box
        >>> ax = plot_set(Box([0, 1, 2], [1, 3, 5]), coordinates=(2, 0))
        >>> ax.dataLim.extents.tolist()
        [2.0, 0.0, 5.0, 1.0]
    """
    require_kind("region", region, AbstractSet, "a set such as tube.sets[1]")
    if coordinates is None and region.dimension > 2:
        raise ValueError(
            f"a set of dimension {region.dimension} arrived: choose the two coordinates to draw, "
            "such as coordinates=(0, 1)"
        )
    i, j = _two_of(region.dimension, (0, 1) if coordinates is None else coordinates)
    from matplotlib.patches import Polygon

    ax = _axes(ax)
    ax.add_patch(Polygon(region.outline(i, j), closed=True, **{**SET, **style}))
    ax.autoscale_view()
    return ax


def _two_of(dimension: int, coordinates: Any) -> tuple[int, int]:
    """Two different coordinates of a space, or an error that says what was wrong."""
    if dimension < 2:
        raise ValueError(f"two or more dimensions can be drawn, but {dimension} arrived")
    chosen = tuple(coordinates) if np.ndim(coordinates) == 1 else ()
    known = [i for i in range(dimension) if i in chosen]
    if len(chosen) != 2 or len(known) != 2:
        raise ValueError(
            f"coordinates must be two different ones of 0 .. {dimension - 1}, "
            f"but {coordinates!r} arrived"
        )
    return int(chosen[0]), int(chosen[1])


@lenient
def plot_tube(
    tube: ReachTube | PartitionedTube,
    ax: Axes | None = None,
    samples: int = 2000,
    coordinates: tuple[int, int] = (0, 1),
) -> Axes:
    """Draw the sets of a tube over simulated states: shadows, where there are more than two.

    Of a differential equation what holds the states in between is filled below, and trajectories
    are lines.

    Args:
        tube: of a loop with two or more states.
        ax: where to draw; a new figure with a legend by default.
        samples: how many trajectories to show; of a partitioned tube so many from each cell.
        coordinates: the two states to draw, counted from 0: the horizontal axis, then the vertical
            one.

    Raises:
        TypeError: the tube is none.
        ValueError: the loop has one state, or the coordinates are not two of its states.
    """
    cells = tube.tubes if isinstance(tube, PartitionedTube) else (tube,)
    for cell in cells:
        require_kind("tube", cell, ReachTube, "a ReachTube, as reach(...) returns it")
    first, *others = cells
    i, j = _two_of(first.loop.states, coordinates)
    with_legend, ax = ax is None, _axes(ax)
    _plot_cell(first, ax, samples, i, j, ("simulated", "initial set", "certified"))
    for cell in others:
        _plot_cell(cell, ax, samples, i, j, (None, None, None))
    ax.set_xlabel(f"$x_{{{i + 1}}}$")
    ax.set_ylabel(f"$x_{{{j + 1}}}$")
    if with_legend:
        ax.legend(**ABOVE, markerscale=8)
    return ax


@lenient
def plot_cells(
    verdict: Verdict | WinningSet, ax: Axes | None = None, coordinates: tuple[int, int] = (0, 1)
) -> Axes:
    """Draw which cells of an initial set or a domain are proved, refuted and undecided.

    Of sets of more than two dimensions it draws the cells' shadows, the undecided ones above the
    proved ones, and the refuted ones above all.

    Args:
        verdict: of `decide(..., cells=...)` or `winning_set`.
        ax: where to draw; a new figure by default.
        coordinates: the two states to draw, counted from 0: the horizontal axis, then the vertical
            one.

    Raises:
        TypeError: it is no verdict.
        ValueError: it has no cells, or the coordinates are not two of its states.
    """
    expected = "a Verdict, as decide(...) returns it, or a WinningSet"
    require_kind("verdict", verdict, (Verdict, WinningSet), expected)
    if not verdict.cells:
        raise ValueError("verdict has no cells: give decide(..., cells=...) a number of them")
    i, j = _two_of(len(verdict.cells[0].lower), coordinates)
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Patch, Rectangle

    ax, handles = _axes(ax), []
    for status, color in CELL_COLORS.items():
        cells = [cell for cell in verdict.cells if cell.status is status]
        if not cells:
            continue
        boxes = [
            Rectangle((cell.lower[i], cell.lower[j]), *(cell.upper - cell.lower)[[i, j]])
            for cell in cells
        ]
        # white edges would hide cells as narrow as those at a boundary
        edge = color if status is VerdictStatus.UNKNOWN else "white"
        look = {"facecolor": color, "edgecolor": edge, "linewidth": 0.4, "alpha": 0.8}
        ax.add_collection(PatchCollection(boxes, **look))
        handles.append(Patch(facecolor=color, label=f"{status.value}: {len(cells)}"))
    ax.autoscale_view()
    ax.legend(handles=handles, **ABOVE)
    ax.set_xlabel(f"$x_{{{i + 1}}}$")
    ax.set_ylabel(f"$x_{{{j + 1}}}$")
    return ax


def _plot_cell(
    tube: ReachTube, ax: Axes, samples: int, i: int, j: int, labels: Sequence[str | None]
) -> None:
    """The sets of one tube over its simulated states, with an entry each in the legend."""
    simulated, initial, certified = labels
    try:
        states = np.asarray(tube.simulate(samples))
        trajectories = states[:, :, [i, j]]
    except ThinSetError:  # the initial set is too thin to be sampled: the sets alone
        states, trajectories = np.zeros((0, 0, 0)), np.zeros((0, tube.horizon + 1, 2))
    if tube.loop.plant.continuous:
        for t, region in enumerate(tube.spans):
            named = None if t or certified is None else "at all times"
            plot_set(region, ax, (i, j), **SPAN, label=named)
        if len(states) and not tube.loop.is_disturbed:
            first = states[:LINES, 0]
            dense = tube.loop.simulate(first, tube.horizon, tube.start, parts=LINE_PARTS)
            ax.plot(*np.asarray(dense)[:, :, [i, j]].T, **LINE)
    for t, region in enumerate(tube.sets):
        ax.scatter(*trajectories[:, t].T, **SAMPLE_STYLE, label=None if t else simulated)
        first = {"edgecolor": "black", "label": initial}
        plot_set(region, ax, (i, j), **({"label": None if t > 1 else certified} if t else first))


def _axes(ax: Axes | None) -> Axes:
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots()[1]
