"""Exact suprema of loops that are affine on their initial set, in fractions."""

from dataclasses import dataclass
from fractions import Fraction
from math import isqrt

import numpy as np

from tests.campaign.oracle import Loop, exact
from tests.campaign.random_regions import Initial

BITS = 300


def root(value: Fraction) -> tuple[Fraction, Fraction]:
    """Two fractions between which the square root lies, of some 150 common bits.

    Example:
        >>> low, high = root(Fraction(2))
        >>> low**2 <= 2 <= high**2, float(high)
        (True, 1.4142135623730951)
    """
    up, down = value.numerator, value.denominator
    shift = max(0, BITS + down.bit_length() - up.bit_length())
    whole = isqrt((up << 2 * shift) // down)
    return Fraction(whole, 1 << shift), Fraction(whole + 1, 1 << shift)


def supremum(initial: Initial, row: np.ndarray) -> tuple[Fraction, Fraction] | None:
    """Fractions between which `max row . x` lies on the set, equal but for balls; None: unknown."""
    region, n = initial.region, initial.region.dimension
    if initial.empty or (region.A is not None and region.center is not None):
        return None
    if region.center is not None:
        middle = row @ exact(region.center)
        low, high = root(row @ exact(region.shape) @ row)
        return middle + low, middle + high
    if initial.kind.startswith("Box"):
        lower, upper = -exact(region.b[:n]), exact(region.b[n:])
        value = sum(a * (hi if a > 0 else lo) for a, lo, hi in zip(row, lower, upper, strict=True))
    elif initial.all_corners:
        value = max(initial.corners @ row)
    else:
        return None
    return Fraction(value), Fraction(value)


@dataclass(frozen=True)
class Affine:
    """`x[t] = M x0 + m` on the whole initial set, in fractions."""

    M: np.ndarray
    m: np.ndarray

    def supremum(self, initial: Initial, row: np.ndarray) -> tuple[Fraction, Fraction] | None:
        """Fractions between which `max row . x[t]` lies."""
        found = supremum(initial, row @ self.M)
        return None if found is None else (found[0] + row @ self.m, found[1] + row @ self.m)


def affine_steps(loop: Loop, initial: Initial, horizon: int) -> list[Affine] | None:
    """The states at `0 .. horizon` as functions of the first; None where a unit switches."""
    n = initial.region.dimension
    x = Affine(exact(np.eye(n)), exact(np.zeros(n)))
    found = [x]
    for t in range(horizon):
        A, B, c, lower, upper = (None if v is None else exact(v) for v in loop.at(t))
        y: Affine | None = x
        for W, b in loop.layers[:-1]:
            y = _clipped(_through(y, W, b), initial, exact(np.zeros(len(b))), None)
            if y is None:
                return None
        u = _through(y, *loop.layers[-1])
        if lower is not None:
            u = _clipped(u, initial, lower, upper)
        if u is None:
            return None
        x = Affine(A @ x.M + B @ u.M, A @ x.m + B @ u.m + c)
        found.append(x)
    return found


def _through(y: Affine, W: np.ndarray, b: np.ndarray) -> Affine:
    W, b = exact(W), exact(b)
    return Affine(W @ y.M, W @ y.m + b)


def _clipped(
    y: Affine, initial: Initial, lower: np.ndarray, upper: np.ndarray | None
) -> Affine | None:
    """`min(max(y, lower), upper)` where each entry is on one side of each bound throughout."""
    M, m = y.M.copy(), y.m.copy()
    for i in range(len(m)):
        above = supremum(initial, M[i])
        below = supremum(initial, -M[i])
        if above is None or below is None:
            return None
        most, least = above[1] + m[i], m[i] - below[1]
        if most <= lower[i]:
            M[i], m[i] = exact(np.zeros(M.shape[1])), lower[i]
        elif upper is not None and least >= upper[i]:
            M[i], m[i] = exact(np.zeros(M.shape[1])), upper[i]
        elif least < lower[i] or (upper is not None and most > upper[i]):
            return None
    return Affine(M, m)
