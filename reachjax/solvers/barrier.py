"""The barrier function of ellipsoids, and its minimisers: the points of the central path.

    f(y) = -log det R + <cost, y> - mu (log det Z(y) + sum_k log y_k - kappa / 2 sum_k y_k^2),

with the pencil `Z` of a goal, the matrix `R` that its unknowns are to enlarge, and `y_k > 0` for
multipliers that are not free: smooth and strictly convex. One more multiplier `t > 0`, at a price,
weighs `sum_i (1 - eta_i^2)`, so that there always is a point inside; a high price keeps it at the
size of `mu`. Without `kappa` there would be no minimiser where products that say nothing let
multipliers grow without bound (every neuron kept: the path of a quadrotor's first step was lost).
Every part of `Z` but `t`'s is a product of two rows, so a step needs Gram matrices of rows only.
All of this is numpy on the host.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.linalg import LinAlgError, cho_factor, cho_solve, solve_triangular

from reachjax.numerics.budget import ENDLESS, PACE, Budget, TimeOverError, clock
from reachjax.programs.presolve import CHUNK, THINNEST, Pencil
from reachjax.solvers.primal_dual import DAMPING

FROM_AFAR = (10.0, 3.0, 1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001, 3e-4, 1e-4, 1e-5)
"""Weights to begin with far from the path. Measured with every neuron kept: the first takes some 60
Newton steps and each of the others about ten; beginning at 0.1 takes 200."""

WEIGHTS = (1e-6, 1e-7, 1e-8)
"""Barrier weights `mu`, followed downwards. At the last one the logarithm of the volume is off by
that times the number of multipliers and rows, and by the damping of large multipliers (2e-6 where
they were 1400). Derivatives lose digits below it, as the matrices become singular: ten times
smaller, one of a thin ellipsoid was off by 7e-4, not by 1e-5."""

PRICES = (10.0, 100.0, 1000.0)
"""Prices of `t` that are tried, in units of the sizes of basis and successor. The trace of moments
stays below the price; with many neurons kept, 1 was seen to be too low by half."""

MOST_MULTIPLIERS = 1500
"""Multipliers beyond which no path is followed: a step costs their cube."""

NEWTON_STEPS = 200
"""Newton steps after which the centre counts as not found."""

CENTRED = 1e-8
"""The squared Newton decrement, in units of `mu`, at which it is found."""

STAGNANT = 1e-3
"""So it is below this one if another step does not halve it: rounding moves multipliers along
directions in which the function is flat."""

QUADRATIC = 0.05
"""The squared decrement, in units of `mu`, below which full Newton steps surely converge."""


class Centre(NamedTuple):
    """A point of the path.

    Attributes:
        y: the minimiser.
        hessian: of the barrier function there.
        weight: `mu`.
    """

    y: np.ndarray
    hessian: np.ndarray
    weight: float


class Barrier:
    """The function of this module, of `[multipliers, t, unknowns]` in one vector `y`.

    Args:
        pencil: of a goal of one program.
    """

    def __init__(self, pencil: Pencil):
        self.n, self.count = len(pencil.normal.columns), pencil.multipliers
        self.sizes, beyond = pencil.sizes, pencil.size - self.n
        self.signed = np.r_[np.flatnonzero(~pencil.normal.free), self.count]
        self.rows, self.left, self.right, sharing = pencil.terms
        none = sp.csr_array((1, len(self.left)))  # `t` has no pairs
        parts = sharing[: self.count], none, sharing[self.count :]
        self.sharing = sp.csr_array(sp.vstack(parts, format="csr"))
        self.unknowns = slice(self.count + 1, self.count + 1 + len(self.sizes))
        self.constant = pencil.constant(0)
        self.states = np.diag(np.r_[np.ones(self.n - 1), 1.0 - self.n, np.zeros(beyond)])
        self.unit = float(self.n * beyond)
        self.cost, signed = np.zeros((2, self.unknowns.stop))
        signed[self.signed] = 1.0
        self.spread = 1 + np.linalg.norm(self.weighted(signed), 2)
        work = len(self.cost) ** 3 / 3 + len(self.left) ** 2
        self._every, self._steps = max(1, int(PACE / 10 / work)), 0

    def weighted(self, y: np.ndarray) -> np.ndarray:
        """What `Z` changes by: linear."""
        weights = self.sharing.T @ y
        half = (weights[:, None] * self.rows[self.left]).T @ self.rows[self.right]
        return (half + half.T) / 2 + y[self.count] * self.states

    def paired(self, matrix: np.ndarray) -> np.ndarray:
        """The inner products of a symmetric matrix with what each variable but `t` adds to `Z`."""
        pairs = np.sum((self.rows @ matrix)[self.left] * self.rows[self.right], 1)
        return self.sharing @ pairs

    def inverse(self, y: np.ndarray) -> np.ndarray:
        """`Z^-1`, positive semidefinite whatever the rounding."""
        factor = triangular_inverse(self.constant + self.weighted(y))
        return factor.T @ factor

    def value(self, y: np.ndarray, weight: float) -> float:
        """The barrier's value, infinite outside."""
        if np.any(y[self.signed] <= 0):
            return np.inf
        value = self.cost @ y - weight * np.sum(np.log(y[self.signed]))
        value += DAMPING * weight / 2 * np.sum(y[: self.count] ** 2)
        blocks = [(each, block) for each, block, _ in self.blocks(y, weight)]
        for each, block in [*blocks, (weight, self.constant + self.weighted(y))]:
            try:
                factor = np.linalg.cholesky(block)
            except LinAlgError:
                return np.inf
            value -= 2 * each * np.sum(np.log(np.diag(factor)))
        return float(value)

    def derivatives(
        self, y: np.ndarray, weight: float, budget: Budget = ENDLESS
    ) -> tuple[np.ndarray, np.ndarray]:
        """Gradient and Hessian.

        Raises:
            TimeOverError: the time of the budget is over.
        """
        factor = triangular_inverse(self.constant + self.weighted(y))
        inverse = factor.T @ factor
        moved = inverse @ self.states @ inverse
        gradient = self.cost - weight * self.paired(inverse)
        hessian = weight * self._crossed(factor, budget)
        t, each = self.count, np.arange(self.count)
        gradient[t] -= weight * np.sum(self.states * inverse)
        hessian[t] = hessian[:, t] = weight * self.paired(moved)
        hessian[t, t] = weight * np.sum(self.states * moved)
        gradient[each] += DAMPING * weight * y[each]
        hessian[each, each] += DAMPING * weight
        gradient[self.signed] -= weight / y[self.signed]
        hessian[self.signed, self.signed] += weight / y[self.signed] ** 2
        for each, block, slopes in self.blocks(y, weight):
            factor = triangular_inverse(block)
            scaled = factor @ slopes @ factor.T
            flat = scaled.reshape(len(scaled), -1)
            gradient[self.unknowns] -= each * np.trace(scaled, axis1=1, axis2=2)
            hessian[self.unknowns, self.unknowns] += each * flat @ flat.T
        return gradient, hessian

    def _crossed(self, factor: np.ndarray, budget: Budget) -> np.ndarray:
        """`<T_k, W T_l W>` of the terms `T_k` for `W = factor' factor`."""
        half = self.rows @ factor.T
        gram = half @ half.T
        by_left, by_right = gram[:, self.left], gram[:, self.right]
        shared = np.zeros((len(self.cost), len(self.left)))
        for first in range(0, len(self.left), CHUNK):
            if first:
                budget.require()
            here = slice(first, first + CHUNK)
            crossed = by_left[self.left[here]] * by_right[self.right[here]]
            crossed += by_right[self.left[here]] * by_left[self.right[here]]
            shared += self.sharing[:, here] @ crossed
        return (self.sharing @ shared.T) / 2

    def enlarged(self, y: np.ndarray) -> np.ndarray:
        """`R`, whose determinant is to be large."""
        return np.tensordot(y[self.unknowns], self.sizes, 1)

    def blocks(
        self, y: np.ndarray, weight: float
    ) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
        """`R`, which is not to be flat, and what keeps it from being too thin.

        Of each its weight, itself, and its derivative in each of the unknowns.
        """
        enlarged = self.enlarged(y)
        yield 1.0, enlarged, self.sizes
        yield weight, np.eye(len(enlarged)) / THINNEST - enlarged, -self.sizes

    def inside(self) -> np.ndarray:
        """A point inside, wherever the solution is: a large `t`, all else small."""
        y, t = np.zeros_like(self.cost), 1 / (2 * self.n)
        y[self.signed] = t / (4 * self.spread)
        y[self.count] = t
        y[self.unknowns] = np.trace(self.sizes, axis1=1, axis2=2) * np.sqrt(t) / (4 * self.n)
        return y

    def near(
        self, multipliers: np.ndarray, unknowns: np.ndarray, weight: float
    ) -> np.ndarray | None:
        """A point inside near a solution: smaller unknowns, and a little of `t`.

        Args:
            multipliers: of the normal program.
            unknowns: of its pencil.
            weight: `mu`.
        """
        for t in 10 * weight * 4.0 ** np.arange(8):
            shrink = 1 - self.n * t
            if shrink <= 0.5:
                break
            y = np.r_[shrink * multipliers, t, np.sqrt(shrink) * unknowns]
            y[self.signed] = np.maximum(y[self.signed], t / (4 * self.spread))
            if np.isfinite(self.value(y, weight)):
                return y
        return None

    def path_end(
        self, start: Callable[[], np.ndarray | None], weights: tuple[float, ...]
    ) -> Centre | None:
        """The last centre that is reached, from one weight to the next; None if there is none.

        At too low a price `t` stays, and what is found is smaller than the relaxation itself
        allows.
        """
        budget = clock()
        for price in PRICES if self.count <= MOST_MULTIPLIERS else ():
            self.cost[self.count] = price * self.unit
            y, found = None if budget.late else start(), None
            if y is None:
                return None
            for weight in weights:
                centre = self.minimiser(y, weight, budget)
                if centre is None:
                    break
                found, y = Centre(*centre, weight), centre[0]
            # it bounds alone the columns that no product does: of each, the moment takes mu / t
            unit = (1 + self.n) * found.weight / self.cost[self.count] if found else np.inf
            if found is None or found.y[self.count] <= unit:
                return found
        return None

    def minimiser(
        self, y: np.ndarray, weight: float, budget: Budget
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Newton's method from a point inside: the minimiser and the Hessian there.

        The clock is asked each tenth of a second.
        """
        value, before = self.value(y, weight), np.inf
        for _ in range(NEWTON_STEPS if np.isfinite(value) else 0):
            self._steps += 1
            if self._steps % self._every == 0 and budget.late:
                return None
            try:
                gradient, hessian = self.derivatives(y, weight, budget)
            except TimeOverError:
                return None
            step = -solved(hessian, gradient)
            decrement = -float(gradient @ step)
            stagnant = before / 2 < decrement <= STAGNANT * weight
            if decrement <= CENTRED * weight or stagnant:
                better = y + step  # by the square of the decrement; the Hessian is to match
                y = better if np.isfinite(self.value(better, weight)) else y
                return y, self.derivatives(y, weight)[1]
            if not np.isfinite(decrement):
                return None
            length, near = 1.0, decrement <= QUADRATIC * weight
            # near the centre, differences of values are not seen: any point inside will do
            while not (
                (after := self.value(y + length * step, weight)) <= value - length * decrement / 4
                or (near and np.isfinite(after))
            ):
                length /= 2
                if length < 1e-10:
                    return None
            y, value, before = y + length * step, after, decrement
        return None


def solved(hessian: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """`hessian^-1 vector`, scaled to a unit diagonal and regularised at rounding level."""
    scale = 1 / np.sqrt(np.diag(hessian))
    matrix = hessian * np.outer(scale, scale)
    for shift in 1e-14 * 100.0 ** np.arange(4):
        try:
            factor = cho_factor(matrix + shift * np.eye(len(matrix)), check_finite=False)
            break
        except LinAlgError:
            continue
    else:
        return np.full(len(vector), np.nan)
    solution = cho_solve(factor, scale * vector, check_finite=False)
    residual = scale * vector - matrix @ solution  # one step of refinement
    return scale * (solution + cho_solve(factor, residual, check_finite=False))


def triangular_inverse(matrix: np.ndarray) -> np.ndarray:
    """The inverse of the Cholesky factor."""
    factor = np.linalg.cholesky(matrix)
    return solve_triangular(factor, np.eye(len(matrix)), lower=True, check_finite=False)
