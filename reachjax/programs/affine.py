"""Affine forms: every number of the unrolled loop as a row over columns that go back to `X_0`.

A number is `c + G eta` up to a radius, where `eta = [w, v, r]` and `|eta_i| <= 1`: `w` stands for
the initial state (`initial`), `v` has one entry for each unit that switches, and `r` those for
rounding errors of states. A unit with inputs in `[l, u]` is

    f(y) = s y + m + e v,    |v| <= 1,    m - e <= f(y) - s y <= m + e  on [l, u],

whatever its slope `s`; here it is that of the unit's line above, which makes a ReLU's `e` least. If
the unit is affine on `[l, u]`, then `e = 0` and there is no column. No column is ever dropped, so
what later states have in common stays known (no wrapping). Such forms are Girard's zonotopes (HSCC
2005) and affine arithmetic (de Figueiredo, Stolfi, Numerical Algorithms 2004); the slopes are those
of Singh, Gehr, Mirman, Puschel, Vechev (NeurIPS 2018).

Radii bound rounding errors alone: by how much a number is off the exact affine function of `eta`
that it stands for. Behind many layers they grow like the product of their `|W|`, and over many
steps beyond all bounds; so those of a state become columns of their own before the next step.

All of it is written over numpy and `jax.numpy` alike (`rounding.namespace`). In numpy, columns are
appended as they are needed. In compiled code every unit and state has its place, so shapes are
fixed.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from reachjax.loops import ClosedLoop
from reachjax.loops.units import AbstractUnit
from reachjax.numerics.pytrees import pytree
from reachjax.numerics.rounding import Ball, gamma, larger, namespace, smaller
from reachjax.programs.initial import Ends, InitialColumns, constant, settled
from reachjax.sets import Box

SPILL = 1e-13
"""On the host a state's radius gets a column where it is more than this part of its range. It is
multiplied by `|W|` of all layers of a step before it gets its next chance."""

Place = int | Array | None
"""Where new columns begin; None to append those that are needed (numpy)."""


@pytree
class AffineForms:
    """`k` numbers, each as a form over `n` columns and, beside it, as an interval.

    Attributes:
        rows: `(k, 2 + n)`, centre of the form, middle of the interval, coefficients of the columns.
        radii: `(k, 2)`, by how much the form may be off, and of the interval. Derivatives take the
            first for a constant.
    """

    rows: Float[Array | np.ndarray, "k n+2"]
    radii: Float[Array | np.ndarray, "k 2"]

    # numpy arrays on the left leave `array @ forms` and `array - forms` to this class
    __array_ufunc__ = None

    @classmethod
    def beginning(cls, start: InitialColumns, size: int | None = None) -> AffineForms:
        """The initial state.

        Args:
            start: its columns.
            size: how many columns there will be; None for these alone.
        """
        xp, (n, w) = namespace(start.center), start.spread.shape
        middle, zero = start.center[:, None], xp.zeros((n, 1))
        empty = xp.zeros((n, (size or w) - w))
        rows = xp.concatenate([middle, middle, start.spread, empty], axis=1)
        forms = cls(rows, xp.concatenate([zero, zero + xp.inf], axis=1))
        return forms.within(Ball.between(*forms.ends(start, cut=True)))

    @property
    def columns(self) -> Float[Array | np.ndarray, "k n"]:
        """Coefficients of the columns."""
        return self.rows[:, 2:]

    def within(self, interval: Ball) -> AffineForms:
        """The same forms with other intervals."""
        xp = namespace(self.rows)
        parts = self.rows[:, :1], interval.mid[:, None], self.rows[:, 2:]
        radii = xp.stack([self.radii[:, 0], interval.rad], axis=1)
        return AffineForms(xp.concatenate(parts, axis=1), radii)

    def __rmatmul__(self, matrix) -> AffineForms:
        """`matrix @ self` for an exact matrix."""
        matrix, count = namespace(self.rows).asarray(matrix), matrix.shape[1]
        error = gamma(count) * abs(constant(self.rows)).sum(axis=1)
        radii = abs(matrix) @ (self.radii + error[:, None])
        return AffineForms(matrix @ self.rows, radii * (1 + gamma(count + self.rows.shape[1])))

    def __add__(self, other) -> AffineForms:
        xp = namespace(self.rows)
        if isinstance(other, AffineForms):
            rows = _sum(self.rows, other.rows)
            radii, changed = self.radii + other.radii, rows
        else:  # exact constants, one for each or one for all
            changed = self.rows[:, :2] + xp.asarray(other)[..., None]
            rows = xp.concatenate([changed, self.rows[:, 2:]], axis=1)
            radii = self.radii
        error = gamma(1) * abs(constant(changed)).sum(axis=1)
        return AffineForms(rows, (radii + error[:, None]) * (1 + gamma(rows.shape[1] + 4)))

    __radd__ = __add__

    def __neg__(self) -> AffineForms:
        return AffineForms(-self.rows, self.radii)

    def __sub__(self, other) -> AffineForms:
        return self + (-other)

    def __rsub__(self, other) -> AffineForms:
        return (-self) + other

    def __getitem__(self, index) -> AffineForms:
        return AffineForms(self.rows[index], self.radii[index])

    def ends(self, start: InitialColumns, cut: bool = False) -> Ends:
        """Lower and upper bounds `(k,)` by forms or by intervals, whichever is better.

        Args:
            start: what the first columns are.
            cut: whether what cuts the initial set is looked at as well (on the host, a linear
                program for each end).
        """
        w, n = len(start.spread), self.rows.shape[1]
        center, middle = self.rows[:, 0], self.rows[:, 1]
        first = self.rows[:, 2 : 2 + w]
        lower, upper = start.cut_ends(first) if cut else start.ends(first)
        largest = abs(constant(center)) + constant(larger(-lower, upper))
        rest = abs(self.rows[:, 2 + w :]).sum(axis=1) * (1 + gamma(n))
        slack = rest + (self.radii[:, 0] + gamma(8) * largest) * (1 + gamma(n))
        by_forms = center + lower - slack, center + upper + slack
        reach = self.radii[:, 1] * (1 + gamma(2)) + gamma(2) * abs(constant(middle))
        return met(by_forms, (middle - reach, middle + reach))

    def widened(self, width: int) -> AffineForms:
        """The same over at least so many columns, the new ones empty (numpy)."""
        more = width - self.rows.shape[1] + 2
        if more <= 0:
            return self
        return AffineForms(np.pad(self.rows, ((0, 0), (0, more))), self.radii)

    def with_own(self, by: Float[Array, " k"], place: Place) -> tuple[AffineForms, Any]:
        """Each number with so much of a column of its own, and where that is, -1 where none is.

        Without a place they come after the columns of these forms, which have to be over all the
        columns there are: see `widened`.
        """
        k, n = self.rows.shape
        if place is not None:
            rows = jax.lax.dynamic_update_slice(self.rows, jnp.diag(by), (0, 2 + place))
            return AffineForms(rows, self.radii), place + jnp.arange(k)
        needed = by != 0
        where, count = np.flatnonzero(needed), int(needed.sum())
        rows = np.zeros((k, n + count))
        rows[:, :n] = self.rows
        rows[where, n + np.arange(count)] = by[where]
        places = np.where(needed, n - 3 + np.cumsum(needed), -1)
        return AffineForms(rows, self.radii), places


class UnitForms(NamedTuple):
    """What affine forms make of a layer of units.

    Attributes:
        unit: which one.
        inputs: forms of the inputs.
        lower: `(k,)`, bounds of the inputs.
        upper: `(k,)`.
        slope: `(k,)`, with `slope y + offset - gap <= z <= slope y + offset + gap` in between.
        offset: `(k,)`.
        gap: `(k,)`, zero where the unit is affine there.
        places: `(k,)`, the column that each got; -1 where it needs none.
    """

    unit: AbstractUnit
    inputs: AffineForms
    lower: Float[Array | np.ndarray, " k"]
    upper: Float[Array | np.ndarray, " k"]
    slope: Float[Array | np.ndarray, " k"]
    offset: Float[Array | np.ndarray, " k"]
    gap: Float[Array | np.ndarray, " k"]
    places: Int[Array | np.ndarray, " k"]


def step_forms(
    loop: ClosedLoop,
    state: AffineForms,
    t: int | Array,
    start: InitialColumns,
    place: Place = None,
    slopes: Float[Array | np.ndarray, " units"] | None = None,
    known: Box | None = None,
) -> tuple[AffineForms, tuple[UnitForms, ...]]:
    """One step of the loop, whose own forward pass is run over affine forms.

    Args:
        loop: of numpy arrays if the state is.
        state: forms of the state at time `t`.
        t: the time.
        start: what the first columns are.
        place: where the columns of this step begin, `units + n_x` of them; None to append.
        slopes: of the units; None for those of their lines. What is found holds for any.
        known: a box that surely holds the successor, where one is known.

    Returns:
        Forms of the successor, and those of each layer of units.
    """
    found: list[UnitForms] = []
    done, width = 0, state.columns.shape[1]

    def apply(unit: AbstractUnit, y: AffineForms) -> AffineForms:
        nonlocal done, width
        here, done = slice(done, done + len(y.rows)), done + len(y.rows)
        slope = None if slopes is None else slopes[here]
        if place is None:  # branches that began alike must not share the columns they add
            y = y.widened(width)
        z, forms = _unit(unit, y, start, None if place is None else place + here.start, slope)
        width = z.columns.shape[1]
        found.append(forms)
        return z

    successor = loop.step(state, t, apply)
    if place is None:
        successor = successor.widened(width)
    successor = _spilled(successor, None if place is None else place + done)
    ends = successor.ends(start)
    if known is not None:
        ends = met(ends, (known.lower, known.upper))
    return successor.within(Ball.between(*ends)), tuple(found)


def _unit(
    unit: AbstractUnit, y: AffineForms, start: InitialColumns, place: Place, slope: Any
) -> tuple[AffineForms, UnitForms]:
    """What a layer of units makes of its inputs."""
    xp, (lower, upper) = namespace(y.rows), y.ends(start)
    if start.cut is not None:
        lower, upper = _cut(unit, y, start, lower, upper)
    if slope is None:
        slope = unit.lines(lower, upper).above.slope
    rest, values = (
        Ball.between(*ends)
        for ends in (unit.remainder(slope, lower, upper), unit.interval(lower, upper))
    )
    slope, offset, gap = settled((slope, rest.mid, rest.rad))
    rows = slope[:, None] * y.rows
    constants = xp.stack([rows[:, 0] + offset, values.mid], axis=1)
    # products with 0 and 1 are exact
    size = abs(constant(rows)).sum(axis=1) + abs(constant(offset))
    rounded = (slope != 0) & (abs(slope) != 1) | (offset != 0)
    radius = abs(slope) * y.radii[:, 0] + xp.where(rounded, gamma(4) * size, 0.0)
    radius = constant(radius) * (1 + gamma(rows.shape[1]))
    z = AffineForms(
        xp.concatenate([constants, rows[:, 2:]], axis=1), xp.stack([radius, values.rad], axis=1)
    )
    z, places = z.with_own(gap, place)
    return z, UnitForms(unit, y, lower, upper, slope, offset, gap, places)


def _cut(unit: AbstractUnit, y: AffineForms, start: InitialColumns, lower: Any, upper: Any) -> Ends:
    """Bounds of inputs by what cuts the initial set; where that takes programs, if they switch."""
    if start.cut is not None and not start.cut.needs_programs:
        return y.ends(start, cut=True)
    switching = np.flatnonzero(~unit.lines(lower, upper).affine)
    if len(switching):
        lower, upper = lower.copy(), upper.copy()
        lower[switching], upper[switching] = y[switching].ends(start, cut=True)
    return lower, upper


def _spilled(forms: AffineForms, place: Place) -> AffineForms:
    """The same with radii as columns of their own; on the host, those that are not negligible.

    Such a column is what a number is off by: what it is beside must be the same everywhere.
    """
    forms, xp = settled(forms), namespace(forms.rows)
    radius, own = forms.radii[:, 0], xp.ones(len(forms.rows), bool)
    if place is None:
        own = radius > SPILL * abs(forms.columns).sum(axis=1)
    left = xp.stack([xp.where(own, 0.0, radius), forms.radii[:, 1]], axis=1)
    return AffineForms(forms.rows, left).with_own(xp.where(own, radius, 0.0), place)[0]


def met(one: Ends, other: Ends) -> Ends:
    """What both bounds hold; never empty. What is no number stays so in the first alone."""
    lower = larger(one[0], other[0])
    return lower, larger(smaller(one[1], other[1]), lower)


def _sum(one: Any, other: Any) -> Any:
    """Rows over columns, of which one may have more than the other."""
    if one.shape[1] == other.shape[1]:
        return one + other
    few, many = sorted((one, other), key=lambda rows: rows.shape[1])
    rows = many.copy()
    rows[:, : few.shape[1]] += few
    return rows
