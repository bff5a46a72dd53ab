"""What a recording is made of: values that depend on the inputs, and the steps that make them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from reachjax.loops.units import AbstractUnit
from reachjax.numerics.checks import is_concrete

Shape = tuple[int, ...]


class UnsupportedError(Exception):
    """A primitive cannot be certified; the message says what to do.

    Attributes:
        primitive: its name, once it is known.
        line: where a user wrote it, the same.
    """

    primitive, line = "", ""


class Value:
    """Numbers that depend on the inputs.

    Attributes:
        place: where they stand among all values.
        shape: of the array that they are, flattened.
        terms: the sum that they are, entry by entry, of values nearer to the inputs, and
        offset: what is added to it; None where they are no such sum.
        source: what they are entries of, and which, if they are picked.
        fact: limits that are known besides, from those of other values.
        binary: whether each number is zero or one.
    """

    def __init__(
        self,
        place: int,
        shape: Shape,
        terms: tuple[Term, ...] | None = None,
        offset: Any = 0.0,
        source: tuple[Value, Any] | None = None,
    ):
        self.place, self.shape, self.terms, self.offset = place, shape, terms, offset
        self.source = source
        self.fact: Fact | None = None
        self.binary = False

    @property
    def size(self) -> int:
        """How many numbers they are."""
        return math.prod(self.shape)

    def levels(self) -> Iterator[tuple[Value, list[Term]]]:
        """The value, and each that it is a multiple of, with the factors and divisors in between.

        They are multiples whatever the parameters are.
        """
        value, found = self, list[Term]()
        yield value, found
        while value.terms is not None and len(value.terms) == 1 and _is_nothing(value.offset):
            found = [*found, *value.terms]
            value = found[-1].value
            yield value, found


class Term(NamedTuple):
    """`factor value / divisor`, entry by entry: flat arrays, or numbers."""

    value: Value
    factor: Any = 1.0
    divisor: Any = 1.0


class Choice:
    """What is decided by comparisons of numbers, and may only choose between others."""


class Comparison(Choice):
    """Whether numbers are above zero.

    Attributes:
        value: these numbers.
        strict: whether it is computed to be false at zero, where both are possible.
    """

    def __init__(self, value: Value, strict: bool):
        self.value, self.strict = value, strict

    @property
    def shape(self) -> Shape:
        """The shape of the array of truth values."""
        return self.value.shape


class Conditions(Choice):
    """Comparisons, or known truth values, one behind the other along a first axis.

    Attributes:
        parts: these.
        counted: whether they are numbers of those so far that hold.
        kind: of the entries: truth values, or zeros and ones of another kind.
    """

    def __init__(self, parts: Sequence[Any], counted: bool = False, kind: Any = bool):
        self.parts, self.counted, self.kind = tuple(parts), counted, kind

    @property
    def shape(self) -> Shape:
        """The shape of the array."""
        return len(self.parts), *np.shape(self.parts[0])


class Index(Choice):
    """The place of the first, or of the last, condition that holds; zero if none does.

    Attributes:
        conditions: comparisons, or known truth values.
        last: whether it is the last one.
        kind: of whole number.
    """

    def __init__(self, conditions: Sequence[Any], last: bool = False, kind: Any = int):
        self.conditions, self.last, self.kind = tuple(conditions), last, kind

    @property
    def shape(self) -> Shape:
        """The shape of the array of places."""
        return np.shape(self.conditions[0])


class Pick(Choice):
    """One of `k` arrays of plain numbers, by which of as many events holds: one of them does.

    Attributes:
        which: `(k,)`, or `(k, *shape)` where each entry has events of its own: one for the event
            that holds, zeros for the others.
        numbers: `(k, *shape)`.
    """

    def __init__(self, which: Value, numbers: Any):
        self.which, self.numbers = which, numbers

    @property
    def shape(self) -> Shape:
        """The shape of the array."""
        return np.shape(self.numbers)[1:]

    @property
    def cases(self) -> list[Any]:
        """The array of each event: of parameters, if the numbers are."""
        own = isinstance(self.numbers, Parameter)
        return [Parameter.of(each) if own else each for each in self.numbers]

    @property
    def is_single(self) -> bool:
        """Whether one event decides about all entries."""
        return len(self.which.shape) == 1


class Unknown:
    """A result that has no bounds, and may be passed on, but not computed with.

    Attributes:
        primitive: what made it.
        why: it has none, and what to do.
        source: what it was made of.
    """

    def __init__(self, primitive: str, why: str, source: Any = None):
        self.primitive, self.why, self.source = primitive, why, source

    @property
    def error(self) -> UnsupportedError:
        """The error where it is used."""
        error = UnsupportedError(self.why)
        error.primitive = self.primitive
        return error


Operand = Any
"""A `Value`, a `Choice`, an `Unknown`, or a plain array that depends on no input."""

Fact = Callable[[Callable[[Operand], Any]], Any]
"""Limits of a value, from a function that gives those of others."""


class Step(NamedTuple):
    """How a value comes about.

    Attributes:
        apply: from what is done at a unit, and the numbers of other values, to its own.
        parents: the places of these.
        entrywise: whether each entry is of the same entries of these alone.
        unit: that of a layer of units.
        again: how it is recorded of other values, flat ones, in place of its parents.
        linear: whether it is affine, by numbers that are known.
        line: where a user wrote it, of a unit.
    """

    apply: Callable[..., Any]
    parents: tuple[int, ...]
    entrywise: bool = True
    unit: AbstractUnit | None = None
    again: Callable[..., Any] | None = None
    linear: bool = False
    line: str = ""


class Parameter(np.ndarray):
    """The numbers of a parameter, or what is made of them: known here, and traced elsewhere."""

    @classmethod
    def of(cls, plain: Any) -> Any:
        """A parameter; one that is traced as it is."""
        return np.asarray(plain).view(cls) if is_concrete(plain) else plain


def _is_nothing(offset: Any) -> bool:
    """Whether an offset is zero, whatever the parameters are."""
    return is_constant(offset) and not np.any(offset)


def is_plain(operand: Operand) -> bool:
    """Whether an operand depends on no input."""
    return not isinstance(operand, Value | Choice | Unknown)


def is_constant(plain: Any) -> bool:
    """Whether plain numbers are the same whatever the parameters are."""
    return is_concrete(plain) and not isinstance(plain, Parameter)


def is_known(*operands: Operand) -> bool:
    """Whether operands are plain arrays of concrete numbers."""
    return all(map(is_plain, operands)) and is_concrete(operands)
