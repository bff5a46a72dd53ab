"""Quotients and logarithms of numbers that know each other: norms, softmax, sums of exponentials.

A number over its norm with others is `v / sqrt(v^2 + R) = g(v / sqrt R)` with `g(y) = y / sqrt(1 +
y^2)`, so it is at most one in size whatever bounds say of `v` and of the norm. An exponential over
a sum of them is a logistic sigmoid of its exponent less the logarithm of the sum of the others, and
`log(e^a + e^b) = a + log(1 + e^(b - a))`: nothing overflows, and no divisor comes near to zero.

As JAX computes it, it may: `exp(x) / (1 + exp(x))` is NaN from 710 on. So the sum itself must have
bounds, unless it is seen to be moderate whatever the inputs are, as where the largest of all
exponents is taken from each.

What a recording is made of rests on its steps and on constants, never on numbers of parameters.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from reachjax.loops.tracing.combinations import LARGEST, Combination, InexactError
from reachjax.loops.tracing.limits import ConstantLimits, Limits
from reachjax.loops.tracing.recording import Entry, Recorder
from reachjax.loops.tracing.values import Term, Value, is_constant
from reachjax.loops.units import (
    ISRU,
    AbstractUnit,
    Exp,
    Log,
    Reciprocal,
    Softplus,
    Sqrt,
    Square,
    Tanh,
    Within,
)
from reachjax.numerics.rounding import TINY, gamma

TERMS = 96
"""More exponentials in sums are left as they are: each costs a unit in every sum that it is in."""


FEW = 3
"""Numbers with this many others and more rarely are most of their norm. They are divided by it, and
it is said of the quotients alone how large they are: what they have in common is worth more. Over
three steps of a network with RMS norms of 12 numbers linear bounds were 0.272 wide by that, and
0.367 with a unit for each; with one number they were 0.48 by the unit, and 62 without."""


class Entries(NamedTuple):
    """Entries `value[numbers]` of a value; what a step picks is that of the step before."""

    value: Value
    numbers: Int[np.ndarray, " k"]


class Exponent(NamedTuple):
    """The exponent of a term of a sum; 1 has the exponent zero.

    Attributes:
        entry: the place of the value that it is of, and its number there; None for zero.
        number: what it is of values before.
    """

    entry: tuple[int, int] | None
    number: Combination


Found = Callable[..., Any]


def _unless_inexact(rule: Found) -> Found:
    """A rule that finds nothing where rounding would decide what it finds."""

    @functools.wraps(rule)
    def found(*given: Any) -> Any:
        try:
            return rule(*given)
        except InexactError:
            return None

    return found


def _entries(value: Value) -> Entries:
    return Entries(*value.source) if value.source else Entries(value, np.arange(value.size))


def _inputs(recorder: Recorder, entries: Entries, kind: type) -> Entries | None:
    """The inputs of the units that these entries are values of; None if these are of others."""
    step = recorder.steps[entries.value.place]
    if step is None or not isinstance(step.unit, kind):
        return None
    inner, before = _entries(recorder.values[step.parents[0]])
    return Entries(inner, before[entries.numbers])


@_unless_inexact
def over_norm(recorder: Recorder, one: Value, other: Value) -> Value | None:
    """The product of a number and the inverse of its norm with others; None if it is none."""
    for inverse, scales in other.levels():
        root = _inputs(recorder, _entries(inverse), Reciprocal)
        inner = root and _inputs(recorder, root, Sqrt)
        if not inner or one.size * inner.value.size > LARGEST**2:
            continue
        squares = Combination.of(recorder, inner.value)[inner.numbers]
        for number, more in one.levels():
            found = _without_own(recorder, squares, _entries(number))
            if found is not None:
                # as JAX computes it, squares overflow long before the quotient would
                recorder.require(other if scales else inner.value, sums=True)
                if more:
                    recorder.require(one, sums=True)
                number = recorder.reshaped(number, one.shape)
                inverse = recorder.reshaped(inverse, one.shape)
                unit = _normalised(recorder, number, inverse, *found)
                return recorder.rescaled(unit, [*more, *scales])
    return None


def _normalised(
    recorder: Recorder, number: Value, inverse: Value, weights: np.ndarray, rest: Combination
) -> Value:
    """A number over its norm.

    Args:
        recorder: of the steps.
        number: which one.
        inverse: that of its norm.
        weights: `(k,)`, of its square in the square of the norm.
        rest: of that square.
    """
    shape, roots = number.shape, np.sqrt(weights).reshape(number.shape)
    others = [np.count_nonzero(part, axis=1).max(initial=0) for part in rest.parts.values()]
    if max(others) >= FEW:
        most = float(np.max(1 / roots)) * (1 + gamma(1))
        found = recorder.product(number, inverse)
        recorder.limited(found, lambda _: Limits(np.full(1, -most), np.full(1, most)))
        return recorder.unit(Within(), found)
    if any(others):
        norm = recorder.unit(Reciprocal(), recorder.unit(Sqrt(), rest.recorded(recorder, shape)))
        inputs = recorder.product(recorder.nearly_scaled(number, roots), norm)
    else:
        ratio = np.sqrt(weights / rest.offset).reshape(shape)
        inputs = recorder.nearly_scaled(number, ratio)
    return recorder.nearly_scaled(recorder.unit(ISRU(), inputs), 1 / roots)


def _without_own(
    recorder: Recorder, squares: Combination, own: Entries
) -> tuple[Float[np.ndarray, " k"], Combination] | None:
    """Weights of the squares of some numbers in sums of such, and the rest of these sums.

    None unless each has its own, and the rest is positive whatever the inputs are.
    """
    squares.require_near()
    weights, rest = np.zeros(len(own.numbers)), {}
    for place, matrix in squares.parts.items():
        value, step, matrix = recorder.values[place], recorder.steps[place], matrix.copy()
        if np.any(matrix < 0) or not recorder.is_nonnegative(value):
            return None
        if step is not None and isinstance(step.unit, Square):
            base, index = _entries(recorder.values[step.parents[0]])
            if base.place == own.value.place:
                same = own.numbers[:, None] == index
                weights += np.where(same, matrix, 0.0).sum(axis=1)
                matrix[same] = 0.0
        rest[place] = matrix
    if not (np.all(weights > 0) and np.all(squares.offset > 0)):
        return None
    return weights, Combination(rest, squares.offset, squares.errors)


@_unless_inexact
def over_sum(recorder: Recorder, one: Any, other: Value) -> Value | None:
    """An exponential, or 1, over a sum of exponentials that it is one of; None if it is none.

    That is `sigmoid(a - log(sum of the others)) = (1 + tanh(... / 2)) / 2`.
    """
    terms = _exponents(recorder, other)
    if terms is None:
        return None
    mine: Combination | None = None
    entries: list[Any] = [None] * other.size
    more: list[Term] = []
    if not isinstance(one, Value):
        is_one = is_constant(one) and bool(np.all(one == 1))
        mine = Combination({}, np.zeros(other.size)) if is_one else None
    else:
        for number, factors in one.levels():
            own = _inputs(recorder, _entries(number), Exp)
            if own is not None:
                mine, more = Combination.of(recorder, own.value)[own.numbers], factors
                entries = [(own.value.place, number) for number in own.numbers.tolist()]
                break
    if mine is None:
        return None
    rows = []
    for k, each in enumerate(terms):
        own_term = Exponent(entries[k], mine[[k]])
        others = [term for term in each if not _is_same(term, own_term)]
        if len(others) != len(each) - 1:
            return None
        rows.append(others)
    columns = _columns(rows)
    if columns is None:
        return None
    if isinstance(one, Value) and not _are_shifted(recorder, terms):
        if not _is_moderate(recorder, other):
            _require_sum(recorder, other, Reciprocal())
        if more:  # factors may be large
            recorder.require(one, sums=True)
    first, logarithm = _logarithm(recorder, columns, other.shape)
    for place in mine.parts | first.parts:  # of what cancels
        recorder.require(recorder.values[place])
    difference = (mine - first).recorded(recorder, other.shape)
    if not isinstance(difference, Value) and not isinstance(logarithm, Value):
        return None
    inputs = recorder.scaled(recorder.added(difference, logarithm, -1), np.array(0.5))
    half = recorder.scaled(recorder.unit(Tanh(), inputs), np.array(0.5))
    return recorder.rescaled(recorder.shifted(half, np.array(0.5)), more)


@_unless_inexact
def of_sum(recorder: Recorder, value: Value) -> Value | None:
    """The logarithm of a sum of exponentials; None if it is of something else."""
    terms = _exponents(recorder, value)
    columns = None if terms is None else _columns(terms)
    if terms is None or columns is None or len(columns) < 2:
        return None
    if not (_are_shifted(recorder, terms) or _is_moderate(recorder, value)):
        _require_sum(recorder, value, Log())
    first, logarithm = _logarithm(recorder, columns, value.shape)
    return recorder.added(first.recorded(recorder, value.shape), logarithm)


def _exponents(recorder: Recorder, value: Value) -> list[list[Exponent]] | None:
    """What the exponentials are of whose sum each entry is, 1 being one; None if it is none."""
    base, index = _entries(value)
    if base.size > LARGEST:
        return None
    sums = Combination.of(recorder, base)[index]
    if sums.errors:
        return None
    found: list[list[Exponent]] = []
    for offset in sums.offset:
        if offset not in (0, 1):
            return None
        found.append([Exponent(None, Combination({}, np.zeros(1)))] if offset == 1 else [])
    for place, matrix in sums.parts.items():
        step = recorder.steps[place]
        if not np.any(matrix):
            recorder.require(recorder.values[place], sums=True)
            continue
        if (
            step is None
            or not isinstance(step.unit, Exp)
            or not np.all((matrix == 0) | (matrix == 1))
        ):
            return None
        if matrix.sum() > TERMS:
            return None
        inner, numbers = _entries(recorder.values[step.parents[0]])
        exponents = Combination.of(recorder, inner)[numbers]
        for row, k in zip(*np.nonzero(matrix), strict=True):
            found[row].append(Exponent((inner.place, int(numbers[k])), exponents[[k]]))
    return found


def _is_moderate(recorder: Recorder, value: Value) -> bool:
    """Whether numbers are neither near zero nor overflow, whatever the inputs are."""
    limits = recorder.limits(value, ConstantLimits)
    return bool(np.all(limits.least >= TINY) and np.all(limits.most < np.inf))


def _are_shifted(recorder: Recorder, terms: list[list[Exponent]]) -> bool:
    """Whether the largest of all exponents is taken from each, in all sums: none overflows."""
    return all(_has_one(recorder, each) for each in terms)


def _require_sum(recorder: Recorder, value: Value, unit: AbstractUnit) -> None:
    """Let a sum be a number, of which a unit has a value unless the sum is never near zero."""
    limits = recorder.limits(value, ConstantLimits)
    number = value if np.all(limits.least >= TINY) else recorder.unit(unit, value)
    recorder.require(number, sums=True)


def _has_one(recorder: Recorder, terms: list[Exponent]) -> bool:
    """Whether the largest of all exponents is taken from each, so that one of them is zero."""
    numbers, largest = set[Entry](), set[Entry]()
    for each in terms:
        if each.entry is None:
            return False
        place, k = each.entry
        value = recorder.values[place]
        if value.terms is None or len(value.terms) != 2 or np.any(value.offset):
            return False
        (one, *plain), (other, *minus) = value.terms
        if plain != [1.0, 1.0] or minus != [-1.0, 1.0]:
            return False
        base, index = _entries(one)
        numbers.add((base.place, int(index[k])))
        base, index = _entries(other)
        largest.add((base.place, int(index[k])))
    if len(largest) != 1:
        return False
    ((place, k),) = largest
    return place in recorder.maxima and recorder.maxima[place][k] == numbers


def _columns(rows: list[list[Exponent]]) -> list[Combination] | None:
    """The first term of each row, the second, and so on; None if rows are not of one length."""
    count = len(rows[0]) if rows else 0
    if count == 0 or any(len(row) != count for row in rows):
        return None
    return [Combination.stacked([row[k].number for row in rows]) for k in range(count)]


def _logarithm(
    recorder: Recorder, columns: list[Combination], shape: tuple[int, ...]
) -> tuple[Combination, Any]:
    """`log(sum_k exp a_k)` as `a_0` and what is added to it: one softplus for each other term."""
    first, *others = columns
    found: Any = np.zeros(shape)
    for each in others:
        rise = (each - first).recorded(recorder, shape)
        rise = recorder.added(rise, found, -1)
        rise = (
            recorder.unit(Softplus(), rise) if isinstance(rise, Value) else np.logaddexp(0.0, rise)
        )
        found = recorder.added(found, rise)
    return first, found


def _is_same(one: Exponent, other: Exponent) -> bool:
    """Whether two exponents are one.

    Raises:
        InexactError: they are but for rounding, which nobody knows.
    """
    if one.entry is not None and one.entry == other.entry:
        return True
    difference = one.number - other.number
    if np.any(difference.offset) or any(map(np.any, difference.parts.values())):
        return False
    if difference.errors:
        raise InexactError
    return True
