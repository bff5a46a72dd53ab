"""Linear functions over polytopes of few facets, by all bases at once instead of linear programs.

`n` independent facets that hold with equality meet in one point. Where a linear function attains
its maximum over a polytope that has a corner, it does so in such a point of the polytope, with
multipliers `y >= 0` of these `n` facets alone (Schrijver, Theory of Linear and Integer
Programming, 1986, section 11). A few hundred of them are less work, in arrays, than a single call
of a linear-programming code.

A basis is found up to rounding, as a linear program's solution is: what is certified rests on the
multipliers, and who bounds with them pays for what they leave over.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations
from math import comb

import numpy as np
from jaxtyping import Float, Int

MOST = 1000
"""A linear program is as fast as twice as many: 3 ms for ten directions in five coordinates."""

LARGEST = 1 << 22
"""Entries of an array of all bases and directions, 32 MB: more are left to a linear program."""

SINGULAR = 1e-9
"""Rows of a size about 1 whose determinant is smaller count as dependent."""

ACCURATE = 1e-12
"""Parts of their terms by which corners may be outside of facets, and multipliers be wrong."""

LARGEST_MULTIPLIERS = 1e3
"""Beside a direction larger multipliers are of facets that are nearly parallel, and inaccurate."""


def maximisers_by_bases(
    A: Float[np.ndarray, "m n"], b: Float[np.ndarray, " m"], D: Float[np.ndarray, "k n"]
) -> tuple[Float[np.ndarray, "k m"], Float[np.ndarray, "k n"]] | None:
    """Multipliers `Y >= 0`, `Y A ~ D`, that bound `D x` on `A x <= b`, and where it is largest.

    Args:
        A: normals, whose largest entries are about 1, in coordinates of a size about 1.
        b: offsets.
        D: directions.

    Returns:
        The multipliers `(k, m)` and corners `(k, n)`. None where linear programs know better: the
        bases are too many, or for some direction none is a solution to rounding, since the polytope
        is empty, unbounded there, has no corner or is too thin.

    Example:
        >>> A, b = np.vstack([np.eye(2), -np.eye(2)]), np.array([1.0, 2.0, 0.0, 0.0])
        >>> Y, points = maximisers_by_bases(A, b, np.array([[1.0, 3.0]]))
        >>> Y.tolist(), points.tolist()
        ([[1.0, 3.0, 0.0, 0.0]], [[1.0, 2.0]])
    """
    m, n = A.shape
    if not n <= m or comb(m, n) > MOST or comb(m, n) * D.size > LARGEST:
        return None
    with np.errstate(all="ignore"):
        bases, inverses, corners = _corners(A, b)
        if len(bases) == 0:
            return None
        parts = np.maximum(D @ inverses, 0.0)  # [basis, direction, facet]
        size = abs(corners).max(axis=0)
        left = abs(D - parts @ A[bases])
        values = (parts @ b[bases][:, :, None])[:, :, 0] + left @ size
        worth = np.where(_solves(D, parts, left), values, np.inf)
    best, each = np.argmin(worth, axis=0), np.arange(len(D))
    if not np.isfinite(worth[best, each]).all():
        return None
    Y = np.zeros((len(D), m))
    Y[each[:, None], bases[best]] = parts[best, each]
    return Y, corners[best]


def _corners(A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The bases whose points are in the polytope: facets, inverses of their normals, points."""
    bases = _bases(*A.shape)
    bases = bases[abs(np.linalg.det(A[bases])) > SINGULAR]
    inverses = np.linalg.inv(A[bases])
    points = (inverses @ b[bases][:, :, None])[:, :, 0]
    terms = abs(points) @ abs(A).T + abs(b)
    inside = np.all(points @ A.T - b <= ACCURATE * terms, axis=1)
    return bases[inside], inverses[inside], points[inside]


def _solves(D: np.ndarray, parts: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Whether multipliers of bases make up directions, which are nothing beside no multiplier."""
    sizes = abs(D).max(axis=1)
    exact = left.max(axis=2) <= ACCURATE * sizes
    return exact & (parts.sum(axis=2) <= LARGEST_MULTIPLIERS * sizes)


@lru_cache(maxsize=64)
def _bases(m: int, n: int) -> Int[np.ndarray, "c n"]:
    """Every choice of `n` of `m` facets, `(c, n)`."""
    found = np.array([*combinations(range(m), n)]).reshape(-1, n)
    found.flags.writeable = False
    return found
