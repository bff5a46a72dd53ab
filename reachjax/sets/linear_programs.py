"""Linear programs over polytopes, on the host by HiGHS (scipy), or by all bases if they are few.

An optimal value that comes out of a linear-programming code is only as good as its tolerance, so
what is used in a certificate is rebuilt from the dual solution: for any `y >= 0`,
`a . x = y'A x + r . x <= y'b + |r| . max|x|` on the polytope, with `r = a - A'y` (weak duality).

So is how far two polytopes are apart: by weak duality, or by one facet alone.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.optimize import linprog

from reachjax.numerics.rounding import TINY, gamma
from reachjax.sets.balance import Balanced, balanced, exponents, lengths, upwards
from reachjax.sets.bases import maximisers_by_bases
from reachjax.sets.unusable import ThinSetError, UnusableSetError

UNEVEN = 10
"""Coordinates whose sizes are further from 1, as powers of two, are scaled anew."""

TOO_LARGE = 1e15
"""From numbers of this size on linear programs are not believed to have no solution."""

REACH = 1e10
"""Points that are further away than this many times a polytope's largest offset are none of it."""

EMPTY = "the polytope A x <= b is empty: no point satisfies all its facets"

NEARLY_EMPTY = (
    "the polytope A x <= b is empty, or it is thinner than linear programs tell: give it facets "
    "that leave more room, or a Box if it is one"
)

NOTHING = 1e-290
"""Coordinates that are no larger, where facets are about 1 away, are zero but for underflow."""


def maximiser(A: np.ndarray, b: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Multipliers `y >= 0` of the facets, `A'y ~ direction`, that bound `max direction . x`, and x.

    Raises:
        ValueError: the polytope is empty, or unbounded in this direction.
        RuntimeError: the linear program was not solved.
    """
    result = linprog(-direction, A_ub=A, b_ub=b, bounds=(None, None), method="highs")
    if result.status in (2, 4) and is_empty(A, b):
        raise UnusableSetError(EMPTY)
    if result.status == 2:
        raise ThinSetError(NEARLY_EMPTY)
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

    Few facets are tried by all their bases at once. Else one linear program with a copy of the
    polytope for each direction takes a fraction of the time of many.
    """
    if (found := maximisers_by_bases(A, b, directions)) is not None:
        return found
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
    """Whether surely no point is in a polytope, which may be unbounded; False if that is not seen.

    By Farkas' lemma: for `y >= 0` with `y'A = 0` and `y'b < 0`, rounding included, and what is left
    of `y'A` by points of up to `REACH` times the largest offset.
    """
    A, b = balanced(A, b)
    if not (np.all(abs(A) < TOO_LARGE) and np.all(abs(b) < TOO_LARGE)):
        return False  # what a linear program says of such numbers is often wrong
    (m, n), norms = A.shape, lengths(A)
    if np.any((norms == 0) & (b < 0)):
        return True
    b = np.ldexp(b, -np.frexp(abs(b).max(initial=0.0))[1])  # exactly, but for underflow
    facets = np.hstack([A, -norms[:, None]])
    ends = [*[(None, None)] * n, (0, None)]
    found = linprog(np.eye(n + 1)[-1], A_ub=facets, b_ub=b, bounds=ends, method="highs")
    if found.status != 0:
        return False
    y, error = np.maximum(-found.ineqlin.marginals, 0.0), gamma(m + n + 8)
    lost = TINY * (m + 2 + y.sum())
    leak = (abs(y @ A) + error * (y @ abs(A)) + lost).sum()
    return bool(y @ b + error * (y @ abs(b)) + lost + leak * REACH < 0)


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

    Returns:
        What is kept for the next call on the same polytope: arrays that cannot be written to.

    Raises:
        RuntimeError: the linear programs were not solved.
        ValueError: the polytope is empty or unbounded.
    """
    return _boxed(*(np.asarray(part, float).tobytes() for part in (A, b)), A.shape)


@lru_cache(maxsize=64)
def _boxed(normals: bytes, offsets: bytes, shape: tuple[int, int]) -> tuple[Balanced, Maxima]:
    """`boxed` of the bytes of `A` and `b`: a set is asked for its box again and again."""
    region, box = _boxed_anew(np.frombuffer(normals).reshape(shape), np.frombuffer(offsets))
    for array in (*region, *box):
        array.flags.writeable = False
    return region, box


def _boxed_anew(A: np.ndarray, b: np.ndarray) -> tuple[Balanced, Maxima]:
    """A polytope in balanced coordinates, and its box there, both computed."""
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
        raise UnusableSetError(EMPTY) if is_empty(A, b) else ThinSetError(NEARLY_EMPTY)
    if result.status != 0:
        raise UnusableSetError("the polytope A x <= b is unbounded")
    return result.x[:-1], float(result.x[-1])


FAR = 1e12
"""Beside facets that many times its size away a polytope is a point: one of them says it all."""


def separation_and_multipliers(
    A: np.ndarray, b: np.ndarray, C: np.ndarray, d: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """How far the facets of `C x <= d` may move outward before it meets the bounded `A x <= b`.

    A lower bound whatever the linear program's accuracy; positive means disjoint. Minimises `s`
    over `A x <= b`, `C x - s |c_i| <= d`. The value returned is the dual one, `-(y'b + w'd)` with
    `y, w >= 0` and `w . |c_i| = 1`, less what its residual can cost; or what the box around
    `A x <= b` proves by a single facet, if that is more.

    Returns:
        The separation, its derivatives in `A`, up to their sign, the multipliers of both sets, and
        the nearest point.

    Raises:
        ValueError: the polytope `A x <= b` is empty or unbounded.
        RuntimeError: the linear programs that bound it were not solved.
    """
    region, box = boxed(A, b)
    other = Balanced.of(C, d, region.columns)
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        norms = np.ldexp(lengths(C), other.rows)
        one = _by_one_facet(region, box, other, norms)
        telling = other.near & ((abs(other.A) @ box.size - other.b) / norms >= one.value)
        all_of_them = _by_program(region, box, other, norms, telling)
        value, swept, y, w, x = _better(one, all_of_them)
        swept = np.ldexp(swept, region.rows[:, None] + region.columns)
        y, w = np.ldexp(y, region.rows), np.ldexp(w, other.rows)
        return value, swept, y, w, np.ldexp(x, region.columns)


class _Apart(NamedTuple):
    """A separation, and in balanced coordinates its derivatives and the nearest point."""

    value: float
    swept: np.ndarray
    y: np.ndarray
    w: np.ndarray
    x: np.ndarray


def _by_one_facet(region: Balanced, box: Maxima, other: Balanced, norms: np.ndarray) -> _Apart:
    """The best separation that one facet has from a box around the polytope."""
    n = len(region.columns)
    weights = np.hstack([np.maximum(other.A, 0.0), np.maximum(-other.A, 0.0)])
    error = gamma(2 * n + 4) * (abs(other.A) @ box.size + abs(other.b)) + TINY * (2 * n + 4)
    room = -(weights @ box.values) - other.b - error  # `C x` is at least the first of these
    values = np.where(other.near & (norms > 0), np.nan_to_num(room / norms, nan=-np.inf), -np.inf)
    best = int(np.argmax(values))
    with_box = weights[best] / norms[best]
    corner = np.where(other.A[best] > 0, -box.values[:n], box.values[n:])
    swept = np.einsum("k,km,kn->mn", with_box, box.Y, box.points)
    single = np.zeros(len(norms))
    single[best] = 1 / norms[best]
    return _Apart(float(values[best]), swept, with_box @ box.Y, single, corner)


def _by_program(
    region: Balanced, box: Maxima, other: Balanced, norms: np.ndarray, telling: np.ndarray
) -> _Apart | None:
    """The separation by a linear program over the facets that tell; None if it is not solved."""
    (m, n), C, d = region.A.shape, other.A[telling], other.b[telling]
    if len(d) == 0 or abs(d).max() > FAR or not np.isfinite(norms[telling]).all():
        return None
    by = int(exponents(norms[telling]))  # the separation, too, in a unit of its own
    units = np.ldexp(norms[telling], -by)
    unit = 2.0 ** float(np.frexp(max(abs(d).max(), 1.0))[1])
    result = linprog(
        np.r_[np.zeros(n), 1.0],
        A_ub=np.block([[region.A, np.zeros((m, 1))], [C, -units[:, None]]]),
        b_ub=np.r_[region.b, d] / unit,
        bounds=(None, None),
        method="highs",
    )
    if result.status != 0:
        return None
    duals = np.maximum(-result.ineqlin.marginals, 0.0)
    total = duals[m:] @ units
    if not total > 0:
        return None
    y, w = duals[:m] / total, duals[m:] / total
    error = gamma(m + len(d) + n + 8)
    lost = TINY * (m + len(d) + 2 + y.sum() + w.sum())  # by underflow
    residual = abs(y @ region.A + w @ C) + error * (y @ abs(region.A) + w @ abs(C)) + lost
    cost = error * (y @ abs(region.b) + w @ abs(d)) + residual @ box.size * (1 + error) + lost
    x, weights = result.x[:n] * unit, np.zeros(len(norms))
    value = float(np.ldexp(-(y @ region.b + w @ d) - cost, -by))
    y, weights[telling] = np.ldexp(y, -by), np.ldexp(w, -by)
    return _Apart(value, y[:, None] * x, y, weights, x)


def _better(one: _Apart, every: _Apart | None) -> _Apart:
    """What the program proves, which has the better derivatives, unless that is clearly less."""
    if every is None or not np.isfinite(every.value) or one.value > 0 >= every.value:
        return one
    return one if one.value - every.value > 1e-6 * (1 + abs(one.value)) else every
