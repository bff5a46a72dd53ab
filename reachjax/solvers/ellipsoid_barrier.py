"""The barrier function of minimum-volume ellipsoids.

    f(y) = -log det R - mu (log det Z + ...),    Z = [e e' - sum_k y_k G_k, V'; V, I],

with `V = R W + r e'`, in units in which the successor `W` varies by one (`barrier` has the rest).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from reachjax.programs.compact import THINNEST, CompactProgram
from reachjax.programs.pairs import Pairs
from reachjax.sets import NormalForm
from reachjax.solvers.barrier import AbstractBarrier


class EllipsoidBarrier(AbstractBarrier):
    """The function of this module, of `[multipliers, t, R, r]`.

    Where a form is given up to its size `f`, it is a function of `[multipliers, t, f]`: `R = f A`,
    `r = f b`, and `log f` takes the place of `log det R`.

    Args:
        program: whose objective rows are the successor's.
        given: the form; free if it is None.
    """

    def __init__(self, program: CompactProgram, given: NormalForm | None = None):
        program = program.with_units(program.widths)
        self.q, n = program.objective.shape
        if given is None:
            self.forms, self.sizes = _free_forms(self.q)
        else:
            self.forms, self.sizes = _sizes_of(program.to_unit_box(given))
        constant = np.diag(np.r_[np.zeros(n - 1), 1.0, np.ones(self.q)])
        super().__init__(
            program, _schur_pairs(program.objective, self.forms), constant, float(n * self.q)
        )

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

    def blocks(self, y: np.ndarray, weight: float):
        """`R` (or `f`), which is not to be flat, and what keeps it from being too thin."""
        size = self._size(y)
        yield 1.0, size, self.sizes
        yield weight, np.eye(len(size)) / THINNEST - size, -self.sizes


def _schur_pairs(W: np.ndarray, forms: NormalForm) -> Pairs:
    """`[0, V'; V, 0] = 2 sum_i sym(u_i' V_i)` of each form: rows `W`, `e` and unit rows `u_i`."""
    q, n = W.shape
    rows = np.zeros((q + 1 + q, n + q))
    rows[:q, :n], rows[q, n - 1], rows[q + 1 :, n:] = W, 1.0, np.eye(q)
    weights = 2 * np.concatenate([forms.A, forms.b[:, :, None]], axis=2)
    k, i, j = np.nonzero(weights)
    shares = weights[k, i, j], (k, np.arange(len(k)))
    sharing = sp.csr_array(shares, shape=(len(weights), len(k)))
    return Pairs(rows, left=q + 1 + i, right=j, sharing=sharing)


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
