"""Polytopes within and around ellipsoids, of normals spread over the sphere."""

from __future__ import annotations

from functools import lru_cache
from itertools import product

import numpy as np
from jaxtyping import Float

from reachjax.sets import hulls
from reachjax.sets.ellipsoid import Ellipsoid
from reachjax.sets.polytope import Polytope

CORNERS = 48
"""Corners of polygons: those within a circle are 0.2 % smaller."""

ENTRIES = {3: 2, 4: 1, 5: 1}
"""Normals in more dimensions are all vectors of whole numbers up to this one."""

SLACK = 1e-6
"""The part of its size that a polytope is smaller or larger by, on account of rounding."""

THIN = 1e9
"""Beyond this ratio of the squares of its axes, rounding of an ellipsoid is no longer covered."""

FAR = 1e8
"""Nor where what a distance from zero, in half-axes, is added up of is larger than this."""


@lru_cache
def _normals(n: int) -> tuple[Float[np.ndarray, "m n"], float]:
    """Unit vectors, and the radius of the ball whose tangents leave its corners on the unit one."""
    if n == 1:
        return np.array([[1.0], [-1.0]]), 1.0
    if n == 2:
        angles = 2 * np.pi * np.arange(CORNERS) / CORNERS
        found = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    else:
        every = np.array([*product(range(-ENTRIES[n], ENTRIES[n] + 1), repeat=n)], float)
        every = every[np.any(every != 0, axis=1)]
        unit = every / np.linalg.norm(every, axis=1, keepdims=True)
        found = np.unique(unit.round(12), axis=0)
    corners = hulls.vertices(found, np.ones(len(found)))
    return found, float(1 / np.linalg.norm(corners, axis=1).max())


def inner_polytope(ellipsoid: Ellipsoid, name: str) -> Polytope:
    """A polytope that lies in an ellipsoid.

    Args:
        ellipsoid: of numbers, of at most five dimensions.
        name: what errors call it.

    Raises:
        ValueError: it has more dimensions, or is too thin or too far away for its size.

    Example:
        >>> disc = Ellipsoid([0.0, 0.0], [[1.0, 0.0], [0.0, 1.0]])
        >>> inner = inner_polytope(disc, "disc")
        >>> round(inner.volume() / np.pi, 2), bool(disc.contains(inner.vertices()).all())
        (1.0, True)
    """
    _, radius = _normals(_checked(ellipsoid, name))
    return _tangents(ellipsoid, radius * (1 - SLACK))


def outer_polytope(ellipsoid: Ellipsoid, name: str) -> Polytope:
    """A polytope in which an ellipsoid lies; arguments and errors as of `inner_polytope`."""
    _checked(ellipsoid, name)
    return _tangents(ellipsoid, 1 + SLACK)


def _tangents(ellipsoid: Ellipsoid, radius: float) -> Polytope:
    """The tangents of the ellipsoid of this part of the size."""
    normals, _ = _normals(ellipsoid.dimension)
    rows = normals @ np.asarray(ellipsoid.normal_form.A)
    return Polytope(rows, radius + rows @ np.asarray(ellipsoid.center))


def _checked(ellipsoid: Ellipsoid, name: str) -> int:
    n, shape = ellipsoid.dimension, np.asarray(ellipsoid.shape)
    if n > max(ENTRIES):
        raise ValueError(
            f"{name} is an ellipsoid of dimension {n}, and up to {max(ENTRIES)} can be decided: "
            "give a Polytope within or around it"
        )
    away = np.linalg.norm(
        abs(np.asarray(ellipsoid.normal_form.A)) @ abs(np.asarray(ellipsoid.center))
    )
    if np.linalg.cond(shape) > THIN or away > FAR:
        raise ValueError(
            f"{name} is too thin, or too small for its distance from zero, for an ellipsoid to be "
            "decided: give a Box or a Polytope"
        )
    return n
