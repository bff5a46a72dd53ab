"""One step of the loop in affine forms: its own forward pass, run over them.

A smooth unit is its quadratic model: with `y = c + d`, `d = g w + h`, where `w` are the columns of
the initial state and `|g w| <= S`, `|h| <= R` for what else there is,

    f(y) = p + s d + q (g w)^2 + e v,    |v| <= 1,    e = (error of the model) + |q| (2 S R + R^2),

and `(g w)^2` is a row over products of the `w`, which are columns too (`initial`). Where `h` is so
large that lines leave less out, it is these. What the units of a smooth part leave out, or of any
part where columns shall be few, that is of the controller or of the plant, is summed up at its
outputs, one column for each: a step adds as many columns for ten neurons as for a thousand. They
stay columns, which the feedback contracts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from reachjax.loops import ClosedLoop
from reachjax.loops.closed_loop import UnitLayer
from reachjax.loops.flows.flow import AbstractFlow
from reachjax.loops.tracing.limits import Limits
from reachjax.loops.units import AbstractUnit, Bilinear, Quadratic, SmoothUnit, UnboundedError
from reachjax.numerics.rounding import (
    NOTHING,
    TINY,
    Ball,
    errors,
    gamma,
    is_counted,
    namespace,
    rounding,
    select,
)
from reachjax.programs.affine import AffineForms, Inner, Place, folded, joined, radii_of
from reachjax.programs.flows import Between, flowed_forms
from reachjax.programs.initial import Ends, InitialColumns, constant, met, settled
from reachjax.sets import Box

SPILL = 1e-13
"""On the host a state's radius gets a column where it is more than this part of its range. It is
multiplied by `|W|` of all layers of a step before it gets its next chance."""


class UnitForms(NamedTuple):
    """What affine forms make of a layer of units.

    Attributes:
        unit: which one.
        inputs: forms of the inputs, of several for each unit one behind the other.
        lower: bounds of the inputs.
        upper: the same.
        slope: `(k,)`, with `slope y + offset - gap <= z <= slope y + offset + gap` in between.
        offset: `(k,)`.
        gap: `(k,)`, zero where the unit is affine there.
        places: `(k,)`, the column that each got; -1 where it needs none.
        outputs: forms of the values.
    """

    unit: AbstractUnit
    inputs: AffineForms
    lower: Float[Array | np.ndarray, " inputs"]
    upper: Float[Array | np.ndarray, " inputs"]
    slope: Float[Array | np.ndarray, " k"]
    offset: Float[Array | np.ndarray, " k"]
    gap: Float[Array | np.ndarray, " k"]
    places: Int[Array | np.ndarray, " k"]
    outputs: AffineForms

    @property
    def curved(self) -> bool:
        """Whether the columns are of what smooth units leave out."""
        return self.unit.curved


class PartColumns(NamedTuple):
    """What the units of a part of a step leave out, as one column for each of its outputs.

    Attributes:
        outputs: forms of the outputs.
        gap: `(m,)`, how much each has of its column.
        places: `(m,)`, the columns; -1 where none is needed.
        layers: those of the step that it sums up.
    """

    outputs: AffineForms
    gap: Float[Array | np.ndarray, " m"]
    places: Int[Array | np.ndarray, " m"]
    layers: range

    @property
    def curved(self) -> bool:
        """Whether the columns are of what smooth units leave out: of several layers, yes."""
        return True


class StepForms(NamedTuple):
    """What affine forms make of one step.

    Attributes:
        successor: of the state.
        units: of each layer of units.
        merged: of the outputs of the controller and of the plant, those whose units are summed up.
    """

    successor: AffineForms
    units: tuple[UnitForms, ...]
    merged: tuple[PartColumns, ...]


Ranges = Callable[[AbstractUnit | None, AffineForms, Ends, Sequence[UnitForms]], Ends]
"""Bounds of a layer's inputs that are no worse than these, given the layers before; or, of no unit,
of the state after the step."""


def states_facts(unit: AbstractUnit) -> bool:
    """Whether facts of a unit say more than its form; columns of free units say all theirs do."""
    return not (unit.free or unit.curved)


def merges(layers: Sequence[UnitLayer], outputs: int, few: bool = False) -> bool:
    """Whether what the units of a part leave out is summed up at its outputs.

    That is so if all of them are smooth, or columns shall be few, and they are more than the
    outputs.
    """
    return (few or all(layer.unit.curved for layer in layers)) and _count(layers) > outputs


def _count(layers: Sequence[UnitLayer]) -> int:
    """How many units layers have."""
    return sum(layer.size for layer in layers)


def step_columns(loop: ClosedLoop, few: bool = False) -> tuple[int, int]:
    """How many columns a step adds, and how many it needs in between.

    Those of the states' radii are among them where rounding is counted, and of what a flow leaves
    out. None is needed in between where rounding is not counted.

    Args:
        loop: the closed loop.
        few: whether what units of any kind leave out is summed up.
    """
    spilled = is_counted() or loop.plant.continuous
    kept, between = loop.units + (loop.states if spilled else 0), 0
    parts = (loop.controller_layers, loop.plant.inputs), (loop.plant_layers, loop.states)
    for layers, outputs in parts:
        if merges(layers, outputs, few):
            kept, between = kept - _count(layers) + outputs, max(between, _count(layers))
    return kept, between if is_counted() else 0


def step_forms(
    loop: ClosedLoop,
    state: AffineForms,
    t: int | Array,
    start: InitialColumns,
    place: Place = None,
    slopes: Float[Array | np.ndarray, " units"] | None = None,
    known: Box | None = None,
    ranges: Ranges | None = None,
    scratch: int | None = None,
    before: int = 0,
    spans: list[Between] | None = None,
    few: bool = False,
    w: AffineForms | None = None,
    v: AffineForms | None = None,
) -> StepForms:
    """One step of the loop, whose own forward pass is run over affine forms.

    Args:
        loop: of numpy arrays if the state is.
        state: forms of the state at time `t`.
        t: the time.
        start: what the first columns are.
        place: where the columns of this step begin, as many as `step_columns` says; None to append.
        slopes: of the units that are not smooth; None for those of their lines. What is found holds
            for any.
        known: a box that surely holds the successor, where one is known.
        ranges: what else bounds the inputs of a layer, or the successor, if anything does.
        scratch: where the columns begin that a step needs in between, if these have places among
            all others; None to keep them apart.
        before: how many steps there were since the initial set.
        spans: gets what is in between the samples, of the flow of a differential equation.
        few: whether what units of any kind leave out is summed up.
        w: the disturbances, where they are known; then the start has no box.
        v: the noise, where it is known; the same.
    """
    found: list[UnitForms] = []
    done, width, free = 0, state.columns.shape[1], place

    def apply(unit: Any, *given: AffineForms) -> AffineForms:
        nonlocal done, width, free
        if place is None:  # branches that began alike must not share the columns they add
            given = tuple(y.padded(width) for y in given)
        if isinstance(unit, AbstractFlow):
            successor, between = flowed_forms(unit, given, start, spans is not None)
            if spans is not None:
                spans.append(between)
            return successor
        y = joined(given)
        ends = _cut(unit, y, start)
        if ranges is not None:
            ends = ranges(unit, y, ends, found)
        ends = settled(ends)
        if unit.curved and unit.inputs > 1:
            z, forms = _bilinear(unit, y, ends, free, start)
        elif unit.curved:
            line = unit.linear(*ends)
            if place is None and _is_lost(line, ends):
                ends = met(ends, _ends_by_intervals(loop, start, int(t), before, len(found)))
                line = unit.linear(*ends)
            z, forms = _smooth(unit, y, ends, line, free, start)
        else:
            here = slice(done, done + len(y))
            z, forms = _unit(unit, y, ends, free, None if slopes is None else slopes[here])
        z = settled(z)
        if place is None and unit.curved:
            _require_bounds(forms, int(t))
        done = done + len(z)
        if free is not None:
            free = free + len(z)
        width = z.columns.shape[1]
        found.append(forms)
        return z

    def part(
        layers: Sequence[UnitLayer], outputs: int, run: Callable[..., AffineForms], *given: Any
    ) -> AffineForms:
        """The outputs of a part of the loop."""
        nonlocal width, free
        if not merges(layers, outputs, few):
            return run(*given)
        first, kept, own = len(found), free, width
        if place is not None:
            free = Inner(0) if scratch is None else scratch
        z, gap, places = _merged(run(*given), own, kept, scratch)
        merged.append(PartColumns(z, gap, places, range(first, len(found))))
        width = z.columns.shape[1]
        free = None if kept is None else kept + outputs
        return z

    merged: list[PartColumns] = []
    measured, (plant, net) = loop.measured(state, t, apply, v), (loop.plant, loop.controller)
    u = part(loop.controller_layers, plant.inputs, net.propagate, measured, apply)
    u, pushed = loop.projected(u, t, apply), loop.pushed(state, t, apply, w)
    successor = part(loop.plant_layers, plant.states, plant.propagate, state, u, t, apply, *pushed)
    if place is None:
        successor = successor.padded(width)
    if successor.off is not NOTHING:
        successor = _spilled(successor, free)
        if not is_counted():  # nothing is left of a flow's radii
            successor = AffineForms(successor.rows, successor.radii[:, -1:])
    if place is not None and done > loop.units:
        raise RuntimeError(f"a step met {done} units, but has columns for {loop.units}")
    ends = successor.ends(start)
    if known is not None:
        ends = met(ends, (known.lower, known.upper))
    if ranges is not None:
        ends = ranges(None, successor, ends, found)
    return StepForms(successor.within(Ball.between(*settled(ends))), tuple(found), tuple(merged))


def _is_lost(line: Quadratic, ends: Ends) -> bool:
    """Whether a unit has no bounds somewhere though its inputs have."""
    known = np.isfinite(ends[0]) & np.isfinite(ends[1])
    return bool(np.any(known & ~np.isfinite(line.gap)))


def _ends_by_intervals(
    loop: ClosedLoop, start: InitialColumns, t: int, before: int, number: int
) -> Ends:
    """Bounds of the inputs of a layer by intervals from the box around the initial set.

    They are wider than forms, but do not round what need not be: a set that touches the edge of a
    domain, as `[0, 1]` does that of a root, does not leave it.
    """
    if start.box is None:
        return -np.inf, np.inf
    state, found = Limits(*map(np.asarray, (start.box.lower, start.box.upper))), []

    def apply(unit: AbstractUnit, y: Limits, *others: Limits) -> Limits:
        found.append((y.least, y.most))
        return y.at(unit, *others)

    for k in range(before + 1):
        found.clear()
        state = loop.step(state, t - before + k, apply)
    return found[number]


def _require_bounds(forms: UnitForms, t: int) -> None:
    """Raise an error where a unit has no bounds although its inputs have.

    Raises:
        UnboundedError: that is so.
    """
    unknown = ~(np.isfinite(forms.lower) & np.isfinite(forms.upper))
    lost = ~np.isfinite(forms.gap) & (forms.unit.combined(1.0 * unknown) == 0)
    if lost.any():
        (k, *_) = np.flatnonzero(lost)
        raise UnboundedError(forms.unit, t, float(forms.lower[k]), float(forms.upper[k]))


def _merged(
    forms: AffineForms, width: int, place: Place, scratch: int | None
) -> tuple[AffineForms, Any, Any]:
    """The forms with all columns from some on as one for each number, how much, and where."""
    if forms.inner:
        gap = settled(forms.within_part * (1 + gamma(forms.width)))
        forms, places = AffineForms(forms.rows, forms.radii).with_own(gap, place)
        return forms, gap, places
    own = width if place is None or scratch is None else scratch
    xp, first = namespace(forms.rows), 2 + own
    last = forms.rows[:, first:]
    gap = settled(abs(last).sum(axis=1) * (1 + gamma(last.shape[1])))
    if place is None:
        rows = forms.rows[:, :first]
    else:
        rows = xp.concatenate([forms.rows[:, :first], xp.zeros_like(last)], axis=1)
    forms, places = AffineForms(rows, forms.radii).with_own(gap, place)
    return forms, gap, places


def _smooth(
    unit: SmoothUnit,
    y: AffineForms,
    ends: Ends,
    line: Quadratic,
    place: Place,
    start: InitialColumns,
) -> tuple[AffineForms, UnitForms]:
    """What a layer of smooth units makes of its inputs, whose bounds and lines are known."""
    xp, (lower, upper), w = namespace(y.rows), ends, start.spread.shape[1]
    values, center, rows = Ball.between(*unit.interval(lower, upper)), y.rows[:, 0], y.rows[:, 2:]
    own, rest = start.norms(rows[:, :w]), y.rest(w) + y.off
    model = unit.quadratic(lower, upper, line)
    lost = abs(model.curvature) * (2 * own + rest) * rest
    better = settled(model.gap + lost <= line.gap)
    model = Quadratic(*(select(better, *pair) for pair in zip(model, line, strict=True)))
    lost = select(better, lost, 0.0)
    model, lost, own, rest, values = settled((model, lost, own, rest, values))
    off = center - model.center
    middle = model.offset + (model.slope + model.curvature * off) * off
    slope = model.slope + 2 * model.curvature * off
    slope, curvature, middle = settled((slope, model.curvature, middle))
    level, products = start.squared(rows[:, :w])
    linear = slope[:, None] * rows
    bent = linear[:, w : start.count] + curvature[:, None] * products
    constants = xp.stack([middle + curvature * level, values.mid], axis=1)
    rows = xp.concatenate([constants, linear[:, :w], bent, linear[:, start.count :]], axis=1)

    def size() -> Any:
        size = abs(model.offset) + (abs(model.slope) + 2 * abs(curvature * off)) * abs(off)
        size = size + abs(slope) * (own + rest) + abs(curvature) * own**2 + abs(slope * center)
        some = abs(center) + own + rest + abs(off) + abs(model.offset)
        flushed = TINY * y.width * (1 + abs(slope) + abs(curvature)) * (1 + some)
        return gamma(y.width + 32) * size + select(some > 0, 32 * flushed, 0.0)

    radius = constant(abs(slope) * y.off * (1 + gamma(4)) + errors(size))
    gap = settled((model.gap + lost) * (1 + gamma(16)))
    z = AffineForms(rows, radii_of(radius, values.rad), y.scaled_layers(slope))
    z, places = z.with_own(gap, place)
    offset = middle - slope * center
    return z, UnitForms(unit, y, lower, upper, slope, offset, gap, places, z)


def _bilinear(
    unit: Bilinear, y: AffineForms, ends: Ends, place: Place, start: InitialColumns
) -> tuple[AffineForms, UnitForms]:
    """What a layer of products, or of sums of them, makes of its factors, whose bounds are known.

    With forms `c + g w + h`, of which `|g w| <= S` and `|h| <= R`, products are

        a b  =  c_a c_b + c_a (g_b w + h_b) + c_b (g_a w + h_a) + (g_a w) (g_b w) + e,
        |e|  <=  sum_j |g_a h_bj + g_b h_aj| + R_a R_b,

    the norm being that of the columns `w` and `j` a column of `h`; or the plane in the middle,
    where that leaves less out.
    """
    xp, (lower, upper), w = namespace(y.rows), ends, start.spread.shape[1]
    count, values = unit.terms, Ball.between(*unit.interval(lower, upper))
    center, rows, size = y.rows[:, 0], y.rows[:, 2:], y.width
    planes, offset, gap = unit.planes(lower, upper)
    own, rest, half = start.norms(rows[:, :w]), y.rest(w) + y.off, len(center) // 2
    (S, S_other), (R, R_other) = map(unit.halves, (own, rest))
    r, r_other = (y.off, y.off) if y.off is NOTHING else unit.halves(y.off)
    one, other = y.every[:half], y.every[half:]
    lost = start.mixed_norms(one, other) + S * r_other + S_other * r + R * R_other
    lost = lost + errors(lambda: gamma(w + 8) * (S * R_other + S_other * R))
    lost = lost * (1 + gamma((w + 1) * size + 16))  # compiled, all is one sum
    better = settled(lost <= gap)
    slope = select(xp.concatenate([better, better]), unit.derivative(center), planes)
    offset = folded(select(better, -(center[:half] * center[half:]), offset), count)
    slope, offset = settled((slope, offset))
    gap = settled(folded(select(better, lost, gap), count) * (1 + gamma(count + 8)))
    level, products = (
        folded(select(better.reshape(-1, *[1] * (part.ndim - 1)), part, 0.0), count)
        for part in start.multiplied(one[:, :w], other[:, :w])
    )
    linear = folded(slope[:, None] * rows, 2 * count)
    middle = folded(slope * center, 2 * count) + offset + level
    parts = linear[:, :w], linear[:, w : start.count] + products, linear[:, start.count :]
    form = xp.concatenate([xp.stack([middle, values.mid], axis=1), *parts], axis=1)

    def lose() -> Any:
        sizes = folded(abs(slope) * (abs(center) + own + rest), 2 * count)
        sizes = sizes + folded(abs(slope[:half] * slope[half:]) + S * S_other, count)
        flushed = (size + 8) * (w + 1) * TINY * (1 + folded(abs(center) + own + rest, 2 * count))
        error = gamma(size + 2 * count + 16) * sizes + count * flushed
        return error + folded(abs(slope) * y.off, 2 * count) * (1 + gamma(2 * count + 4))

    z = AffineForms(form, radii_of(errors(lose), values.rad), y.folded_layers(slope, 2 * count))
    z, places = z.with_own(gap, place)
    return z, UnitForms(unit, y, lower, upper, xp.zeros_like(gap), offset, gap, places, z)


def _unit(
    unit: AbstractUnit, y: AffineForms, ends: Ends, place: Place, slope: Any
) -> tuple[AffineForms, UnitForms]:
    """What a layer of units makes of its inputs, whose bounds are known."""
    xp, (lower, upper) = namespace(y.rows), ends
    with rounding(True):  # it is little that these count, and said in many ways
        if slope is None:
            slope = settled(unit.lines(lower, upper).above.slope)
        rest, values = (
            Ball.between(*ends)
            for ends in (unit.remainder(slope, lower, upper), unit.interval(lower, upper))
        )
    offset, gap = settled((rest.mid, rest.rad))
    left = NOTHING if not is_counted() else xp.zeros_like(gap)
    rows = slope[:, None] * y.rows
    constants = xp.stack([rows[:, 0] + offset, values.mid], axis=1)
    if not unit.separable and is_counted():  # what rounding alone leaves of a value is no column
        small = settled(gap <= SPILL * abs(y.columns).max(axis=1, initial=0.0))
        left, gap = select(small, gap, 0.0), select(small, 0.0, gap)

    def size() -> Any:  # products with 0 and 1 are exact
        size = abs(constant(rows)).sum(axis=1) + abs(constant(offset))
        size = size + constant(abs(slope)) * y.within_part
        rounded = (slope != 0) & (abs(slope) != 1) | (offset != 0)
        flushed = select(y.sizes + y.off > 0, 2 * TINY * (y.width + 2), 0.0)
        return select(rounded, gamma(4) * size + flushed, 0.0)

    radius = abs(slope) * y.off + errors(size)
    radius = constant(radius + left) * (1 + gamma(y.width))
    columns = xp.concatenate([constants, rows[:, 2:]], axis=1)
    z = AffineForms(columns, radii_of(radius, values.rad), y.scaled_layers(slope))
    z, places = z.with_own(gap, place)
    return z, UnitForms(unit, y, lower, upper, slope, offset, gap, places, z)


def _cut(unit: AbstractUnit, y: AffineForms, start: InitialColumns) -> Ends:
    """Bounds of inputs, also by what cuts the initial set; if that takes programs, of switching."""
    lower, upper = y.ends(start)
    if start.cut is None:
        return lower, upper
    if not start.cut.needs_programs:
        return y.ends(start, cut=True)
    switching = np.flatnonzero(np.tile(unit.open(lower, upper), unit.inputs))
    if len(switching):
        lower, upper = lower.copy(), upper.copy()
        lower[switching], upper[switching] = y[switching].ends(start, cut=True)
    return lower, upper


def _spilled(forms: AffineForms, place: Place) -> AffineForms:
    """The forms with radii as columns of their own; on the host, those that are not negligible.

    Such a column is what a number is off by: what it is beside must be the same everywhere.
    """
    forms, xp = settled(forms), namespace(forms.rows)
    radius, own = forms.off, xp.ones(len(forms.rows), bool)
    if place is None:
        own = radius > SPILL * abs(forms.columns).sum(axis=1)
    left = xp.stack([xp.where(own, 0.0, radius), forms.radii[:, 1]], axis=1)
    return AffineForms(forms.rows, left).with_own(xp.where(own, radius, 0.0), place)[0]
