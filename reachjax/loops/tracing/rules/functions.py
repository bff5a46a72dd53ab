"""Functions of JAX that are known as a whole: tables, lengths, `x log y` and `sin y / y`.

JAX computes them by cases, against overflow or to find an entry, that have jumps in them, though
the functions have none. They are told by what they compute, never by their names alone: a call is
one of them if its equations are those that JAX traces for it here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reachjax.loops.tracing.dependence import CALLS, OWN_SLOPES, body_of
from reachjax.loops.tracing.limits import Limits
from reachjax.loops.tracing.recording import Recorder
from reachjax.loops.tracing.rules.entries import ONE, Product, as_value, entries, sums
from reachjax.loops.tracing.rules.equations import shaped
from reachjax.loops.tracing.traces import description, equations
from reachjax.loops.tracing.values import Operand, UnsupportedError, Value, is_constant, is_known
from reachjax.loops.units import Log, Sinc, Sqrt, XLogX

Rule = Callable[[Recorder, list[Operand], tuple[int, ...]], Operand]
"""From operands, of which one at least is a value, to the value of a shape."""


def _length(recorder: Recorder, operands: list[Operand], shape: tuple[int, ...]) -> Operand:
    """`hypot(x, y) = sqrt(x^2 + y^2)`."""
    both = [shaped(recorder, each, shape) for each in operands]
    x, y = (entries(recorder, each).ravel() for each in both)
    squares = sums(
        recorder, ([Product(1, a, a), Product(1, b, b)] for a, b in zip(x, y, strict=True))
    )
    square = as_value(recorder, np.array([None, *squares], object)[1:].reshape(shape))
    found = recorder.unit(Sqrt(), recorder.limited(square, lambda _: NOT_NEGATIVE))
    return recorder.limited(found, lambda limits: _beyond(limits, both))


NOT_NEGATIVE = Limits(np.zeros(1), np.full(1, np.inf))


def _beyond(limits: Any, operands: Sequence[Operand]) -> Limits:
    """What is at least as large as each of these."""
    found = NOT_NEGATIVE
    for each in operands:
        own = limits(each)
        found = found.meeting(type(own)(own.larger(-own).least, np.full(1, np.inf)))
    return found


def _times_logarithm(recorder: Recorder, operands: list[Operand], shape: Any) -> Operand:
    """`x log y`, which is zero where both are."""
    x, y = (shaped(recorder, each, shape) for each in operands)
    if isinstance(x, Value) and isinstance(y, Value):
        if x.place == y.place:
            return recorder.unit(XLogX(), x)
        return recorder.product(x, recorder.unit(Log(), y))
    if isinstance(y, Value):
        return recorder.scaled(recorder.unit(Log(), y), x)
    if not is_known(y) or not np.all(np.asarray(y) > 0):
        raise UnsupportedError("the number whose logarithm it takes must be known, and positive")
    return recorder.nearly_scaled(x, np.log(np.asarray(y)))


def _wave(recorder: Recorder, operands: list[Operand], shape: tuple[int, ...]) -> Operand:
    """`sinc x = sin(pi x) / (pi x)`."""
    (x,) = operands
    return recorder.unit(Sinc(), recorder.scaled(x, np.pi))


def _table(recorder: Recorder, operands: list[Operand], shape: tuple[int, ...]) -> Operand:
    """`interp(x, xp, fp)`: ramps that begin at the places, by how much slopes change there."""
    x, places, heights, *beyond = operands
    if not isinstance(x, Value) or isinstance(places, Value) or not is_constant(places):
        raise UnsupportedError(
            "the places of its table must be constants: close over them, and let what is looked "
            "up, or the heights, depend on inputs and parameters"
        )
    at = np.asarray(places, float)
    if not np.all(np.diff(at) > 0):
        raise UnsupportedError(
            "the places of its table must increase, as it jumps where two are one: move one of "
            "them, and give the table a steep slope there"
        )
    heights = entries(recorder, heights)
    ends = (entries(recorder, each).item() for each in beyond)
    if any(a != b for a, b in zip(ends, (heights[0], heights[-1]), strict=False)):
        raise UnsupportedError(
            "left and right of its table it must be what it is at the first and at the last place, "
            "as it jumps there: leave them out"
        )
    steps = [
        ONE / (b - a) for a, b in zip(map(Fraction, at[:-1]), map(Fraction, at[1:]), strict=True)
    ]
    rises = zip(heights[:-1], heights[1:], steps, strict=True)
    slopes = sums(recorder, ([Product(1, b, by), Product(-1, a, by)] for a, b, by in rises))
    nothing = [Fraction(0)]
    turns = sums(
        recorder,
        (
            [Product(1, after, ONE), Product(-1, before, ONE)]
            for before, after in zip(nothing + slopes, slopes + nothing, strict=True)
        ),
    )
    spread = recorder.broadcast(recorder.reshaped(x, (x.size, 1)), (x.size, len(at)))
    ramps = entries(recorder, recorder.rectified(recorder.shifted(spread, -at)))
    rows = (
        [Product(1, heights[0], ONE), *(Product(1, *pair) for pair in zip(turns, row, strict=True))]
        for row in ramps
    )
    found = as_value(recorder, np.array([None, *sums(recorder, rows)], object)[1:].reshape(shape))
    if isinstance(found, Value) and all(isinstance(each, Fraction) for each in heights):
        ends = float(min(heights)), float(max(heights))
        recorder.limited(found, lambda _: Limits(np.full(1, ends[0]), np.full(1, ends[1])))
    return found


class Known(NamedTuple):
    """A function of JAX.

    Attributes:
        function: which one.
        rule: how it is recorded.
        call: the name that JAX gives to calls of it; None if it has a derivative of its own.
    """

    function: Callable[..., Any]
    rule: Rule
    call: str | None

    def is_call(self, equation: Any) -> bool:
        """Whether an equation may be a call of it."""
        kinds = OWN_SLOPES if self.call is None else CALLS
        return equation.primitive.name in kinds and equation.params.get("name") == self.call


KNOWN = (
    Known(jnp.hypot, _length, "hypot"),
    Known(jnp.interp, _table, "_interp"),
    Known(jnp.sinc, _wave, "sinc"),
    Known(jax.scipy.special.xlogy, _times_logarithm, None),
)
"""The functions that have a rule as a whole."""


def rule_of(equation: Any) -> Rule | None:
    """The rule of a call, if it is one of a function that is known."""
    for known in KNOWN:
        if known.is_call(equation):
            given = (each.aval for each in equation.invars)
            kinds = tuple((each.shape, each.dtype, each.weak_type) for each in given)
            if description(body_of(equation.params)) == _expected(known, kinds):
                return known.rule
    return None


@cache
def _expected(known: Known, kinds: tuple[Any, ...]) -> str | None:
    """What JAX computes for a function of such arguments; None if it has none for these."""
    given = [jax.ShapeDtypeStruct(shape, kind, weak_type=weak) for shape, kind, weak in kinds]
    try:
        whole = jax.make_jaxpr(known.function)(*given)
    except (TypeError, ValueError):
        return None
    calls = filter(known.is_call, equations(whole))
    return next((description(body_of(each.params)) for each in calls), None)
