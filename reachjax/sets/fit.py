"""Directions of facets: regular ones, and such as fit a cloud of points."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from reachjax.sets.balance import exponents, lengths

LEAST_SPREAD = 1e-6
"""Points are taken to spread by at least this part of their widest spread in every direction."""

ROUNDED = 2.0**-48
"""Points that spread by a smaller part of their size may be on a line: some roundings of theirs."""


def signed(rows: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "2m n"]:
    """Each row followed by its negative."""
    return np.stack([rows, 0.0 - rows], axis=1).reshape(-1, rows.shape[1])  # 0, not -0


def octagonal(n: int) -> Float[np.ndarray, "f n"]:
    """Axes, then sums and differences of two of them, with both signs."""
    eye = np.eye(n)
    pairs = [
        row
        for i, j in itertools.combinations(range(n), 2)
        for row in (eye[i] - eye[j], eye[i] + eye[j])
    ]
    return signed(np.array([*eye, *pairs]))


def plane(facets: int) -> Float[np.ndarray, "f 2"]:
    """Unit vectors at equal angles."""
    angles = 2 * np.pi * np.arange(facets) / facets
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def axes(points: Float[np.ndarray, "c n"], facets: int) -> Float[np.ndarray, "f n"]:
    """Principal axes of points, then sums and differences of two of them, scaled by their spreads.

    Raises:
        ValueError: that many directions do not come in pairs, or are not to be had.
    """
    n, points = points.shape[1], _about_one(points)
    rows = octagonal(n)
    if facets % 2 or facets > len(rows):
        raise ValueError(
            f"facets must be an even number of {2 * n} to {len(rows)}, but {facets} arrived"
        )
    W, _ = _whitening(points)
    return _unit(rows[:facets] @ W)


def edges(points: Float[np.ndarray, "c 2"], facets: int) -> Float[np.ndarray, "f 2"]:
    """Normals of edges of the convex hull of points, and others where it has too few.

    Edges are left out one by one, the one first without which the polygon grows least. Ratios of
    areas do not depend on the coordinates, so points are whitened.
    """
    points = _about_one(points)
    W, spreads = _whitening(points)
    on_a_line = _unit(plane(facets) @ W)
    if spreads[1] < ROUNDED * np.linalg.norm(points):  # rounding makes edges of a line
        return on_a_line
    try:
        hull = ConvexHull(points @ W.T)
    except QhullError:
        return on_a_line
    corners = hull.points[hull.vertices]  # counterclockwise
    steps = np.roll(corners, -1, axis=0) - corners
    normals = _unit(np.stack([steps[:, 1], -steps[:, 0]], axis=1))
    offsets = np.einsum("ij,ij->i", normals, corners)
    while len(normals) > facets:
        growth = [_growth(normals, offsets, i) for i in range(len(normals))]
        if not np.isfinite(growth).any():  # without any edge it opens, as a parallelogram does
            return on_a_line
        left_out = int(np.argmin(growth))
        normals, offsets = np.delete(normals, left_out, 0), np.delete(offsets, left_out)
    while len(normals) < facets:
        angles = np.unwrap(np.arctan2(normals[:, 1], normals[:, 0]))
        turns = np.diff(angles, append=angles[0] + 2 * np.pi)
        widest = int(np.argmax(turns))
        middle = angles[widest] + turns[widest] / 2
        normals = np.insert(normals, widest + 1, [np.cos(middle), np.sin(middle)], axis=0)
    return _unit(normals @ W)


def _growth(normals: np.ndarray, offsets: np.ndarray, i: int) -> float:
    """The area that a polygon gains without its edge `i`; infinite if it opens."""
    before, after = (i - 1) % len(normals), (i + 1) % len(normals)

    def meet(first: int, second: int) -> np.ndarray:
        here = [first, second]
        return np.linalg.solve(normals[here], offsets[here])

    (a, b), (c, d) = normals[before], normals[after]
    if a * d - b * c <= 1e-12:  # its neighbours do not meet beyond it
        return np.inf
    start, end, tip = meet(before, i), meet(i, after), meet(before, after)
    (p, q), (r, s) = end - start, tip - start
    return abs(p * s - q * r) / 2


def _whitening(
    points: Float[np.ndarray, "c n"],
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, " n"]]:
    """A matrix that gives points unit spread in all directions, and spreads, widest axis first."""
    _, spreads, rows = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    if not spreads[0] > 0:
        return np.eye(points.shape[1]), spreads
    return rows / np.maximum(spreads, LEAST_SPREAD * spreads[0])[:, None], spreads


def _about_one(points: Float[np.ndarray, "c n"]) -> Float[np.ndarray, "c n"]:
    """The same points in another unit: directions do not depend on it."""
    return np.ldexp(points, -exponents(points.ravel()))


def _unit(rows: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "m n"]:
    return rows / lengths(rows)[:, None]
