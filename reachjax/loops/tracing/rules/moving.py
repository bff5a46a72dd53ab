"""Primitives that move entries: what they do is done to numbers of entries."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from reachjax.loops.tracing.recording import Recorder
from reachjax.loops.tracing.rules.equations import NOT_FINITE, Equation, Rule, shape_of
from reachjax.loops.tracing.values import Operand, UnsupportedError, Value, is_known, is_plain
from reachjax.numerics.rounding import namespace

NONE = -1
"""The number of an entry that there is not."""


def _numbers(operands: Sequence[Operand]) -> list[np.ndarray]:
    """Numbers of the entries of operands, one behind the other."""
    found, end = [], 0
    for each in operands:
        shape = shape_of(each)
        found.append(np.arange(end, end + math.prod(shape)).reshape(shape))
        end += math.prod(shape)
    return found


def _evaluated(equation: Equation, *operands: Any, **changes: Any) -> Any:
    with jax.ensure_compile_time_eval():
        return equation.evaluate(*map(jnp.asarray, operands), **changes)


def _require_known(places: Sequence[Operand]) -> None:
    if not is_known(*places):
        raise UnsupportedError(
            "which entries it takes must not depend on inputs or traced parameters"
        )


def _require_inside(index: np.ndarray, size: int) -> None:
    if index.size and not (index.min() >= 0 and index.max() < size):
        raise UnsupportedError(
            "it takes entries that there are not: an index is out of range, where JAX takes "
            "others; keep it within, or clip it, as jnp.clip(i, 0, len(x) - 1)"
        )


def _taken(recorder: Recorder, operands: Sequence[Operand], index: Any) -> Value:
    """Entries of several operands, by their numbers; constants among them must be finite."""
    index = np.asarray(index)
    parts = []
    for each, numbers in zip(operands, _numbers(operands), strict=True):
        if is_known(each):
            finite = np.isfinite(np.asarray(each))
            if np.any(np.isin(numbers[~finite], index)):
                raise UnsupportedError(NOT_FINITE)
            each = each if np.all(finite) else np.where(finite, np.asarray(each), 0.0)
        parts.append(each)
    return recorder.picked(recorder.joined(parts), index)


def _moved(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """Entries of one operand, by others that are known."""
    value, *places = operands
    _require_known(places)
    if not isinstance(value, Value):
        raise UnsupportedError("what it moves must depend on inputs")
    if equation.name == "dynamic_slice":  # JAX would take the nearest entries that there are
        for first, size, end in zip(
            places, equation.params["slice_sizes"], value.shape, strict=True
        ):
            _require_inside(int(first) + np.arange(size), end)
    moved = _evaluated(equation, *_numbers([value]), *places)
    if isinstance(moved, list | tuple):
        return [recorder.picked(value, np.asarray(part)) for part in moved]
    _require_inside(np.asarray(moved), value.size)
    return recorder.picked(value, np.asarray(moved))


def _gathered(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """Entries by their places, which are known; out of range it may fill in a number."""
    value, places = operands
    _require_known([places])
    modes, mode = jax.lax.GatherScatterMode, equation.params["mode"]
    fills, clips = mode == modes.FILL_OR_DROP, mode == modes.CLIP
    changes = {} if clips else {"fill_value": NONE, "mode": modes.FILL_OR_DROP}
    index = np.asarray(_evaluated(equation, *_numbers([value]), places, **changes))
    filled = equation.params["fill_value"]
    if fills and np.any(index == NONE) and filled is not None and np.isfinite(filled):
        parts = [value, np.full(1, float(filled))]
        return _taken(recorder, parts, np.where(index == NONE, value.size, index))
    _require_inside(index, value.size)
    return recorder.picked(value, index)


def _joined(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    """Entries of all operands: concatenated, stacked, or padded by one number of any kind."""
    index = _evaluated(equation, *_numbers(operands))
    return _taken(recorder, operands, index)


def _updated(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    """A slice, whose place is known, by other entries."""
    whole, part, *places = operands
    _require_known(places)
    index = _evaluated(equation, *_numbers([whole, part]), *places)
    return _taken(recorder, [whole, part], index)


def _require_once(equation: Equation, whole: Operand, places: Operand, part: Operand) -> None:
    """Raise an error if an entry is set twice: which one counts is not said."""
    zeros, ones = np.zeros(shape_of(whole)), np.ones(shape_of(part))
    if np.any(np.asarray(_scattered(equation, zeros, places, ones, adding=True)) > 1):
        raise UnsupportedError(
            "it sets an entry more than once, and which one counts is not said: give it one value"
        )


def _scattered(equation: Equation, whole: Any, places: Any, part: Any, adding: bool = False) -> Any:
    """What a scattering of any kind sets, or adds."""
    params = equation.params
    apply = jax.lax.scatter_add if adding else jax.lax.scatter
    with jax.ensure_compile_time_eval():
        return apply(
            jnp.asarray(whole),
            jnp.asarray(places),
            jnp.asarray(part),
            params["dimension_numbers"],
            indices_are_sorted=params["indices_are_sorted"],
            unique_indices=False,
            mode=params["mode"],
        )


def _set(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """`x.at[i].set(y)` with known places."""
    whole, places, part = operands
    _require_known([places])
    if equation.params.get("update_jaxpr") is not None and equation.name == "scatter":
        raise UnsupportedError(
            "it applies a function of its own to entries: write x.at[i].set(f(x[i]))"
        )
    _require_once(equation, whole, places, part)
    before, new = _numbers([whole, part])
    index = _scattered(equation, before, places, new)
    return _taken(recorder, [whole, part], index)


def _columns(
    equation: Equation, whole: Operand, places: Operand, part: Operand
) -> list[np.ndarray]:
    """For each entry of what is scattered, how often it gets to each entry of the whole."""
    zeros, size = np.zeros(shape_of(whole)), math.prod(shape_of(part))
    ones = np.eye(size).reshape(size, *shape_of(part))
    return [np.asarray(_scattered(equation, zeros, places, one, adding=True)) for one in ones]


def _meets(equation: Equation, whole: Operand, places: Operand, part: Operand) -> bool:
    """Whether two entries of what is scattered get to one entry of the whole."""
    zeros, ones = np.zeros(shape_of(whole)), np.ones(shape_of(part))
    return bool(np.any(np.asarray(_scattered(equation, zeros, places, ones, adding=True)) > 1))


def _added(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """`x.at[i].add(y)` with known places: what is added is a sum of entries of `y`."""
    whole, places, part = operands
    _require_known([places])
    if not isinstance(part, Value) and not _meets(equation, whole, places, part):
        zeros = np.zeros(shape_of(whole))
        return recorder.added(whole, equation.evaluate(zeros, places, part))
    columns = _columns(equation, whole, places, part)
    if not isinstance(part, Value):
        for column, number in zip(columns, part.reshape(-1), strict=True):
            whole = recorder.added(whole, number * column)  # sums of numbers would be rounded
        return whole
    matrix = np.stack([column.reshape(-1) for column in columns], axis=1)
    return recorder.added(recorder.mapped(part, matrix, equation.shape), whole)


def _multiplied(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """`x.at[i].multiply(y)` with known places."""
    whole, places, part = operands
    _require_known([places])
    ones = np.ones(shape_of(whole))
    if not isinstance(part, Value):
        if not _meets(equation, whole, places, part):
            return recorder.scaled(whole, equation.evaluate(ones, places, part))
        columns, xp = _columns(equation, whole, places, part), namespace(part)
        for column, number in zip(columns, part.reshape(-1), strict=True):
            whole = recorder.scaled(whole, xp.where(column > 0, number, 1.0))
        return whole
    factor = _set(recorder, equation, [ones, places, part])
    if not isinstance(whole, Value):
        return recorder.scaled(factor, whole)
    return recorder.product(whole, factor)


def chosen(recorder: Recorder, which: Any, cases: Sequence[Operand]) -> Operand:
    """Entries of several operands, by known numbers; or weighed, by traced ones.

    Raises:
        UnsupportedError: the numbers depend on inputs.
    """
    if not is_plain(which):
        raise UnsupportedError(
            "it chooses by a number that depends on inputs, as a sum of comparisons does: compare "
            "that number, as jnp.where(k == 1, a, b), or choose by jnp.argmax"
        )
    if is_known(which):
        which = np.broadcast_to(np.asarray(which, int), shape_of(cases[0]))
        if which.size and np.all(which == which.flat[0]):
            return cases[int(which.flat[0])]
        index = which * which.size + np.arange(which.size).reshape(which.shape)
        return _taken(recorder, cases, index)
    parts: list[Any] = []
    for number, each in enumerate(cases):
        weight = jnp.broadcast_to(which == number, each.shape).astype(float)
        parts.append(recorder.scaled(each, weight) if isinstance(each, Value) else weight * each)
    return reduce(recorder.added, parts)


# fmt: off
ALONE = (
    "reshape", "squeeze", "expand_dims", "transpose", "broadcast_in_dim", "slice", "rev",
    "dynamic_slice", "tile",
)
"""Primitives that move the entries of one operand, and have one result."""
# fmt: on

RULES: dict[str, Rule] = {
    **dict.fromkeys((*ALONE, "split", "unstack"), _moved),
    **dict.fromkeys(("concatenate", "pad", "stack"), _joined),
    "gather": _gathered,
    "dynamic_update_slice": _updated,
    "scatter": _set,
    "scatter-add": _added,
    "scatter-mul": _multiplied,
}
