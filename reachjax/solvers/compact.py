"""The program as a solver should see it: nothing empty, nothing at rounding level, unit sizes.

Rows whose coefficients are rounding noise are dropped (one of size 1e-16 scaled up to 1 made a
solver report "solved" for an offset below the true support), so are columns that the others use at
that level or not at all. The generators that remain are scaled to unit norm.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from reachjax.lmi import Program
from reachjax.rounding import Ball
from reachjax.sets import NormalForm

NOISE = 16.0
"""Coefficients no larger than this many times the rounding error of their row count as zero."""

THINNEST = 1e-4
"""In the coordinates in which it is sought, an ellipsoid has no half-axis below this part of the
interval radius: that keeps ellipsoids of least volume around flat sets from degenerating."""

TINY = 1e-100
"""The least width of anything that is enclosed, in the units of the state."""

TOUCHING = 1e-6
"""A fact negative on an ellipsoid by no more than this part of its size counts as implied by it."""

CHUNK = 256
"""Pairs whose dense outer products are held in memory at once."""


class CompactProgram(NamedTuple):
    """`sum_k y_k G_k + p e' + e p' - 2 b e e' <= 0` with `|G_k| = 1`, in `n` used columns.

    Attributes:
        generators: sparse `(n * n, K')`, the flattened `G_k`.
        objective: `(f, n)`, of unit 1-norm and without a constant.
        centers: `(f,)`, the constants; a facet's offset is `centers + units b`.
        units: `(f,)`; the program's multipliers are those of the scaled objective times this. Zero
            where the objective has one value.
        free: `(K',)`, multipliers of either sign.
        columns: `(n,)`, numbers of the columns kept.
        kept: `(K',)`, numbers of the multipliers kept.
        norms: `(K',)`: the program's multiplier is `y_k / norms_k`.
    """

    generators: sp.csc_array
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
        """The same program with other units of the objective."""
        return self._replace(objective=self.objective * (self.units / units)[:, None], units=units)

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
    facts, solid = np.asarray(program.facts.mid), _solid(program.facts)
    columns = np.flatnonzero(solid.any(axis=0) | _solid(program.objective).any(axis=0))
    facts = np.where(solid.any(axis=1, keepdims=True), facts, 0.0)[:, columns]
    generators, norms = _generators(program, facts)
    kept = np.flatnonzero((norms > 0) & ~_implied_by_cone(program, facts))
    unit_size = sp.diags_array(1 / norms[kept])
    # solvers' tolerances are absolute, objectives come in the size of the set of states
    objective = np.asarray(program.objective.mid)[:, columns].copy()
    centers = objective[:, -1].copy()
    objective[:, -1] = 0.0
    units = abs(objective).sum(axis=1)
    return CompactProgram(
        generators=sp.csc_array(generators[:, kept] @ unit_size),
        objective=objective / np.where(units > 0, units, 1.0)[:, None],
        centers=centers,
        units=units,
        free=np.asarray(program.products.free)[kept],
        columns=columns,
        kept=kept,
        norms=norms[kept],
    )


def _solid(rows: Ball) -> np.ndarray:
    """Which coefficients stand out from the rounding errors of their row."""
    noise = np.linalg.norm(np.asarray(rows.rad), axis=1)
    return abs(np.asarray(rows.mid)) > NOISE * noise[:, None]


def _implied_by_cone(program: Program, facts: np.ndarray) -> np.ndarray:
    """Multipliers `(K,)` of products that say nothing beyond an ellipsoid's own fact.

    A quadratic function of the state that is not negative on the ellipsoid is a positive multiple
    of its fact and a positive semidefinite term (the S-lemma loses nothing for one constraint).
    Products of neurons that are affine on the set are of this kind; kept, hundreds of them made a
    solver stall at its second digit. So are those of facets that do not cut the ellipsoid.
    """
    p = program.products
    left, right, owner = (np.asarray(part) for part in (p.left, p.right, p.multiplier))
    cone = np.flatnonzero(np.asarray(p.sign) < 0)
    if not len(cone):
        return np.zeros(len(p.free), dtype=bool)
    holds: np.ndarray = _least_on_ellipsoid(facts, left[cone]) >= 0
    zero = np.logical_not(facts.any(axis=1))
    beyond = ~(holds[left] & holds[right]) & ~zero[left] & ~zero[right]
    implied = np.ones(len(p.free), dtype=bool)
    implied[owner[beyond]] = implied[owner[cone]] = False
    return implied


def _least_on_ellipsoid(facts: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """A lower bound `(m,)` of each fact on the ellipsoid; `-inf` if it is not one of the state.

    Args:
        facts: `(m, n)`, the level `s` standing just before `rows`.
        rows: numbers of the rows `R` with `|R x| <= s`.
    """
    R, level = facts[rows], facts[rows[0] - 1, -1]
    state = (R != 0).any(axis=0)
    state[-1] = False
    weights = np.linalg.lstsq(R[:, state].T, facts[:, state].T, rcond=None)[0].T
    middle, reach = facts[:, -1] - weights @ R[:, -1], level * np.linalg.norm(weights, axis=1)
    elsewhere = facts[:, :-1][:, ~state[:-1]].any(axis=1)
    least = middle - reach + TOUCHING * (abs(middle) + reach)
    return np.where(elsewhere, -np.inf, least)


def _generators(program: Program, facts: np.ndarray) -> tuple[sp.csc_array, np.ndarray]:
    """The flattened `sum sym(p' q)` of each multiplier's pairs `(n * n, K)`, and their norms."""
    left, right = np.asarray(program.products.left), np.asarray(program.products.right)
    owner, sign = np.asarray(program.products.multiplier), np.asarray(program.products.sign)
    count, pairs, n = len(program.products.free), len(left), facts.shape[1]
    blocks = []
    for first in range(0, pairs, CHUNK):
        here = slice(first, first + CHUNK)
        outer = facts[left[here], :, None] * facts[right[here], None, :]
        symmetric = sign[here, None, None] * (outer + outer.transpose(0, 2, 1)) / 2
        blocks.append(sp.csr_array(symmetric.reshape(-1, n * n)))
    sharing = sp.csr_array((np.ones(pairs), (owner, np.arange(pairs))), shape=(count, pairs))
    generators = sp.csc_array((sharing @ sp.vstack(blocks, format="csr")).T)
    return generators, np.sqrt(np.asarray(generators.multiply(generators).sum(axis=0)).ravel())
