"""Linear programs over polytopes, on the host by HiGHS (scipy).

An optimal value that comes out of a linear-programming code is only as good as its tolerance, so
what is used in a certificate is rebuilt from the dual solution: for any `y >= 0`,
`a . x = y'A x + r . x <= y'b + |r| . max|x|` on the polytope, with `r = a - A'y` (weak duality).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.optimize import linprog

from reachjax.numerics.rounding import gamma


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


def maximisers(
    A: np.ndarray, b: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`maximiser` for `k` directions: multipliers `(k, m)` and points `(k, n)`.

    One linear program with a copy of the polytope for each takes a fraction of the time of many.
    """
    k, (m, n) = len(directions), A.shape
    blocks = sp.kron(sp.eye_array(k), A, format="csr")
    result = linprog(
        -directions.ravel(), blocks, np.tile(b, k), bounds=(None, None), method="highs"
    )
    if result.status != 0:  # one by one, to say what is wrong
        pairs = [maximiser(A, b, direction) for direction in directions]
        return np.stack([y for y, _ in pairs]), np.stack([x for _, x in pairs])
    return np.maximum(-result.ineqlin.marginals.reshape(k, m), 0.0), result.x.reshape(k, n)


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
    Y, points = maximisers(A, b, D)
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
    return support_and_multipliers(A, b, directions)[0]


def support_and_multipliers(
    A: np.ndarray, b: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Upper bounds of `max a . x` for each of `k` directions, true for the exact polytope.

    Returns:
        The bounds `(k,)`, the multipliers `(k, m)` and where the maxima are attained `(k, n)`.
    """
    lengths = np.frexp(np.linalg.norm(A, axis=1))[1]
    A, b = balanced(A, b)
    lower, upper = bounding_box(A, b)
    size = np.maximum(np.abs(lower), np.abs(upper))
    error = gamma(len(b) + len(size) + 4)
    exponents = np.frexp(abs(directions).max(axis=1))[1]  # squares of entries may overflow
    D = np.ldexp(directions, -exponents[:, None])
    Y, points = maximisers(A, b, D)
    residual = np.abs(D - Y @ A) + error * (np.abs(D) + Y @ np.abs(A))
    values = Y @ b + error * (Y @ np.abs(b)) + residual @ size * (1 + error)
    return np.ldexp(values, exponents), np.ldexp(Y, exponents[:, None] - lengths), points


def separation_and_multipliers(
    A: np.ndarray, b: np.ndarray, C: np.ndarray, d: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """How far the facets of `C x <= d` may move outward before it meets the bounded `A x <= b`.

    A lower bound whatever the linear program's accuracy; positive means disjoint. Minimises `s`
    over `A x <= b`, `C x - s |c_i| <= d`. The value returned is the dual one, `-(y'b + w'd)` with
    `y, w >= 0` and `w . |c_i| = 1`, less what its residual can cost.

    Returns:
        The separation, the multipliers of both sets and the nearest point.

    Raises:
        RuntimeError: the linear program was not solved.
    """
    lengths = [np.frexp(np.linalg.norm(rows, axis=1))[1] for rows in (A, C)]
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
    value = float(-(y @ b + w @ d) - cost)
    return value, np.ldexp(y, -lengths[0]), np.ldexp(w, -lengths[1]), result.x[:n]


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
