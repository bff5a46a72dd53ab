"""Linear programs over polytopes, on the host by HiGHS (scipy).

An optimal value that comes out of a linear-programming code is only as good as its tolerance, so
what is used in a certificate is rebuilt from the dual solution: for any `y >= 0`,
`a . x = y'A x + r . x <= y'b + |r| . max|x|` on the polytope, with `r = a - A'y` (weak duality).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.optimize import linprog

from reachjax.numerics.rounding import TINY, gamma
from reachjax.sets.balance import Balanced, balanced, lengths, upwards
from reachjax.sets.unusable import ThinSetError, UnusableSetError

UNEVEN = 10
"""Coordinates whose sizes are further from 1, as powers of two, are scaled anew."""

TOO_LARGE = 1e15
"""From numbers of this size on linear programs are not believed to have no solution."""

NOTHING = 1e-290
"""Coordinates that are no larger, where facets are about 1 away, are zero but for underflow."""


def maximiser(A: np.ndarray, b: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Multipliers `y >= 0` of the facets, `A'y ~ direction`, that bound `max direction . x`, and x.

    Raises:
        ValueError: the polytope is empty, or unbounded in this direction.
        RuntimeError: the linear program was not solved.
    """
    result = linprog(-direction, A_ub=A, b_ub=b, bounds=(None, None), method="highs")
    if result.status == 2 or (result.status == 4 and is_empty(A, b)):
        raise UnusableSetError("the polytope A x <= b is empty: no point satisfies all its facets")
    if result.status == 3:
        raise UnusableSetError(
            f"the polytope A x <= b is unbounded in direction {np.round(direction, 6).tolist()}"
        )
    if result.status != 0:
        raise ThinSetError(f"a linear program over the polytope failed: {result.message}")
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


def is_empty(A: np.ndarray, b: np.ndarray) -> bool:
    """Whether a linear program says that no point is in a polytope, which may be unbounded."""
    A, b = balanced(A, b)
    if not (np.all(abs(A) < TOO_LARGE) and np.all(abs(b) < TOO_LARGE)):
        return False  # what it says of such numbers is often wrong
    zero = np.zeros(A.shape[1])
    return linprog(zero, A_ub=A, b_ub=b, bounds=(None, None), method="highs").status == 2


def bounding_box(A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, ...]:
    """Lower and upper bounds of each coordinate, true for the exact polytope.

    Returns:
        Lower and upper bounds `(n,)`, the multipliers `Y` `(2 n, m)` and where the maxima are
        attained `(2 n, n)`, both for `-x_i` and then for `x_i`.

    Raises:
        ValueError: the polytope is empty or unbounded.
        RuntimeError: the linear programs were not solved.
    """
    region, box = boxed(A, b)
    n, columns = A.shape[1], region.columns
    lower, upper = -upwards(box.values[:n], columns), upwards(box.values[n:], columns)
    ends = np.minimum(lower, upper), np.maximum(lower, upper)
    with np.errstate(over="ignore"):
        Y = np.ldexp(box.Y, region.rows + np.tile(columns, 2)[:, None])
        return *ends, Y, np.ldexp(box.points, columns)


class Maxima(NamedTuple):
    """Bounds of directions over a polytope in balanced coordinates.

    Attributes:
        values: `(k,)`, upper bounds, rounding included.
        Y: `(k, m)`, the multipliers that prove them.
        points: `(k, n)`, where the maxima are attained.
    """

    values: np.ndarray
    Y: np.ndarray
    points: np.ndarray

    @property
    def size(self) -> np.ndarray:
        """The largest absolute value of each coordinate, of bounds of `-x_i` and then of `x_i`."""
        n = self.points.shape[1]
        return np.maximum(abs(self.values[:n]), abs(self.values[n:]))


def boxed(A: np.ndarray, b: np.ndarray) -> tuple[Balanced, Maxima]:
    """A polytope in coordinates of a size about 1, and its box in these.

    The first guess of the sizes is mended by the box that it leads to. If it leads to none, all
    coordinates are taken to be of one size.
    """
    region = Balanced.of(A, b)
    try:
        box = _box(region)
    except (ValueError, RuntimeError) as error:
        region = Balanced.of(A, b, region.of_one_size)
        try:
            box = _box(region)
        except (ValueError, RuntimeError):
            raise error from None
    size = box.size
    by = np.where(size > NOTHING, np.frexp(size)[1], 0)
    if abs(by).max() > UNEVEN:
        mended = Balanced.of(A, b, region.columns + by)
        try:
            return mended, _box(mended)
        except (ValueError, RuntimeError):
            pass  # the first one holds as well
    return region, box


def _box(region: Balanced) -> Maxima:
    """Bounds of `-x_i` and of `x_i` in balanced coordinates.

    With `D = [-I; I]`, multipliers `Y` and residual `E = D - Y A`, every point has
    `D x <= Y b + |E| rho` where `rho = max|x_i| <= max(Y b) / (1 - max row sum of |E|)`.
    """
    n = region.A.shape[1]
    D = np.vstack([-np.eye(n), np.eye(n)])
    Y, points = maximisers(region.A, region.b, D)
    values, residual = _proved(region, Y, D)
    leak = residual.sum(axis=1)
    if not leak.max() <= 0.5:
        raise ThinSetError("the linear programs that bound the polytope are too inaccurate")
    radius = max(values.max(), 0.0) / (1 - leak.max())
    return Maxima(values + leak * radius * (1 + gamma(len(region.b) + 2)), Y, points)


def _proved(region: Balanced, Y: np.ndarray, D: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What multipliers prove: `Y b`, rounded up, and bounds of `|D - Y A|`, `(k,)` and `(k, n)`."""
    m, n = region.A.shape
    error = gamma(m + n + 4)
    lost = TINY * (m + 2 + Y.sum(axis=1))  # by underflow, here and where `region` was scaled
    residual = abs(D - Y @ region.A) + error * (abs(D) + Y @ abs(region.A)) + lost[:, None]
    return Y @ region.b + error * (Y @ abs(region.b)) + lost, residual


def support(A: np.ndarray, b: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, ...]:
    """Upper bounds of `max a . x` for each of `k` directions, true for the exact polytope.

    Returns:
        The bounds `(k,)`, the multipliers `(k, m)` and where the maxima are attained `(k, n)`.

    Raises:
        ValueError: the polytope is empty or unbounded.
        RuntimeError: the linear programs were not solved.
    """
    region, box = boxed(A, b)
    D, by = region.facing(directions)
    Y, points = maximisers(region.A, region.b, D)
    values, residual = _proved(region, Y, D)
    values = values + residual @ box.size * (1 + gamma(A.shape[1] + 4))
    with np.errstate(over="ignore"):
        Y = np.ldexp(Y, region.rows + by[:, None])
        return upwards(values, by), Y, np.ldexp(points, region.columns)


def chebyshev(A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre and radius of the largest ball inside (radius 0 for a flat polytope)."""
    A, b = balanced(A, b)
    norms = lengths(A)
    result = linprog(
        np.r_[np.zeros(A.shape[1]), -1.0],
        A_ub=np.hstack([A, norms[:, None]]),
        b_ub=b,
        bounds=[(None, None)] * A.shape[1] + [(0, None)],
        method="highs",
    )
    if result.status == 2:
        raise UnusableSetError("the polytope A x <= b is empty: no point satisfies all its facets")
    if result.status != 0:
        raise UnusableSetError("the polytope A x <= b is unbounded")
    return result.x[:-1], float(result.x[-1])
