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

Where rounding is not counted (`rounding.rounding`) forms have no radii of their own, and say what
would hold in exact arithmetic, which is no bound.

All of it is written over numpy and `jax.numpy` alike (`rounding.namespace`). In numpy, columns are
appended as they are needed. In compiled code every unit and state has its place, so shapes are
fixed; columns that are summed up at the end of a part of a step are kept apart there, layer by
layer: those of the newest one are a diagonal.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.numerics.numbers import AbstractNumber
from reachjax.numerics.pytrees import pytree
from reachjax.numerics.rounding import (
    NOTHING,
    TINY,
    Ball,
    errors,
    gamma,
    is_counted,
    larger,
    namespace,
    select,
    settled,
    smaller,
    underflow,
)
from reachjax.programs.initial import SIZE, Ends, InitialColumns, SubboxColumns, met


@dataclasses.dataclass(frozen=True)
class Inner:
    """A place for columns that are summed up at the end of a part of a step.

    Attributes:
        first: how many units the part has before.
    """

    first: int

    def __add__(self, count: int) -> Inner:
        return Inner(self.first + count)


Place = int | Array | Inner | None
"""Where new columns begin; None to append those that are needed (numpy)."""

Layers = dict[int, Any]
"""Coefficients of columns of units of a part, by how many units are before: `(k, units)`, or `(k,)`
where each number has one of its own."""


@pytree
class AffineForms(AbstractNumber):
    """`k` numbers, each as a form over `n` columns and, beside it, as an interval.

    Attributes:
        rows: `(k, 2 + n)`, centre of the form, middle of the interval, coefficients of the columns.
        radii: `(k, 2)`, by how much the form may be off, and of the interval. Derivatives take the
            first for a constant. It is missing, `(k, 1)`, where rounding is not counted.
        inner: columns besides, within a part of a step in compiled code.
    """

    rows: Float[Array | np.ndarray, "k n+2"]
    radii: Float[Array | np.ndarray, "k radii"]
    inner: Layers = dataclasses.field(default_factory=dict)

    def __len__(self) -> int:
        return self.rows.shape[0]

    @classmethod
    def beginning(cls, start: InitialColumns, size: int | None = None) -> AffineForms:
        """The initial state.

        Args:
            start: its columns.
            size: how many columns there will be; None for these alone.
        """
        xp, (n, w) = namespace(start.center), start.spread.shape
        middle, exact = start.center[:, None], NOTHING if not is_counted() else xp.zeros(n)
        empty = xp.zeros((n, (size or start.count) - w))
        rows = xp.concatenate([middle, middle, start.spread, empty], axis=1)
        forms = cls(rows, radii_of(exact, xp.full(n, xp.inf)))
        return forms.within(Ball.between(*forms.ends(start, cut=True)))

    @classmethod
    def exact(cls, values: Float[np.ndarray, " k"]) -> AffineForms:
        """Known numbers, which no column moves, in numpy."""
        values = np.asarray(values, float)
        return cls(np.stack([values, values], axis=1), np.zeros((len(values), 2)))

    @property
    def off(self) -> Any:
        """By how much each form may be off `(k,)`; nothing where rounding is not counted."""
        return self.radii[:, 0] if self.radii.shape[1] == 2 else NOTHING

    @property
    def columns(self) -> Float[Array | np.ndarray, "k n"]:
        """Coefficients of the columns."""
        return self.rows[:, 2:]

    @property
    def every(self) -> Any:
        """Coefficients of all columns, those within a part among them."""
        if not self.inner:
            return self.columns
        return jnp.concatenate([self.columns, *map(_whole, self.inner.values())], axis=1)

    def rest(self, first: int) -> Any:
        """What all columns from some on are worth to each number, radii left aside."""
        found = abs(self.columns[:, first:]).sum(axis=1)
        return (found + self.within_part) * (1 + gamma(self.width))

    @property
    def within_part(self) -> Any:
        """What the columns within a part are worth to each number, but for rounding."""
        each = (abs(part).reshape(len(part), -1).sum(axis=1) for part in self.inner.values())
        return sum(each, start=NOTHING)

    @property
    def width(self) -> int:
        """How many coefficients a number has, its constants among them."""
        own = (1 if part.ndim == 1 else part.shape[1] for part in self.inner.values())
        return self.rows.shape[1] + sum(own)

    @property
    def sizes(self) -> Any:
        """Sums of absolute values of all coefficients, constants among them, but for rounding."""
        return abs(self.rows).sum(axis=1) + self.within_part

    def _layers(self, change: Callable[[Any], Any], whole: bool = False) -> Layers:
        """The columns within a part, changed; all of them as matrices if these are asked for."""
        each = {key: _whole(part) if whole else part for key, part in self.inner.items()}
        return {key: change(part) for key, part in each.items()}

    def scaled_layers(self, factor: Any) -> Layers:
        """The columns within a part, each number times one."""
        return self._layers(lambda part: factor.reshape(-1, *[1] * (part.ndim - 1)) * part)

    def folded_layers(self, factor: Any, count: int) -> Layers:
        """Sums of so many parts of the columns within a part of a step, each number times one."""
        return self._layers(lambda part: folded(factor[:, None] * part, count), whole=True)

    def _nonzero(self, sizes: Any) -> Any:
        """Which numbers are not zero, from the sizes of their coefficients."""
        return sizes + self.radii.sum(axis=1) > 0

    def within(self, interval: Ball) -> AffineForms:
        """The same forms with other intervals."""
        xp = namespace(self.rows)
        parts = self.rows[:, :1], interval.mid[:, None], self.rows[:, 2:]
        radii = radii_of(self.off, interval.rad)
        return AffineForms(xp.concatenate(parts, axis=1), radii, self.inner)

    def __rmatmul__(self, matrix) -> AffineForms:
        """`matrix @ self` for an exact matrix."""
        matrix, count = namespace(self.rows).asarray(matrix), matrix.shape[1]
        sizes = errors(lambda: self.sizes)
        error = gamma(count) * sizes
        lost = errors(lambda: underflow(matrix, self._nonzero(sizes), self.width + 2))
        radii = abs(matrix) @ (self.radii + error[:, None]) + lost[:, None]
        radii = _once(radii * (1 + gamma(count + self.width)))
        inner = self._layers(lambda part: matrix * part if part.ndim == 1 else matrix @ part)
        return AffineForms(matrix @ self.rows, radii, inner)

    def __add__(self, other) -> AffineForms:
        xp = namespace(self.rows)
        if isinstance(other, AffineForms):
            inner = _added(self.inner, other.inner)
            found = AffineForms(_sum(self.rows, other.rows), self.radii + other.radii, inner)
            changed = found.sizes
        else:  # exact constants, one for each or one for all
            constants = self.rows[:, :2] + xp.asarray(other)[..., None]
            rows = xp.concatenate([constants, self.rows[:, 2:]], axis=1)
            found = AffineForms(rows, self.radii, self.inner)
            changed = abs(constants).sum(axis=1)
        error = errors(lambda: gamma(1) * changed)
        radii = _once((found.radii + error[:, None]) * (1 + gamma(found.width + 4)))
        return AffineForms(found.rows, radii, found.inner)

    def __neg__(self) -> AffineForms:
        return AffineForms(-self.rows, self.radii, self._layers(lambda part: -part))

    def __rmul__(self, factor) -> AffineForms:
        """Each number times an exact one, or all times one."""
        xp = namespace(self.rows)
        factor = xp.broadcast_to(xp.asarray(factor, float), (len(self.rows),))
        sizes, count = errors(lambda: self.sizes), self.width + 2
        error = gamma(1) * sizes
        lost = errors(lambda: 2 * TINY * count * ((factor != 0) & self._nonzero(sizes)))
        radii = abs(factor)[:, None] * (self.radii + error[:, None]) + lost[:, None]
        radii = _once(radii * (1 + gamma(self.width + 4)))
        return AffineForms(factor[:, None] * self.rows, radii, self.scaled_layers(factor))

    def __getitem__(self, index) -> AffineForms:
        inner = self._layers(lambda part: part[index], whole=True)
        return AffineForms(self.rows[index], self.radii[index], inner)

    def ends(self, start: InitialColumns, cut: bool = False) -> Ends:
        """Lower and upper bounds `(k,)` by forms or by intervals, whichever is better.

        Args:
            start: what the first columns are.
            cut: whether what cuts the initial set is looked at as well (on the host, a linear
                program for each end).
        """
        by_interval = self.ends_by_interval()
        return met(self.ends_by_form(start, cut), by_interval)

    def uppers(self, start: InitialColumns, cut: bool = False) -> Any:
        """The upper bounds of `ends`, where nothing is proved at half the price.

        Those of a number and of its negative are never those of an empty interval, as of `met`.
        """
        if is_counted():
            return self.ends(start, cut)[1]
        center, own = self.rows[:, 0], start.count
        above = center + start.uppers(self.rows[:, 2 : 2 + own], cut) + self.rest(own) + self.off
        least, most = self.ends_by_interval()
        return larger(smaller(above, most), larger(smaller(center, most), least))

    def ends_by_form(self, start: InitialColumns, cut: bool = False) -> Ends:
        """Lower and upper bounds `(k,)` by forms alone."""
        own, n = start.count, self.width
        center = self.rows[:, 0]
        lower, upper = start.bounds(self.rows[:, 2 : 2 + own], cut)
        error = errors(lambda: gamma(8) * (abs(center) + larger(-lower, upper)))
        slack = self.rest(own) + (self.off + error) * (1 + gamma(n))
        return center + lower - slack, center + upper + slack

    def ends_by_interval(self) -> Ends:
        """Lower and upper bounds `(k,)` by intervals alone."""
        middle = self.rows[:, 1]
        error = errors(lambda: gamma(2) * abs(middle))
        reach = self.radii[:, -1] * (1 + gamma(2)) + error
        return middle - reach, middle + reach

    def of_first(self, start: InitialColumns) -> AffineForms:
        """The numbers over the first columns, what all others add counted as an error (numpy)."""
        own = start.count
        off = (self.rest(own) + self.off) * (1 + gamma(4))
        return AffineForms(self.rows[:, : 2 + own], radii_of(off, self.radii[:, -1]))

    def over_part(self, part: SubboxColumns) -> AffineForms:
        """Forms in the first columns, over those of a part of the initial box (numpy)."""
        n, size = self.columns.shape[1], abs(self.columns).sum(axis=1)
        constant = self.rows[:, 0] + self.columns @ part.change[:, 0]
        columns = self.columns @ part.change[:, 1:]
        lost = 4 * TINY * (n + 2) ** 2 * (1 + SIZE * size)
        error = gamma(n + 24) * (abs(self.rows[:, 0]) + SIZE * size) + lost
        rows = np.concatenate([constant[:, None], self.rows[:, 1:2], columns], axis=1)
        off = (self.off + error) * (1 + gamma(4))
        return AffineForms(rows, radii_of(off, self.radii[:, -1]))

    def widened(self, by) -> AffineForms:
        """The numbers up to an error of so much each."""
        return AffineForms(self.rows, (self.radii + by[..., None]) * (1 + gamma(4)), self.inner)

    def where_known(self, others: Sequence[AffineForms]) -> AffineForms:
        """The numbers, of which nothing is known where others have no form and no interval."""
        xp = namespace(self.rows)
        lost: Any = False
        for each in others:
            form = abs(each.rows[:, 0]) + abs(each.columns).sum(axis=1)
            form = form + each.within_part + each.off
            interval = abs(each.rows[:, 1]) + each.radii[:, -1]
            lost = lost | xp.any(~(xp.isfinite(form) | xp.isfinite(interval)))
        return AffineForms(self.rows, self.radii + xp.where(lost, xp.nan, 0.0), self.inner)

    def padded(self, width: int) -> AffineForms:
        """The forms over at least so many columns, the new ones empty (numpy)."""
        more = width - self.rows.shape[1] + 2
        if more <= 0:
            return self
        rows = np.zeros((len(self.rows), width + 2))
        rows[:, : self.rows.shape[1]] = self.rows
        return AffineForms(rows, self.radii)

    def with_own(self, by: Float[Array, " k"], place: Place) -> tuple[AffineForms, Any]:
        """Each number with so much of a column of its own, and where that is, -1 where none is.

        Without a place they come after the columns of these forms, which have to be over all the
        columns there are: see `padded`.
        """
        k, n = self.rows.shape
        if isinstance(place, Inner):
            inner = self.inner | {place.first: by}
            return AffineForms(self.rows, self.radii, inner), np.full(k, -1)
        if place is not None:
            own = select(np.eye(k, dtype=bool), by[:, None], 0.0)
            rows = jax.lax.dynamic_update_slice(self.rows, own, (0, 2 + place))
            return AffineForms(rows, self.radii), place + jnp.arange(k)
        needed = by != 0
        where, count = np.flatnonzero(needed), int(needed.sum())
        rows = np.zeros((k, n + count))
        rows[:, :n] = self.rows
        rows[where, n + np.arange(count)] = by[where]
        places = np.where(needed, n - 3 + np.cumsum(needed), -1)
        return AffineForms(rows, self.radii), places


def _once(radii: Any) -> Any:
    """Radii that compilers do not compute again for each of their uses, which are many."""
    return settled(radii) if is_counted() else radii


def radii_of(off: Any, interval: Any) -> Any:
    """The radii of forms and of intervals beside each other, or of these alone."""
    if off is NOTHING:
        return interval[:, None]
    return namespace(off, interval).stack([off, interval], axis=1)


def joined(parts: Sequence[AffineForms]) -> AffineForms:
    """All of these forms, which are over the same columns."""
    if len(parts) == 1:
        return parts[0]
    xp = namespace(parts[0].rows)
    rows, radii = zip(*((part.rows, part.radii) for part in parts), strict=True)
    inner = {key: _stacked(key, parts) for part in parts for key in part.inner}
    return AffineForms(xp.concatenate(rows), xp.concatenate(radii), inner)


def folded(parts: Any, count: int) -> Any:
    """Sums of so many blocks of rows of equal length; `numbers.summed` has the last axis."""
    if count == 1:
        return parts
    return parts.reshape(count, len(parts) // count, *parts.shape[1:]).sum(axis=0)


def _stacked(layer: int, parts: Sequence[AffineForms]) -> Any:
    """The columns of a layer in forms one behind the other, of which some may have none."""
    known = [_whole(part.inner[layer]) for part in parts if layer in part.inner]
    left, width = iter(known), known[0].shape[1]
    none = (jnp.zeros((len(part), width)) for part in parts)
    pairs = zip(parts, none, strict=True)
    return jnp.concatenate([next(left) if layer in part.inner else zero for part, zero in pairs])


def _whole(part: Any) -> Any:
    """The columns of a layer as a matrix."""
    return jnp.diag(part) if part.ndim == 1 else part


def _added(one: Layers, other: Layers) -> Layers:
    """Sums of the columns within a part."""
    found = one | other
    for key in one.keys() & other.keys():
        parts = one[key], other[key]
        same = parts[0].ndim == parts[1].ndim
        found[key] = sum(parts if same else map(_whole, parts))
    return found


def _sum(one: Any, other: Any) -> Any:
    """Rows over columns, of which one may have more than the other."""
    if one.shape[1] == other.shape[1]:
        return one + other
    few, many = sorted((one, other), key=lambda rows: rows.shape[1])
    rows = many.copy()
    rows[:, : few.shape[1]] += few
    return rows
