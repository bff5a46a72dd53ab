"""Scaling by powers of two, which rounds nothing, so that numbers of any size can be compared.

A linear-programming code drops coefficients below 1e-9 and takes numbers from 1e20 on for infinite;
squares overflow above 1e154 and vanish below 1e-162. What is scaled here has rows of a length about
1, and coordinates of a size about 1 on the polytope. What underflows all the same is smaller than
`TINY` beside these ones, and is accounted for where bounds are formed.
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
from jaxtyping import Float, Int

from reachjax.numerics.rounding import TINY

LARGEST_FLOAT = float(np.finfo(float).max)


def exponents(rows: Float[np.ndarray, "*m n"]) -> Int[np.ndarray, "*m"]:
    """Whole numbers `e` with the largest entry of each row in `[2^e, 2^(e+1))`; 0 for zeros."""
    largest = abs(rows).max(axis=-1)
    return np.where(largest > 0, np.frexp(largest)[1] - 1, 0)


def lengths(rows: Float[np.ndarray, "m n"]) -> Float[np.ndarray, " m"]:
    """The norm of each row, whose squares may overflow or vanish."""
    by = exponents(rows)
    with np.errstate(over="ignore"):
        return np.ldexp(np.linalg.norm(np.ldexp(rows, -by[:, None]), axis=1), by)


def upwards(
    numbers: Float[np.ndarray, " m"], by: Int[np.ndarray, " m"] | int
) -> Float[np.ndarray, " m"]:
    """`numbers * 2^by`, rounded up where it leaves the range of floats, to infinity at last.

    What is left between 0 and `TINY` in size is rounded as well: JAX would take it for zero.
    """
    with np.errstate(over="ignore", under="ignore"):
        values = np.maximum(np.ldexp(numbers, by), -LARGEST_FLOAT)
    values = np.where(numbers > 0, np.maximum(values, TINY), values)
    return np.where((values < 0) & (values > -TINY), 0.0, values)


def balanced(
    A: Float[np.ndarray, "m n"], b: Float[np.ndarray, " m"], inner: bool = False
) -> tuple[Float[np.ndarray, "m n"], Float[np.ndarray, " m"]]:
    """Rows `A x <= b` whose largest coefficients are in `[1, 2)`, without any error.

    A row that spans more than the range of floats is scaled as far as no coefficient is lost.
    Offsets that leave that range are rounded up, or down for a set that is `inner`.
    """
    by = exponents(A)
    smallest = np.where(A == 0, np.inf, abs(A)).min(axis=1)
    by = np.minimum(by, np.frexp(smallest)[1] - 1 + 1022)
    return np.ldexp(A, -by[:, None]), -upwards(-b, -by) if inner else upwards(b, -by)


class Balanced(NamedTuple):
    """The polytope `A x <= b` in coordinates `x = 2^columns y`, row `i` times `2^rows[i]`.

    Attributes:
        A: `(m, n)`, rows whose largest coefficients are in `[1, 2)`.
        b: `(m,)`, rounded up. A facet so far away that it is no number is `0 x <= 0` instead.
        rows: `(m,)`.
        columns: `(n,)`.
    """

    A: Float[np.ndarray, "m n"]
    b: Float[np.ndarray, " m"]
    rows: Int[np.ndarray, " m"]
    columns: Int[np.ndarray, " n"]

    @classmethod
    def of(
        cls,
        A: Float[np.ndarray, "m n"],
        b: Float[np.ndarray, " m"],
        columns: Int[np.ndarray, " n"] | None = None,
    ) -> Self:
        """A polytope balanced, in given coordinates or in those that its offsets suggest."""
        columns = _sizes(A, b) if columns is None else columns
        logs = _logarithms(A)
        rows = -np.where(np.isfinite(logs), logs + columns, -np.inf).max(axis=1).astype(int)
        scaled = np.ldexp(A, rows[:, None] + columns)
        offsets = upwards(b, rows)
        near = np.isfinite(offsets)
        return cls(scaled * near[:, None], np.where(near, offsets, 0.0), rows, columns)

    @property
    def near(self) -> np.ndarray:
        """The facets that are not too far away to be told, `(m,)`."""
        return np.any(self.A != 0, axis=1)

    @property
    def of_one_size(self) -> Int[np.ndarray, " n"]:
        """Coordinates in which all are taken to be of the size that the farthest facet has."""
        sizes = np.where(self.b == 0, -np.inf, np.frexp(self.b)[1] - 1.0)
        largest = (sizes[:, None] + self.columns + 0.0)[self.A != 0].max(initial=-np.inf)
        return np.full(len(self.columns), int(largest) if np.isfinite(largest) else 0)

    def facing(
        self, directions: Float[np.ndarray, "k n"]
    ) -> tuple[Float[np.ndarray, "k n"], Int[np.ndarray, " k"]]:
        """Directions in these coordinates, times a power of two, and the exponents to undo it."""
        logs = _logarithms(directions)
        by = np.where(np.isfinite(logs), logs + self.columns, -np.inf).max(axis=1)
        by = np.where(np.isfinite(by), by, 0).astype(int)
        return np.ldexp(directions, self.columns - by[:, None]), by


def _logarithms(A: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "m n"]:
    return np.where(A == 0, -np.inf, np.frexp(A)[1] - 1.0)


def _sizes(A: Float[np.ndarray, "m n"], b: Float[np.ndarray, " m"]) -> Int[np.ndarray, " n"]:
    """A guess of each coordinate's size on the polytope, as a power of two.

    Facets with `A[i, j] > 0` bound `x_j` from above by about `b_i / A[i, j]`, those of the other
    sign from below; of each sign the closest counts, of both the farther one. Facets through the
    origin say how large a coordinate is beside those that are known. A guess is not proved.
    """
    logs, known = _logarithms(A), np.full(A.shape[1], -np.inf)
    offsets = np.where(b == 0, -np.inf, np.frexp(b)[1] - 1.0)
    for _ in known:
        others = np.where(np.isfinite(logs), logs + known, -np.inf).max(axis=1)
        sizes = np.where(np.isfinite(offsets), offsets, others)
        told = np.isfinite(sizes)[:, None] & (A != 0)
        away = np.subtract(sizes[:, None], logs, out=np.zeros(A.shape), where=told)
        sides = [np.where(told & side, away, np.inf).min(axis=0) for side in (A > 0, A < 0)]
        found = np.max([np.where(np.isfinite(side), side, -np.inf) for side in sides], axis=0)
        new = np.where(np.isfinite(known), known, found)
        if np.array_equal(new, known):
            break
        known = new
    rest = known[np.isfinite(known)].max(initial=-np.inf)
    return np.where(np.isfinite(known), known, rest if np.isfinite(rest) else 0.0).astype(int)
