"""Points at which a file's function is evaluated once, in numpy, before anything is built on it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

SCALES = (0.0, 1e-2, 0.3, 1.0, 1.0, 3.0, 30.0)
"""Sizes of the entries of a point. A scaler may expect large inputs, a logarithm small ones."""


def points(inputs: int) -> list[np.ndarray]:
    """Points of several sizes, in both orthants that have no mixed signs and at random."""
    rng = np.random.default_rng(0)
    drawn = [scale * rng.uniform(0.1, 1, inputs) for scale in SCALES]
    signs = [rng.choice([-1.0, 1.0], inputs) for _ in SCALES]
    return [*drawn, *(-x for x in drawn[1:]), *(s * x for s, x in zip(signs, drawn, strict=True))]


def require_finite(function: Callable[[Any], Any], inputs: int) -> list[np.ndarray]:
    """Raise an error where a function is finite at none of the points; else those where it is.

    Raises:
        ValueError: there are none.
    """
    with np.errstate(all="ignore"):
        found = [x for x in points(inputs) if np.isfinite(function(x)).all()]
    if not found:
        raise ValueError(
            "its output is finite at none of the points at which it was evaluated: numbers in it "
            "are out of the domain of their functions, or divided by zero"
        )
    return found
