"""What notebooks show: tables and pictures as HTML, and tubes as data frames."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from reachjax.proofs.certificates import AbstractProof
from reachjax.sets import AbstractTemplate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame

DRAWN, SHOWN = 2000, 300
"""Trajectories in a picture by default, and in one that nobody asked for."""

WIDTH, HEIGHT = 4.2, 3.0
"""The sides of such a picture, in inches."""


def table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table: numbers to four digits, on the right.

    Example:
        >>> table(["t", "gap"], [[1, 0.123456]]).count("<td")
        2
    """
    cells = "".join(f"<th>{html.escape(each)}</th>" for each in head)
    body = "".join(f"<tr>{''.join(map(_cell, row))}</tr>" for row in rows)
    return f"<table><thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table>"


def _cell(value: Any) -> str:
    if isinstance(value, float | np.floating):
        value = f"{value:.4g}"
    side = "left" if isinstance(value, str) and not value[:1].strip("+-.").isdigit() else "right"
    return f'<td style="text-align: {side}">{html.escape(str(value))}</td>'


def picture(draw: Callable[[Axes], Any]) -> str:
    """What is drawn on axes, as an image; nothing where matplotlib is missing."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        return ""
    figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
    FigureCanvasAgg(figure)  # no window, and nothing that a notebook would show again
    draw(figure.subplots())
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=100)
    return f'<img src="data:image/png;base64,{base64.b64encode(data.getvalue()).decode()}">'


def display(title: str, *parts: str) -> str:
    """A title above a picture and tables, side by side where there is room."""
    shown = "".join(f"<div>{part}</div>" for part in parts if part)
    style = "display: flex; flex-wrap: wrap; gap: 1.5em; align-items: start"
    return f'<div><b>{html.escape(title)}</b><div style="{style}">{shown}</div></div>'


def rows(
    template: AbstractTemplate, certificates: Sequence[AbstractProof | None]
) -> list[dict[str, Any]]:
    """A row for each step and facet, or ellipsoid, with what is known of its bound."""
    found: list[dict[str, Any]] = []
    for t, proof in enumerate(certificates):
        if proof is None:  # of the initial set
            continue
        directions = _directions(template, t)
        numbers = {
            "bound": np.asarray(proof.bounds),
            "witness": np.asarray(proof.witnesses),
            "gap": np.asarray(proof.gaps),
        }
        for k, status in enumerate(proof.statuses):
            known = k < len(directions)
            row: dict[str, Any] = {"t": t, "facet": k if known else None}
            row["direction"] = tuple(directions[k].tolist()) if known else None
            row |= {name: float(values[k]) for name, values in numbers.items()}
            row |= {"status": status.name, "seconds": float(np.asarray(proof.seconds)[k])}
            found.append(row | {"proof": type(proof).__name__})
    return found


def frame(found: list[dict[str, Any]]) -> DataFrame:
    """Rows as a data frame.

    Raises:
        ImportError: pandas is missing.
    """
    try:
        import pandas
    except ImportError:
        raise ImportError(
            "a data frame needs the package pandas: pip install 'reachjax[tables]'"
        ) from None
    return pandas.DataFrame(found).astype({"facet": "Int64"})


def _directions(template: AbstractTemplate, t: int) -> np.ndarray:
    """Directions of a step's facets; none of ellipsoids."""
    facets, _ = template.at(t).parts
    return np.zeros((0, 0)) if facets is None else np.asarray(facets.directions)
