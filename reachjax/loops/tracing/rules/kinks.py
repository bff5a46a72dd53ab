"""`jnp.where(c > 0, above, below)` that is continuous: affine pieces, and smooth ones.

Where `above - below = k c + d` exactly, it is `below + k max(c, 0)` up to `d`. Where both are
functions `f` and `g` of one number `y` alone, and `c` is above zero where `y > p`, it is
`f(max(y, p)) + g(min(y, p)) - f(p)` up to `d = f(p) - g(p)`. All of that is computed in rational
numbers. What constants such as 0.3 are rounded by is all that `d` may be; it is an error then.
"""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from reachjax.loops.tracing.rationals import Rationals, aligned, evaluated
from reachjax.loops.tracing.recording import Recorder
from reachjax.loops.tracing.values import Operand, Value
from reachjax.loops.units import ReLU
from reachjax.numerics.rounding import TINY, gamma


class Affine(NamedTuple):
    """A sum of values times rational factors, by their places, and a rational offset."""

    terms: dict[int, Rationals]
    offset: Rationals

    def added(self, other: Affine, factor: Rationals) -> Affine:
        """`self + factor other`."""
        terms = dict(self.terms)
        for place, scale in other.terms.items():
            more = factor * scale
            terms[place] = terms[place] + more if place in terms else more
        return Affine(terms, self.offset + factor * other.offset)


def _affine(operand: Operand, ends: int | None = None) -> Affine:
    """What an operand is of values that are no sums themselves, or of the one at a place."""
    if not isinstance(operand, Value):
        return Affine({}, Rationals.of(operand))
    needed, todo = {}, [operand]
    while todo:
        value = todo.pop()
        if value.place not in needed:
            needed[value.place] = value
            is_sum = value.terms is not None and value.place != ends
            todo += [term.value for term in value.terms or ()] if is_sum else []
    found: dict[int, Affine] = {}
    for place, value in sorted(needed.items()):
        if value.terms is None or place == ends:
            found[place] = Affine({place: Rationals.of(1.0)}, Rationals.of(0.0))
            continue
        total = Affine({}, Rationals.of(value.offset))
        for each, factor, divisor in value.terms:
            scale = Rationals.of(factor).over(Rationals.of(divisor))
            total = total.added(found[each.place], scale)
        found[place] = total
    return found[operand.place]


def bent(recorder: Recorder, condition: Value, below: Operand, above: Operand) -> Operand | None:
    """`above` where the condition is above zero, else `below`.

    None where they are not known to agree where it is zero.
    """
    lines = [*_lines(condition)]
    for ends in (*(y.place for y in lines), None):
        found = _slope(condition, below, above, ends)
        if found is not None:
            slope, jumps = found
            bend = recorder.added(_times(recorder, recorder.rectified(condition), slope), below)
            if _has_more(recorder, above, bend):  # which cancels: it is what JAX computes
                recorder.require(above, sums=True)
            return _loosened(recorder, bend, jumps)
    for y in lines:
        bend = _pieces(recorder, y, condition, below, above)
        if bend is not None:
            return bend
    return None


def _has_more(recorder: Recorder, one: Operand, other: Value) -> bool:
    """Whether units are met on the way to one value that the other does not depend on."""
    if not isinstance(one, Value):
        return False
    rest = {*recorder.between(one)} - {*recorder.between(other)}
    steps = (recorder.steps[place] for place in rest)
    return any(step is not None and step.unit is not None for step in steps)


def _loosened(recorder: Recorder, value: Value, jumps: list[Fraction]) -> Value:
    """A value up to what it jumps by."""
    if not any(jumps):
        return value
    errors = [float(jump) * (1 + gamma(1)) + TINY * bool(jump) for jump in jumps]
    return recorder.loosened(value, _spread(errors, value))


def _jump(one: Fraction, other: Fraction, size: Fraction) -> Fraction | None:
    """How far two numbers are apart; None if that is more than roundings of constants explain."""
    apart = abs(one - other)
    return apart if apart <= Fraction(gamma(4)) * size else None


def _spread(numbers: Any, value: Value) -> np.ndarray:
    """Numbers, or one that stands for all, as an array of the shape of a value."""
    return np.broadcast_to(np.asarray(numbers), (value.size,)).reshape(value.shape)


def _times(recorder: Recorder, value: Value, slope: Rationals) -> Value:
    exact = slope.floats()
    if exact is not None:
        return recorder.scaled(value, _spread(exact, value))
    rounded = [float(each or 0) for each in slope.numbers]
    return recorder.nearly_scaled(value, _spread(rounded, value))


def _slope(
    condition: Value, below: Operand, above: Operand, ends: int | None
) -> tuple[Rationals, list[Fraction]] | None:
    """The `k` of `above - below = k condition`, and what is left; None if there is none."""
    on, low, high = (_affine(each, ends) for each in (condition, below, above))
    rise = high.added(low, Rationals.of(-1.0))
    places = sorted({*on.terms, *rise.terms})
    offsets = [each.offset.numbers for each in (on, low, high)]
    columns = [*_factors(on, places), *_factors(rise, places), *offsets]
    if any(number is None for column in columns for number in column):
        return None
    slopes: list[Fraction | None] = []
    jumps = []
    for entry in aligned(*columns):
        *factors, start, under, over = (Fraction(each or 0) for each in entry)
        scales, rises = factors[: len(places)], factors[len(places) :]
        slope = next((b / a for a, b in zip(scales, rises, strict=True) if a), None)
        if slope is None or any(b != slope * a for a, b in zip(scales, rises, strict=True)):
            return None
        if slope and not TINY < abs(slope) < 1 / TINY:
            return None
        jump = _jump(over - under, slope * start, abs(over) + abs(under) + abs(slope * start))
        if jump is None:
            return None
        slopes.append(slope)
        jumps.append(jump)
    return Rationals(slopes), jumps


def _factors(affine: Affine, places: list[int]) -> list[list[Fraction | None]]:
    zero = Rationals.of(0.0)
    return [affine.terms.get(place, zero).numbers for place in places]


def _lines(condition: Value) -> Iterator[Value]:
    """What a condition is an affine function of, entry by entry, the nearest first: itself."""
    yield condition
    while condition.terms is not None and len(condition.terms) == 1:
        condition = condition.terms[0].value
        yield condition


def _pieces(
    recorder: Recorder, y: Value, condition: Value, below: Operand, above: Operand
) -> Operand | None:
    """A choice as one between two functions of `y`; None unless they are, and agree."""
    found = _kink(condition, y)
    if found is None:
        return None
    kink, rises = found
    at, lost = _meeting(*(_value_at(recorder, each, y, kink) for each in (above, below)))
    floats = kink.floats()
    if floats is None or lost is None:
        return None
    f, g = (above, below) if rises else (below, above)
    floats = _spread(floats, y)
    rise = recorder.rectified(recorder.shifted(y, -floats) if np.any(floats) else y)
    more = recorder.shifted(rise, floats) if np.any(floats) else rise
    less = recorder.added(y, rise, -1)
    same = np.arange(y.size).reshape(condition.shape)
    one, other = (
        recorder.picked(each, same) if isinstance(each, Value) else each
        for each in (
            _changed(recorder, f, y, more, kink, above=True),
            _changed(recorder, g, y, less, kink, above=False),
        )
    )
    found = recorder.added(one, other)
    if np.any(at):
        found = recorder.shifted(found, -_spread(at, condition))
    return _loosened(recorder, found, lost)


def _kink(condition: Value, y: Value) -> tuple[Rationals, bool] | None:
    """Where a condition is zero, and whether it rises there; None if it is no line of `y` alone."""
    on = _affine(condition, y.place)
    scale = on.terms.get(y.place)
    if scale is None or len(on.terms) != 1 or not all(scale.numbers):
        return None
    signs = {each > 0 for each in scale.numbers if each is not None}
    return ((-on.offset).over(scale), signs == {True}) if len(signs) == 1 else None


def _side(recorder: Recorder, y: Value, at: np.ndarray, above: bool) -> Value:
    """`max(y, at)` or `min(y, at)`, whose intervals end there."""
    if above:
        return recorder.shifted(recorder.rectified(recorder.shifted(y, -at)), at)
    turned = recorder.scaled(y, np.array(-1.0))
    return recorder.added(at, recorder.rectified(recorder.shifted(turned, at)), -1)


def halves(
    recorder: Recorder, condition: Value, below: Operand, above: Operand
) -> tuple[Operand, Operand]:
    """Two functions that a condition chooses between, each where it is chosen.

    Smooth functions of the number that is compared get that number up to where it changes, and from
    there on: `log(y)` where `y > 0.1` is `log(max(y, 0.1))`.
    """
    for y in _lines(condition):
        found = _kink(condition, y)
        floats = None if found is None else found[0].floats()
        smooth = [_is_smooth(recorder, each, y) for each in (below, above)]
        if found is None or floats is None or not any(smooth):
            continue
        kink, rises = found
        at, same = _spread(floats, y), np.arange(y.size).reshape(condition.shape)
        cases = []
        for each, bends, is_above in zip((below, above), smooth, (not rises, rises), strict=True):
            if bends:
                side = _side(recorder, y, at, is_above)
                each = _changed(recorder, each, y, side, kink, above=is_above)
                each = recorder.picked(each, same) if isinstance(each, Value) else each
            cases.append(each)
        return cases[0], cases[1]
    return below, above


def _is_smooth(recorder: Recorder, operand: Operand, y: Value) -> bool:
    """Whether an operand is a function of `y` alone, entry by entry, with smooth units."""
    if not isinstance(operand, Value):
        return False
    places = recorder.between(operand, y)
    steps = [recorder.steps[place] for place in places if place != y.place]
    known = y.place in places and all(step is not None and step.entrywise for step in steps)
    return known and any(
        step.unit is not None and step.unit.curved and len(step.parents) == 1
        for step in steps
        if step
    )


def _meeting(
    one: Rationals | None, other: Rationals | None
) -> tuple[list[float], list[Fraction] | None]:
    """Where two functions meet, as floats, and what these and the other one are off by."""
    if one is None or other is None:
        return [], None
    at, lost = [], []
    for a, b in aligned(one.numbers, other.numbers):
        jump = None if a is None or b is None else _jump(a, b, abs(a) + abs(b))
        if jump is None or a is None or abs(a) > 1 / TINY:
            return [], None
        at.append(float(a))
        lost.append(jump + abs(Fraction(at[-1]) - a))
    return at, lost


def _value_at(recorder: Recorder, operand: Operand, y: Value, kink: Rationals) -> Rationals | None:
    """The value where `y` is at its kink; None if it is not of `y` alone, entry by entry."""
    if not isinstance(operand, Value):
        return Rationals.of(operand)
    places = recorder.between(operand, y)
    steps = [recorder.steps[place] for place in places if place != y.place]
    if y.place not in places or any(step is None or not step.entrywise for step in steps):
        return None
    found = {y.place: kink}
    for place in places:
        step = recorder.steps[place]
        if place != y.place and step is not None:
            found[place] = step.apply(evaluated, *(found[parent] for parent in step.parents))
    return found[operand.place]


def _changed(
    recorder: Recorder, operand: Operand, y: Value, new: Value, kink: Rationals, above: bool
) -> Operand:
    """An operand with `max(y, kink)`, or `min(y, kink)`, in the place of `y`.

    A rectifier that bends at the same place is its input there, or zero.
    """
    if not isinstance(operand, Value):
        return operand
    passing = {}
    for place in recorder.between(operand, y):
        step = recorder.steps[place]
        if place != y.place and step is not None and step.unit == ReLU():
            rises = _rises(recorder.values[step.parents[0]], y, kink)
            if rises is not None:
                passing[place] = rises == above
    return recorder.replaced(operand, y, new, passing)


def _rises(value: Value, y: Value, kink: Rationals) -> bool | None:
    """Whether a line through zero at the kink rises or falls; None if a value is none."""
    line = _affine(value, y.place)
    scale = line.terms.get(y.place)
    if scale is None or len(line.terms) != 1:
        return None
    signs = {None if each is None else (each > 0) - (each < 0) for each in scale.numbers}
    through = all(each == 0 for each in (line.offset + scale * kink).numbers)
    return signs == {1} if through and signs in ({1}, {-1}) else None
