"""One step of the loop in affine forms: its own forward pass, run over them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from reachjax.loops import ClosedLoop
from reachjax.loops.units import AbstractUnit
from reachjax.numerics.rounding import Ball, gamma, namespace
from reachjax.programs.affine import AffineForms, Place, met
from reachjax.programs.initial import Ends, InitialColumns, constant, settled
from reachjax.sets import Box

SPILL = 1e-13
"""On the host a state's radius gets a column where it is more than this part of its range. It is
multiplied by `|W|` of all layers of a step before it gets its next chance."""


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
        outputs: forms of the values.
    """

    unit: AbstractUnit
    inputs: AffineForms
    lower: Float[Array | np.ndarray, " k"]
    upper: Float[Array | np.ndarray, " k"]
    slope: Float[Array | np.ndarray, " k"]
    offset: Float[Array | np.ndarray, " k"]
    gap: Float[Array | np.ndarray, " k"]
    places: Int[Array | np.ndarray, " k"]
    outputs: AffineForms


Ranges = Callable[[AbstractUnit, AffineForms, Ends, Sequence[UnitForms]], Ends]
"""Bounds of a layer's inputs that are no worse than these, given the layers before."""


def step_forms(
    loop: ClosedLoop,
    state: AffineForms,
    t: int | Array,
    start: InitialColumns,
    place: Place = None,
    slopes: Float[Array | np.ndarray, " units"] | None = None,
    known: Box | None = None,
    ranges: Ranges | None = None,
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
        ranges: what else bounds the inputs of a layer, if anything does.

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
        ends = _cut(unit, y, start)
        if ranges is not None:
            ends = ranges(unit, y, ends, found)
        z, forms = _unit(unit, y, ends, None if place is None else place + here.start, slope)
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
    unit: AbstractUnit, y: AffineForms, ends: Ends, place: Place, slope: Any
) -> tuple[AffineForms, UnitForms]:
    """What a layer of units makes of its inputs, whose bounds are known."""
    xp, (lower, upper) = namespace(y.rows), ends
    if slope is None:
        slope = unit.lines(lower, upper).above.slope
    rest, values = (
        Ball.between(*ends)
        for ends in (unit.remainder(slope, lower, upper), unit.interval(lower, upper))
    )
    slope, offset, gap = settled((slope, rest.mid, rest.rad))
    left = xp.zeros_like(gap)
    rows = slope[:, None] * y.rows
    constants = xp.stack([rows[:, 0] + offset, values.mid], axis=1)
    if not unit.separable:  # what rounding alone leaves of a value needs no column
        small = gap <= SPILL * abs(y.columns).max(axis=1, initial=0.0)
        left, gap = xp.where(small, gap, 0.0), xp.where(small, 0.0, gap)
    # products with 0 and 1 are exact
    size = abs(constant(rows)).sum(axis=1) + abs(constant(offset))
    rounded = (slope != 0) & (abs(slope) != 1) | (offset != 0)
    radius = abs(slope) * y.radii[:, 0] + xp.where(rounded, gamma(4) * size, 0.0)
    radius = constant(radius + left) * (1 + gamma(rows.shape[1]))
    z = AffineForms(
        xp.concatenate([constants, rows[:, 2:]], axis=1), xp.stack([radius, values.rad], axis=1)
    )
    z, places = z.with_own(gap, place)
    return z, UnitForms(unit, y, lower, upper, slope, offset, gap, places, z)


def _cut(unit: AbstractUnit, y: AffineForms, start: InitialColumns) -> Ends:
    """Bounds of inputs, also by what cuts the initial set; if that takes programs, of switching."""
    lower, upper = y.ends(start)
    if start.cut is None:
        return lower, upper
    if not start.cut.needs_programs:
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
