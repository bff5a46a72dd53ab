"""Barrier functions of the programs, whose minimisers are the points of the central path.

    f(y) = <cost, y> - sum_j w_j log det S_j(y)
           - mu (log det Z(y) + sum_k log y_k - kappa / 2 sum_k y_k^2),

with `Z` affine in `y` and positive definite, and `y_k > 0` for multipliers that are not free:
smooth and strictly convex. One more multiplier `t > 0`, at a price, weighs `sum_i (1 - eta_i^2)`,
so that there always is a point inside; a high price keeps it at the size of `mu`. Without `kappa`
there would be no minimiser where products that say nothing let multipliers grow without bound
(every neuron kept: the path of a quadrotor's first step was lost). Every part of `Z` but `t`'s is a
product of two rows, so a step needs Gram matrices of rows only. All of this is numpy on the host.
"""

from __future__ import annotations

import abc
from collections.abc import Iterator

import numpy as np
import scipy.sparse as sp
from scipy.linalg import LinAlgError, solve_triangular

from reachjax.programs.compact import CompactProgram
from reachjax.programs.pairs import Pairs
from reachjax.solvers.primal_dual import DAMPING


class AbstractBarrier(abc.ABC):
    """The function of this module, of `[multipliers, t, others]` in one vector `y`.

    Multipliers of either sign and weights of facts are those of the compact program.

    Args:
        program: with `n` columns and `K` multipliers.
        others: what the other variables add to `Z` `(N, N)`, whose first `n` columns are the
            program's.
        constant: `(N, N)`, `Z` at zero.
        unit: of the price of `t`: the size that the trace of the moments may have.
    """

    def __init__(self, program: CompactProgram, others: Pairs, constant: np.ndarray, unit: float):
        self.program, self.unit = program, unit
        self.n, self.count = program.objective.shape[1], len(program.kept)
        self.signed = np.r_[np.flatnonzero(~program.free), self.count]
        self.terms = _together(program.generators, others)
        self.others = slice(self.count + 1, self.terms.size)
        self.constant = constant
        beyond = len(constant) - self.n
        self.states = np.diag(np.r_[np.ones(self.n - 1), 1.0 - self.n, np.zeros(beyond)])
        self.cost = np.zeros(self.others.stop)
        signed = np.zeros(self.others.stop)
        signed[self.signed] = 1.0
        self.spread = 1 + np.linalg.norm(self.weighted(signed), 2)

    @abc.abstractmethod
    def inside(self) -> np.ndarray:
        """A point inside, wherever the solution is."""

    def blocks(
        self, y: np.ndarray, weight: float
    ) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
        """The `S_j` of the other variables: weight, itself, and its derivative in each of them."""
        yield from ()

    @property
    def price(self) -> float:
        """Of `t`, in units of the trace that the moments may have."""
        return self.cost[self.count] / self.unit

    @price.setter
    def price(self, price: float) -> None:
        self.cost[self.count] = price * self.unit

    def weighted(self, y: np.ndarray) -> np.ndarray:
        """What `Z` changes by: linear."""
        return self.terms.weighted(y) + y[self.count] * self.states

    def schur(self, y: np.ndarray) -> np.ndarray:
        """`Z`."""
        return self.constant + self.weighted(y)

    def inverse(self, y: np.ndarray) -> np.ndarray:
        """`Z^-1`, positive semidefinite whatever the rounding."""
        factor = triangular_inverse(self.schur(y))
        return factor.T @ factor

    def multipliers(self, y: np.ndarray, count: int) -> np.ndarray:
        """Multipliers `(count,)` of the whole program; linear."""
        multipliers = np.zeros(count)
        multipliers[self.program.kept] = y[: self.count] / self.program.norms
        return multipliers

    def value(self, y: np.ndarray, weight: float) -> float:
        """Infinite outside."""
        if np.any(y[self.signed] <= 0):
            return np.inf
        value = self.cost @ y - weight * np.sum(np.log(y[self.signed]))
        value += DAMPING * weight / 2 * np.sum(y[: self.count] ** 2)
        blocks = [(each, block) for each, block, _ in self.blocks(y, weight)]
        for each, block in [*blocks, (weight, self.schur(y))]:
            try:
                factor = np.linalg.cholesky(block)
            except LinAlgError:
                return np.inf
            value -= 2 * each * np.sum(np.log(np.diag(factor)))
        return float(value)

    def derivatives(self, y: np.ndarray, weight: float) -> tuple[np.ndarray, np.ndarray]:
        """Gradient and Hessian."""
        factor = triangular_inverse(self.schur(y))
        inverse = factor.T @ factor
        moved = inverse @ self.states @ inverse
        gradient = self.cost - weight * self.terms.paired(inverse)
        hessian = weight * self.terms.hessian(factor)
        t, each = self.count, np.arange(self.count)
        gradient[t] -= weight * np.sum(self.states * inverse)
        hessian[t] = hessian[:, t] = weight * self.terms.paired(moved)
        hessian[t, t] = weight * np.sum(self.states * moved)
        gradient[each] += DAMPING * weight * y[each]
        hessian[each, each] += DAMPING * weight
        gradient[self.signed] -= weight / y[self.signed]
        hessian[self.signed, self.signed] += weight / y[self.signed] ** 2
        for each, block, slopes in self.blocks(y, weight):
            factor = triangular_inverse(block)
            scaled = factor @ slopes @ factor.T
            flat = scaled.reshape(len(scaled), -1)
            gradient[self.others] -= each * np.trace(scaled, axis1=1, axis2=2)
            hessian[self.others, self.others] += each * flat @ flat.T
        return gradient, hessian


def _together(generators: Pairs, others: Pairs) -> Pairs:
    """`-sum_k y_k G_k` and what the other variables add; `t` has no pairs."""
    m, n = generators.rows.shape
    rows = np.zeros((m + len(others.rows), others.rows.shape[1]))
    rows[:m, :n], rows[m:] = generators.rows, others.rows
    t = sp.csr_array((1, 0))
    return Pairs(
        rows=rows,
        left=np.r_[generators.left, m + others.left],
        right=np.r_[generators.right, m + others.right],
        sharing=sp.csr_array(sp.block_diag([-generators.sharing, t, others.sharing])),
    )


def triangular_inverse(matrix: np.ndarray) -> np.ndarray:
    """The inverse of the Cholesky factor."""
    factor = np.linalg.cholesky(matrix)
    return solve_triangular(factor, np.eye(len(matrix)), lower=True, check_finite=False)
