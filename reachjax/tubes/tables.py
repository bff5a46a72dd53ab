"""Tubes as data frames: a row for each step and facet, with what is known of its bound."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from reachjax.sets import AbstractTemplate

if TYPE_CHECKING:
    from pandas import DataFrame

    from reachjax.tubes.reach import ReachTube


def rows(tube: ReachTube) -> list[dict[str, Any]]:
    """What is known of each facet of each step, and of each ellipsoid."""
    found: list[dict[str, Any]] = []
    for t in range(1, tube.horizon + 1):
        proof, directions = tube.proof(t), _directions(tube.template, t)
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
