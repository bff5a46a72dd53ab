"""Comparisons as they travel: stacked, counted, made places of branches, and at last decided by.

`jnp.select`, `jnp.piecewise`, `jax.lax.cond` and `jax.lax.switch` choose by a place, that of the
first or the last condition that holds. That is one choice between two after the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from reachjax.loops.primitives.bends import decided
from reachjax.loops.primitives.equations import Equation, Rule, shaped
from reachjax.loops.recording import Recorder
from reachjax.loops.values import (
    Choice,
    Comparison,
    Conditions,
    Index,
    Operand,
    Unknown,
    UnsupportedError,
    is_known,
    is_plain,
)

ONLY = (
    "a comparison of numbers may only choose between two of them that agree where it changes, as "
    "jnp.where(y > 0, y, 0.1 * y) does: write what else is made of it with jnp.where, jnp.select, "
    "jnp.maximum or jnp.clip"
)
"""What comparisons are good for."""

NUMBERS = "what it chooses must be numbers, not comparisons of them: choose first, then compare"


def _converted(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """Truth values as whole numbers."""
    (choice,) = operands
    if not jnp.issubdtype(equation.kind, jnp.integer):
        raise UnsupportedError(ONLY)
    if isinstance(choice, Comparison):
        return Index([np.zeros(choice.shape, bool), choice])
    return choice


def _stacked(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """Conditions along the first axis."""
    is_stack = equation.name == "stack"
    if equation.params["axis" if is_stack else "dimension"] != 0:
        raise UnsupportedError(ONLY)
    parts: list[Any] = []
    for each in operands:
        if is_stack:
            parts.append(each)
        elif isinstance(each, Conditions):
            parts += each.parts
        elif isinstance(each, Comparison):
            index = np.arange(each.value.size).reshape(each.shape)
            parts += [Comparison(recorder.taken(each.value, row)) for row in index]
        else:
            parts += [*(np.asarray(each) if is_known(each) else each)]
    if not all(isinstance(each, Comparison) or _is_truth(each) for each in parts):
        raise UnsupportedError(ONLY)
    return Conditions(parts)


def _is_truth(part: Any) -> bool:
    """Whether plain numbers are truth values, or known to stand for such: 0 and 1."""
    if not is_plain(part):
        return False
    return part.dtype == bool or (is_known(part) and bool(np.isin(np.asarray(part), (0, 1)).all()))


def _so_far(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    (choice,) = operands
    params = equation.params
    if not isinstance(choice, Conditions) or choice.counted or params["axis"] or params["reverse"]:
        raise UnsupportedError(ONLY)
    return Conditions(choice.parts, counted=True)


def _place(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """The place of the first one that holds; where these are counted, of the last."""
    (choice,) = operands
    if not isinstance(choice, Conditions) or tuple(equation.params["axes"]) != (0,):
        raise UnsupportedError(ONLY)
    return Index(choice.parts, last=choice.counted)


def _limited(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """Places, between the first and the last, which they always are."""
    least, choice, most = operands
    if not isinstance(choice, Index) or not is_known(least, most):
        raise UnsupportedError(ONLY)
    if np.any(np.asarray(least) > 0) or np.any(np.asarray(most) < len(choice.conditions) - 1):
        raise UnsupportedError("there are more places than branches: give each one")
    return choice


def _asked(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    return Unknown(equation.name, ONLY)


def _selected(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    which, *cases = operands
    if not isinstance(which, Choice):
        raise UnsupportedError(NUMBERS)
    return chosen_by(recorder, which, cases, equation.shape)


RULES: dict[str, Rule] = {
    "convert_element_type": _converted,
    "stack": _stacked,
    "concatenate": _stacked,
    "cumsum": _so_far,
    "argmax": _place,
    "clamp": _limited,
    "select_n": _selected,
    **dict.fromkeys(("eq", "ne", "lt", "le", "gt", "ge"), _asked),
}
"""What primitives make of choices."""


def chosen_by(recorder: Recorder, which: Choice, cases: Sequence[Operand], shape: Any) -> Operand:
    """One of several operands of a shape, by a comparison or a place.

    Raises:
        UnsupportedError: two of them do not meet where the choice changes.
    """
    if isinstance(which, Comparison):
        which = Index([np.zeros(which.shape, bool), which])
    if not isinstance(which, Index):
        raise UnsupportedError(ONLY)
    if any(isinstance(each, Choice | Unknown) for each in cases):
        raise UnsupportedError(NUMBERS)
    found, *_ = cases = [shaped(recorder, each, shape) for each in cases]
    places = range(len(which.conditions))
    for k in places if which.last else reversed(places):
        found = decided(recorder, which.conditions[k], found, cases[k], shape)
    return found
