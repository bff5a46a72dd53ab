"""The program as a solver on the host should see it: nothing unused, and unit sizes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from reachjax.programs.lmi import Program
from reachjax.programs.pairs import Pairs
from reachjax.programs.trimming import trimmed
from reachjax.sets import NormalForm

THINNEST = 1e-4
"""In the coordinates in which it is sought, an ellipsoid has no half-axis below this part of the
interval radius: that keeps ellipsoids of least volume around flat sets from degenerating."""

TINY = 1e-100
"""The least width of anything that is enclosed, in the units of the state."""


class CompactProgram(NamedTuple):
    """`sum_k y_k G_k + p e' + e p' - 2 b e e' <= 0` with `|G_k|` about 1, in `n` used columns.

    Attributes:
        generators: the `G_k`.
        objective: `(f, n)`, of unit 1-norm and without a constant.
        centers: `(f,)`, the constants; a facet's offset is `centers + units b`.
        units: `(f,)`; the program's multipliers are those of the scaled objective times this. Zero
            where the objective has one value.
        free: `(K',)`, multipliers of either sign.
        columns: `(n,)`, numbers of the columns kept.
        kept: `(K',)`, numbers of the multipliers kept.
        norms: `(K',)`: the program's multiplier is `y_k / norms_k`.
    """

    generators: Pairs
    objective: np.ndarray
    centers: np.ndarray
    units: np.ndarray
    free: np.ndarray
    columns: np.ndarray
    kept: np.ndarray
    norms: np.ndarray

    @property
    def widths(self) -> np.ndarray:
        """The units, none of them at rounding level, nor so small that squares underflow."""
        return np.maximum(self.units, 1e-9 * (abs(self.centers) + self.units.max()) + TINY)

    def with_units(self, units: np.ndarray) -> CompactProgram:
        """The same program with other units of the objective; where it has one value they are 0."""
        ratios = self.units / np.where(units > 0, units, 1.0)
        return self._replace(objective=self.objective * ratios[:, None], units=units)

    @property
    def is_flat(self) -> bool:
        """Whether the objective hardly varies in some coordinate."""
        return bool(np.any(self.units < self.widths))

    def is_thinnest(self, form: NormalForm) -> bool:
        """Whether an ellipsoid is about as thin as it may be in these coordinates."""
        return bool(np.linalg.norm(form.A * self.widths, 2) > 0.5 / THINNEST)

    def to_unit_box(self, form: NormalForm) -> NormalForm:
        """`|A x + b| <= 1` over the coordinates in which the objective rows are stated."""
        return NormalForm(form.A * self.units, form.b + form.A @ self.centers)

    def from_unit_box(self, form: NormalForm) -> NormalForm:
        """The inverse of `to_unit_box`."""
        A = form.A / self.units
        return NormalForm(A, form.b - A @ self.centers)

    def cotangent_to_unit_box(self, cotangent: NormalForm) -> NormalForm:
        """The transpose of `from_unit_box`."""
        A = (cotangent.A - np.outer(cotangent.b, self.centers)) / self.units
        return NormalForm(A, cotangent.b)


def compact(program: Program) -> CompactProgram:
    """Drop what is empty or noise, and bring the generators to unit norm."""
    given, products = trimmed(program), program.products
    columns, kept = np.flatnonzero(given.columns), np.flatnonzero(given.kept)
    number = np.full(len(given.kept), -1)
    number[kept] = np.arange(len(kept))
    owner, present = number[products.multiplier], given.facts.any(axis=1)
    there = np.flatnonzero((owner >= 0) & present[products.left] & present[products.right])
    owner, norms = owner[there], given.sizes[kept]
    shares = np.asarray(products.sign)[there] / norms[owner], (owner, np.arange(len(there)))
    return CompactProgram(
        generators=Pairs(
            rows=given.facts[:, columns],
            left=np.asarray(products.left)[there],
            right=np.asarray(products.right)[there],
            sharing=sp.csr_array(shares, shape=(len(kept), len(there))),
        ),
        objective=given.objective[:, columns],
        centers=given.centers,
        units=given.units,
        free=np.asarray(products.free)[kept],
        columns=columns,
        kept=kept,
        norms=norms,
    )
