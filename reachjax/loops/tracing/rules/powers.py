"""Powers, exponentials and their kin: units, and what is made of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from reachjax.loops.tracing.recording import Recorder
from reachjax.loops.tracing.rules.equations import Equation, Rule, entrywise
from reachjax.loops.tracing.rules.related import of_sum
from reachjax.loops.tracing.values import Operand, UnsupportedError, Value, is_known
from reachjax.loops.units import (
    AbstractUnit,
    Asinh,
    Erf,
    Exp,
    Log,
    Reciprocal,
    Sqrt,
    Tanh,
)


def by(unit: AbstractUnit) -> Rule:
    """The rule that a primitive is a unit."""
    return lambda recorder, equation, operands: recorder.unit(unit, operands[0])


def _raised(recorder: Recorder, value: Value, power: int) -> Any:
    """A whole power, by squares and products."""
    if power < 0:
        return _raised(recorder, recorder.unit(Reciprocal(), value), -power)
    if power == 0:
        return np.ones(value.shape)
    half = value if power < 2 else _raised(recorder, value, power // 2)
    if power < 2:
        return half
    square = recorder.product(half, half)
    return square if power % 2 == 0 else recorder.product(square, value)


def _to_the(recorder: Recorder, value: Value, exponent: float) -> Any:
    """A real power."""
    if exponent.is_integer():
        return _raised(recorder, value, int(exponent))
    if (2 * exponent).is_integer():
        return _raised(recorder, recorder.unit(Sqrt(), value), int(2 * exponent))
    return recorder.unit(Exp(), recorder.scaled(recorder.unit(Log(), value), np.array(exponent)))


def _integer_power(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    return _raised(recorder, operands[0], equation.params["y"])


@entrywise
def _power(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    value, power = operands
    if not isinstance(value, Value):
        return _exponential(recorder, value, power)
    if not is_known(power):
        raise UnsupportedError("the exponent must be known: no input, and no traced parameter")
    flat = np.asarray(power, float).ravel()
    exponents, which = np.unique(flat, return_inverse=True)
    if not np.all(np.isfinite(exponents)):
        raise UnsupportedError("the exponent must be finite")
    if len(exponents) == 1:
        return _to_the(recorder, value, float(exponents[0]))
    places = [np.flatnonzero(which == k) for k in range(len(exponents))]
    parts = [
        _to_the(recorder, recorder.picked(value, here), float(exponent))
        for here, exponent in zip(places, exponents, strict=True)
    ]
    order = np.argsort(np.concatenate(places)).reshape(equation.shape)
    return recorder.picked(recorder.joined(parts), order)


def _exponential(recorder: Recorder, base: Any, power: Value) -> Any:
    """`b^y = exp(y log b)` for known `b`."""
    if not is_known(base) or not np.all((np.asarray(base) > 0) & np.isfinite(np.asarray(base))):
        raise UnsupportedError("its base must be known and positive")
    flat = np.asarray(base, float).ravel()
    logarithms = np.array([math.log(each) for each in flat]).reshape(np.shape(base))
    return recorder.unit(Exp(), recorder.nearly_scaled(power, logarithms))


def _power_of_two(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    return _exponential(recorder, np.full(equation.shape, 2.0), operands[0])


def _square(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    return recorder.product(operands[0], operands[0])


def _root(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    return recorder.unit(Sqrt(), operands[0])


def _inverse_root(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    return recorder.unit(Reciprocal(), recorder.unit(Sqrt(), operands[0]))


def _logistic(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    half = recorder.unit(Tanh(), recorder.scaled(operands[0], np.array(0.5)))
    return recorder.shifted(recorder.scaled(half, np.array(0.5)), np.array(0.5))


def _log(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    found = of_sum(recorder, operands[0])
    return recorder.unit(Log(), operands[0]) if found is None else found


def _log_of_more(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    return _log(recorder, equation, [recorder.shifted(operands[0], np.array(1.0))])


def _exp_less_one(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    return recorder.shifted(recorder.unit(Exp(), operands[0]), np.array(-1.0))


def _hyperbolic(sign: int) -> Rule:
    """`(e^y + e^-y) / 2`, or the difference."""

    def rule(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
        (value,) = operands
        up, down = value, recorder.scaled(value, np.array(-1.0))
        parts = [recorder.unit(Exp(), each) for each in (up, down)]
        return recorder.scaled(recorder.added(parts[0], parts[1], sign), np.array(0.5))

    return rule


def _rest_of_erf(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    """`1 - erf y`."""
    return recorder.added(np.ones(operands[0].shape), recorder.unit(Erf(), operands[0]), -1)


def _inverse_cosine(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    """`arcosh y = 2 arsinh sqrt((y - 1) / 2)`."""
    half = recorder.scaled(recorder.shifted(operands[0], np.array(-1.0)), np.array(0.5))
    return recorder.scaled(recorder.unit(Asinh(), recorder.unit(Sqrt(), half)), np.array(2.0))


def _inverse_tangent(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    """`artanh y = (log(1 + y) - log(1 - y)) / 2`."""
    one = np.ones(operands[0].shape)
    more, less = (recorder.unit(Log(), recorder.added(one, operands[0], sign)) for sign in (1, -1))
    return recorder.scaled(recorder.added(more, less, -1), np.array(0.5))


RULES: dict[str, Rule] = {
    "tanh": by(Tanh()),
    "exp": by(Exp()),
    "log": _log,
    "sqrt": _root,
    "rsqrt": _inverse_root,
    "square": _square,
    "integer_pow": _integer_power,
    "pow": _power,
    "exp2": _power_of_two,
    "expm1": _exp_less_one,
    "log1p": _log_of_more,
    "logistic": _logistic,
    "erf": by(Erf()),
    "erfc": _rest_of_erf,
    "asinh": by(Asinh()),
    "acosh": _inverse_cosine,
    "atanh": _inverse_tangent,
    "cosh": _hyperbolic(1),
    "sinh": _hyperbolic(-1),
}
