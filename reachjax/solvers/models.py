"""The two semidefinite programs as cvxpy states them: an offset for each facet, and an ellipsoid.

A model of facets is built once for a step. Only a parameter (the objective row) changes from facet
to facet, so cvxpy's canonicalisation is done once as well (disciplined parametrised programming).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from reachjax.programs.presolve import THINNEST, NormalProgram
from reachjax.sets import NormalForm


def unit_generators(program: NormalProgram) -> tuple[sp.csc_array, Float[np.ndarray, " K"]]:
    """The flattened generators `(n * n, K)` at unit size, and the sizes that they had."""
    generators = program.generators.columns()
    sizes = np.sqrt(np.asarray(generators.multiply(generators).sum(axis=0)).ravel())
    sizes = np.where(sizes > 0, sizes, 1.0)
    return sp.csc_array(generators @ sp.diags_array(1 / sizes)), sizes


class Multipliers:
    """The variables, of generators of unit size, and `sum_k y_k G_k` as a flat expression."""

    def __init__(self, program: NormalProgram):
        import cvxpy as cp

        generators, self.sizes = unit_generators(program)
        free, signed = generators[:, program.free], generators[:, ~program.free]
        self.program = program
        self.free = cp.Variable(free.shape[1]) if free.shape[1] else None
        self.signed = cp.Variable(signed.shape[1], nonneg=True)
        self.weighted = signed @ self.signed
        if self.free is not None:
            self.weighted = self.weighted + free @ self.free

    @property
    def value(self) -> np.ndarray | None:
        """The values found, in the order of the program's generators; None if there are none."""
        if self.signed.value is None:
            return None
        y = np.zeros(len(self.program.kept))
        y[~self.program.free] = self.signed.value
        if self.free is not None:
            y[self.program.free] = self.free.value
        return y / self.sizes if np.isfinite(y).all() else None


class FacetModel:
    """`sum_k y_k G_k + p e' + e p' - 2 b e e' <= 0` with the smallest `b`; `p` is a parameter."""

    def __init__(self, program: NormalProgram):
        import cvxpy as cp

        n = program.objective.shape[1]
        self.multipliers = Multipliers(program)
        self.offset = cp.Variable()
        self.objective = cp.Parameter(n)
        corner = np.zeros(n * n)
        corner[-1] = 2.0
        matrix = self.multipliers.weighted + _bordered(n) @ self.objective - corner * self.offset
        self.lmi = cp.reshape(matrix, (n, n), order="F") << 0
        self.problem = cp.Problem(cp.Minimize(self.offset), [self.lmi])


def _bordered(n: int) -> sp.csr_array:
    """The map from a row `p` to the flattened `p e' + e p'`."""
    index = np.arange(n)
    rows = np.r_[index * n + n - 1, (n - 1) * n + index]
    return sp.csr_array((np.ones(2 * n), (rows, np.r_[index, index])), shape=(n * n, n))


class EllipsoidModel:
    """The smallest ellipsoid `|V eta| <= 1`, from `sum_k y_k G_k + V' V <= e e'`.

    The Schur complement of that is affine in all unknowns. With `W` the rows of the successor,
    `V = R W + r e'`. Either `R`, symmetric, and `r` are sought (maximise `log det R`), or `V` is
    given up to a factor (maximise the factor).
    """

    def __init__(self, program: NormalProgram, given: NormalForm | None = None):
        import cvxpy as cp

        W = program.objective
        q, n = W.shape
        self.multipliers = Multipliers(program)
        e = np.zeros((n, 1))
        e[-1] = 1.0
        constraints = []
        if given is None:
            self.R, self.r = cp.Variable((q, q), PSD=True), cp.Variable((q, 1))
            size = cp.log_det(self.R)
            constraints.append(self.R << np.eye(q) / THINNEST)
        else:
            size = cp.Variable(nonneg=True)
            unit = np.linalg.norm(given.A)
            self.R, self.r = size * (given.A / unit), size * (given.b[:, None] / unit)
        V = self.R @ W + self.r @ e.T
        weighted = cp.reshape(self.multipliers.weighted, (n, n), order="F")
        schur = cp.bmat([[e @ e.T - weighted, V.T], [V, np.eye(q)]])
        self.lmi = (schur + schur.T) / 2 >> 0
        self.problem = cp.Problem(cp.Maximize(size), [self.lmi, *constraints])

    @property
    def form(self) -> NormalForm | None:
        """What was found: `R` and `r`, None if nothing was."""
        R, r = self.R.value, self.r.value
        if R is None or r is None or not (np.isfinite(R).all() and np.isfinite(r).all()):
            return None
        return NormalForm(R, r[:, 0])
