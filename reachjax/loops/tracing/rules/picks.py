"""Decisions: steps of what is compared, and what is picked by them.

A comparison is a unit, `Step`, and a choice between more cases says by zeros and ones which of some
events holds. What depends on nothing but a decision is computed by JAX itself, once for each event,
whatever the primitive is and whatever kind of number it makes: whole numbers stay whole numbers. It
becomes a number that is computed with where it meets others, a sum of gated ones.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from reachjax.loops.tracing.rationals import Rationals
from reachjax.loops.tracing.recording import Recorder
from reachjax.loops.tracing.rules.equations import NOT_FINITE, require_exact_whole, shaped
from reachjax.loops.tracing.values import (
    Choice,
    Comparison,
    Conditions,
    Index,
    Operand,
    Parameter,
    Pick,
    Shape,
    Step,
    Term,
    UnsupportedError,
    Value,
    is_constant,
    is_known,
)
from reachjax.loops.units import AbstractUnit, AtUnit, Entered, Gated
from reachjax.loops.units import Step as StepUnit

MANY = 64
"""More events are not told apart: each costs a unit or more where something is picked by it."""

TOO_MANY = (
    f"it decides between more than {MANY} cases: use fewer, or clip what decides, as "
    "jnp.clip(y, -1.0, 1.0), so that fewer are possible"
)


def is_binary(recorder: Recorder, value: Value) -> bool:
    """Whether each number is known to be zero or one."""
    base = recorder.values[value.place]
    return base.binary or (base.source is not None and is_binary(recorder, base.source[0]))


def _marked(recorder: Recorder, value: Value) -> Value:
    """A value of which each number is zero or one."""
    recorder.values[value.place].binary = True
    return value


def gated(recorder: Recorder, gate: Value, value: Value) -> Value:
    """`gate * value`, entry by entry, of a gate that is zero or one."""
    if gate.place == value.place:
        return value
    again = lambda s, y: gated(recorder, s, y)  # noqa: E731
    return _of_two(recorder, Gated(), gate, value, again)


def entered(recorder: Recorder, taken: Value, value: Value) -> Value:
    """A value as a branch gets it that is taken or not: zeros and ones of the value's shape."""
    again = lambda s, y: entered(recorder, s, y)  # noqa: E731
    return _of_two(recorder, Entered(), taken, value, again)


def _of_two(recorder: Recorder, unit: AbstractUnit, gate: Value, value: Value, again: Any) -> Value:
    """What a layer of units makes of zeros and ones and of as many numbers."""
    n = value.size
    first, second = np.eye(2 * n, n), np.eye(2 * n, n, -n)

    def apply(at: AtUnit, s: Any, y: Any) -> Any:
        if isinstance(y, Rationals):
            return y.widened(1.0)
        if isinstance(y, np.ndarray):
            both = np.concatenate([s, y])
        elif isinstance(y, jax.Array):
            both = jnp.concatenate([s, y])
        else:
            both = first @ s + second @ y
        return at(unit, both)[n:]

    places = gate.place, value.place
    return recorder.layer(
        value.shape, Step(apply, places, again=again), (type(unit).__name__, *places)
    )


def opposite(recorder: Recorder, bits: Operand) -> Operand:
    """`1 - bits`, of numbers that are zero or one."""
    if not isinstance(bits, Value):
        return 1.0 - bits
    return _marked(recorder, recorder.shifted(recorder.scaled(bits, np.array(-1.0)), np.array(1.0)))


def both(recorder: Recorder, one: Operand, other: Operand) -> Operand:
    """Whether both of two hold, of one shape: zeros and ones."""
    if not isinstance(one, Value):
        one, other = other, one
    if not isinstance(one, Value):
        return one * other
    if isinstance(other, Value):
        return _marked(recorder, gated(recorder, one, other))
    plain = np.broadcast_to(np.asarray(other, float), one.shape)
    if np.all(plain == 1):
        return one
    return _marked(recorder, recorder.scaled(one, plain)) if np.any(plain) else plain


def stepped(recorder: Recorder, comparison: Comparison) -> Value:
    """One where a comparison holds, and zero elsewhere.

    Comparisons of one number written in two ways, as `y > 0` and `0 >= y`, are one step.
    """
    value, strict = comparison.value, comparison.strict
    if value.source is not None and value.source[0].size <= 2 * max(1, value.size):
        base, index = value.source
        found = stepped(recorder, Comparison(base, strict))
        return recorder.picked(found, index.reshape(value.shape))
    turned = _turned(recorder, value)
    if turned is not None:
        found = stepped(recorder, Comparison(turned, not strict))
        return opposite(recorder, found)  # type: ignore[return-value]
    return _marked(recorder, recorder.unit(StepUnit(0.0 if strict else 1.0), value))


def _turned(recorder: Recorder, value: Value) -> Value | None:
    """`-value` where that is what others would write; None where it is not."""

    def is_times(term: Term, factor: float) -> bool:
        known = is_constant(term.factor) and is_constant(term.divisor)
        same = known and np.all(np.asarray(term.factor) == factor)
        return bool(same and np.all(np.asarray(term.divisor) == 1))

    terms = value.terms or ()
    plain = is_constant(value.offset) and not np.any(value.offset)
    if len(terms) == 1 and plain and is_times(terms[0], 1):
        return _turned(recorder, recorder.reshaped(terms[0].value, value.shape))
    if len(terms) == 1 and plain and is_times(terms[0], -1):
        return recorder.reshaped(terms[0].value, value.shape)
    if len(terms) == 1 and not plain:
        inner = terms[0].value.terms or ()
        bare = is_constant(terms[0].value.offset) and not np.any(terms[0].value.offset)
        if len(inner) == 1 and bare and is_times(inner[0], -1):
            base = recorder.reshaped(inner[0].value, value.shape)
            return recorder.shifted(base, -value.offset)
    if len(terms) == 2 and plain and is_times(terms[1], -1):
        one, other = terms[0].value, terms[1].value
        if one.place > other.place:
            shape = value.shape
            one, other = (recorder.reshaped(each, shape) for each in (one, other))
            return recorder.added(other, one, -1)
    return None


def stacked(recorder: Recorder, parts: Sequence[Operand]) -> Operand:
    """Operands of one shape along a first axis, plain if all are."""
    if not any(isinstance(each, Value) for each in parts):
        return np.stack([np.asarray(each) for each in parts])
    shape = next(each.shape for each in parts if isinstance(each, Value))
    given = [
        each if isinstance(each, Value) else np.broadcast_to(np.asarray(each, float), shape)
        for each in parts
    ]
    joined = recorder.joined(given)
    return recorder.picked(joined, np.arange(joined.size).reshape(len(parts), *shape))


def of_bits(recorder: Recorder, bits: Operand) -> Operand:
    """Truth values from zeros and ones."""
    if not isinstance(bits, Value):
        return np.asarray(bits) > 0.5
    which = stacked(recorder, [opposite(recorder, bits), bits])
    truth = np.array([False, True]).reshape(2, *[1] * len(bits.shape))
    return Pick(_marked(recorder, which), np.broadcast_to(truth, (2, *bits.shape)))


def bits_of(recorder: Recorder, operand: Operand) -> Operand:
    """Truth values as zeros and ones."""
    if isinstance(operand, Comparison):
        return stepped(recorder, operand)
    if isinstance(operand, Choice):
        operand = as_pick(recorder, operand)
    if isinstance(operand, Pick):
        return number(recorder, operand)
    return known_of(operand).astype(float)


def as_pick(recorder: Recorder, operand: Operand) -> Operand:
    """What is decided by comparisons, as one of some arrays; plain if nothing is left open.

    Raises:
        UnsupportedError: it is none.
    """
    if isinstance(operand, Pick):
        return operand
    if isinstance(operand, Comparison):
        return of_bits(recorder, stepped(recorder, operand))
    if isinstance(operand, Conditions) and not operand.counted:
        parts = [bits_of(recorder, each) for each in operand.parts]
        found = of_bits(recorder, stacked(recorder, parts))
        if not isinstance(found, Pick):
            return found.astype(operand.kind)
        return Pick(found.which, found.numbers.astype(operand.kind))
    if isinstance(operand, Index):
        return _places(recorder, operand)
    raise UnsupportedError(
        "counting what holds along an axis has no bounds: use jnp.sum(y > 0, axis=...)"
    )


def _places(recorder: Recorder, index: Index) -> Operand:
    """The place of the first, or of the last, condition that holds; zero if none does."""
    count, shape = len(index.conditions), index.shape
    events: list[Any] = [np.zeros(shape)] * count
    rest: Any = np.ones(shape)
    for k in reversed(range(count)) if index.last else range(count):
        bits = bits_of(recorder, index.conditions[k])
        events[k] = both(recorder, rest, bits)
        rest = both(recorder, rest, opposite(recorder, bits))
    events[0] = _sum(recorder, events[0], rest)
    which = stacked(recorder, events)
    if not isinstance(which, Value):
        return np.argmax(which, axis=0).astype(index.kind)
    places = np.arange(count).astype(index.kind).reshape(count, *[1] * len(shape))
    return Pick(_marked(recorder, which), np.broadcast_to(places, (count, *shape)))


def _sum(recorder: Recorder, one: Operand, other: Operand) -> Operand:
    """Whether one of two holds that exclude each other."""
    if not isinstance(one, Value) and not isinstance(other, Value):
        return one + other
    for a, b in ((one, other), (other, one)):
        if not isinstance(a, Value) and not np.any(a):
            return b
    return _marked(recorder, recorder.added(one, other))


def _spread(recorder: Recorder, pick: Pick, shape: Shape) -> Pick:
    """A pick of the same numbers in an array of a shape, with an event for each entry."""
    count, own = len(pick.numbers), pick.which.shape[1:]
    index = np.arange(pick.which.size).reshape(count, *[1] * (len(shape) - len(own)), *own)
    which = recorder.picked(pick.which, np.broadcast_to(index, (count, *shape)))
    return Pick(which, _widened(pick, shape))


def _widened(pick: Pick, shape: Shape) -> Any:
    """The numbers in arrays of a shape."""
    count, own = len(pick.numbers), pick.shape
    numbers = pick.numbers.reshape(count, *[1] * (len(shape) - len(own)), *own)
    if isinstance(numbers, np.ndarray):
        return np.broadcast_to(numbers, (count, *shape), subok=True)
    return jnp.broadcast_to(numbers, (count, *shape))


def number(recorder: Recorder, pick: Operand) -> Operand:
    """What is picked as a number: the sum of the numbers, each times whether it is the one.

    What is no pick is a number as it is.

    Raises:
        UnsupportedError: one of them is infinite or no number.
    """
    if not isinstance(pick, Pick):
        return pick
    numbers = pick.numbers
    if is_known(numbers):
        own = isinstance(numbers, Parameter)
        require_exact_whole(numbers)
        numbers = np.asarray(numbers).astype(float)
        if not np.all(np.isfinite(numbers)):
            raise UnsupportedError(NOT_FINITE)
        numbers = Parameter.of(numbers) if own else numbers
    else:
        numbers = numbers.astype(float)
    count, size = len(numbers), int(np.prod(pick.shape, dtype=int))
    flat = numbers.reshape(count, size)
    if pick.is_single:
        matrix = flat.T
    else:
        eye = np.eye(size)
        xp = np if isinstance(flat, np.ndarray) else jnp
        matrix = xp.concatenate([eye * row for row in flat], axis=1)
        matrix = Parameter.of(matrix) if isinstance(flat, Parameter) else matrix
    found = recorder.mapped(pick.which, matrix, pick.shape)
    if is_constant(flat) and bool(np.all(np.isin(flat, (0.0, 1.0)))):
        _marked(recorder, found)
    return found


def merged(recorder: Recorder, pick: Pick) -> Operand:
    """What is picked, with one event for what is the same; plain if all is."""
    numbers = pick.numbers
    if not isinstance(numbers, np.ndarray) or isinstance(numbers, Parameter):
        return pick
    groups: dict[bytes, list[int]] = {}
    for k, each in enumerate(numbers):
        groups.setdefault(np.ascontiguousarray(each).tobytes(), []).append(k)
    if len(groups) == len(numbers):
        return pick
    firsts = [mine[0] for mine in groups.values()]
    if len(groups) == 1:
        recorder.require(pick.which)
        return numbers[0]
    matrix = np.zeros((len(groups), len(numbers)))
    for row, mine in zip(matrix, groups.values(), strict=True):
        row[mine] = 1.0
    rest = pick.which.shape[1:]
    size = int(np.prod(rest, dtype=int))
    which = recorder.mapped(pick.which, np.kron(matrix, np.eye(size)), (len(groups), *rest))
    return Pick(_marked(recorder, which), numbers[firsts])


def together(recorder: Recorder, picks: Sequence[Pick]) -> list[Pick]:
    """The same numbers by common events.

    Raises:
        UnsupportedError: there are too many.
    """
    distinct: dict[Any, Pick] = {}
    for each in picks:
        distinct.setdefault((each.which.place, each.which.shape), each)
    if len(distinct) == 1:
        return [*picks]
    kinds = [*distinct.values()]
    at = {key: k for k, key in enumerate(distinct)}
    places = [at[_key(each)] for each in picks]
    if not all(each.is_single for each in kinds):
        try:
            shape = np.broadcast_shapes(*(each.shape for each in picks))
        except ValueError:
            raise UnsupportedError(
                "decisions about arrays of several shapes meet in it: write it of numbers, and "
                "use jax.vmap"
            ) from None
        picks = [Pick(each.which, _widened(each, shape)) for each in picks]
        kinds = [_spread(recorder, each, shape) for each in kinds]
    which = reduce(lambda one, other: _product(recorder, one, other), [e.which for e in kinds])
    order = [*itertools.product(*(range(len(each.numbers)) for each in kinds))]
    return [
        Pick(which, each.numbers[np.array([entry[place] for entry in order])])
        for each, place in zip(picks, places, strict=True)
    ]


def _key(pick: Pick) -> Any:
    return pick.which.place, pick.which.shape


def _product(recorder: Recorder, one: Value, other: Value) -> Value:
    """Which of all pairs of events holds: that of the last ones follows from the others."""
    m, n, rest = one.shape[0], other.shape[0], one.shape[1:]
    if m * n > MANY:
        raise UnsupportedError(TOO_MANY)
    size = int(np.prod(rest, dtype=int))
    index = np.arange(size)
    rows, columns = np.arange(1, m), np.arange(1, n)
    left = recorder.picked(one, np.repeat(rows, n - 1)[:, None] * size + index)
    right = recorder.picked(other, np.tile(columns, m - 1)[:, None] * size + index)
    inner = _marked(recorder, gated(recorder, left, right))
    given = recorder.joined([one, other, inner])
    matrix = np.zeros((m, n, m + n + (m - 1) * (n - 1)))
    inside = m + n + np.arange((m - 1) * (n - 1)).reshape(m - 1, n - 1)
    for i, j in itertools.product(range(1, m), range(1, n)):
        matrix[i, j, inside[i - 1, j - 1]] = 1.0
    for i in range(1, m):
        matrix[i, 0, i], matrix[i, 0, inside[i - 1]] = 1.0, -1.0
    for j in range(1, n):
        matrix[0, j, m + j], matrix[0, j, inside[:, j - 1]] = 1.0, -1.0
    matrix[0, 0, 0] = 1.0
    matrix[0, 0] -= matrix[0, 1:].sum(axis=0)
    matrix = np.kron(matrix.reshape(m * n, -1), np.eye(size))
    return _marked(recorder, recorder.mapped(given, matrix, (m * n, *rest)))


def events_of(recorder: Recorder, which: Operand, count: int) -> list[Operand]:
    """Whether each of the numbers `0 .. count - 1` is picked: zeros and ones.

    Raises:
        UnsupportedError: the numbers are those of a parameter.
    """
    numbers = places_of(which)
    if not isinstance(which, Pick):
        return [(numbers == k).astype(float) for k in range(count)]
    found = (merged(recorder, Pick(which.which, numbers == k)) for k in range(count))
    return [bits_of(recorder, each) for each in found]


def places_of(which: Operand) -> np.ndarray:
    """The numbers that say which branch or case is taken.

    Raises:
        UnsupportedError: they are those of a parameter.
    """
    return known_of(which.numbers if isinstance(which, Pick) else which).astype(int)


def known_of(plain: Operand) -> np.ndarray:
    """What decides, where it depends on no input.

    Raises:
        UnsupportedError: it depends on a parameter.
    """
    if not is_constant(plain):
        raise UnsupportedError(
            "which case is taken must not depend on the numbers of a parameter: let the function "
            "close over what decides, in place of being given it"
        )
    return np.asarray(plain)


def chosen_among(
    recorder: Recorder, events: Sequence[Operand], cases: Sequence[Operand], shape: Shape
) -> Operand:
    """The case whose event holds, of events of which one does, all brought to a shape.

    Raises:
        UnsupportedError: a case that may hold is infinite or no number.
    """
    pairs = []
    for event, case in zip(events, cases, strict=True):
        if isinstance(event, Value):
            pairs.append((shaped(recorder, event, shape), shaped(recorder, case, shape)))
        elif np.all(event):
            return shaped(recorder, case, shape)
        elif np.any(event):
            pairs.append((np.broadcast_to(event, shape), shaped(recorder, case, shape)))
    _require_finite(case for _, case in pairs)
    if len(pairs) == 2 and all(isinstance(event, Value) for event, _ in pairs):
        (_, below), (gate, above) = pairs
        if isinstance(below, Value) or isinstance(above, Value):
            return between(recorder, gate, below, above)
    parts = [_weighed(recorder, *pair) for pair in pairs]
    return reduce(recorder.added, parts)


def _weighed(recorder: Recorder, event: Operand, case: Operand) -> Operand:
    """A case where its event holds, else zero."""
    if not isinstance(event, Value):
        return recorder.scaled(case, event) if isinstance(case, Value) else event * case
    if isinstance(case, Value):
        return gated(recorder, event, case)
    return recorder.scaled(event, case)


def _require_finite(cases: Iterable[Operand]) -> None:
    """Raise an error if one of some cases is known to be infinite or no number."""
    known = filter(is_known, cases)
    if not all(np.all(np.isfinite(np.asarray(case, float))) for case in known):
        raise UnsupportedError(NOT_FINITE)


def between(recorder: Recorder, gate: Value, below: Operand, above: Operand) -> Operand:
    """`above` where a gate is one, else `below`, all of one shape.

    Raises:
        UnsupportedError: one of them is infinite or no number.
    """
    _require_finite((below, above))
    if not isinstance(below, Value) and not isinstance(above, Value):
        on, off = recorder.scaled(gate, above), recorder.scaled(opposite(recorder, gate), below)
        return recorder.added(on, off)
    rise = recorder.added(above, below, -1)
    return recorder.added(gated(recorder, gate, rise), below)


def product_of(recorder: Recorder, one: Value, other: Value) -> Value:
    """A product, of which one factor may be known to be zero or one."""
    for gate, value in ((one, other), (other, one)):
        if is_binary(recorder, gate):
            return gated(recorder, gate, value)
    return recorder.product(one, other)


def evaluated(recorder: Recorder, evaluate: Callable[..., Any], operands: Sequence[Operand]) -> Any:
    """What JAX makes of operands that decisions pick, and plain ones: once for each event.

    Args:
        recorder: of the steps.
        evaluate: from plain arrays to one, or to several.
        operands: picked ones by common events, and plain ones.
    """
    picks = [each for each in operands if isinstance(each, Pick)]
    found = []
    for k in range(len(picks[0].numbers)):
        given = [each.cases[k] if isinstance(each, Pick) else each for each in operands]
        found.append(evaluate(*given))
    made = [*zip(*found, strict=True)] if isinstance(found[0], list | tuple) else [found]
    results = []
    for each in made:
        numbers = plain_stack(each)
        which = _fitted(recorder, picks[0].which, np.shape(numbers)[1:])
        results.append(merged(recorder, Pick(which, numbers)))
    return results if isinstance(found[0], list | tuple) else results[0]


def _fitted(recorder: Recorder, which: Value, shape: Shape) -> Value:
    """Events of entries of an array, for those of a larger one that it is broadcast to."""
    count, *own = which.shape
    if not own or tuple(own) == tuple(shape):
        return which
    placed = recorder.reshaped(which, (count, *[1] * (len(shape) - len(own)), *own))
    return recorder.broadcast(placed, (count, *shape))


def plain_stack(parts: Sequence[Any]) -> Any:
    """Plain arrays along a first axis, numpy's if all are."""
    if not all(isinstance(each, np.ndarray | np.generic) for each in parts):
        return jnp.stack(parts)
    own = any(isinstance(each, Parameter) for each in parts)
    found = np.stack([np.asarray(each) for each in parts])
    return Parameter.of(found) if own else found
