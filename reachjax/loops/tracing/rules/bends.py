"""Maxima, limits, and choices by comparisons: rectifiers, and steps where values jump."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from reachjax.loops.tracing.recording import Recorder
from reachjax.loops.tracing.rules.equations import Equation, Rule, entrywise, shaped
from reachjax.loops.tracing.rules.jumps import compared_equal
from reachjax.loops.tracing.rules.kinks import bent, halves
from reachjax.loops.tracing.rules.moving import chosen
from reachjax.loops.tracing.rules.picks import between, stepped
from reachjax.loops.tracing.values import Comparison, Operand, UnsupportedError, Value, is_known


def _beyond(recorder: Recorder, one: Operand, other: Operand, idle: float, rule: Any) -> Operand:
    """A maximum or a minimum, of which infinite entries of the one sign take nothing.

    Args:
        recorder: of the steps.
        one: a value, or
        other: the same.
        idle: the infinity that takes nothing.
        rule: what is done where entries are finite.
    """
    if not isinstance(one, Value):
        one, other = other, one
    if not is_known(other):
        return rule(one, other)
    plain = np.asarray(other, float)
    if np.any(np.isnan(plain) | (plain == -idle)):
        which = plain[~np.isfinite(plain)].flat[0]
        raise UnsupportedError(f"one of its operands is {which}: use a finite one in its place")
    ignored = plain == idle
    if not np.any(ignored):
        return rule(one, other)
    found = rule(one, np.where(ignored, 0.0, plain)) if not np.all(ignored) else one
    return chosen(recorder, ignored, [found, one])


def _larger(recorder: Recorder, one: Value, other: Operand) -> Value:
    if is_known(other) and not np.any(other):
        return recorder.rectified(one)
    found = recorder.added(recorder.rectified(recorder.added(one, other, -1)), other)
    if isinstance(other, Value):
        both = zip(recorder.largest_of(one), recorder.largest_of(other), strict=True)
        recorder.maxima[found.place] = [mine | others for mine, others in both]
    return recorder.limited(found, lambda limits: limits(one).larger(limits(other)))


def _smaller(recorder: Recorder, one: Value, other: Operand) -> Value:
    found = recorder.added(one, recorder.rectified(recorder.added(one, other, -1)), -1)
    return recorder.limited(found, lambda limits: limits(one).smaller(limits(other)))


def largest(recorder: Recorder, one: Operand, other: Operand) -> Operand:
    """The larger of two of one shape, one of which at least is a value."""
    return _beyond(recorder, one, other, -np.inf, lambda a, b: _larger(recorder, a, b))


def smallest(recorder: Recorder, one: Operand, other: Operand) -> Operand:
    """The smaller of two, as `largest`."""
    return _beyond(recorder, one, other, np.inf, lambda a, b: _smaller(recorder, a, b))


@entrywise
def _maximum(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Operand:
    return largest(recorder, *operands)


@entrywise
def _minimum(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Operand:
    return smallest(recorder, *operands)


@entrywise
def _clamped(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Operand:
    """`min(max(value, least), most)`."""
    least, value, most = operands
    plain = not any(isinstance(each, Value) for each in (value, least))
    found = jnp.maximum(value, least) if plain else largest(recorder, value, least)
    return smallest(recorder, found, most)


def _absolute(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    return recorder.absolute(operands[0])


@entrywise
def _compared(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    one, other = operands if equation.name in ("gt", "ge") else reversed(operands)
    for each, sign in ((one, 1), (other, -1)):
        if is_known(each) and np.size(each) and np.all(np.isinf(np.asarray(each))):
            recorder.require(other if each is one else one, sums=True)
            return sign * np.asarray(each) > 0
    return Comparison(recorder.added(one, other, -1), strict=equation.name in ("gt", "lt", "lt_to"))


@entrywise
def _equal(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """Numbers are equal to themselves, and to no infinity; to others they may be."""
    one, other = operands
    if isinstance(one, Value) and isinstance(other, Value) and one.place == other.place:
        recorder.require(one, sums=True)
        return np.full(equation.shape, equation.name == "eq")
    if any(is_known(each) and np.all(~np.isfinite(np.asarray(each))) for each in (one, other)):
        recorder.require(one, sums=True)
        recorder.require(other, sums=True)
        return np.full(equation.shape, equation.name == "ne")
    return compared_equal(recorder, recorder.added(one, other, -1), equation.name == "eq")


def _finite(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> np.ndarray:
    """Real numbers are."""
    recorder.require(operands[0], sums=True)
    return np.full(equation.shape, True)


def decided(
    recorder: Recorder, condition: Any, below: Operand, above: Operand, shape: tuple[int, ...]
) -> Operand:
    """`above` where a condition holds, else `below`, both of a shape."""
    if below is above:
        return below
    if not isinstance(condition, Comparison):
        which = np.asarray(condition) if is_known(condition) else condition
        return chosen(recorder, which, [below, above])
    value = shaped(recorder, condition.value, shape)
    found = bent(recorder, value, below, above)
    if found is not None:
        return found
    gate = shaped(recorder, stepped(recorder, condition), shape)
    return between(recorder, gate, *halves(recorder, value, below, above))


def _selected(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    which, *cases = operands
    cases = [shaped(recorder, each, equation.shape) for each in cases]
    return chosen(recorder, np.asarray(which) if is_known(which) else which, cases)


RULES: dict[str, Rule] = {
    "max": _maximum,
    "min": _minimum,
    "clamp": _clamped,
    "abs": _absolute,
    **dict.fromkeys(("gt", "ge", "lt", "le", "lt_to", "le_to"), _compared),
    **dict.fromkeys(("eq", "ne"), _equal),
    "is_finite": _finite,
    "select_n": _selected,
}
