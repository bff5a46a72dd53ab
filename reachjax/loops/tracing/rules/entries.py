"""Single numbers, exact constants or entries of values, and sums of products of them.

What is made of constants alone is computed in fractions. So a formula that is written for any
numbers, such as a determinant, is rounded nowhere before what it gives meets what varies.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from reachjax.loops.tracing.limits import ConstantLimits
from reachjax.loops.tracing.recording import Recorder
from reachjax.loops.tracing.values import Operand, UnsupportedError, Value, is_constant
from reachjax.numerics.rounding import TINY, UNIT, gamma


class Entry(NamedTuple):
    """One number of a value.

    Attributes:
        place: of the value.
        number: of the entry in it.
    """

    place: int
    number: int


Scalar = Entry | Fraction


ONE = Fraction(1)


class Product(NamedTuple):
    """`sign one other`, a term of a sum."""

    sign: int
    one: Scalar
    other: Scalar


def entries(recorder: Recorder, operand: Operand) -> np.ndarray:
    """The numbers of an operand, in an array of its shape; constants as fractions."""
    if not isinstance(operand, Value) and is_constant(operand):
        flat = np.asarray(operand, float).ravel()
        found: list[Scalar] = [*map(Fraction, flat.tolist())]
        shape = np.shape(operand)
    else:
        operand = varying(recorder, operand)
        limits, shape = recorder.limits(operand, ConstantLimits), operand.shape
        value, numbers = operand.source or (operand, np.arange(operand.size))
        known = (limits.least == limits.most) & np.isfinite(limits.least)
        if known.any():
            recorder.require(recorder.picked(operand, np.flatnonzero(known)), sums=True)
        found = [
            Fraction(end) if same else Entry(value.place, number)
            for end, same, number in zip(
                limits.least.tolist(), known.tolist(), numbers.tolist(), strict=True
            )
        ]
    return row_of(found).reshape(shape)


def row_of(scalars: Sequence[Scalar]) -> np.ndarray:
    """Scalars as an array of objects."""
    found = np.empty(len(scalars), object)
    found[:] = scalars
    return found


def zeros(*shape: int) -> np.ndarray:
    """An array of zeros."""
    return np.full(shape, Fraction(0), object)


def identity(n: int) -> np.ndarray:
    """The identity matrix."""
    found = zeros(n, n)
    np.fill_diagonal(found, ONE)
    return found


def varying(recorder: Recorder, operand: Operand) -> Value:
    """An operand as a value; plain numbers as `0 x` plus these."""
    if isinstance(operand, Value):
        return operand
    nothing = recorder.picked(recorder.inputs[0], np.zeros(np.shape(operand), int))
    return recorder.shifted(recorder.scaled(nothing, np.array(0.0)), operand)


def gathered(recorder: Recorder, wanted: Sequence[Entry]) -> Value:
    """Entries as one vector."""
    distinct = sorted(set(wanted))
    places = sorted({each.place for each in distinct})
    parts = [
        recorder.picked(
            recorder.values[place], np.array([e.number for e in distinct if e.place == place])
        )
        for place in places
    ]
    joined = parts[0] if len(parts) == 1 else recorder.joined(parts)
    order = {each: k for k, each in enumerate(distinct)}
    return recorder.picked(joined, np.array([order[each] for each in wanted]))


def as_value(recorder: Recorder, scalars: np.ndarray) -> Any:
    """An array of scalars as an operand, plain if all are constants."""
    flat = [*scalars.ravel()]
    own = [each for each in flat if isinstance(each, Entry)]
    constants = [each if isinstance(each, Fraction) else Fraction(0) for each in flat]
    if not own:
        return _floats(constants).reshape(scalars.shape)
    (index,) = np.nonzero(np.array([isinstance(each, Entry) for each in flat]))
    found = gathered(recorder, own)
    if len(own) < len(flat):
        matrix = np.zeros((len(flat), len(own)))
        matrix[index, np.arange(len(own))] = 1.0
        found = _shifted(recorder, recorder.mapped(found, matrix, (len(flat),)), constants)
    return recorder.reshaped(found, scalars.shape)


def sums(recorder: Recorder, rows: Iterable[Iterable[Product]]) -> list[Scalar]:
    """Sums of products."""
    offsets: list[Fraction] = []
    products: dict[Any, None] = {}
    multiples: dict[Any, None] = {}
    terms: list[list[tuple[int, Any]]] = []
    for row in rows:
        offset, mine = Fraction(0), []
        for sign, one, other in row:
            one, other = (other, one) if isinstance(one, Fraction) else (one, other)
            if isinstance(one, Fraction):
                offset += sign * one * other  # type: ignore[operator]
            elif isinstance(other, Fraction):
                if other:
                    mine.append((1, (one, sign * other)))
                else:
                    recorder.require(recorder.values[one.place], sums=True)
            else:
                mine.append((sign, (min(one, other), max(one, other))))
        offsets.append(offset)
        terms.append(mine)
    found: list[Scalar] = [*offsets]
    open_rows = []
    for k, (offset, mine) in enumerate(zip(offsets, terms, strict=True)):
        if offset == 0 and len(mine) == 1 and mine[0][1][1] == 1:
            found[k] = mine[0][1][0]
        elif mine:
            open_rows.append(k)
            for _, pair in mine:
                (multiples if isinstance(pair[1], Fraction) else products)[pair] = None
    if not open_rows:
        return found
    total: Any = None
    for pairs, made in ((products, _products), (multiples, _multiples)):
        if pairs:
            order = {pair: j for j, pair in enumerate(pairs)}
            matrix = np.zeros((len(open_rows), len(pairs)))
            for i, k in enumerate(open_rows):
                for sign, pair in terms[k]:
                    if pair in order:
                        matrix[i, order[pair]] += sign
            part = recorder.mapped(made(recorder, [*pairs]), matrix, (len(open_rows),))
            total = part if total is None else recorder.added(total, part)
    total = _shifted(recorder, total, [offsets[k] for k in open_rows])
    for k, entry in zip(open_rows, entries(recorder, total), strict=True):
        found[k] = entry
    return found


def _products(recorder: Recorder, pairs: Sequence[tuple[Entry, Entry]]) -> Value:
    one, other = (gathered(recorder, [pair[k] for pair in pairs]) for k in (0, 1))
    return recorder.product(one, other)


def _multiples(recorder: Recorder, pairs: Sequence[tuple[Entry, Fraction]]) -> Value:
    """Entries times constants, which may be rounded."""
    value, factors = gathered(recorder, [one for one, _ in pairs]), [by for _, by in pairs]
    floats = _floats(factors)
    exact = all(Fraction(a) == b for a, b in zip(floats.tolist(), factors, strict=True))
    return (recorder.scaled if exact else recorder.nearly_scaled)(value, floats)


def _shifted(recorder: Recorder, value: Value, by: Sequence[Fraction]) -> Value:
    """A value plus constants, up to what these are rounded by."""
    floats = _floats(by)
    if not np.any(floats):
        return value
    found = recorder.shifted(value, floats)
    inexact = np.array([Fraction(a) != b for a, b in zip(floats.tolist(), by, strict=True)])
    if not np.any(inexact):
        return found
    return recorder.loosened(found, np.where(inexact, UNIT * (1 + gamma(1)) * abs(floats), 0.0))


def _floats(numbers: Sequence[Fraction]) -> np.ndarray:
    """The nearest floats, relative errors of which are roundings.

    Raises:
        UnsupportedError: a number is too large or too small for that.
    """
    if any(each and not TINY < abs(each) < 1 / TINY for each in numbers):
        raise UnsupportedError(
            "constants in it make numbers beyond 1e-307 to 1e307: scale its rows, or the units of "
            "the states"
        )
    return np.array([float(each) for each in numbers])
