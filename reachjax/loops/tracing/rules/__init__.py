"""What each primitive of a jaxpr is as steps of a recording.

Affine ones and those that move entries become matrices and choices of entries; the others are units
and what is made of them. Choices between numbers are continuous ones in disguise, or jumps.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax

from reachjax.loops.tracing.recording import Recorder
from reachjax.loops.tracing.rules import (
    affine,
    angles,
    bends,
    choices,
    folds,
    jumps,
    moving,
    powers,
    solvers,
)
from reachjax.loops.tracing.rules.equations import NOT_FINITE, Equation, Rule, on_host
from reachjax.loops.tracing.values import (
    Choice,
    Comparison,
    Index,
    Operand,
    Unknown,
    UnsupportedError,
    Value,
    is_known,
    is_plain,
)

__all__ = ["Equation", "recorded"]

# fmt: off
INFINITE = (
    "max", "min", "clamp", "select_n", *jumps.COMPARED, *moving.RULES,
)
"""Primitives that may take numbers that are not finite."""
# fmt: on

INSTEAD = {
    "cbrt": "use y ** (1 / 3) of numbers above zero",
    "cumlogsumexp": "use jax.nn.logsumexp of each part",
    "nextafter": "leave it out, and give what it moves by as a disturbance",
    "ragged_dot_general": "use jnp.dot of each group",
    "reduce": "use jnp.sum, jnp.prod, jnp.max or jnp.min",
    "reduce_precision": "leave it out, and give what it rounds by as a disturbance",
    "scatter-max": "use x.at[i].set(jnp.maximum(x[i], y))",
    "scatter-min": "use x.at[i].set(jnp.minimum(x[i], y))",
    "top_k": "use jnp.sort, jnp.max or jnp.min",
}
"""What to do in place of primitives that have no rule."""

OTHERWISE = (
    "write it with arithmetic, powers, exponentials, logarithms and sines, or use a polynomial "
    "that is close to it, and give the difference as a disturbance"
)

RULES: dict[str, Rule] = {
    **moving.RULES,
    **affine.RULES,
    **powers.RULES,
    **angles.RULES,
    **bends.RULES,
    **folds.RULES,
    **solvers.RULES,
    **jumps.RULES,
}


def recorded(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """The value, or a list of them, of one equation, of which one operand at least is a value.

    Raises:
        UnsupportedError: there is no rule for it, whole numbers may leave their range, or truth
            values would be computed with as numbers.
    """
    found = _recorded(recorder, equation, operands)
    for each in found if isinstance(found, list) else [found]:
        if isinstance(each, Value):
            jumps.require_of_kind(recorder, equation, each)
    return found


def _recorded(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    if jnp.issubdtype(equation.kind, jnp.inexact) and equation.kind != jnp.result_type(float):
        raise UnsupportedError(
            f"it rounds to {equation.kind}: compute in 64-bit floats, for example by not giving "
            "layers a dtype"
            if jnp.issubdtype(equation.kind, jnp.floating)
            else "it computes in complex numbers: compute with their real and imaginary parts"
        )
    if equation.name == "dot_general" and _rounds(equation.params["precision"]):
        raise UnsupportedError(
            "its precision, or jax.default_matmul_precision, rounds the numbers that it "
            "multiplies: take jax.lax.Precision.HIGHEST"
        )
    first, *others = operands
    if all(map(is_plain, operands)):  # it was found on the way that nothing depends on inputs
        return equation.evaluate(*operands)
    unknown = [each for each in operands if isinstance(each, Unknown)]
    if unknown and equation.name == "select_n" and all(each is others[0] for each in others):
        return others[0]
    if unknown and equation.name != "custom_linear_solve":  # which needs no factors
        raise unknown[0].error
    if isinstance(first, Comparison | Index) and equation.name in moving.ALONE:
        return _moved(recorder, equation, first, others)
    if any(isinstance(each, Choice) for each in operands):
        travelling = choices.RULES.get(equation.name)
        found = None if travelling is None else travelling(recorder, equation, operands)
        if found is None:
            found = jumps.of_decisions(recorder, equation, operands, recorded)
        return found
    if equation.name == "convert_element_type" and not _is_float(equation):
        return jumps.whole_numbers(recorder, equation, operands[0])
    if jnp.issubdtype(equation.kind, jnp.integer) and equation.name not in jumps.OF_WHOLE:
        raise UnsupportedError(jumps.WHOLE)
    rule = RULES.get(equation.name)
    if rule is None:
        raise UnsupportedError(_why(equation))
    plain = [*filter(is_plain, operands)]
    if equation.name not in INFINITE and not all(map(_is_finite, plain)):
        raise UnsupportedError(NOT_FINITE)
    values = [each for each in operands if isinstance(each, Value)]
    if values and not any(each.size for each in values):  # vectors without entries are all alike
        return equation.evaluate(
            *(np.zeros(each.shape) if isinstance(each, Value) else each for each in operands)
        )
    return rule(recorder, equation, operands)


def _rounds(precision: Any) -> bool:
    """Whether products of 64-bit floats are computed in fewer bits."""
    if isinstance(precision, lax.DotAlgorithmPreset):
        return precision not in (
            lax.DotAlgorithmPreset.DEFAULT,
            lax.DotAlgorithmPreset.F64_F64_F64,
        )
    if not isinstance(precision, lax.DotAlgorithm):  # of others, 64-bit floats stay what they are
        return False
    kinds = precision.lhs_precision_type, precision.rhs_precision_type, precision.accumulation_type
    imprecise = precision.allow_imprecise_accumulation
    return imprecise or any(jnp.dtype(kind) != jnp.float64 for kind in kinds)


def _moved(recorder: Recorder, equation: Equation, operand: Any, others: Sequence[Any]) -> Any:
    """Entries of truth values, or of places, are those of what decides about them."""
    if isinstance(operand, Comparison):
        moved = _recorded(recorder, equation, [operand.value, *others])  # no whole numbers
        return Comparison(moved, operand.strict)
    if isinstance(operand, Index):
        conditions = [_moved(recorder, equation, each, others) for each in operand.conditions]
        return Index(conditions, operand.last, operand.kind)
    return equation.evaluate(operand, *others)


def _why(equation: Equation) -> str:
    instead = INSTEAD.get(equation.name, OTHERWISE)
    return f"there are no bounds for it: {instead}"


def _is_float(equation: Equation) -> bool:
    return jnp.issubdtype(equation.kind, jnp.floating)


def _is_finite(plain: Any) -> bool:
    is_number = on_host(plain) or jnp.issubdtype(plain.dtype, jnp.number)
    return not (is_number and is_known(plain)) or bool(np.all(np.isfinite(np.asarray(plain))))
