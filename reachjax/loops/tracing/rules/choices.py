"""Comparisons as they travel: stacked, counted, made places of branches, and at last decided by.

What is made of them else has a rule for all of it (`jumps.of_decisions`): these give None for it.

`jnp.select`, `jnp.piecewise`, `jax.lax.cond` and `jax.lax.switch` choose by a place, that of the
first or the last condition that holds. That is one choice between two after the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from reachjax.loops.tracing.recording import Recorder
from reachjax.loops.tracing.rules.bends import decided
from reachjax.loops.tracing.rules.equations import Equation, Rule, shaped
from reachjax.loops.tracing.rules.jumps import picked_case
from reachjax.loops.tracing.rules.picks import as_pick
from reachjax.loops.tracing.values import (
    Choice,
    Comparison,
    Conditions,
    Index,
    Operand,
    Unknown,
    Value,
    is_known,
    is_plain,
)


def _converted(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """Truth values as numbers of another kind, and counts as whole numbers that hold them."""
    (choice,), kind = operands, equation.kind
    if isinstance(choice, Comparison) and jnp.issubdtype(kind, jnp.integer):
        return Index([np.zeros(choice.shape, bool), choice], kind=kind)
    if not isinstance(choice, Conditions) or (choice.counted and not _counts(choice, kind)):
        return None
    return Conditions(choice.parts, choice.counted, kind)


def _counts(conditions: Conditions, kind: Any) -> bool:
    """Whether numbers of a kind are as many as there are conditions, and wrap at none of these."""
    return jnp.issubdtype(kind, jnp.integer) and len(conditions.parts) <= jnp.iinfo(kind).max


def _stacked(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """Conditions along the first axis."""
    is_stack = equation.name == "stack"
    if equation.params["axis" if is_stack else "dimension"] != 0:
        return None
    parts: list[Any] = []
    for each in operands:
        if is_stack:
            parts.append(each)
        elif isinstance(each, Conditions) and not each.counted:
            parts += each.parts
        elif isinstance(each, Comparison):
            index = np.arange(each.value.size).reshape(each.shape)
            taken = (recorder.taken(each.value, row) for row in index)
            parts += [Comparison(one, each.strict) for one in taken]
        elif is_known(each):
            parts += [*np.asarray(each)]
        else:
            return None
    if not all(isinstance(each, Comparison) or _is_truth(each) for each in parts):
        return None
    return Conditions(parts, kind=equation.kind)


def _is_truth(part: Any) -> bool:
    """Whether plain numbers are truth values, or known to stand for such: 0 and 1."""
    if not is_plain(part):
        return False
    return part.dtype == bool or (is_known(part) and bool(np.isin(np.asarray(part), (0, 1)).all()))


def _so_far(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    (choice,) = operands
    params = equation.params
    if not isinstance(choice, Conditions) or choice.counted or params["axis"] or params["reverse"]:
        return None
    if not _counts(choice, equation.kind):
        return None
    return Conditions(choice.parts, counted=True, kind=equation.kind)


def _place(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """The place of the first one that holds; where these are counted, of the last."""
    (choice,) = operands
    if not isinstance(choice, Conditions) or tuple(equation.params["axes"]) != (0,):
        return None
    return Index(choice.parts, choice.counted, equation.kind)


def _limited(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """Places, between the first and the last, which they always are."""
    least, choice, most = operands
    if not isinstance(choice, Index) or not is_known(least, most):
        return None
    if np.any(np.asarray(least) > 0) or np.any(np.asarray(most) < len(choice.conditions) - 1):
        return None
    return choice


def _opposite(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """Whether a comparison does not hold."""
    (choice,) = operands
    if not isinstance(choice, Comparison):
        return None
    return _turned(recorder, choice)


def _turned(recorder: Recorder, comparison: Comparison) -> Comparison:
    """The comparison that holds where another one does not."""
    turned = recorder.scaled(comparison.value, np.array(-1.0))
    return Comparison(turned, not comparison.strict)


def _asked(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """A comparison of a truth value, taken for a whole number, with others: itself, or not it."""
    places = [each for each in operands if isinstance(each, Index)]
    if len(places) != 1 or len(places[0].conditions) != 2 or places[0].last:
        return None
    (index,), (first, second) = places, places[0].conditions
    plain = [each for each in operands if each is not index]
    if not isinstance(second, Comparison) or np.any(first) or not is_known(*plain):
        return None
    both = [
        np.asarray(equation.evaluate(*(np.asarray(k, index.kind) if e is index else e
                                       for e in operands)))
        for k in (0, 1)
    ]  # fmt: skip
    if any(np.any(each != each.flat[0]) for each in both if each.size):
        return None
    one, other = (bool(each.flat[0]) if each.size else False for each in both)
    if one == other:
        return np.full(equation.shape, one)
    return second if other else _turned(recorder, second)


def _selected(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """One of some numbers by comparisons, if one of them depends on inputs."""
    which, *cases = operands
    is_number = any(isinstance(each, Value) for each in cases)
    if not isinstance(which, Comparison | Index) or not is_number:
        return None
    if any(isinstance(each, Choice) for each in cases):
        return None
    return chosen_by(recorder, which, cases, equation.shape)


RULES: dict[str, Rule] = {
    "convert_element_type": _converted,
    "stack": _stacked,
    "concatenate": _stacked,
    "cumsum": _so_far,
    "argmax": _place,
    "clamp": _limited,
    "select_n": _selected,
    "not": _opposite,
    **dict.fromkeys(("eq", "ne", "lt", "le", "gt", "ge"), _asked),
}
"""What primitives make of choices."""


def chosen_by(recorder: Recorder, which: Choice, cases: Sequence[Operand], shape: Any) -> Operand:
    """One of several operands of a shape, by a comparison or a place."""
    if isinstance(which, Comparison):
        which = Index([np.zeros(which.shape, bool), which])
    unknown = [each for each in cases if isinstance(each, Unknown)]
    if unknown:
        raise unknown[0].error
    decided_too = any(isinstance(each, Choice) for each in cases)
    if decided_too or not isinstance(which, Index) or all(map(is_plain, cases)):
        return picked_case(recorder, as_pick(recorder, which), cases, shape)
    found, *_ = cases = [shaped(recorder, each, shape) for each in cases]
    places = range(len(which.conditions))
    for k in places if which.last else reversed(places):
        found = decided(recorder, which.conditions[k], found, cases[k], shape)
    return found
