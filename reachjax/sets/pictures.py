"""Pictures of sets: Axes in, Axes out. matplotlib is imported when it is needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from reachjax.numerics.checks import require_kind
from reachjax.numerics.flags import lenient
from reachjax.sets.base import AbstractSet

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SET = {"facecolor": "none", "edgecolor": "tab:red", "linewidth": 1.4}
ABOVE = {"loc": "lower center", "bbox_to_anchor": (0.5, 1), "ncols": 3, "frameon": False}
"""A legend that covers nothing."""

SAMPLE_STYLE = {"s": 1.0, "color": "tab:blue", "linewidths": 0, "rasterized": True}

SPAN = {"facecolor": "tab:red", "edgecolor": "none", "alpha": 0.15}
"""Sets that hold all states of a period."""

LINE = {"color": "tab:blue", "linewidth": 0.4, "alpha": 0.6}


class Flowpipe(NamedTuple):
    """What is drawn of a tube.

    Attributes:
        sets: of each time.
        states: of simulated trajectories.
        spans: what holds the states in between samples, of a differential equation.
        lines: some trajectories, with states in between.
    """

    sets: Sequence[AbstractSet]
    states: Float[np.ndarray, "c h+1 n"]
    spans: Sequence[AbstractSet] = ()
    lines: Float[np.ndarray, "c p n"] | None = None


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
    ax = _axes(ax)
    from matplotlib.patches import Polygon

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


def draw_flowpipes(
    flowpipes: Sequence[Flowpipe], ax: Axes | None, coordinates: tuple[int, int]
) -> Axes:
    """Draw sets over simulated states: shadows, where there are more than two dimensions.

    What holds the states in between is filled below, and trajectories are lines.

    Args:
        flowpipes: each with its simulated states; all begin at the same time.
        ax: where to draw; a new figure with a legend by default.
        coordinates: the two states to draw.
    """
    i, j = _two_of(flowpipes[0][0][0].dimension, coordinates)
    with_legend, ax = ax is None, _axes(ax)
    labels: Sequence[str | None] = ("simulated", "initial set", "certified")
    for regions, states, spans, lines in flowpipes:
        simulated, initial, certified = labels
        for t, region in enumerate(spans):
            named = "at all times" if t == 0 and certified else None
            plot_set(region, ax, (i, j), **SPAN, label=named)
        if lines is not None:
            ax.plot(*lines[:, :, [i, j]].T, **LINE)
        for t, region in enumerate(regions):
            ax.scatter(*states[:, t, [i, j]].T, **SAMPLE_STYLE, label=None if t else simulated)
            first = {"edgecolor": "black", "label": initial}
            plot_set(
                region, ax, (i, j), **({"label": None if t > 1 else certified} if t else first)
            )
        labels = (None, None, None)
    _name_axes(ax, i, j)
    if with_legend:
        ax.legend(**ABOVE, markerscale=8)
    return ax


def draw_boxes(
    groups: Mapping[str, tuple[str, str, Sequence[Any]]],
    ax: Axes | None,
    coordinates: tuple[int, int],
) -> Axes:
    """Draw boxes, or their shadows, in one color a group, the later groups above the earlier.

    Args:
        groups: of each name the color of faces, that of edges, and the boxes: whatever has a
            `lower` and an `upper` corner. There is at least one box.
        ax: where to draw; a new figure by default.
        coordinates: the two to draw.
    """
    dimension = next(len(box.lower) for *_, boxes in groups.values() for box in boxes)
    i, j = _two_of(dimension, coordinates)
    ax, handles = _axes(ax), []
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Patch, Rectangle

    for name, (color, edge, boxes) in groups.items():
        if not boxes:
            continue
        faces = [
            Rectangle((box.lower[i], box.lower[j]), *(box.upper - box.lower)[[i, j]])
            for box in boxes
        ]
        look = {"facecolor": color, "edgecolor": edge, "linewidth": 0.4, "alpha": 0.8}
        ax.add_collection(PatchCollection(faces, **look))
        handles.append(Patch(facecolor=color, label=f"{name}: {len(boxes)}"))
    ax.autoscale_view()
    ax.legend(handles=handles, **ABOVE)
    _name_axes(ax, i, j)
    return ax


def _name_axes(ax: Axes, i: int, j: int) -> None:
    ax.set_xlabel(f"$x_{{{i + 1}}}$")
    ax.set_ylabel(f"$x_{{{j + 1}}}$")


def _axes(ax: Axes | None) -> Axes:
    """The axes that are given, else those of a new figure.

    Raises:
        ImportError: matplotlib is missing.
    """
    if ax is not None:
        return ax
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise ImportError(
            f"a figure needs the package matplotlib: pip install 'reachjax[plot]' ({error})"
        ) from error
    return plt.subplots()[1]


def draw_curves(
    curves: Mapping[str, tuple[str, Sequence[float]]],
    marks: Mapping[str, tuple[str, Sequence[float]]],
    ax: Axes | None,
    label: str,
) -> Axes:
    """Draw numbers that follow one another, on a logarithmic axis, and where something happens.

    Args:
        curves: of each name a color, and its numbers; what is not positive is left out.
        marks: of each name a color, and the places of vertical lines.
        ax: where to draw; a new figure by default.
        label: of the horizontal axis.
    """
    ax = _axes(ax)
    for name, (color, values) in curves.items():
        shown = np.where(np.asarray(values) > 0, values, np.nan)
        ax.plot(shown, ".-", color=color, label=name)
    for name, (color, places) in marks.items():
        for k, place in enumerate(places):
            ax.axvline(place, color=color, linewidth=0.8, label=name if k == 0 else None)
    ax.set(yscale="log", xlabel=label)
    ax.legend(**ABOVE)
    return ax
