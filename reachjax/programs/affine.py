"""Affine forms: every number of the unrolled loop as a row over columns that go back to `X_0`.

A number is `center + columns . eta` up to `radius`, where `eta = [w, v, r]` and `|eta_i| <= 1`: `w`
stands for the initial state (`initial`), `v` has one entry for each unit that switches, and `r`
those for rounding errors. A unit with inputs in `[l, u]` is

    f(y) = s y + m + e v,    |v| <= 1,    m - e <= f(y) - s y <= m + e  on [l, u],

whatever its slope `s`; here it is that of the unit's line above, which makes a ReLU's `e` least. If
the unit is affine on `[l, u]`, then `e = 0` and there is no column. No column is ever dropped, so what
later states have in common stays known (no wrapping). The forms are those of Girard's zonotopes
(HSCC 2005) and of affine arithmetic (de Figueiredo, Stolfi, Numerical Algorithms 2004); the slopes are
those of Singh, Gehr, Mirman, Puschel, Vechev (NeurIPS 2018).

Radii bound rounding errors alone. Of a number with many units behind it they grow like the product of
`|W|` over its layers, so what a unit's input has goes into that unit's column, and what a state has
into columns of its own.

All of it is written over numpy and `jax.numpy` alike (`rounding.namespace`). In numpy, columns are
appended as they are needed. In compiled code every unit and state has its place, so shapes are fixed.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from reachjax.loops import ClosedLoop
from reachjax.loops.units import AbstractUnit
from reachjax.numerics.pytrees import Replaceable, pytree
from reachjax.numerics.rounding import Ball, gamma, namespace
from reachjax.programs.initial import Ends, InitialColumns

SPILL = 1e-12
"""A state's radius gets a column of its own where it is more than this part of its range. Looser,
and it is multiplied by `|W|` of all layers before the next chance; tighter adds columns for nothing."""

Place = int | Array | None
"""Where new columns begin; None to append those that are needed (numpy)."""


@pytree
class AffineForms(Replaceable):
    """`k` numbers over `n` columns, each known by intervals as well.

    Attributes:
        center: `(k,)`.
        columns: `(k, n)`, coefficients of numbers in `[-1, 1]`.
        radius: `(k,)`, how far off they may be.
        interval: `(k,)`, by interval arithmetic from what the latest units gave.
    """

    center: Float[Array | np.ndarray, " k"]
    columns: Float[Array | np.ndarray, "k n"]
    radius: Float[Array | np.ndarray, " k"]
    interval: Ball

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
        empty = xp.zeros((n, (size or w) - w))
        columns, zero = xp.concatenate([start.spread, empty], axis=1), xp.zeros(n)
        forms = cls(start.center, columns, zero, Ball(start.center, zero + xp.inf))
        return forms.replace(interval=Ball.between(*forms.range(start, cut=True)))

    @property
    def size(self) -> Any:
        """What the numbers do not exceed, but for their radius and rounding `(k,)`."""
        return abs(self.center) + abs(self.columns).sum(axis=1)

    def __rmatmul__(self, matrix) -> AffineForms:
        """`matrix @ self` for an exact matrix."""
        matrix = namespace(self.center).asarray(matrix)
        radius = abs(matrix) @ (self.radius + gamma(matrix.shape[1]) * self.size)
        radius = radius * (1 + gamma(matrix.shape[1] + self.columns.shape[1]))
        interval = matrix @ self.interval
        return AffineForms(matrix @ self.center, matrix @ self.columns, radius, interval)

    def __add__(self, other) -> AffineForms:
        if not isinstance(other, AffineForms):  # exact constants
            interval = self.interval + namespace(self.center).asarray(other)
            center = self.center + other
            radius = (self.radius + gamma(1) * abs(center)) * (1 + gamma(4))
            return AffineForms(center, self.columns, radius, interval)
        center, columns = self.center + other.center, _sum(self.columns, other.columns)
        forms = AffineForms(center, columns, self.radius, self.interval + other.interval)
        radius = self.radius + other.radius + gamma(1) * forms.size
        return forms.replace(radius=radius * (1 + gamma(columns.shape[1] + 4)))

    __radd__ = __add__

    def __neg__(self) -> AffineForms:
        return AffineForms(-self.center, -self.columns, self.radius, -self.interval)

    def __sub__(self, other) -> AffineForms:
        return self + (-other)

    def __rsub__(self, other) -> AffineForms:
        return (-self) + other

    def range(self, start: InitialColumns, cut: bool = False) -> Ends:
        """Lower and upper bounds `(k,)` of the numbers, by these forms alone.

        Args:
            start: what the first columns are.
            cut: whether what cuts the initial set is looked at as well (on the host, a linear
                program for each end).
        """
        w = len(start.spread)
        lower, upper = start.cut_ends(self.columns[:, :w]) if cut else start.ends(self.columns[:, :w])
        rest = abs(self.columns[:, w:]).sum(axis=1) + self.radius
        largest = abs(self.center) + namespace(rest).maximum(-lower, upper)
        slack = rest * (1 + gamma(self.columns.shape[1] + 8)) + gamma(8) * largest
        return self.center + lower - slack, self.center + upper + slack

    def ends(self, start: InitialColumns, cut: bool = False) -> Ends:
        """Lower and upper bounds `(k,)` by forms or by intervals, whichever is better."""
        return met(self.range(start, cut), (self.interval.lower, self.interval.upper))

    def with_own(self, by: Float[Array, " k"], place: Place) -> tuple[AffineForms, Any]:
        """Each number with so much of a column of its own, and where that is, -1 where none is."""
        k, n = self.columns.shape
        if place is not None:
            own = jax.lax.dynamic_update_slice(self.columns, jnp.diag(by), (0, place))
            return self.replace(columns=own), place + jnp.arange(k)
        needed = by != 0
        where, count = np.flatnonzero(needed), int(needed.sum())
        own = np.zeros((k, count))
        own[where, np.arange(count)] = by[where]
        places = np.where(needed, n + np.cumsum(needed) - 1, -1)
        return self.replace(columns=np.concatenate([self.columns, own], axis=1)), places


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
) -> tuple[AffineForms, tuple[UnitForms, ...]]:
    """One step of the loop, whose own forward pass is run over affine forms.

    Args:
        loop: of numpy arrays if the state is.
        state: forms of the state at time `t`.
        t: the time.
        start: what the first columns are.
        place: where the columns of this step begin, `units + n_x` of them; None to append.
        slopes: of the units; None for those of their lines. What is found holds for any.

    Returns:
        Forms of the successor, and those of each layer of units.
    """
    found: list[UnitForms] = []
    done = 0

    def unit(unit: AbstractUnit, y: AffineForms) -> AffineForms:
        nonlocal done
        here, done = slice(done, done + len(y.center)), done + len(y.center)
        slope = None if slopes is None else slopes[here]
        z, forms = _unit(unit, y, start, None if place is None else place + here.start, slope)
        found.append(forms)
        return z

    state = state.replace(interval=Ball.between(*state.ends(start)))
    successor = _settled(loop.step(state, t, unit))
    return _spilled(successor, None if place is None else place + done), tuple(found)


def _unit(
    unit: AbstractUnit, y: AffineForms, start: InitialColumns, place: Place, slope: Any
) -> tuple[AffineForms, UnitForms]:
    """What a layer of units makes of its inputs."""
    xp, (lower, upper) = namespace(y.center), y.ends(start)
    if start.cut is not None:
        lower, upper = _cut(unit, y, start, lower, upper)
    if slope is None:
        slope = unit.lines(lower, upper).above.slope
    rest = Ball.between(*unit.remainder(slope, lower, upper))
    slope, offset, gap = _settled((slope, rest.mid, rest.rad))
    exact = ((slope == 0) | (abs(slope) == 1)) & (offset == 0)
    values = Ball.between(*unit.interval(lower, upper))
    center, columns = slope * y.center + offset, slope[:, None] * y.columns
    rounding = gamma(4) * (abs(slope) * y.size + abs(offset)) * (1 + gamma(columns.shape[1]))
    radius = (abs(slope) * y.radius + xp.where(exact, 0.0, rounding)) * (1 + gamma(4))
    # a unit with a column takes the rounding errors into it
    own = gap > 0 if place is None else xp.ones(len(gap), bool)
    by = xp.where(own, (gap + radius) * (1 + gamma(4)), 0.0)
    z = AffineForms(center, columns, xp.where(own, 0.0, radius), values)
    z, places = z.with_own(by, place)
    return _settled(z), UnitForms(unit, y, lower, upper, slope, offset, gap, places)


def _cut(
    unit: AbstractUnit, y: AffineForms, start: InitialColumns, lower: Any, upper: Any
) -> Ends:
    """Bounds of inputs by what cuts the initial set: on the host, only of units that switch."""
    if namespace(y.center) is not np:
        return met((lower, upper), y.range(start, cut=True))
    switching = np.flatnonzero(~unit.lines(lower, upper).affine)
    if len(switching):
        some = AffineForms(*(part[switching] for part in (y.center, y.columns, y.radius, y.interval)))
        ends = met((lower[switching], upper[switching]), some.range(start, cut=True))
        lower, upper = lower.copy(), upper.copy()
        lower[switching], upper[switching] = ends
    return lower, upper


def _spilled(forms: AffineForms, place: Place) -> AffineForms:
    """The same with radii as columns of their own; on the host, those that are not negligible."""
    xp, radius = namespace(forms.center), forms.radius
    if place is None:
        own = radius > SPILL * abs(forms.columns).sum(axis=1)
    else:
        own = xp.ones(len(radius), bool)
    left = forms.replace(radius=xp.where(own, 0.0, radius))
    return left.with_own(xp.where(own, radius, 0.0), place)[0]


def met(one: Ends, other: Ends) -> Ends:
    """What both bounds hold; never empty."""
    xp = namespace(*one, *other)
    lower = xp.maximum(one[0], other[0])
    return lower, xp.maximum(lower, xp.minimum(one[1], other[1]))


def _sum(one: Any, other: Any) -> Any:
    """Rows over columns, of which one may have more than the other."""
    if one.shape[1] == other.shape[1]:
        return one + other
    few, many = sorted((one, other), key=lambda rows: rows.shape[1])
    columns = many.copy()
    columns[:, : few.shape[1]] += few
    return columns


def _settled(parts: Any) -> Any:
    """One rounding of numbers for all that is made of them, whatever a compiler fuses.

    A column is defined by them: it must be the same wherever it stands.
    """
    return jax.lax.optimization_barrier(parts) if namespace(*jax.tree.leaves(parts)) is jnp else parts
