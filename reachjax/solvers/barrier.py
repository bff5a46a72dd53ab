"""The barrier function of minimum-volume ellipsoids.

    f(y) = -log det R + price t - mu (log det Z + log det(bound - R) + sum_k log y_k
           - kappa / 2 sum_k y_k^2),

with `Z = [e e' - sum_k y_k G_k, V'; V, I]` and `V = R W + r e'`: smooth and strictly convex where
the program has a point inside, and it always has. One more multiplier `t >= 0`, at a price, weighs
`sum_i (1 - eta_i^2)`; a high price keeps it at the size of `mu`. Without `kappa` there would be no
minimiser where products that say nothing let multipliers grow without bound (every neuron kept: the
path of a quadrotor's first step was lost). Every part of `Z` but `t`'s is a product of two rows, so
a step needs Gram matrices of rows only. Everything here is numpy on the host.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.linalg import LinAlgError, solve_triangular

from reachjax.sets import NormalForm
from reachjax.solvers.compact import THINNEST, CompactProgram
from reachjax.solvers.pairs import Pairs

DAMPING = 1e-4
"""`kappa`, as in `primal_dual`."""


class Barrier:
    """The function of this module, of `[multipliers, t, R, r]` in one vector `y`.

    Multipliers of either sign and weights of facts are those of the compact program, in units in
    which the successor varies by one. Where a form is given up to its size `f`, it is a function of
    `[multipliers, t, f]`: `R = f A`, `r = f b`, and `log f` takes the place of `log det R`.

    Args:
        program: whose objective rows are the successor's.
        given: the form; free if it is None.
    """

    def __init__(self, program: CompactProgram, given: NormalForm | None = None):
        self.program = program = program.with_units(program.widths)
        self.q, self.n = program.objective.shape
        self.count = len(program.kept)
        if given is None:
            self.forms, self.sizes = _free_forms(self.q)
        else:
            self.forms, self.sizes = _sizes_of(program.to_unit_box(given))
        self.signed = np.r_[np.flatnonzero(~program.free), self.count]
        self.size = slice(self.count + 1, self.count + 1 + len(self.sizes))
        self.terms = self._pairs()
        self.states = np.diag(np.r_[np.ones(self.n - 1), 1.0 - self.n, np.zeros(self.q)])
        self.constant = np.diag(np.r_[np.zeros(self.n - 1), 1.0, np.ones(self.q)])
        self.price = 1.0
        together = np.zeros(self.size.stop)
        together[self.signed] = 1.0
        self.spread = 1 + np.linalg.norm(self.weighted(together), 2)

    def _pairs(self) -> Pairs:
        """All of `Z` but `t`: products of facts, `W`, `e` and unit rows for `A x+ + b`."""
        q, n, generators = self.q, self.n, self.program.generators
        m, (A, b) = len(generators.rows), self.forms
        rows = np.zeros((m + q + 1 + q, n + q))
        rows[:m, :n], rows[m : m + q, :n] = generators.rows, self.program.objective
        rows[m + q, n - 1] = 1.0
        rows[m + q + 1 :, n:] = np.eye(q)
        # [0, V'; V, 0] = 2 sum_i sym(u_i' V_i)
        weights = 2 * np.concatenate([A, b[:, :, None]], axis=2)
        k, i, j = np.nonzero(weights)
        extra = sp.csr_array(
            (weights[k, i, j], (k + 1, np.arange(len(k)))), shape=(1 + len(A), len(k))
        )
        return Pairs(
            rows=rows,
            left=np.r_[generators.left, m + q + 1 + i],
            right=np.r_[generators.right, m + j],
            sharing=sp.csr_array(sp.block_diag([-generators.sharing, extra], format="csr")),
        )

    def weighted(self, y: np.ndarray) -> np.ndarray:
        """What `Z` changes by: linear."""
        return self.terms.weighted(y) + y[self.count] * self.states

    def schur(self, y: np.ndarray) -> np.ndarray:
        """`Z`."""
        return self.constant + self.weighted(y)

    def inverse(self, y: np.ndarray) -> np.ndarray:
        """`Z^-1`, positive semidefinite whatever the rounding."""
        factor = inverse_cholesky(self.schur(y))
        return factor.T @ factor

    def form(self, y: np.ndarray) -> NormalForm:
        """`R` and `r`."""
        return NormalForm(*(np.tensordot(y[self.size], part, 1) for part in self.forms))

    def vector(self, cotangent: NormalForm) -> np.ndarray:
        """The gradient of `<cotangent, (A, b)>` in the variables."""
        return np.r_[
            np.zeros(self.count + 1), self._paired(self.program.cotangent_to_unit_box(cotangent))
        ]

    def _paired(self, form: NormalForm) -> np.ndarray:
        """The inner products of a form with those of each variable of size."""
        return np.tensordot(self.forms.A, form.A, 2) + self.forms.b @ form.b

    def unscaled(self, y: np.ndarray, count: int) -> tuple[np.ndarray, NormalForm]:
        """Multipliers `(count,)` of the whole program, and `A` and `b`; linear."""
        multipliers = np.zeros(count)
        multipliers[self.program.kept] = y[: self.count] / self.program.norms
        return multipliers, self.program.from_unit_box(self.form(y))

    def whole(self, moments: np.ndarray, size: int) -> np.ndarray:
        """Moments over the columns kept, as those over all `size` columns and the successor."""
        used = np.r_[self.program.columns, size + np.arange(self.q)]
        whole = np.zeros((size + self.q, size + self.q))
        whole[np.ix_(used, used)] = moments
        return whole

    def inside(self) -> np.ndarray:
        """A point inside, wherever the solution is: a large `t`, all else small."""
        y, t = np.zeros(self.size.stop), 1 / (2 * self.n)
        y[self.signed] = t / (4 * self.spread)
        y[self.count] = t
        y[self.size] = np.trace(self.sizes, axis1=1, axis2=2) * np.sqrt(t) / (4 * self.n)
        return y

    def near(self, multipliers: np.ndarray, form: NormalForm, weight: float) -> np.ndarray | None:
        """A point inside near a solution: a smaller `V`, and a little of `t`.

        Args:
            multipliers: `(K,)`, of the whole program.
            form: `A` and `b` of the ellipsoid.
            weight: `mu`.
        """
        multipliers = self.program.norms * multipliers[self.program.kept]
        squares = (self.forms.A**2).sum(axis=(1, 2)) + (self.forms.b**2).sum(axis=1)
        size = self._paired(self.program.to_unit_box(form)) / squares
        for t in 10 * weight * 4.0 ** np.arange(8):
            shrink = 1 - self.n * t
            if shrink <= 0.5:
                break
            y = np.r_[shrink * multipliers, t, np.sqrt(shrink) * size]
            y[self.signed] = np.maximum(y[self.signed], t / (4 * self.spread))
            if np.isfinite(self.value(y, weight)):
                return y
        return None

    def _blocks(self, y: np.ndarray, weight: float):
        """The small matrices under a logarithm of a determinant: weight, itself, its sign."""
        block = np.tensordot(y[self.size], self.sizes, 1)
        yield 1.0, block, 1.0
        yield weight, np.eye(len(block)) / THINNEST - block, -1.0

    def value(self, y: np.ndarray, weight: float) -> float:
        """Infinite outside."""
        if np.any(y[self.signed] <= 0):
            return np.inf
        value = self.price * y[self.count] - weight * np.sum(np.log(y[self.signed]))
        value += DAMPING * weight / 2 * np.sum(y[: self.count] ** 2)
        blocks = [(each, block) for each, block, _ in self._blocks(y, weight)]
        for each, block in [*blocks, (weight, self.schur(y))]:
            try:
                factor = np.linalg.cholesky(block)
            except LinAlgError:
                return np.inf
            value -= 2 * each * np.sum(np.log(np.diag(factor)))
        return float(value)

    def derivatives(self, y: np.ndarray, weight: float) -> tuple[np.ndarray, np.ndarray]:
        """Gradient and Hessian."""
        factor = inverse_cholesky(self.schur(y))
        inverse = factor.T @ factor
        moved = inverse @ self.states @ inverse
        gradient = -weight * self.terms.paired(inverse)
        hessian = weight * self.terms.hessian(factor)
        t = self.count
        gradient[t] = self.price - weight * np.sum(self.states * inverse)
        hessian[t] = hessian[:, t] = weight * self.terms.paired(moved)
        hessian[t, t] = weight * np.sum(self.states * moved)
        each = np.arange(self.count)
        gradient[each] += DAMPING * weight * y[each]
        hessian[each, each] += DAMPING * weight
        gradient[self.signed] -= weight / y[self.signed]
        hessian[self.signed, self.signed] += weight / y[self.signed] ** 2
        for each, block, sign in self._blocks(y, weight):
            factor = inverse_cholesky(block)
            scaled = factor @ self.sizes @ factor.T
            flat = scaled.reshape(len(scaled), -1)
            gradient[self.size] -= sign * each * np.trace(scaled, axis1=1, axis2=2)
            hessian[self.size, self.size] += each * flat @ flat.T
        return gradient, hessian


def inverse_cholesky(matrix: np.ndarray) -> np.ndarray:
    """The inverse of the Cholesky factor."""
    factor = np.linalg.cholesky(matrix)
    return solve_triangular(factor, np.eye(len(matrix)), lower=True, check_finite=False)


def _free_forms(q: int) -> tuple[NormalForm, np.ndarray]:
    """`A` and `b` of each variable of size, `A` symmetric; and what `log det` is taken of."""
    pairs = np.transpose(np.triu_indices(q))
    A, b = np.zeros((len(pairs) + q, q, q)), np.zeros((len(pairs) + q, q))
    for k, (i, j) in enumerate(pairs):
        A[k, i, j] = A[k, j, i] = 1.0
    b[len(pairs) :] = np.eye(q)
    return NormalForm(A, b), A


def _sizes_of(given: NormalForm) -> tuple[NormalForm, np.ndarray]:
    """The same for a given form, of one variable."""
    largest = np.linalg.norm(given.A, 2)
    unit = max(largest, np.linalg.norm(given.b))
    form = NormalForm(given.A[None] / unit, given.b[None] / unit)
    return form, np.full((1, 1, 1), largest / unit)
