"""Limits of numbers whatever the inputs are: interval arithmetic over all of them.

A variance plus 1e-5 is at least 1e-5, and an exponential of what is at most zero at most one.
Intervals of a wide set lose that to rounding, and forms to what they leave out; so units are told.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from reachjax.loops.tracing.values import Parameter
from reachjax.loops.units import AbstractUnit
from reachjax.numerics.checks import is_concrete
from reachjax.numerics.numbers import AbstractNumber
from reachjax.numerics.rounding import TINY, Ball, gamma, underflow


class Limits(AbstractNumber):
    """Numbers in `[least, most]`, rounded outwards, infinite where nothing is known: a kind.

    Attributes:
        least: `(k,)`.
        most: `(k,)`.
        hidden: kinds of arrays of which nothing is taken to be known.
    """

    hidden: ClassVar[tuple[type, ...]] = ()

    def __init__(self, least: Float[np.ndarray, " k"], most: Float[np.ndarray, " k"]):
        self.least = np.where(np.isnan(least), -np.inf, least)
        self.most = np.where(np.isnan(most), np.inf, most)

    def __len__(self) -> int:
        return len(self.least)

    @classmethod
    def unknown(cls, size: int) -> Limits:
        """Limits of numbers of which nothing is known."""
        return cls(np.full(size, -np.inf), np.full(size, np.inf))

    @classmethod
    def of(cls, plain: Any) -> Limits:
        """Limits of plain numbers, which are themselves; of traced ones nothing is known."""
        if cls._is_hidden(plain):
            return cls.unknown(1)
        flat = np.array(plain, float).reshape(-1)
        return cls(flat, flat)

    @classmethod
    def _is_hidden(cls, plain: Any) -> bool:
        return not is_concrete(plain) or isinstance(plain, cls.hidden)

    @property
    def nonnegative(self) -> bool:
        """Whether none of the numbers is ever negative."""
        return bool(np.all(self.least >= 0))

    def __getitem__(self, index: Any) -> Limits:
        return type(self)(self.least[index], self.most[index])

    @np.errstate(invalid="ignore", over="ignore")
    def __add__(self, other: Any) -> Limits:
        other = other if isinstance(other, Limits) else self.of(other)
        ends, off = [], []
        for one, another in ((self.least, other.least), (self.most, other.most)):
            ends.append(one + another)
            off.append(np.where(_is_exact(one, another), 0.0, gamma(1) * abs(ends[-1])))
        return self._outward(*ends, *off)

    def __neg__(self) -> Limits:
        return type(self)(-self.most, -self.least)

    def widened(self, by: Any) -> Limits:
        """The numbers up to an error of so much each."""
        by = by * (1 + gamma(2))
        off = (by + gamma(1) * (abs(end) + by) for end in (self.least, self.most))
        return self._outward(self.least, self.most, *off)

    @np.errstate(invalid="ignore", over="ignore")
    def __mul__(self, other: Any) -> Limits:
        """Products with plain numbers or with limits; those with powers of two are exact."""
        other = other if isinstance(other, Limits) else self.of(other)
        corners = [
            _times(one, another)
            for one in (self.least, self.most)
            for another in (other.least, other.most)
        ]
        least, most = np.minimum.reduce(corners), np.maximum.reduce(corners)
        exact = _is_power(other.least) & (other.least == other.most)
        off = (
            np.where(exact & (abs(end) >= TINY), 0.0, gamma(1) * abs(end) + TINY * (end != 0))
            for end in (least, most)
        )
        return self._outward(least, most, *off)

    def __rmul__(self, factor: Any) -> Limits:
        return self * factor

    @np.errstate(invalid="ignore", over="ignore")
    def nearly_times(self, factor: Any) -> Limits:
        """The products with numbers that these factors are off by a few roundings.

        Those with powers of two are rounded too.
        """
        found = factor * self
        sizes = (gamma(3) * abs(end) + TINY * (end != 0) for end in (found.least, found.most))
        return self._outward(found.least, found.most, *sizes)

    @np.errstate(invalid="ignore", over="ignore")
    def __rmatmul__(self, matrix: Any) -> Limits:
        """A plain matrix times the numbers; where it only picks them nothing is rounded.

        Nor is it where it picks them times powers of two.
        """
        if self._is_hidden(matrix):
            return self.unknown(matrix.shape[0])
        matrix = np.asarray(matrix, float)
        over, under = np.maximum(matrix, 0.0), np.minimum(matrix, 0.0)
        picking = _is_power(matrix) | (matrix == 0)
        picking = picking.all(axis=1) & ((matrix != 0).sum(axis=1) <= 1)
        error, ends, off = np.where(picking, 0.0, gamma(matrix.shape[1])), [], []
        for one, other in ((self.least, self.most), (self.most, self.least)):
            terms = _times(over, one) + _times(under, other)
            ends.append(terms.sum(axis=1))
            lost = underflow(over, one != 0) + underflow(under, other != 0)
            off.append(error * abs(terms).sum(axis=1) + np.where(picking, 0.0, lost))
        return self._outward(*ends, *off)

    def flowed(self, flow: Any, given: tuple[Limits, ...], unit: Any) -> Limits:
        """The state after one period of a flow; nothing is known of it if limits are infinite."""
        if not all(np.isfinite(end).all() for each in given for end in (each.least, each.most)):
            return self.unknown(len(self))
        found = flow.enclosed(tuple(Ball.between(each.least, each.most) for each in given))
        return type(self)(np.asarray(found.lower), np.asarray(found.upper))

    def meeting(self, other: Limits) -> Limits:
        """Limits that both hold."""
        return type(self)(np.maximum(self.least, other.least), np.minimum(self.most, other.most))

    def larger(self, other: Limits) -> Limits:
        """Limits of the larger of two numbers each."""
        return type(self)(np.maximum(self.least, other.least), np.maximum(self.most, other.most))

    def smaller(self, other: Limits) -> Limits:
        """Limits of the smaller of two numbers each."""
        return type(self)(np.minimum(self.least, other.least), np.minimum(self.most, other.most))

    def _outward(self, least: Any, most: Any, below: Any, above: Any) -> Limits:
        """Ends moved by so much; infinite ones stay."""
        return type(self)(
            np.where(np.isfinite(least), least - below, least),
            np.where(np.isfinite(most), most + above, most),
        )

    def at(self, unit: AbstractUnit, *others: Limits) -> Limits:
        """Limits of the values of a layer of units of these inputs."""
        if others:  # products and sums of limits are theirs
            return unit(self, *others)  # type: ignore[arg-type]
        with np.errstate(all="ignore"):
            least, most = unit.limits(self.least, self.most)
        return type(self)(np.asarray(least, float), np.asarray(most, float))


def _is_power(number: Any) -> Any:
    """Whether numbers are powers of two, or these times -1, of moderate size."""
    return (abs(np.frexp(number)[0]) == 0.5) & (abs(number) >= 2.0**-32) & (abs(number) <= 2.0**32)


def _is_exact(one: Any, other: Any) -> Any:
    """Whether sums are floats: what rounding takes from them is one (Knuth, Moller), here zero."""
    total = one + other
    part = total - one
    return (one - (total - part)) + (other - part) == 0


def _times(one: Any, other: Any) -> Any:
    """Products, those with zero being zero."""
    return np.where((one == 0) | (other == 0), 0.0, one * other)


class ConstantLimits(Limits):
    """Limits that rest on constants alone, as they do where parameters are traced.

    What a recording is made of must not depend on numbers that are known in one place only.
    """

    hidden = (Parameter,)
