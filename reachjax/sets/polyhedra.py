"""Polytopes on the host: linear programs by HiGHS, hulls and triangulations by Qhull (scipy).

An optimal value that comes out of a linear-programming code is only as good as its tolerance, so
what is used in a certificate is rebuilt from the dual solution: for any `y >= 0`,
`a . x = y'A x + r . x <= y'b + |r| . max|x|` on the polytope, with `r = a - A'y` (weak duality).
"""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, Delaunay, HalfspaceIntersection, QhullError

from reachjax.rounding import gamma

TOO_THIN = "the polytope is too thin for its corners to be told apart"

FLAT = 1e-9
"""Scaled to a unit box, a polytope whose largest inscribed ball is smaller than this is flat."""


def balanced(A: np.ndarray, *others: np.ndarray) -> tuple[np.ndarray, ...]:
    """Rows brought to a length between 1/2 and 1 by powers of two, which is exact.

    The linear-programming code drops small coefficients and stops on large ones.
    """
    exponents = -np.frexp(np.linalg.norm(A, axis=1))[1]
    return (np.ldexp(A, exponents[:, None]), *(np.ldexp(other, exponents) for other in others))


def maximiser(A: np.ndarray, b: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Multipliers `y >= 0` of the facets, `A'y ~ direction`, that bound `max direction . x`, and x.

    Raises:
        ValueError: the polytope is empty, or unbounded in this direction.
        RuntimeError: the linear program was not solved.
    """
    result = linprog(-direction, A_ub=A, b_ub=b, bounds=(None, None), method="highs")
    if result.status == 2 or (result.status == 4 and _is_empty(A, b)):
        raise ValueError("the polytope A x <= b is empty: no point satisfies all its facets")
    if result.status == 3:
        raise ValueError(
            f"the polytope A x <= b is unbounded in direction {np.round(direction, 6).tolist()}"
        )
    if result.status != 0:
        raise RuntimeError(f"a linear program over the polytope failed: {result.message}")
    return np.maximum(-result.ineqlin.marginals, 0.0), result.x


def _is_empty(A: np.ndarray, b: np.ndarray) -> bool:
    zero = np.zeros(A.shape[1])
    return linprog(zero, A_ub=A, b_ub=b, bounds=(None, None), method="highs").status == 2


def bounding_box(A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of each coordinate, true for the exact polytope."""
    lower, upper, _, _ = bounding_box_and_multipliers(A, b)
    return lower, upper


def bounding_box_and_multipliers(A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, ...]:
    """Lower and upper bounds of each coordinate, true for the exact polytope.

    With `D = [-I; I]`, multipliers `Y` and residual `E = D - Y A`, every point has
    `D x <= Y b + |E| rho` where `rho = max|x_i| <= max(Y b) / (1 - max row sum of |E|)`.

    Returns:
        Lower and upper bounds `(n,)`, the multipliers `Y` `(2 n, m)` and where the maxima are
        attained `(2 n, n)`, both for `-x_i` and then for `x_i`.
    """
    lengths = np.frexp(np.linalg.norm(A, axis=1))[1]
    A, b = balanced(A, b)
    n = A.shape[1]
    D = np.vstack([-np.eye(n), np.eye(n)])
    Y, points = (np.stack(part) for part in zip(*(maximiser(A, b, d) for d in D), strict=True))
    error = gamma(len(b) + 2)
    residual = np.abs(D - Y @ A) + error * (np.abs(D) + Y @ np.abs(A))
    values = Y @ b + error * (Y @ np.abs(b))
    leak = residual.sum(axis=1)
    if leak.max() > 0.5:
        raise RuntimeError("the linear programs that bound the polytope are too inaccurate")
    radius = max(values.max(), 0.0) / (1 - leak.max())
    values = values + leak * radius * (1 + error)
    lower = -values[:n]
    ends = np.minimum(lower, values[n:]), np.maximum(lower, values[n:])
    return *ends, np.ldexp(Y, -lengths), points


def support(A: np.ndarray, b: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Upper bounds of `max a . x` for each direction, true for the exact polytope."""
    A, b = balanced(A, b)
    lower, upper = bounding_box(A, b)
    size = np.maximum(np.abs(lower), np.abs(upper))
    error = gamma(len(b) + len(size) + 4)
    exponents = np.frexp(np.linalg.norm(directions, axis=1))[1]
    values = []
    for a in np.ldexp(directions, -exponents[:, None]):
        y, _ = maximiser(A, b, a)
        residual = np.abs(a - y @ A) + error * (np.abs(a) + y @ np.abs(A))
        values.append(y @ b + error * (y @ np.abs(b)) + residual @ size * (1 + error))
    return np.ldexp(values, exponents)


def separation(A: np.ndarray, b: np.ndarray, C: np.ndarray, d: np.ndarray) -> float:
    """How far the facets of `C x <= d` may move outward before it meets the bounded `A x <= b`.

    Minimises `s` over `A x <= b`, `C x - s |c_i| <= d`; positive means disjoint. The value
    returned is the dual one, `-(y'b + w'd)` with `y, w >= 0` and `w . |c_i| = 1`, less what its
    residual can cost: a lower bound whatever the solver's accuracy.
    """
    (A, b), (C, d) = balanced(A, b), balanced(C, d)
    norms = np.linalg.norm(C, axis=1)
    m, n = A.shape
    result = linprog(
        np.r_[np.zeros(n), 1.0],
        A_ub=np.block([[A, np.zeros((m, 1))], [C, -norms[:, None]]]),
        b_ub=np.r_[b, d],
        bounds=(None, None),
        method="highs",
    )
    if result.status != 0:
        raise RuntimeError(f"the linear program that separates two sets failed: {result.message}")
    duals = np.maximum(-result.ineqlin.marginals, 0.0)
    duals = duals / (duals[m:] @ norms)
    y, w = duals[:m], duals[m:]
    lower, upper = bounding_box(A, b)
    size = np.maximum(np.abs(lower), np.abs(upper))
    error = gamma(m + len(d) + n + 8)
    residual = np.abs(y @ A + w @ C) + error * (y @ np.abs(A) + w @ np.abs(C))
    cost = error * (y @ np.abs(b) + w @ np.abs(d)) + residual @ size * (1 + error)
    return float(-(y @ b + w @ d) - cost)


def chebyshev(A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre and radius of the largest ball inside (radius 0 for a flat polytope)."""
    norms = np.linalg.norm(A, axis=1)
    result = linprog(
        np.r_[np.zeros(A.shape[1]), -1.0],
        A_ub=np.hstack([A, norms[:, None]]),
        b_ub=b,
        bounds=[(None, None)] * A.shape[1] + [(0, None)],
        method="highs",
    )
    if result.status == 2:
        raise ValueError("the polytope A x <= b is empty: no point satisfies all its facets")
    if result.status != 0:
        raise ValueError("the polytope A x <= b is unbounded")
    return result.x[:-1], float(result.x[-1])


def vertices(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The corners of a bounded polytope `(v, n)`; a flat one is treated in its affine hull.

    Raises:
        RuntimeError: the polytope is too thin for its corners to be told apart.
    """
    if A.shape[1] == 1:
        ends = b / A[:, 0]
        return np.unique([[ends[A[:, 0] < 0].max()], [ends[A[:, 0] > 0].min()]], axis=0)
    lower, upper = bounding_box(A, b)
    middle, radii = (lower + upper) / 2, (upper - lower) / 2
    radii = np.where(radii > FLAT * radii.max(), radii, radii.max() or 1.0)
    try:
        return middle + radii * _unit_vertices(*balanced(A * radii, b - A @ middle))
    except QhullError as error:
        raise RuntimeError(f"{TOO_THIN}: {str(error).splitlines()[0]}") from None


def _unit_vertices(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The corners of a polytope whose bounding box is the unit box, or flat in some coordinates."""
    center, radius = chebyshev(A, b)
    if radius > FLAT:
        corners = HalfspaceIntersection(np.hstack([A, -b[:, None]]), center).intersections
        return corners[ConvexHull(corners).vertices]
    basis = _affine_hull(A, b, center, FLAT)
    if basis.shape[1] == 0:
        return center[None]
    reduced = A @ basis
    kept = np.linalg.norm(reduced, axis=1) > FLAT
    slack = np.maximum(b - A @ center, 0.0)
    return center + vertices(reduced[kept], slack[kept]) @ basis.T


def extreme_points(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The corners, or where they cannot be told apart, points that linear programs find."""
    try:
        return vertices(A, b)
    except RuntimeError:
        A, b = balanced(A, b)
        n = A.shape[1]
        draws = np.random.default_rng(0).normal(size=(8 * n, n))
        return np.stack([maximiser(A, b, d)[1] for d in np.vstack([np.eye(n), -np.eye(n), draws])])


def _affine_hull(A: np.ndarray, b: np.ndarray, point: np.ndarray, tolerance: float) -> np.ndarray:
    """An orthonormal basis `(n, k)` of the directions in which a flat polytope extends."""
    norms = np.linalg.norm(A, axis=1)
    extent = [-_least(A, b, a) for a in A / norms[:, None]]
    tight = np.array(extent) + b / norms <= 4 * tolerance
    if not tight.any():
        raise RuntimeError(TOO_THIN)
    _, values, rows = np.linalg.svd(A[tight] / norms[tight, None])
    rank = int(np.sum(values > 1e-6))
    return rows[rank:].T


def _least(A: np.ndarray, b: np.ndarray, direction: np.ndarray) -> float:
    result = linprog(direction, A_ub=A, b_ub=b, bounds=(None, None), method="highs")
    return float(result.fun)


def volume(A: np.ndarray, b: np.ndarray) -> float:
    """The volume of a bounded polytope, zero for a flat one."""
    corners = vertices(A, b)
    n = A.shape[1]
    if n == 1:
        return float(np.ptp(corners))
    if len(corners) <= n:
        return 0.0
    try:
        return float(ConvexHull(corners).volume)
    except QhullError:  # the corners span fewer than n dimensions
        return 0.0


def facet_areas(A: np.ndarray, b: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """The volume, and of each facet the `(n-1)`-volume `(m,)` and the centroid `(m, n)`.

    Moving facet `i` outwards by `db_i` sweeps the volume `area_i db_i / |a_i|`. A facet that does
    not bound the polytope has area zero.
    """
    n, norms = A.shape[1], np.linalg.norm(A, axis=1)
    corners = vertices(A, b)
    areas, centroids = np.zeros(len(b)), np.zeros((len(b), n))
    if n == 1:
        for side in (A[:, 0] < 0, A[:, 0] > 0):
            facet = np.flatnonzero(side)[np.argmin((b / abs(A[:, 0]))[side])]
            areas[facet], centroids[facet] = 1.0, b[facet] / A[facet, 0]
        return float(np.ptp(corners)), areas, centroids
    if len(corners) <= n:
        return 0.0, areas, centroids
    try:
        hull = ConvexHull(corners)
    except QhullError:  # the corners span fewer than n dimensions
        return 0.0, areas, centroids
    for simplex, equation in zip(corners[hull.simplices], hull.equations, strict=True):
        facet = int(np.argmin(np.linalg.norm(A / norms[:, None] - equation[:-1], axis=1)))
        edges = simplex[1:] - simplex[0]
        area = np.sqrt(max(np.linalg.det(edges @ edges.T), 0.0)) / math.factorial(n - 1)
        areas[facet] += area
        centroids[facet] += area * simplex.mean(axis=0)
    return float(hull.volume), areas, centroids / np.where(areas > 0, areas, 1)[:, None]


def uniform(A: np.ndarray, b: np.ndarray, rng: np.random.Generator, count: int) -> np.ndarray:
    """`count` points drawn uniformly, by a triangulation of the corners `(count, n)`."""
    corners = extreme_points(A, b)
    center = corners.mean(axis=0)
    _, values, rows = np.linalg.svd(corners - center, full_matrices=False)
    spanned = rows[values > FLAT * max(values.max(initial=0.0), np.finfo(float).tiny)]
    flat = (corners - center) @ spanned.T
    if flat.shape[1] == 0:
        return np.repeat(center[None], count, axis=0)
    if flat.shape[1] == 1:
        ends = np.array([flat.min(), flat.max()])
        return center + rng.uniform(*ends, size=(count, 1)) @ spanned
    simplices = flat[Delaunay(flat).simplices]
    volumes = np.abs(np.linalg.det(simplices[:, 1:] - simplices[:, :1]))
    chosen = rng.choice(len(simplices), size=count, p=volumes / volumes.sum())
    weights = rng.dirichlet(np.ones(flat.shape[1] + 1), size=count)
    return center + np.einsum("cv,cvk->ck", weights, simplices[chosen]) @ spanned
