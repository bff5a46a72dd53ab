"""What bounds over a horizon rest on, as compiled forms hold it while a derivative is taken.

A bound is the largest value of a row over the columns, so the row's derivative where that is
attained is the bound's (Danskin). Of a form that is where its norm is; of a linear program, at its
vertex: there reduced costs are zero but for rounding, and their signs mean nothing. What better
ranges of units rest on is held alike, so that lines of units move as they do.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from reachjax.programs.affine import AffineForms
from reachjax.programs.affine_steps import UnitForms, step_columns
from reachjax.programs.horizon import OF_PRODUCTS, OF_SET, Horizon
from reachjax.programs.initial import InitialColumns
from reachjax.programs.unrolled import HeldBounds
from reachjax.sets.polyhedra import support

NEAR = 1e-7
"""Values of a row that differ by a smaller part of its size are the same."""

Facets = tuple[np.ndarray, np.ndarray]


class Attained(NamedTuple):
    """Where a bound of a row is attained.

    Attributes:
        columns: `(n,)`, of the first columns.
        multipliers: `(m,)`, of the first facts.
        of_set: `(r,)`, of the facets of what the initial set is cut by, beside those.
        by_norm: whether it is attained instead where the norm of the initial columns is.
    """

    columns: Float[np.ndarray, " n"]
    multipliers: Float[np.ndarray, " m"] = np.zeros(0)
    of_set: Float[np.ndarray, " r"] = np.zeros(0)
    by_norm: bool = False


class _Layer(NamedTuple):
    """A layer of units and its place among the units of a step, and its columns'.

    Attributes:
        step: of the horizon.
        number: of the layer.
        before: how many units of the step come before it.
        forms: of its units.
        places: `(n,)`, where compiled forms have the columns so far; -1 where they have none.
    """

    step: int
    number: int
    before: int
    forms: UnitForms
    places: Int[np.ndarray, " n"]

    @property
    def here(self) -> slice:
        """The units among those of the step."""
        return slice(self.before, self.before + len(self.forms.places))


def held_bounds(
    horizon: Horizon, bounds: Sequence[Attained | None], steps: int, facets: Facets | None = None
) -> HeldBounds:
    """What bounds of the last states rest on, and the ranges of units that these do.

    Args:
        horizon: over some of the steps.
        bounds: of directions; None for those of forms alone.
        steps: over how many steps compiled forms go.
        facets: of the polytope that the initial set is cut by; None for the horizon's own.
    """
    start, facts, own = horizon.start, horizon.facts, facets is None
    if own and start.cut is not None:
        facets = start.cut.facets
    layers, last = _layers(horizon, steps)
    units = sum(len(layer.forms.places) for layer in layers if layer.step == 0)
    ranges, numbers = np.zeros((steps, 2, units)), np.full((steps, 2, units), -1)
    found = [(bound or Attained(np.zeros(0)), last) for bound in bounds]
    for layer in layers:
        ranges[layer.step, :, layer.here] = np.stack([layer.forms.lower, layer.forms.upper])
        for side, number, bound in _of_ranges(horizon, layer, facets):
            numbers[layer.step, side, layer.here][number] = len(found)
            found.append((bound, layer.places))
    count = 1 << (len(found) - 1).bit_length()  # few shapes: each is compiled
    more, between = step_columns(horizon.loop)
    columns = np.zeros((count, start.count + steps * more + between))
    multipliers = np.zeros((count, len(facts.rows)))
    of_set = np.zeros((count, 0 if facets is None else len(facets[1])))
    for k, (bound, places) in enumerate(found):
        there = np.flatnonzero(places[: len(bound.columns)] >= 0)
        columns[k, places[there]] = bound.columns[there]
        multipliers[k, : len(bound.multipliers)] = bound.multipliers
        of_set[k, : len(bound.of_set)] = bound.of_set
    if own:
        of_set += horizon.of_kind(multipliers, OF_SET)
    return HeldBounds(
        of_units=horizon.of_units(multipliers, steps),
        of_set=of_set,
        of_products=horizon.of_kind(multipliers, OF_PRODUCTS),
        columns=columns,
        by_norm=np.array([bound.by_norm for bound, _ in found] + [False] * (count - len(found))),
        by_form=np.array([bound is None for bound in bounds]),
        ranges=ranges,
        of_ranges=numbers,
    )


def attained(
    horizon: Horizon,
    row: AffineForms,
    multipliers: Float[np.ndarray, " m"],
    columns: Float[np.ndarray, " n"],
) -> Attained:
    """Where a bound of one row by multipliers is attained.

    Args:
        horizon: of whose first facts they are.
        row: one.
        multipliers: of the facts.
        columns: where a program says that it is attained; those of rounding errors do not matter.
    """
    start, count = horizon.start, horizon.start.count
    facts = horizon.facts[: len(multipliers)]
    width = max(row.columns.shape[1], facts.columns.shape[1])
    weighed = row.widened(width).columns[0] + multipliers @ facts.widened(width).columns
    first, there = weighed[None, :count], np.sign(weighed)
    largest = start.bounds(first)[1][0] + abs(weighed[count:]).sum()
    varying = horizon.varying
    varying = varying[varying < len(columns)]
    there[varying] = columns[varying]
    near = NEAR * abs(weighed).sum()
    if not start.round and weighed @ there > largest - near:
        return Attained(there, multipliers)
    by_norm = start.bounds(first)[1][0] + weighed[count:] @ there[count:]
    if abs(by_norm - largest) > near:  # the program has not found where it is
        there = np.sign(weighed)
    return Attained(there, multipliers, by_norm=True)


def by_cut(start: InitialColumns, rows: AffineForms, facets: Facets) -> list[Attained]:
    """Where rows are largest on a polytope that cuts the initial set.

    Raises:
        ValueError, RuntimeError: the polytope is too thin for programs.
    """
    first, rest = np.split(rows.columns, [len(start.spread)], axis=1)
    A, b = facets
    _, multipliers, points = support(np.asarray(A), np.asarray(b), first @ start.back)
    there = np.concatenate([(points - start.center) @ start.back.T, np.sign(rest)], axis=1)
    return [
        Attained(columns, of_set=of_set) for columns, of_set in zip(there, multipliers, strict=True)
    ]


def _of_ranges(
    horizon: Horizon, layer: _Layer, facets: Facets | None
) -> Iterator[tuple[int, int, Attained]]:
    """Side, number of the unit, and where it is attained, of ends that no form gives."""
    known, inputs = set[tuple[int, int]](), layer.forms.inputs
    for end in horizon.tightened:
        if (end.step, end.layer) == (layer.step, layer.number):
            row = inputs[end.unit : end.unit + 1]
            known.add((end.side, end.unit))
            row = row if end.side else -row
            yield end.side, end.unit, attained(horizon, row, end.multipliers, end.columns)
    cut = horizon.start.cut
    if facets is None or cut is None or not cut.needs_programs:
        return
    lower, upper = inputs.ends(horizon.start)
    near = NEAR * (upper - lower)
    better = layer.forms.lower > lower + near, layer.forms.upper < upper - near
    for side, rows in enumerate((-inputs, inputs)):
        units = [k for k in np.flatnonzero(better[side]) if (side, k) not in known]
        if units:
            yield from zip(
                [side] * len(units), units, by_cut(horizon.start, rows[units], facets), strict=True
            )


def _layers(horizon: Horizon, steps: int) -> tuple[list[_Layer], Int[np.ndarray, " n"]]:
    """Layers of units, and where compiled forms have all columns.

    Args:
        horizon: over some of the steps.
        steps: over how many steps compiled forms go.
    """
    start, (more, between) = horizon.start, step_columns(horizon.loop)
    places = np.full(horizon.width + between, -1)
    places[: start.count] = np.arange(start.count)
    end, found = start.count + steps * more, list[_Layer]()
    for step, (layers, merged) in enumerate(zip(horizon.steps, horizon.merged, strict=True)):
        place, scratch, before = start.count + step * more, end, 0
        summed = range(0) if merged is None else merged.layers
        for number, layer in enumerate(layers):
            found.append(_Layer(step, number, before, layer, places.copy()))
            here, before = np.flatnonzero(layer.places >= 0), before + len(layer.places)
            if number not in summed:
                places[layer.places[here]] = place + here
                place += len(layer.places)
                continue
            places[layer.places[here]] = scratch + here
            scratch += len(layer.places)
            if merged is not None and number == summed[-1]:  # what is in between is gone
                places[places >= end] = -1
                here = np.flatnonzero(merged.places >= 0)
                places[merged.places[here]] = place + here
                place += len(merged.places)
    return found, places
