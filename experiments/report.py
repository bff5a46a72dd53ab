"""Tables and figures of all experiments, and their results as JSON."""

import dataclasses
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float
from rich.box import SIMPLE_HEAD
from rich.table import Table

import reachjax as rj

COLOURS = {"PROVED": "green", "REFUTED": "red", "UNKNOWN": "yellow"}
"""Of verdicts."""

WITHIN = 1.02
"""Errors up to so many times that of plain training are called as good."""

POINT = 20.0
"""The least size of a scattered point in a legend, in square points."""


def table(title: str, left: Sequence[str], right: Sequence[str], rows: Iterable[Sequence]) -> Table:
    """A table in the style of all experiments.

    Args:
        title: above it.
        left: headings of the first columns, which hold words, in several lines if need be.
        right: headings of the others, which hold numbers, in one.
        rows: cells, one for each heading.
    """
    style: Any = {"box": SIMPLE_HEAD, "padding": (0, 1, 0, 0), "title_style": "bold"}
    shown = Table(title=title, **style)
    for heading in left:
        shown.add_column(heading)
    for heading in right:
        shown.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        shown.add_row(*map(str, row))
    return shown


def grouped(groups: Iterable[str], columns: Sequence[str]) -> list[str]:
    """Headings of two lines: the same columns for each group, whose name is above the first."""
    return [f"{group if k == 0 else ''}\n{c}" for group in groups for k, c in enumerate(columns)]


def coloured(verdict: str, words: str | None = None) -> str:
    """Words in the colour of a verdict; without any, its own name."""
    return f"[{COLOURS[verdict]}]{words or verdict}[/]"


def panels(rows: int, columns: int, size: tuple[float, float], **options: Any):
    """A figure and its axes `(rows, columns)`."""
    import matplotlib.pyplot as plt

    return plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained", **options)


def legend_below(figure, order: Sequence[str] = (), **options: Any) -> None:
    """One legend for all panels, each name once; in the given order if there is one.

    Points of a scatter plot are at least `POINT` in size there, however small they are drawn.
    """
    from matplotlib.collections import PathCollection

    found = {}
    for ax in figure.axes:
        for handle, name in zip(*ax.get_legend_handles_labels(), strict=True):
            found.setdefault(name, handle)
    names = [name for name in order or found if name in found]
    options = {"loc": "outside lower center", "ncols": len(names), "frameon": False} | options
    legend = figure.legend([found[name] for name in names], names, **options)
    for handle in legend.legend_handles:
        if isinstance(handle, PathCollection):
            handle.set_sizes(np.maximum(handle.get_sizes(), POINT))


def draw_tube(
    ax,
    tube: rj.ReachTube,
    goal: Float[np.ndarray, "2 2"] | None,
    example: rj.Counterexample | None = None,
    coordinates: tuple[int, int] = (0, 1),
    samples: int = 2000,
) -> None:
    """A tube over its simulated states, the goal in the plane and the trajectory that refutes."""
    if goal is not None:
        style = {"edgecolor": "none", "facecolor": "tab:green", "alpha": 0.3}
        rj.plot_set(rj.Box(*goal), ax, label="goal", **style)
    rj.plot_tube(tube, ax, samples, coordinates)
    if example is not None:
        path = example.states[:, list(coordinates)].T
        ax.plot(*path, ".-", color="tab:orange", linewidth=1, label="counterexample")
    ax.margins(0.05)
    ax.autoscale_view()


def ratios(outcomes: Sequence[Any], plain: Sequence[Any] | None) -> Float[np.ndarray, " seeds"]:
    """Errors over those of plain training, network by network; NaN without any."""
    if not plain:
        return np.full(len(outcomes), np.nan)
    pairs = zip(outcomes, plain, strict=True)
    return np.array([each.error / other.error for each, other in pairs])


def draw_networks(ax, at: tuple, proved: np.ndarray, label: str, colour: str) -> None:
    """Networks of one way of training as points, filled where they are proved."""
    style = {"color": colour, "s": 36, "linewidths": 1.4}
    ax.scatter(*(part[proved] for part in at), label=label, **style)
    hollow = style | {"color": "none", "edgecolors": colour}
    ax.scatter(*(part[~proved] for part in at), **hollow)


def over_plain(ax, title: str, label: str) -> None:
    """Title and axis of errors over those of plain training, and up to where they are as good."""
    ax.axvline(WITHIN, color="black", linewidth=1, linestyle=":")
    low, high = ax.get_xlim()
    scale = "log" if high > 20 * low else "linear"  # a log axis has few ticks within a decade
    ax.set(title=title, xscale=scale, xlabel=label)
    ax.xaxis.set_major_formatter("{x:g}")
    ax.xaxis.set_minor_formatter("")


def save(figure, *paths: Path) -> None:
    """Write a figure to each of the paths, and forget it."""
    import matplotlib.pyplot as plt

    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=150)
    plt.close(figure)


def write(path: Path, settings: Any, **results: Any) -> None:
    """Settings and results as strict JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"settings": dataclasses.asdict(settings)} | results
    path.write_text(json.dumps(plain(content), indent=1, allow_nan=False))


def plain(value: Any) -> Any:
    """What JSON can hold: arrays as lists, paths as words, and no number (NaN) as null.

    Example:
        >>> plain({"bounds": np.array([1.0, np.nan]), "output": Path("results")})
        {'bounds': [1.0, None], 'output': 'results'}
    """
    if isinstance(value, dict):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
