"""Pictures of sets and tubes: Axes in, Axes out. matplotlib is imported when it is needed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from reachjax.reach import ReachTube
from reachjax.sets import AbstractSet, Ellipsoid, PolyhedralSet

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SET = {"facecolor": "none", "edgecolor": "tab:red", "linewidth": 1.4}
OUTLINE = 200
"""Points of an ellipse's outline."""

SAMPLES = {"s": 1.0, "color": "tab:blue", "linewidths": 0, "rasterized": True}


def plot_set(region: AbstractSet, ax: Axes | None = None, **style: Any) -> Axes:
    """Draw the outline of a bounded set in the plane.

    Args:
        region: a set of two dimensions.
        ax: where to draw; a new figure by default.
        style: keyword arguments of `matplotlib.patches.Polygon`.

    Raises:
        ValueError: the set has another dimension, or is unbounded.
    """
    if region.dimension != 2:
        raise ValueError(f"a set of dimension 2 can be drawn, but {region.dimension} arrived")
    from matplotlib.patches import Polygon

    ax = _axes(ax)
    ax.add_patch(Polygon(_outline(region), closed=True, **{**SET, **style}))
    ax.autoscale_view()
    return ax


def _outline(region: AbstractSet) -> np.ndarray:
    """Points around a set of the plane, in order."""
    if isinstance(region, Ellipsoid):
        angles = np.linspace(0, 2 * np.pi, OUTLINE, endpoint=False)
        circle = np.column_stack([np.cos(angles), np.sin(angles)])
        return np.asarray(region.center) + circle @ np.linalg.cholesky(region.shape).T
    assert isinstance(region, PolyhedralSet)
    corners = np.asarray(region.vertices())
    around = corners - corners.mean(axis=0)
    return corners[np.argsort(np.arctan2(around[:, 1], around[:, 0]))]


def plot_tube(tube: ReachTube, ax: Axes | None = None, samples: int = 2000) -> Axes:
    """Draw the sets of a tube over simulated states, in the plane.

    Args:
        tube: of a loop with two states.
        ax: where to draw; a new figure by default.
        samples: how many trajectories to show.

    Raises:
        ValueError: the loop has another number of states.
    """
    if tube.loop.states != 2:
        raise ValueError(f"a tube of 2 states can be drawn, but {tube.loop.states} arrived")
    ax = _axes(ax)
    trajectories = np.asarray(tube.simulate(samples))
    for t, region in enumerate(tube.sets):
        ax.scatter(*trajectories[:, t].T, **SAMPLES, label="simulated" if t == 0 else None)
        first = {"edgecolor": "black", "label": "initial set"} if t == 0 else {}
        plot_set(region, ax, **(first or {"label": "certified" if t == 1 else None}))
    ax.set_xlabel("$x_1$")
    ax.set_ylabel("$x_2$")
    return ax


def _axes(ax: Axes | None) -> Axes:
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots()[1]
