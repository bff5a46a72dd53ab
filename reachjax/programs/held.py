"""Where bounds over a horizon are attained, as compiled forms hold it while a derivative is taken.

A bound is the largest value of a row over the columns, so the row's derivative where that is
attained is the bound's (Danskin). Of a form that is where its norm is; of a linear program, at its
vertex: there reduced costs are zero but for rounding, and their signs mean nothing. Ranges of units
are bounds too and are held alike, so that lines of units move as they do.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from reachjax.programs.affine import AffineForms
from reachjax.programs.affine_steps import UnitForms, step_columns
from reachjax.programs.horizon import Horizon
from reachjax.programs.initial import InitialColumns
from reachjax.programs.moving import INTERVAL, KNOWN, HeldBounds
from reachjax.sets.linear_programs import support

NEAR = 1e-7
"""Values of a row that differ by a smaller part of its size are the same."""

LARGE = 4e6
"""Multipliers up to this many have one shape for all steps, which is compiled once."""

Facets = tuple[Float[Array | np.ndarray, "r n"], Float[Array | np.ndarray, " r"]]
"""Normals and offsets."""


class Attained(NamedTuple):
    """Where a bound of a row is attained.

    Attributes:
        columns: `(n,)`, of the first columns.
        multipliers: `(m,)`, of the first facts of the horizon.
        of_set: `(r,)`, of the facets of what the initial set is cut by, beside those.
    """

    columns: Float[np.ndarray, " n"]
    multipliers: Float[np.ndarray, " m"] = np.zeros(0)
    of_set: Float[np.ndarray, " r"] = np.zeros(0)


Source = Attained | None
"""What a bound rests on: None for an interval."""


class _Bound(NamedTuple):
    """A bound, where compiled forms have its columns, and where its number is to be written."""

    source: Attained
    places: Int[np.ndarray, " n"]
    slot: Int[np.ndarray, ""]


class _Layer(NamedTuple):
    """A layer of units.

    Attributes:
        step: of the horizon.
        number: of the layer.
        before: how many inputs of units of the step come before its own.
        forms: of its units.
        places: `(n,)`, where compiled forms have the columns so far; -1 where they have none.
    """

    step: int
    number: int
    before: int
    forms: UnitForms
    places: Int[np.ndarray, " n"]


def held_bounds(
    horizon: Horizon, bounds: Sequence[Source], steps: int, facets: Facets | None = None
) -> HeldBounds:
    """Where bounds of the last states are attained, and those of ranges that they rest on.

    Args:
        horizon: over some of the steps.
        bounds: of directions.
        steps: over how many steps compiled forms go.
        facets: of the polytope that the initial set is cut by; None for the horizon's own.
    """
    start, own = horizon.start, facets is None
    if own and start.cut is not None:
        facets = start.cut.facets
    layers, places = _layers(horizon, steps)
    first = [layer.forms for layer in layers if layer.step == 0]
    inputs = sum(len(forms.lower) for forms in first)
    units = sum(len(forms.gap) for forms in first)
    ranges, states = np.zeros((steps, 2, inputs)), np.zeros((steps, 2, len(start.center)))
    of_ranges, of_states = (np.full(part.shape, INTERVAL) for part in (ranges, states))
    found = list[_Bound]()
    for layer in layers:
        here = slice(layer.before, layer.before + len(layer.forms.lower))
        ranges[layer.step, :, here] = layer.forms.lower, layer.forms.upper
        given = _of_layer(horizon, layer, facets)
        found += _told(given, layer.places, of_ranges[layer.step, :, here])
    for step, (forms, (lower, upper)) in enumerate(zip(horizon.states, horizon.ends, strict=True)):
        states[step] = lower, upper
        sides = (-forms, -lower), (forms, upper)
        given = [sources(start, rows, end, None) for rows, end in sides]
        found += _told(given, places[step], of_states[step])
        narrowed = [end < rows.ends(start)[1] - _near(rows) for rows, end in sides]
        of_states[step] = np.where(narrowed, KNOWN, INTERVAL)
    for part in (ranges, states):  # what comes later has no say, but shall be finite
        part[len(horizon.steps) :] = part[len(horizon.steps) - 1]
    nothing = Attained(np.zeros(0))
    directions = [_Bound(bound or nothing, places[-1], np.zeros((), int)) for bound in bounds]
    found = sorted(found, key=lambda bound: not _weighed(bound.source))
    for number, bound in enumerate(found, start=len(bounds)):
        if bound.slot != KNOWN:
            bound.slot[...] = number
    found = directions + found
    weighed = len(bounds) + sum(_weighed(bound.source) for bound in found[len(bounds) :])
    more, between = step_columns(horizon.loop)
    shape = steps, horizon.kinds, units
    every = len(bounds) + 2 * steps * (inputs + len(start.center))  # few shapes: each is compiled
    some = every if every * np.prod(shape) < LARGE else 1 << (weighed - 1).bit_length()
    columns = np.zeros((max(every, some), start.count + steps * more + between))
    multipliers = np.zeros((some, len(horizon.facts.rows)))
    of_set = np.zeros((some, 0 if facets is None else len(facets[1])))
    for k, (source, where, _) in enumerate(found):
        there = np.flatnonzero(where[: len(source.columns)] >= 0)
        columns[k, where[there]] = source.columns[there]
    for k, (source, *_) in enumerate(found[:weighed]):
        multipliers[k, : len(source.multipliers)] = source.multipliers
        of_set[k, : len(source.of_set)] = source.of_set
    return HeldBounds(
        columns=columns,
        of_units=horizon.of_units(multipliers, steps),
        of_set=of_set + horizon.of_set(multipliers) if own else of_set,
        by_interval=np.array([bound is None for bound in bounds]),
        ranges=ranges,
        of_ranges=of_ranges,
        states=states,
        of_states=of_states,
    )


def _weighed(source: Attained) -> bool:
    """Whether there are multipliers."""
    return bool(len(source.multipliers) + len(source.of_set))


def _told(
    given: Sequence[Sequence[Source]], places: Int[np.ndarray, " n"], slots: Int[np.ndarray, "2 k"]
) -> list[_Bound]:
    """The bounds of both sides that no interval gives, and where their numbers go."""
    return [
        _Bound(source, places, slots[side, k : k + 1].reshape(()))
        for side, sources in enumerate(given)
        for k, source in enumerate(sources)
        if source is not None
    ]


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
        columns: where a program says that it is attained; NaN where none does.
    """
    start, facts = horizon.start, horizon.facts[: len(multipliers)]
    width = max(row.columns.shape[1], facts.columns.shape[1])
    own, others = row.padded(width).columns[0], facts.padded(width).columns
    weighed = own + multipliers @ others
    first, rest = np.split(weighed, [start.count])
    there = np.sign(weighed)
    near = NEAR * (abs(own) + abs(multipliers) @ abs(others)).sum()  # they may cancel
    varying = horizon.varying
    varying = varying[varying < len(columns)]
    varying = varying[np.isfinite(columns[varying])]
    there[varying] = columns[varying]
    by_norm = start.bounds(first[None])[1][0]
    largest = by_norm + abs(rest).sum()
    if start.round or weighed @ there < largest - near:
        there[: start.count] = start.attaining(first[None])[0]
        if by_norm + rest @ there[start.count :] < largest - near:  # the program did not find it
            there[start.count :] = np.sign(rest)
    return Attained(there, multipliers)


def sources(
    start: InitialColumns,
    rows: AffineForms,
    ends: Float[np.ndarray, " k"],
    facets: Facets | None,
) -> list[Source]:
    """What upper bounds of rows rest on that are of forms or intervals.

    Args:
        start: what the first columns are.
        rows: one a bound.
        ends: the bounds.
        facets: of the polytope that the initial set is cut by, where rows are bounded on it.
    """
    first, rest = np.split(rows.columns, [start.count], axis=1)
    there = np.concatenate([start.attaining(first), np.sign(rest)], axis=1)
    found: list[Source] = [Attained(columns) for columns in there]
    better = ends < rows.ends_by_form(start)[1] - _near(rows)
    intervals = better & (rows.ends_by_interval()[1] < ends + _near(rows))
    for number in np.flatnonzero(intervals):
        found[number] = None
    cut = np.flatnonzero(better & ~intervals)
    if facets is None or not len(cut) or start.cut is None or not start.cut.needs_programs:
        return found
    A, b = (np.asarray(part) for part in facets)
    w = len(start.spread)
    try:
        _, multipliers, points = support(A, b, first[cut, :w] @ start.back)
    except (ValueError, RuntimeError):  # too thin for programs
        return found
    states = (points - start.center) @ start.back.T
    for number, state, of_set in zip(cut, states, multipliers, strict=True):
        columns = np.concatenate([state, np.sign(rows.columns[number, w:])])
        found[number] = Attained(columns, of_set=of_set)
    return found


def _of_layer(horizon: Horizon, layer: _Layer, facets: Facets | None) -> list[list[Source]]:
    """What lower and upper ends of the inputs of units rest on."""
    inputs, found = layer.forms.inputs, list[list[Source]]()
    sides = (-inputs, -layer.forms.lower), (inputs, layer.forms.upper)
    for side, (rows, ends) in enumerate(sides):
        found.append(sources(horizon.start, rows, np.asarray(ends), facets))
        for end in horizon.better:
            if (end.step, end.layer, end.side) == (layer.step, layer.number, side):
                row = rows[end.unit : end.unit + 1]
                found[side][end.unit] = attained(horizon, row, end.multipliers, end.columns)
    return found


def _near(rows: AffineForms) -> Float[np.ndarray, " k"]:
    return NEAR * np.asarray(abs(rows.columns).sum(axis=1))


def _layers(horizon: Horizon, steps: int) -> tuple[list[_Layer], list[Int[np.ndarray, " n"]]]:
    """Layers of units, and where compiled forms have all columns after each step.

    Args:
        horizon: over some of the steps.
        steps: over how many steps compiled forms go.
    """
    start, (more, between) = horizon.start, step_columns(horizon.loop)
    places = np.full(horizon.width + between, -1)
    places[: start.count] = np.arange(start.count)
    end, found, after = start.count + steps * more, list[_Layer](), list[np.ndarray]()
    for step, (layers, merged) in enumerate(zip(horizon.steps, horizon.merged, strict=True)):
        place, scratch, before = start.count + step * more, end, 0
        of_parts = {number: part for part in merged for number in part.layers}
        for number, layer in enumerate(layers):
            found.append(_Layer(step, number, before, layer, places.copy()))
            here, before = np.flatnonzero(layer.places >= 0), before + len(layer.lower)
            if number not in of_parts:
                places[layer.places[here]] = place + here
                place += len(layer.places)
                continue
            places[layer.places[here]] = scratch + here
            scratch, part = scratch + len(layer.places), of_parts[number]
            if number == part.layers[-1]:  # what is in between is gone
                places[places >= end], scratch = -1, end
                here = np.flatnonzero(part.places >= 0)
                places[part.places[here]] = place + here
                place += len(part.places)
        after.append(places.copy())
    return found, after
