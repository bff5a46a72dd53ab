"""The barrier function of minimum-volume ellipsoids, and Newton's method for it.

    f(y) = -log det R - mu log det Z - mu sum_k log y_k,    Z = [e e' - sum_k y_k G_k, V'; V, I],

with `V = R W + r e'`: smooth and strictly convex where the program has a point inside, and it
always has. One more multiplier `t >= 0`, at a price, weighs `sum_i (1 - eta_i^2)`; the price keeps
it at the size of `mu`. Everything here is numpy on the host.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, solve_triangular

from reachjax.sets import NormalForm
from reachjax.solvers.compact import THINNEST, CompactProgram

STEPS = 60
"""Newton steps after which the centre counts as not found."""

CENTRED = 1e-8
"""The squared Newton decrement, in units of `mu`, at which it is found."""

QUADRATIC = 0.05
"""The squared decrement, in units of `mu`, below which full Newton steps surely converge."""


class Barrier:
    """The function of this module, of `[multipliers, t, R, r]` in one vector `y`.

    Multipliers of either sign and weights of facts are those of the compact program, in units in
    which the successor varies by one.
    """

    def __init__(self, program: CompactProgram):
        self.program = program = program.with_units(program.widths)
        W = program.objective
        self.q, self.n = q, n = W.shape
        self.count = len(program.kept)
        self.pairs = np.triu_indices(q)
        N, sides = n + q, len(self.pairs[0])
        size = self.count + 1 + sides + q
        self.R = slice(self.count + 1, self.count + 1 + sides)
        self.signed = np.r_[np.flatnonzero(~program.free), self.count]
        terms = np.zeros((size, N, N))
        terms[: self.count, :n, :n] = -program.generators.T.toarray().reshape(-1, n, n)
        terms[self.count, :n, :n] = np.diag(np.r_[np.ones(n - 1), 1.0 - n])
        self.symmetric = np.zeros((sides, q, q))
        for k, (i, j) in enumerate(zip(*self.pairs, strict=True)):
            self.symmetric[k, i, j] = self.symmetric[k, j, i] = 1.0
        rows = np.zeros((sides + q, q, n))
        rows[:sides] = self.symmetric @ W
        rows[sides + np.arange(q), np.arange(q), -1] = 1.0
        terms[self.count + 1 :, n:, :n] = rows
        terms[self.count + 1 :, :n, n:] = rows.transpose(0, 2, 1)
        self.terms = terms
        self.constant = np.diag(np.r_[np.zeros(n - 1), 1.0, np.ones(q)])
        self.price = float(n * q)
        self.spread = 1 + np.linalg.norm(terms[self.signed].sum(axis=0), 2)

    def schur(self, y: np.ndarray) -> np.ndarray:
        """`Z`."""
        return self.constant + np.tensordot(y, self.terms, 1)

    def form(self, y: np.ndarray) -> NormalForm:
        """`R` and `r`."""
        return NormalForm(np.tensordot(y[self.R], self.symmetric, 1), y[-self.q :])

    def vector(self, cotangent: NormalForm) -> np.ndarray:
        """The gradient of `<cotangent, (A, b)>` in the variables."""
        zero, cotangent = np.zeros(self.count + 1), self.program.cotangent_to_unit_box(cotangent)
        return np.r_[zero, np.tensordot(self.symmetric, cotangent.A, 2), cotangent.b]

    def unscaled(self, y: np.ndarray, count: int) -> tuple[np.ndarray, NormalForm]:
        """Multipliers `(count,)` of the whole program, and `A` and `b`; linear."""
        multipliers = np.zeros(count)
        multipliers[self.program.kept] = y[: self.count] / self.program.norms
        return multipliers, self.program.from_unit_box(self.form(y))

    def follow(
        self, y: np.ndarray, weights: tuple[float, ...]
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """The minimiser at the last of some weights, from one to the next, and the Hessian there.

        None where one of them is not reached.
        """
        hessian = np.zeros(2 * (len(y),))
        for weight in weights:
            centre = self.minimiser(y, weight)
            if centre is None:
                return None
            y, hessian = centre
        return y, hessian

    def inside(self) -> np.ndarray:
        """A point inside, wherever the solution is: a large `t`, all else small."""
        y, t = np.zeros(self.terms.shape[0]), 1 / (2 * self.n)
        y[self.signed] = t / (4 * self.spread)
        y[self.count] = t
        y[self.R] = (np.sqrt(t) / (4 * self.n) * np.eye(self.q))[self.pairs]
        return y

    def near(self, multipliers: np.ndarray, form: NormalForm, weight: float) -> np.ndarray | None:
        """A point inside near a solution: a smaller `V`, and a little of `t`.

        Args:
            multipliers: `(K,)`, of the whole program.
            form: `A` and `b` of the ellipsoid.
            weight: `mu`.
        """
        multipliers = self.program.norms * multipliers[self.program.kept]
        form = self.program.to_unit_box(form)
        for t in 10 * weight * 4.0 ** np.arange(8):
            shrink = 1 - self.n * t
            if shrink <= 0.5:
                break
            R = np.sqrt(shrink) * (form.A + form.A.T) / 2
            y = np.r_[shrink * multipliers, t, R[self.pairs], np.sqrt(shrink) * form.b]
            y[self.signed] = np.maximum(y[self.signed], t / (4 * self.spread))
            if np.isfinite(self.value(y, weight)):
                return y
        return None

    def _blocks(self, y: np.ndarray, weight: float):
        """Each matrix under a logarithm of a determinant: its weight, itself, its variables."""
        R = self.form(y).A
        yield 1.0, R, (self.R, self.symmetric)
        yield weight, np.eye(self.q) / THINNEST - R, (self.R, -self.symmetric)
        yield weight, self.schur(y), (slice(None), self.terms)

    def value(self, y: np.ndarray, weight: float) -> float:
        """Infinite outside."""
        if np.any(y[self.signed] <= 0):
            return np.inf
        value = self.price * y[self.count] - weight * np.sum(np.log(y[self.signed]))
        for each, block, _ in self._blocks(y, weight):
            try:
                factor = np.linalg.cholesky(block)
            except LinAlgError:
                return np.inf
            value -= 2 * each * np.sum(np.log(np.diag(factor)))
        return float(value)

    def derivatives(self, y: np.ndarray, weight: float) -> tuple[np.ndarray, np.ndarray]:
        """Gradient and Hessian."""
        gradient, hessian = np.zeros(len(y)), np.zeros((len(y), len(y)))
        gradient[self.count] = self.price
        gradient[self.signed] -= weight / y[self.signed]
        hessian[self.signed, self.signed] += weight / y[self.signed] ** 2
        for each, block, (where, terms) in self._blocks(y, weight):
            inverse = solve_triangular(np.linalg.cholesky(block), np.eye(len(block)), lower=True)
            scaled = inverse @ terms @ inverse.T
            flat = scaled.reshape(len(terms), -1)
            gradient[where] -= each * np.trace(scaled, axis1=1, axis2=2)
            hessian[where, where] += each * flat @ flat.T
        return gradient, hessian

    def minimiser(self, y: np.ndarray, weight: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Newton's method from a point inside: the minimiser and the Hessian there."""
        value = self.value(y, weight)
        for _ in range(STEPS if np.isfinite(value) else 0):
            gradient, hessian = self.derivatives(y, weight)
            step = -solved(hessian, gradient)
            decrement = -float(gradient @ step)
            if decrement <= CENTRED * weight:
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
            y, value = y + length * step, after
        return None


def solved(hessian: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """`hessian^-1 vector`, scaled to a unit diagonal and regularised at rounding level."""
    scale = 1 / np.sqrt(np.diag(hessian))
    matrix = hessian * np.outer(scale, scale)
    for shift in 1e-14 * 100.0 ** np.arange(4):
        try:
            factor = cho_factor(matrix + shift * np.eye(len(matrix)))
            break
        except LinAlgError:
            continue
    else:
        return np.full(len(vector), np.nan)
    solution = cho_solve(factor, scale * vector)
    residual = scale * vector - matrix @ solution  # one step of refinement
    return scale * (solution + cho_solve(factor, residual))
