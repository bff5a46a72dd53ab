"""How far two polytopes are apart: a bound by weak duality, or by one facet alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog

from reachjax.numerics.rounding import TINY, gamma
from reachjax.sets.balance import Balanced, exponents, lengths
from reachjax.sets.polyhedra import Maxima, boxed

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
