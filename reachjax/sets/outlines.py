"""Outlines of shadows in the plane: points around a convex set, in order."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from reachjax.sets.balance import exponents

COUNT = 200
"""Points of an ellipse's outline."""

Points = Float[np.ndarray, "p 2"]


def circle() -> Points:
    """The unit circle."""
    angles = np.linspace(0, 2 * np.pi, COUNT, endpoint=False)
    return np.column_stack([np.cos(angles), np.sin(angles)])


def hull(points: Points) -> Points:
    """The corners of the convex hull of points; two, if they are on a line."""
    try:  # in units of their own: Qhull takes small differences for none
        return points[ConvexHull(np.ldexp(points, -exponents(points.T))).vertices]
    except QhullError:
        return points[np.lexsort(points.T)[[0, -1]]]


def cut(corners: Points, ellipse: tuple[Any, Any]) -> Points:
    """What the tangents of an ellipse leave of a convex polygon, corners in order."""
    A, b = (np.asarray(part) for part in ellipse)
    for tangent in circle():
        room = 1 - corners @ (tangent @ A) - tangent @ b
        after, left = np.roll(corners, -1, axis=0), np.roll(room, -1)
        crossing = room * left < 0
        share = np.where(crossing, room / np.where(crossing, room - left, 1.0), 0.0)
        between = corners + share[:, None] * (after - corners)
        either = np.stack([corners, between], axis=1).reshape(-1, 2)
        corners = either[np.stack([room >= 0, crossing], axis=1).ravel()]
    return corners
