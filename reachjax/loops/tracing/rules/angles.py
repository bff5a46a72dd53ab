"""Sines, tangents and angles."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from reachjax.loops.tracing.limits import ConstantLimits, Limits
from reachjax.loops.tracing.recording import Recorder
from reachjax.loops.tracing.rules.equations import Equation, Rule, entrywise
from reachjax.loops.tracing.rules.powers import by
from reachjax.loops.tracing.values import Operand, UnsupportedError, Value, is_known
from reachjax.loops.units import Asin, Atan, Cos, Origin, Reciprocal, Sin, Sqrt
from reachjax.numerics.rounding import Ball, gamma, larger, namespace

CUT = Origin(
    "arctan2(y, x)",
    "comes too near to y = 0 with x <= 0, where angles jump by 2 pi: x + sqrt(x^2 + y^2) is in",
    "keep (x, y) away from there, or turn the axes: jnp.pi / 2 + jnp.arctan2(-x, y) is the same "
    "angle, and jumps where x = 0 and y <= 0 instead",
)
"""What is wrong where an angle has no bounds."""

SMALL = 2.0**-500
"""What squares and roots may lose of lengths whose squares vanish in 64 bits."""

ROUNDING = 2.0**-53
"""How far the float `math.pi / 2` is from the number, at most."""


def _tangent(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    sine, cosine = (recorder.unit(unit, operands[0]) for unit in (Sin(), Cos()))
    return recorder.product(sine, recorder.unit(Reciprocal(), cosine))


def _from_right_angle(recorder: Recorder, value: Value, sign: float = 1.0) -> Value:
    """`sign pi/2 - value`."""
    found = recorder.added(np.full(value.shape, sign * math.pi / 2), value, -1)
    return recorder.loosened(found, np.full(value.shape, ROUNDING))


def _arc_cosine(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    """`arccos y = pi/2 - arcsin y`."""
    return _from_right_angle(recorder, recorder.unit(Asin(), operands[0]))


@entrywise
def _angle(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    """`atan2(y, x)`, the angle of a point, by one formula wherever it does not jump.

    That is `arctan(y / x)` where `x` is known to be positive, `pi/2 - arctan(x / y)` where `y` is,
    and half the angle otherwise: `2 arctan(y / (r + x))` with the distance `r` from the origin,
    whose divisor is zero on the cut alone.
    """
    y, x = operands
    for each in operands:
        if not isinstance(each, Value) and not is_known(each):
            raise UnsupportedError("its operands must be known, or depend on inputs")
    limits = [recorder.limits(each, ConstantLimits) for each in operands]
    if np.all(limits[1].least > 0):
        return recorder.unit(Atan(), _quotient(recorder, y, x))
    if np.all(limits[0].least > 0) or np.all(limits[0].most < 0):
        sign = 1.0 if np.all(limits[0].least > 0) else -1.0
        return _from_right_angle(recorder, recorder.unit(Atan(), _quotient(recorder, x, y)), sign)
    if not isinstance(y, Value):
        raise UnsupportedError(
            "its first operand must not be known to be zero, nor of both signs: angles jump there"
        )
    if not isinstance(x, Value) and np.any(np.asarray(x) == 0):
        raise UnsupportedError(
            "its second operand must not be zero everywhere: the angle jumps where y changes its "
            "sign"
        )
    squares = [
        recorder.product(each, each) if isinstance(each, Value) else np.asarray(each) ** 2
        for each in (y, x)
    ]
    distance = recorder.unit(Sqrt(), recorder.added(squares[0], squares[1]))
    divisor = recorder.added(distance, x)
    if isinstance(x, Value):
        again = lambda divisor, *_: divisor  # noqa: E731
        divisor = recorder.met(divisor, [y, x], _beyond, again)
    recorder.limited(divisor, lambda _: Limits(np.zeros(1), np.full(1, np.inf)))
    half = recorder.product(y, recorder.unit(Reciprocal(origin=CUT), divisor))
    return recorder.scaled(recorder.unit(Atan(), half), np.array(2.0))


def _beyond(y: Ball, x: Ball) -> Ball:
    """`x + sqrt(x^2 + y^2) = y^2 / (sqrt(x^2 + y^2) - x)`, which grows with `x` and with `|y|`."""
    xp = namespace(y.mid)
    near, far = larger(larger(y.lower, -y.upper), 0.0), larger(-y.lower, y.upper)
    ends = []
    for a, b, sign in ((x.lower, near, -1), (x.upper, far, 1)):
        distance = xp.sqrt(a * a + b * b)
        behind = (a < 0) & (distance > 0)
        found = xp.where(behind, b * b / xp.where(behind, distance - a, 1.0), a + distance)
        ends.append(larger(found * (1 + sign * gamma(8)) + sign * SMALL, 0.0))
    return Ball.between(*ends)


def _quotient(recorder: Recorder, one: Operand, other: Operand) -> Value:
    """`one / other`, of which one at least is a value."""
    if not isinstance(other, Value):
        return recorder.divided(one, other)
    inverse = recorder.unit(Reciprocal(), other)
    return (
        recorder.product(one, inverse) if isinstance(one, Value) else recorder.scaled(inverse, one)
    )


RULES: dict[str, Rule] = {
    "sin": by(Sin()),
    "cos": by(Cos()),
    "tan": _tangent,
    "asin": by(Asin()),
    "acos": _arc_cosine,
    "atan": by(Atan()),
    "atan2": _angle,
}
