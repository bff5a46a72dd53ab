"""Minimum-volume ellipsoids on the central path, and how they move with their program.

The optimum of a semidefinite program need not be differentiable, and its optimality conditions are
singular there. The minimiser of

    -log det R - mu log det Z - mu sum_k log y_k,    Z = [e e' - sum_k y_k G_k, V'; V, I],

`V = R W + r e'`, is near it, unique and smooth, and moves as the implicit function theorem says,
with the Hessian of this function. A few Newton steps lead there from a solver's point, also from
one that stalled: so that point is what is reported, and its derivative is exact.

One more multiplier `t >= 0`, at a price, weighs `sum_i (1 - eta_i^2)`, so that there always is a
point inside; the price keeps it at the size of `mu`. Everything here is numpy on the host.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, solve_triangular

from reachjax.lmi import Program
from reachjax.sets import NormalForm
from reachjax.solvers.compact import CompactProgram, compact
from reachjax.solvers.host import all_finite
from reachjax.solvers.models import FLAT

WEIGHTS = (1e-6, 1e-7, 1e-8, 1e-9)
"""Barrier weights `mu`, followed downwards. At the last one the logarithm of the volume is off by
that times the number of multipliers, at most."""

FROM_AFAR = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)
"""Weights to begin with where a solver stalled far from the path."""

LARGEST = 10_000_000
"""Numbers in all generators together, beyond which a solver's point is taken as it is."""

STEPS = 60
"""Newton steps after which the centre counts as not found."""

CENTRED = 1e-8
"""The squared Newton decrement, in units of `mu`, at which it is found."""

QUADRATIC = 0.05
"""The squared decrement, in units of `mu`, below which full Newton steps surely converge."""


class Sensitivity(NamedTuple):
    """A derivative of `A` and `b` as that of two Lagrangians, `lmi.schur_lagrangian`.

    The derivative in the rows of `<cotangent, (A, b)>` is that of the Lagrangian at the first three
    less that at the last three.

    Attributes:
        multipliers: `(K,)`, at the centre.
        form: `A` and `b` at the centre.
        moments: `(n + q, n + q)`, how the moments at the centre answer the cotangent.
        multipliers_slope: `(K,)`, how the multipliers answer it.
        form_slope: how `A` and `b` do.
        moments_slope: `(n + q, n + q)`, the moments at the centre.
    """

    multipliers: np.ndarray
    form: NormalForm
    moments: np.ndarray
    multipliers_slope: np.ndarray
    form_slope: NormalForm
    moments_slope: np.ndarray

    @classmethod
    def unknown(cls, program: Program) -> Sensitivity:
        """NaN throughout, of the right shapes."""
        q, n = program.objective.mid.shape
        K = program.products.free.shape[0]
        half = (
            np.full(K, np.nan),
            NormalForm(np.full((q, q), np.nan), np.full(q, np.nan)),
            np.full((n + q, n + q), np.nan),
        )
        return cls(*half, *half)


def centred(
    program: Program, multipliers: np.ndarray, form: NormalForm
) -> tuple[np.ndarray, NormalForm] | None:
    """Multipliers `(K,)` and ellipsoid on the central path near a solution.

    None where the path is not reached, or the program is so large that it would take long.
    """
    reduced = compact(program)
    if len(reduced.kept) * (len(reduced.columns) + len(form.b)) ** 2 > LARGEST:
        return None
    barrier = _Barrier(reduced)
    found = barrier.followed(multipliers, form)
    return None if found is None else barrier.unscaled(found[0], len(multipliers))


def sensitivity(
    program: Program, multipliers: np.ndarray, form: NormalForm, cotangent: NormalForm
) -> Sensitivity:
    """The derivative of `<cotangent, (A, b)>`, NaN where the centre is not found.

    Args:
        program: whose objective rows are the successor's.
        multipliers: `(K,)`, of the solution.
        form: the solution.
        cotangent: weights of `A` and `b`.
    """
    barrier = _Barrier(compact(program))
    found = barrier.followed(multipliers, form) if all_finite(cotangent) else None
    if found is None:
        return Sensitivity.unknown(program)
    y, hessian = found
    weight = WEIGHTS[-1]
    w = _solved(hessian, barrier.vector(cotangent))
    inverse = np.linalg.inv(barrier.schur(y))
    moving = np.tensordot(w, barrier.terms, 1)
    size, q = len(program.scale), len(form.b)
    used = np.ix_(*2 * [np.r_[barrier.program.columns, size + np.arange(q)]])
    halves = []
    for vector, moments in ((y, -weight * inverse @ moving @ inverse), (w, -weight * inverse)):
        whole = np.zeros((size + q, size + q))
        whole[used] = moments
        halves += [*barrier.unscaled(vector, len(multipliers)), whole]
    return Sensitivity(*halves)


class _Barrier:
    """The function of this module's docstring, of `[multipliers, t, R, r]` in one vector."""

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
        return self.constant + np.tensordot(y, self.terms, 1)

    def form(self, y: np.ndarray) -> NormalForm:
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

    def followed(
        self, multipliers: np.ndarray, form: NormalForm
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """The centre at the last weight and the Hessian there, None where it is not reached.

        Args:
            multipliers: `(K,)`, near it or not.
            form: the same.
        """
        if not all_finite((multipliers, form)):
            return None
        scaled = self.program.norms * multipliers[self.program.kept]
        near = self._start(scaled, self.program.to_unit_box(form), WEIGHTS[0])
        return self._path(near, WEIGHTS) or self._path(self._inside(), FROM_AFAR + WEIGHTS)

    def _path(
        self, y: np.ndarray | None, weights: tuple[float, ...]
    ) -> tuple[np.ndarray, np.ndarray] | None:
        hessian = None
        for weight in weights:
            centre = None if y is None else self._centred(y, weight)
            if centre is None:
                return None
            y, hessian = centre
        return None if y is None or hessian is None else (y, hessian)

    def _inside(self) -> np.ndarray:
        """A point inside, wherever the solution is: a large `t`, all else small."""
        y, t = np.zeros(self.terms.shape[0]), 1 / (2 * self.n)
        y[self.signed] = t / (4 * self.spread)
        y[self.count] = t
        y[self.R] = (np.sqrt(t) / (4 * self.n) * np.eye(self.q))[self.pairs]
        return y

    def _start(self, multipliers: np.ndarray, form: NormalForm, weight: float) -> np.ndarray | None:
        """A point inside near a solution: a smaller `V`, and a little of `t`."""
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
        yield weight, np.eye(self.q) / FLAT - R, (self.R, -self.symmetric)
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

    def _centred(self, y: np.ndarray, weight: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Newton's method from a point inside: the minimiser and the Hessian there."""
        value = self.value(y, weight)
        for _ in range(STEPS if np.isfinite(value) else 0):
            gradient, hessian = self.derivatives(y, weight)
            step = -_solved(hessian, gradient)
            decrement = -float(gradient @ step)
            if decrement <= CENTRED * weight:
                return y, hessian
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


def _solved(hessian: np.ndarray, vector: np.ndarray) -> np.ndarray:
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
