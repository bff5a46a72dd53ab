"""Primitives that jump: signs, whole numbers, winners, and what is made of decisions.

`sign y` is one of three numbers by two steps, `floor y` of a bounded number one of several by a
step at each edge, and `argmax` a layer of its own. All of them are picked (`picks`): what follows
is computed by JAX for each case, until it meets numbers that depend on inputs in other ways.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import jax
import numpy as np

from reachjax.loops.tracing.limits import ConstantLimits
from reachjax.loops.tracing.recording import Recorder
from reachjax.loops.tracing.rules.equations import NOT_FINITE, Equation, Rule, on_host, shaped
from reachjax.loops.tracing.rules.moving import ALONE
from reachjax.loops.tracing.rules.picks import (
    MANY,
    as_pick,
    bits_of,
    both,
    chosen_among,
    entered,
    evaluated,
    events_of,
    gated,
    number,
    of_bits,
    opposite,
    places_of,
    plain_stack,
    stacked,
    stepped,
    together,
)
from reachjax.loops.tracing.values import (
    Choice,
    Comparison,
    Operand,
    Pick,
    Shape,
    UnsupportedError,
    Value,
    is_constant,
    is_known,
    is_plain,
)
from reachjax.loops.units import Floor, OneHot

Again = Callable[[Recorder, Equation, Sequence[Operand]], Any]
"""How an equation is recorded of other operands."""

ACTIONS = 32
"""Among so many numbers the largest is found at most: each pair of them is a row of a program."""

# fmt: off
ENTRYWISE = frozenset({
    "abs", "add", "add_any", "and", "ceil", "clamp", "convert_element_type", "copy", "copy_p",
    "cos", "div", "eq", "exp", "exp2", "expm1", "floor", "ge", "gt", "integer_pow", "is_finite",
    "le", "le_to", "log", "log1p", "logistic", "lt", "lt_to", "max", "min", "mul", "ne", "neg",
    "not", "or", "pow", "rem", "round", "select_n", "shift_left", "shift_right_arithmetic",
    "shift_right_logical", "sign", "sin", "sqrt", "square", "stop_gradient", "sub", "tan", "tanh",
    "xor",
})
"""Primitives whose results are entry by entry of the same entries of their operands."""

COMPARED = frozenset({"eq", "ge", "gt", "le", "le_to", "lt", "lt_to", "ne"})
"""Primitives that compare: what is picked with what depends on inputs, as numbers."""

OF_WHOLE = frozenset({
    "add", "add_any", "sub", "neg", "reduce_sum", "cumsum", "dot_general", "mul", "argmax",
    "argmin", *ALONE, "gather", "concatenate", "stack", "pad", "split", "unstack",
})
"""Primitives that make of whole numbers, such as counts, what they make of any: no quotients."""

SUMMED = frozenset({
    "add", "add_any", "sub", "neg", "reduce_sum", "cumsum", "dot_general", "convert_element_type",
    "mul",
})
"""Primitives that make of whole numbers, taken for numbers, what they make of these."""
# fmt: on

WHOLE = (
    "it makes whole numbers or truth values of what depends on inputs, other than by comparing, "
    "by jnp.argmax, or by rounding numbers between known limits: clip these first, as "
    "jnp.clip(y, 0.0, 9.0).astype(int)"
)

NOT_COUNTED = (
    "of truth values JAX makes whether any product holds, and no sum: compute with numbers, as "
    "m.astype(float) @ n, or use jnp.any"
)

BITS = "it is taken bit by bit of whole numbers: use jnp.all or jnp.any of comparisons"
"""Why `reduce_and` and `reduce_or` are refused: of truth values alone they are all and any."""


def of_decisions(
    recorder: Recorder, equation: Equation, operands: Sequence[Operand], again: Again
) -> Any:
    """What an equation makes of what is decided, and of other operands.

    Args:
        recorder: of the steps.
        equation: which one.
        operands: one of which at least is decided.
        again: how the equation is recorded of values and plain numbers.

    Raises:
        UnsupportedError: it has no bounds.
    """
    operands = [as_pick(recorder, e) if isinstance(e, Choice) else e for e in operands]
    picks = [each for each in operands if isinstance(each, Pick)]
    if not picks:
        return again(recorder, equation, operands)
    values = [each for each in operands if isinstance(each, Value)]
    if equation.name == "select_n" and values:
        return _selected(recorder, equation, operands, again)
    if equation.name in ("reduce_and", "reduce_or") and not picks[0].is_single:
        return _all(recorder, equation, picks[0])
    if equation.name == "gather" and len(picks) == 1 and not picks[0].is_single:
        return _looked_up(recorder, equation, operands, again)
    alone = all(each.is_single for each in picks)
    entrywise = equation.name in ENTRYWISE
    apart = len({each.which.place for each in picks}) > 1
    if apart and _is_float(equation) and equation.name in ("add", "add_any", "sub"):
        return again(recorder, equation, _numbers(recorder, operands))  # which no event is for
    if not values and (alone or entrywise):
        common = iter(together(recorder, picks))
        given = [next(common) if isinstance(each, Pick) else each for each in operands]
        return evaluated(recorder, equation.evaluate, given)
    if not values and equation.name in ALONE and len(picks) == 1:
        return _moved(recorder, equation, operands)
    if equation.name == "mul" and values:
        return _scaled(recorder, values[0], picks[0], equation.shape)
    if equation.name in COMPARED and values:
        return again(recorder, equation, _numbers(recorder, operands))
    additive = equation.name in SUMMED or not (alone or entrywise)
    if additive and (_is_float(equation) or equation.name in SUMMED):
        return again(recorder, equation, _numbers(recorder, operands))
    if not values:
        raise UnsupportedError(WHOLE)
    return _by_cases(recorder, equation, operands, again)


def _numbers(recorder: Recorder, operands: Sequence[Operand]) -> list[Operand]:
    """Operands of which those that are picked are numbers."""
    return [number(recorder, each) for each in operands]


def _is_float(equation: Equation) -> bool:
    return np.issubdtype(equation.kind, np.floating)


def _by_cases(
    recorder: Recorder, equation: Equation, operands: Sequence[Operand], again: Again
) -> Any:
    """One of what an equation makes in each case."""
    common = iter(together(recorder, [each for each in operands if isinstance(each, Pick)]))
    given = [next(common) if isinstance(each, Pick) else each for each in operands]
    picks = [each for each in given if isinstance(each, Pick)]
    found = [
        again(recorder, equation, [e.cases[k] if isinstance(e, Pick) else e for e in given])
        for k in range(len(picks[0].numbers))
    ]
    if any(isinstance(each, list | tuple | Choice) for each in found):
        raise UnsupportedError(WHOLE)
    return chosen_among(recorder, _events(recorder, picks[0]), found, equation.shape)


def _events(recorder: Recorder, pick: Pick) -> list[Value]:
    """Whether each of its events holds."""
    count, shape = pick.which.shape[0], pick.which.shape[1:]
    index = np.arange(pick.which.size).reshape(count, *shape)
    return [recorder.picked(pick.which, each) for each in index]


def _scaled(recorder: Recorder, value: Value, pick: Pick, shape: Shape) -> Operand:
    """A product of a number with what is picked: a gated number for each case but one."""
    if is_known(pick.numbers) and not np.all(np.isfinite(np.asarray(pick.numbers, float))):
        raise UnsupportedError(NOT_FINITE)
    value = shaped(recorder, value, shape)
    events = [shaped(recorder, each, shape) for each in _events(recorder, pick)]
    numbers = [shaped(recorder, each, shape) for each in pick.cases]
    zeros = (k for k, each in enumerate(numbers) if is_constant(each) and not np.any(each))
    first = next(zeros, 0)
    parts, rest = [], value
    for k, (event, factor) in enumerate(zip(events, numbers, strict=True)):
        if k != first:
            part = gated(recorder, event, value)
            parts.append(recorder.scaled(part, factor))
            rest = recorder.added(rest, part, -1)
    if not is_constant(numbers[first]) or np.any(numbers[first]):
        parts.append(recorder.scaled(rest, numbers[first]))
    return reduce(recorder.added, parts)


def _moved(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """Entries of what is picked entry by entry."""
    pick, *places = operands
    if not is_known(*places):
        raise UnsupportedError(WHOLE)
    size = int(np.prod(pick.shape, dtype=int))
    with jax.ensure_compile_time_eval():
        index = np.asarray(equation.evaluate(np.arange(size).reshape(pick.shape), *places))
    count = len(pick.numbers)
    every = np.arange(count).reshape(count, *[1] * index.ndim) * size + index
    numbers = pick.numbers.reshape(count, size)[:, index.ravel()]
    which = recorder.picked(pick.which, every)
    return Pick(which, numbers.reshape(count, *index.shape))


def _looked_up(
    recorder: Recorder, equation: Equation, operands: Sequence[Operand], again: Again
) -> Operand:
    """Entries of a table by places each of which has events of its own."""
    table, places = operands
    if not isinstance(places, Pick) or places.shape[-1] != 1:
        raise UnsupportedError(
            "it takes entries by several places at once: take them one after the other"
        )
    offset = equation.params["dimension_numbers"].offset_dims
    count, size = len(places.numbers), int(np.prod(places.shape, dtype=int))
    index = np.arange(size).reshape([
        1 if axis in offset else length for axis, length in enumerate(equation.shape)
    ])  # fmt: skip
    every = np.arange(count).reshape(count, *[1] * index.ndim) * size
    every = every + np.broadcast_to(index, equation.shape)
    found = [again(recorder, equation, [table, each]) for each in places.cases]
    which = Pick(recorder.picked(places.which, every), np.zeros((count, *equation.shape)))
    if not any(isinstance(each, Value) for each in found):
        return Pick(which.which, plain_stack(found))
    return chosen_among(recorder, _events(recorder, which), found, equation.shape)


def _all(recorder: Recorder, equation: Equation, pick: Pick) -> Operand:
    """Whether all truth values along axes hold, or any.

    Raises:
        UnsupportedError: they are whole numbers.
    """
    if not np.issubdtype(equation.kind, np.bool_):
        raise UnsupportedError(BITS)
    bits, axes = bits_of(recorder, pick), tuple(equation.params["axes"])
    if not isinstance(bits, Value):
        return equation.evaluate(bits > 0.5)
    index = np.moveaxis(np.arange(bits.size).reshape(bits.shape), axes, range(len(axes)))
    index = index.reshape(-1, *equation.shape)
    every = equation.name == "reduce_and"
    parts = [recorder.picked(bits, each) for each in index]
    if not every:
        parts = [opposite(recorder, each) for each in parts]
    found = reduce(lambda one, other: both(recorder, one, other), parts)
    return of_bits(recorder, found if every else opposite(recorder, found))


def _selected(
    recorder: Recorder, equation: Equation, operands: Sequence[Operand], again: Again
) -> Operand:
    """One of several numbers, some of which depend on inputs, by a decision."""
    which, *cases = operands
    cases = _numbers(recorder, cases)
    if not isinstance(which, Pick):
        return again(recorder, equation, [which, *cases])
    return chosen_among(recorder, events_of(recorder, which, len(cases)), cases, equation.shape)


def entering(
    recorder: Recorder, which: Pick, count: int, operands: Sequence[Operand]
) -> list[list[Operand]]:
    """The operands of each of some branches, of which one is picked."""
    within = Pick(which.which, np.clip(places_of(which), 0, count - 1))
    found = []
    for event in events_of(recorder, within, count):
        found.append([
            entered(recorder, recorder.broadcast(event, each.shape), each)
            if isinstance(event, Value) and isinstance(each, Value)
            else each
            for each in operands
        ])  # fmt: skip
    return found


def picked_case(
    recorder: Recorder, which: Operand, cases: Sequence[Operand], shape: Shape
) -> Operand:
    """The result of the branch whose place is picked, or known."""
    last = len(cases) - 1
    cases = [as_pick(recorder, each) if isinstance(each, Choice) else each for each in cases]
    if not isinstance(which, Pick) and np.ndim(which) == 0:
        return cases[int(np.clip(places_of(which), 0, last))]
    if isinstance(which, Pick) and all(is_plain(each) or isinstance(each, Pick) for each in cases):
        common = together(recorder, [which, *(e for e in cases if isinstance(e, Pick))])
        rest = iter(common[1:])
        given = [next(rest) if isinstance(each, Pick) else each for each in cases]
        return evaluated(recorder, _case, [common[0], *given])
    within = np.clip(places_of(which), 0, last)
    if isinstance(which, Pick):
        within = Pick(which.which, within)
    events = events_of(recorder, within, len(cases))
    return chosen_among(recorder, events, _numbers(recorder, cases), shape)


def _case(place: Any, *cases: Any) -> Any:
    """The case of a place, entry by entry if that is an array."""
    within = np.clip(places_of(place), 0, len(cases) - 1)
    if not within.ndim:
        return cases[int(within)]
    each = plain_stack([np.broadcast_to(e, within.shape, subok=True) if on_host(e) else e
                        for e in cases])  # fmt: skip
    return each[within, *np.indices(within.shape)]


def compared_equal(recorder: Recorder, difference: Value, equal: bool) -> Operand:
    """Whether numbers are zero, or are not."""
    which = _signs(recorder, difference)
    truth = np.array([not equal, equal, not equal]).reshape(3, *[1] * len(difference.shape))
    return Pick(which, np.broadcast_to(truth, (3, *difference.shape)))


def _signs(recorder: Recorder, value: Value) -> Value:
    """Whether numbers are below, at, or above zero."""
    above = stepped(recorder, Comparison(value, strict=True))
    not_below = stepped(recorder, Comparison(value, strict=False))
    at = recorder.added(not_below, above, -1)
    recorder.values[at.place].binary = True
    found = stacked(recorder, [opposite(recorder, not_below), at, above])
    recorder.values[found.place].binary = True
    return found


def _sign(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Operand:
    (value,) = operands
    signs = np.array([-1.0, 0.0, 1.0]).reshape(3, *[1] * len(value.shape))
    return Pick(_signs(recorder, value), np.broadcast_to(signs, (3, *value.shape)))


def _staircase(
    recorder: Recorder,
    value: Value,
    first: int,
    edges: Sequence[float],
    reached: Sequence[bool],
    kind: Any,
) -> Operand:
    """Whole numbers that rise by one at each edge.

    Args:
        recorder: of the steps.
        value: what is rounded.
        first: the number below the first edge.
        edges: in their order.
        reached: whether the number above an edge is the one that is computed at it.
        kind: of the numbers.
    """
    count, shape = len(edges), value.shape
    numbers = (first + np.arange(count + 1)).astype(kind)
    if not count:
        recorder.require(value)
        return np.broadcast_to(numbers[0], shape)
    columns = [*[1] * len(shape)]
    steps: list[Any] = [None] * count
    for strict in (False, True):
        mine = [k for k in range(count) if reached[k] is not strict]
        if mine:
            at = np.array([edges[k] for k in mine]).reshape(len(mine), *columns)
            wide = recorder.broadcast(value, (len(mine), *shape))
            wide = recorder.shifted(wide, -np.broadcast_to(at, wide.shape))
            found = stepped(recorder, Comparison(wide, strict))
            index = np.arange(found.size).reshape(len(mine), *shape)
            for k, each in zip(mine, index, strict=True):
                steps[k] = recorder.picked(found, each)
    events = [opposite(recorder, steps[0])]
    for one, other in itertools.pairwise(steps):
        events.append(recorder.added(one, other, -1))
    which = stacked(recorder, [*events, steps[-1]])
    recorder.values[which.place].binary = True
    return Pick(which, np.broadcast_to(numbers.reshape(-1, *columns), (count + 1, *shape)))


def _range(recorder: Recorder, value: Value) -> tuple[float, float] | None:
    """Between what constants the numbers surely are; None if there are too many between them."""
    if not value.size:
        return 0.0, 0.0
    limits = recorder.limits(value, ConstantLimits)
    least, most = float(limits.least.min()), float(limits.most.max())
    return (least, most) if most - least < MANY else None


def _rounded(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Operand:
    """`floor`, `ceil` and `round`."""
    (value,), name = operands, equation.name
    ends = _range(recorder, value)
    if ends is None:
        return _unlimited(recorder, equation, value)
    least, most = ends
    if name == "floor":
        whole = [*range(int(np.floor(least)), int(np.floor(most)) + 1)]
        edges, reached = whole[1:], [True] * (len(whole) - 1)
    elif name == "ceil":
        whole = [*range(int(np.ceil(least)), int(np.ceil(most)) + 1)]
        edges, reached = whole[:-1], [False] * (len(whole) - 1)
    else:
        away = equation.params["rounding_method"] == jax.lax.RoundingMethod.AWAY_FROM_ZERO
        whole = [*range(int(np.floor(least + 0.5)) - 1, int(np.floor(most + 0.5)) + 1)]
        edges = [n + 0.5 for n in whole[:-1]]
        reached = [n >= 0 if away else n % 2 == 1 for n in whole[:-1]]
    return _staircase(recorder, value, whole[0], edges, reached, float)


def _unlimited(recorder: Recorder, equation: Equation, value: Value) -> Value:
    """Whole numbers next to numbers that may be anything; `ceil y = -floor(-y)`."""
    if equation.name == "ceil":
        turned = recorder.scaled(value, np.array(-1.0))
        return recorder.scaled(recorder.unit(Floor(), turned), np.array(-1.0))
    if equation.name == "floor":
        return recorder.unit(Floor(), value)
    away = equation.params["rounding_method"] == jax.lax.RoundingMethod.AWAY_FROM_ZERO
    return recorder.unit(Floor(0.5, even=not away), value)


def whole_numbers(recorder: Recorder, equation: Equation, value: Value) -> Operand:
    """Numbers cut to whole ones towards zero, or whether they are not zero.

    Raises:
        UnsupportedError: they are not known to be between limits.
    """
    if np.issubdtype(equation.kind, np.bool_):
        return compared_equal(recorder, value, equal=False)
    ends = _range(recorder, value)
    if ends is None or not np.issubdtype(equation.kind, np.integer):
        raise UnsupportedError(WHOLE)
    whole = [*range(int(np.trunc(ends[0])), int(np.trunc(ends[1])) + 1)]
    kind = np.iinfo(equation.kind)
    if whole[0] < kind.min or whole[-1] > kind.max:
        raise UnsupportedError(
            f"numbers from {whole[0]} to {whole[-1]} are not all of {equation.kind}: clip them"
        )
    edges = [n if n < 0 else n + 1 for n in whole[:-1]]
    reached = [n >= 0 for n in whole[:-1]]
    return _staircase(recorder, value, whole[0], edges, reached, equation.kind)


def require_of_kind(recorder: Recorder, equation: Equation, value: Value) -> None:
    """Raise an error unless JAX computes with numbers of this kind as with any others.

    Whole numbers, which it wraps at the ends of their kind, are computed with as if there were no
    end to them; sums of truth values are to it whether any of them holds.

    Raises:
        UnsupportedError: whole numbers may leave their range, or it is a truth value.
    """
    if np.issubdtype(equation.kind, np.bool_):
        raise UnsupportedError(NOT_COUNTED)
    if not (value.size and np.issubdtype(equation.kind, np.integer)):
        return
    limits, kind = recorder.limits(value, ConstantLimits), np.iinfo(equation.kind)
    least, most = limits.least.min(), limits.most.max()
    if not (np.isfinite([least, most]).all() and kind.min <= int(least) <= int(most) <= kind.max):
        raise UnsupportedError(
            f"whole numbers between {least:g} and {most:g} may leave the range of {equation.kind}, "
            "where JAX wraps them: use a wider kind, as jnp.sum(y > 0, dtype=int), or numbers with "
            "a point"
        )


def _winner(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Operand:
    """The place of the largest number along an axis, or of the smallest."""
    (value,) = operands
    (axis,) = equation.params["axes"]
    count, kind = value.shape[axis], equation.params["index_dtype"]
    if count > ACTIONS:
        raise UnsupportedError(
            f"it finds the largest of {count} numbers, but {ACTIONS} at most have bounds"
        )
    if equation.name == "argmin":
        value = recorder.scaled(value, np.array(-1.0))
    index = np.moveaxis(np.arange(value.size).reshape(value.shape), axis, 0)
    groups = index.reshape(count, -1).T
    if count == 1:
        return np.zeros(equation.shape, kind)
    winners = [_one_hot(recorder, recorder.picked(value, group)) for group in groups]
    which = stacked(recorder, winners) if len(winners) > 1 else winners[0]
    order = np.arange(which.size).reshape(len(winners), count).T
    which = recorder.picked(which, order.reshape(count, *equation.shape))
    recorder.values[which.place].binary = True
    places = np.arange(count).astype(kind).reshape(count, *[1] * len(equation.shape))
    return Pick(which, np.broadcast_to(places, (count, *equation.shape)))


def _one_hot(recorder: Recorder, scores: Value) -> Value:
    """One for the largest of some numbers, and zeros for the others."""
    count = scores.size
    if count == 2:
        one, other = (recorder.picked(scores, np.array(k)) for k in (0, 1))
        second = stepped(recorder, Comparison(recorder.added(other, one, -1), strict=True))
        found = stacked(recorder, [opposite(recorder, second), second])
    else:
        unit = OneHot(count)
        matrix = np.zeros((len(unit.pairs), count))
        for row, (i, j) in zip(matrix, unit.pairs, strict=True):
            row[i], row[j] = 1.0, -1.0
        given = recorder.mapped(
            scores, np.concatenate([np.eye(count), matrix]), (count + len(unit.pairs),)
        )
        found = recorder.picked(recorder.unit(unit, given), np.arange(count))
    recorder.values[found.place].binary = True
    return found


def _remainder(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Operand:
    """`y - d trunc(y / d)`."""
    value, divisor = operands
    if not isinstance(value, Value) or not is_plain(divisor) or not _is_float(equation):
        raise UnsupportedError(
            "it takes the remainder by a number that depends on inputs, or of whole numbers: use "
            "y - d * jnp.floor(y / d) of real numbers"
        )
    value, divisor = (shaped(recorder, each, equation.shape) for each in operands)
    quotient = recorder.divided(value, divisor)
    ends = _range(recorder, quotient)
    if ends is None:
        raise UnsupportedError(
            "of numbers without known limits it has no bounds: use y - d * jnp.floor(y / d), or "
            "clip them first"
        )
    whole = [*range(int(np.trunc(ends[0])), int(np.trunc(ends[1])) + 1)]
    edges = [n if n < 0 else n + 1 for n in whole[:-1]]
    cut = _staircase(recorder, quotient, whole[0], edges, [n >= 0 for n in whole[:-1]], float)
    times = number(recorder, cut)
    if not isinstance(times, Value):
        return recorder.shifted(value, -times * divisor)
    return recorder.added(value, recorder.scaled(times, divisor), -1)


RULES: dict[str, Rule] = {
    "sign": _sign,
    **dict.fromkeys(("floor", "ceil", "round"), _rounded),
    **dict.fromkeys(("argmax", "argmin"), _winner),
    "rem": _remainder,
}


def entry_of(recorder: Recorder, choice: Choice, k: int) -> Operand:
    """An entry along the first axis of what is decided."""
    pick = as_pick(recorder, choice)
    if pick.is_single:
        return Pick(pick.which, pick.numbers[:, k])
    count, size = len(pick.numbers), int(np.prod(pick.shape, dtype=int))
    index = np.arange(count * size).reshape(count, *pick.shape)[:, k]
    return Pick(recorder.picked(pick.which, index), pick.numbers[:, k])


def stack_of(recorder: Recorder, column: Sequence[Operand]) -> Operand:
    """What is decided, and plain numbers, as one along a first axis."""
    picks = [as_pick(recorder, each) if isinstance(each, Choice) else each for each in column]
    decided = [each for each in picks if isinstance(each, Pick)]
    if not any(isinstance(each, Value) for each in picks):
        if all(each.is_single for each in decided):
            common = iter(together(recorder, decided))
            given = [next(common) if isinstance(each, Pick) else each for each in picks]
            return evaluated(recorder, lambda *parts: np.stack(parts), given)
        if all(each.numbers.dtype == bool for each in decided):
            bits = [bits_of(recorder, each) for each in picks]
            return of_bits(recorder, stacked(recorder, bits))
    if any(not np.issubdtype(each.numbers.dtype, np.floating) for each in decided):
        raise UnsupportedError(WHOLE)
    return stacked(recorder, _numbers(recorder, picks))
