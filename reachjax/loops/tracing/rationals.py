"""Rational numbers: what a function is at a point, without any rounding.

Two branches of a function that meet at a point are one continuous function only if their values
there are the same numbers: floats that agree do not prove it. So they are computed as fractions,
with units at those points where their values are rational; elsewhere nothing is known.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import Any

import numpy as np

from reachjax.loops.units import (
    ISRU,
    AbstractUnit,
    Asin,
    Asinh,
    Atan,
    Cos,
    Erf,
    Exp,
    Log,
    Reciprocal,
    ReLU,
    Sin,
    Sinc,
    Sqrt,
    Square,
    Tanh,
    Within,
    XLogX,
)
from reachjax.numerics.checks import is_concrete
from reachjax.numerics.numbers import AbstractNumber

Rational = Fraction | None
"""A number, or None where it is not known."""


def _root(y: Fraction) -> Rational:
    if y < 0:
        return None
    root = Fraction(math.isqrt(y.numerator), math.isqrt(y.denominator))
    return root if root * root == y else None


def _at(point: int, value: int) -> Callable[[Fraction], Rational]:
    return lambda y: Fraction(value) if y == point else None


VALUES: dict[type[AbstractUnit], Callable[[Fraction], Rational]] = {
    ReLU: lambda y: max(y, Fraction(0)),
    Square: lambda y: y * y,
    Reciprocal: lambda y: 1 / y if y else None,
    Sqrt: _root,
    Exp: _at(0, 1),
    Log: _at(1, 0),
    Tanh: _at(0, 0),
    Sin: _at(0, 0),
    Sinc: _at(0, 1),
    Cos: _at(0, 1),
    Atan: _at(0, 0),
    Asin: _at(0, 0),
    Asinh: _at(0, 0),
    Erf: _at(0, 0),
    ISRU: _at(0, 0),
    XLogX: lambda y: Fraction(0) if y in (0, 1) else None,
    Within: lambda y: y,
}
"""Rational values of units at rational points."""


class Rationals(AbstractNumber):
    """A vector of rational numbers: a kind of number. One number stands for many that are the same.

    Example:
        >>> third = Rationals.of(np.ones(1)).over(np.full(1, 3.0))
        >>> (third + third + third).numbers
        [Fraction(1, 1)]
    """

    def __init__(self, numbers: list[Rational]):
        self.numbers = numbers

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, index: Any) -> Rationals:
        return Rationals([self.numbers[k] for k in np.atleast_1d(np.arange(len(self))[index])])

    @classmethod
    def of(cls, plain: Any) -> Rationals:
        """Floats as they are; of what is traced or not finite nothing is known."""
        if not is_concrete(plain):
            return cls([None])
        flat = np.asarray(plain, float).reshape(-1)
        if flat.size and np.all(flat == flat[0]):
            flat = flat[:1]
        return cls([Fraction(each) if math.isfinite(each) else None for each in flat.tolist()])

    def _pairs(self, other: Any) -> list[tuple[Rational, Rational]]:
        other = other if isinstance(other, Rationals) else self.of(other)
        return [*aligned(self.numbers, other.numbers)]

    def _with(self, other: Any, made: Callable[[Fraction, Fraction], Rational]) -> Rationals:
        pairs = self._pairs(other)
        return Rationals([None if a is None or b is None else made(a, b) for a, b in pairs])

    def __add__(self, other: Any) -> Rationals:
        return self._with(other, lambda a, b: a + b)

    def __neg__(self) -> Rationals:
        return Rationals([None if each is None else -each for each in self.numbers])

    def __sub__(self, other: Any) -> Rationals:
        return self._with(other, lambda a, b: a - b)

    def __mul__(self, other: Any) -> Rationals:
        """Products; that of zero and what is not known is zero."""
        return Rationals(
            [
                Fraction(0) if a == 0 or b == 0 else None if a is None or b is None else a * b
                for a, b in self._pairs(other)
            ]
        )

    def __rmul__(self, factor: Any) -> Rationals:
        return self * factor

    def __rmatmul__(self, matrix: Any) -> Rationals:
        return Rationals([None])

    def over(self, divisor: Any, inverse: Any = None) -> Rationals:
        """Quotients; that of zero and what is not known is zero."""
        return Rationals(
            [
                Fraction(0) if a == 0 else None if a is None or not b else a / b
                for a, b in self._pairs(divisor)
            ]
        )

    def nearly_times(self, factor: Any) -> Rationals:
        """Products with a number that is not rational."""
        return Rationals([Fraction(0) if each == 0 else None for each in self.numbers])

    def widened(self, by: Any) -> Rationals:
        """Numbers of which nothing is known."""
        return Rationals([None])

    def floats(self) -> np.ndarray | None:
        """The numbers as floats; None unless all of them are known, and are floats."""
        if any(each is None for each in self.numbers):
            return None
        try:
            found = [float(each) for each in self.numbers]  # type: ignore[arg-type]
        except OverflowError:
            return None
        same = all(Fraction(a) == b for a, b in zip(found, self.numbers, strict=True))
        return np.array(found) if same else None


def aligned(*columns: list[Rational]) -> Iterator[Any]:
    """The entries of several vectors, side by side."""
    size = max((len(each) for each in columns if len(each) != 1), default=1)
    size = 0 if any(not each for each in columns) else size
    return zip(*(each * size if len(each) == 1 else each for each in columns), strict=True)


def evaluated(unit: AbstractUnit, y: Rationals, *others: Rationals) -> Rationals:
    """What is done at a unit."""
    if others:
        return unit(y, *others)  # type: ignore[arg-type]
    value = VALUES.get(type(unit), lambda number: None)
    return Rationals([None if each is None else value(each) for each in y.numbers])
