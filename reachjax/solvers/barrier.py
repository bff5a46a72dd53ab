"""The barrier function of ellipsoids, whose minimisers are the points of the central path.

    f(y) = -log det R + <cost, y> - mu (log det Z(y) + sum_k log y_k - kappa / 2 sum_k y_k^2),
    Z = [e e' - sum_k y_k G_k, V'; V, I],    V = R W + r e',

with `y_k > 0` for multipliers that are not free, in units in which the successor `W` varies by one:
smooth and strictly convex. One more multiplier `t > 0`, at a price, weighs `sum_i (1 - eta_i^2)`,
so that there always is a point inside; a high price keeps it at the size of `mu`. Without `kappa`
there would be no minimiser where products that say nothing let multipliers grow without bound
(every neuron kept: the path of a quadrotor's first step was lost). Every part of `Z` but `t`'s is a
product of two rows, so a step needs Gram matrices of rows only. All of this is numpy on the host.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy.sparse as sp
from scipy.linalg import LinAlgError, solve_triangular

from reachjax.programs.generators import Generators
from reachjax.programs.presolve import THINNEST, NormalProgram
from reachjax.sets import NormalForm
from reachjax.solvers.primal_dual import DAMPING


class EllipsoidBarrier:
    """The function of this module, of `[multipliers, t, R, r]` in one vector `y`.

    Where a form is given up to its size `f`, it is a function of `[multipliers, t, f]`: `R = f A`,
    `r = f b`, and `log f` takes the place of `log det R`.

    Multipliers of either sign and weights of facts are those of the normal program.

    Args:
        program: whose objective rows are the successor's.
        given: the form; free if it is None.
    """

    def __init__(self, program: NormalProgram, given: NormalForm | None = None):
        program = program.with_units(program.widths)
        self.q, n = program.objective.shape
        if given is None:
            self.forms, self.sizes = _free_forms(self.q)
        else:
            self.forms, self.sizes = _sizes_of(program.to_unit_box(given))
        self.program, self.unit = program, float(n * self.q)
        self.n, self.count = n, len(program.kept)
        self.signed = np.r_[np.flatnonzero(~program.free), self.count]
        self.terms = _together(program.generators, _schur_terms(program.objective, self.forms))
        self.others = slice(self.count + 1, self.terms.size)
        self.constant = np.diag(np.r_[np.zeros(n - 1), 1.0, np.ones(self.q)])
        self.states = np.diag(np.r_[np.ones(n - 1), 1.0 - n, np.zeros(self.q)])
        self.cost = np.zeros(self.others.stop)
        signed = np.zeros(self.others.stop)
        signed[self.signed] = 1.0
        self.spread = 1 + np.linalg.norm(self.weighted(signed), 2)

    @property
    def price(self) -> float:
        """The price of `t`, in units of the trace that the moments may have."""
        return self.cost[self.count] / self.unit

    @price.setter
    def price(self, price: float) -> None:
        self.cost[self.count] = price * self.unit

    def weighted(self, y: np.ndarray) -> np.ndarray:
        """What `Z` changes by: linear."""
        return self.terms.weighted(y) + y[self.count] * self.states

    def schur(self, y: np.ndarray) -> np.ndarray:
        """The Schur complement `Z`."""
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
        """The barrier's value, infinite outside."""
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

    def form(self, y: np.ndarray) -> NormalForm:
        """`R` and `r`."""
        return NormalForm(*(np.tensordot(y[self.others], part, 1) for part in self.forms))

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
        return self.multipliers(y, count), self.program.from_unit_box(self.form(y))

    def whole(self, moments: np.ndarray, size: int) -> np.ndarray:
        """Moments over the columns kept, as those over all `size` columns and the successor."""
        used = np.r_[self.program.columns, size + np.arange(self.q)]
        whole = np.zeros((size + self.q, size + self.q))
        whole[np.ix_(used, used)] = moments
        return whole

    def _size(self, y: np.ndarray) -> np.ndarray:
        """What the determinant is taken of."""
        return np.tensordot(y[self.others], self.sizes, 1)

    def inside(self) -> np.ndarray:
        """A point inside, wherever the solution is: a large `t`, all else small."""
        y, t = np.zeros(self.others.stop), 1 / (2 * self.n)
        y[self.signed] = t / (4 * self.spread)
        y[self.count] = t
        y[self.others] = np.trace(self.sizes, axis1=1, axis2=2) * np.sqrt(t) / (4 * self.n)
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

    def blocks(
        self, y: np.ndarray, weight: float
    ) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
        """`R` (or `f`), which is not to be flat, and what keeps it from being too thin.

        Of each its weight, itself, and its derivative in each of the other variables.
        """
        size = self._size(y)
        yield 1.0, size, self.sizes
        yield weight, np.eye(len(size)) / THINNEST - size, -self.sizes


def _together(generators: Generators, others: Generators) -> Generators:
    """`-sum_k y_k G_k` and what the other variables add; `t` has no pairs."""
    m, n = generators.rows.shape
    rows = np.zeros((m + len(others.rows), others.rows.shape[1]))
    rows[:m, :n], rows[m:] = generators.rows, others.rows
    t = sp.csr_array((1, 0))
    return Generators(
        rows=rows,
        left=np.r_[generators.left, m + others.left],
        right=np.r_[generators.right, m + others.right],
        sharing=sp.csr_array(sp.block_diag([-generators.sharing, t, others.sharing])),
    )


def triangular_inverse(matrix: np.ndarray) -> np.ndarray:
    """The inverse of the Cholesky factor."""
    factor = np.linalg.cholesky(matrix)
    return solve_triangular(factor, np.eye(len(matrix)), lower=True, check_finite=False)


def _schur_terms(W: np.ndarray, forms: NormalForm) -> Generators:
    """`[0, V'; V, 0] = 2 sum_i sym(u_i' V_i)` of each form: rows `W`, `e` and unit rows `u_i`."""
    q, n = W.shape
    rows = np.zeros((q + 1 + q, n + q))
    rows[:q, :n], rows[q, n - 1], rows[q + 1 :, n:] = W, 1.0, np.eye(q)
    weights = 2 * np.concatenate([forms.A, forms.b[:, :, None]], axis=2)
    k, i, j = np.nonzero(weights)
    shares = weights[k, i, j], (k, np.arange(len(k)))
    sharing = sp.csr_array(shares, shape=(len(weights), len(k)))
    return Generators(rows, left=q + 1 + i, right=j, sharing=sharing)


def _free_forms(q: int) -> tuple[NormalForm, np.ndarray]:
    """`A` and `b` of each variable of size, `A` symmetric; and what `log det` is taken of."""
    pairs = np.transpose(np.triu_indices(q))
    A, b = np.zeros((len(pairs) + q, q, q)), np.zeros((len(pairs) + q, q))
    for k, (i, j) in enumerate(pairs):
        A[k, i, j] = A[k, j, i] = 1.0
    b[len(pairs) :] = np.eye(q)
    return NormalForm(A, b), A


def _sizes_of(given: NormalForm) -> tuple[NormalForm, np.ndarray]:
    """The sizes for a given form, of one variable."""
    largest = np.linalg.norm(given.A, 2)
    unit = max(largest, np.linalg.norm(given.b))
    form = NormalForm(given.A[None] / unit, given.b[None] / unit)
    return form, np.full((1, 1, 1), largest / unit)
