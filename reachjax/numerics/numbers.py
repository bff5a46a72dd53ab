"""What every kind of number has, so that a loop's forward pass is written once.

Arrays are numbers too, plain ones, which know nothing of errors; the functions here are for both.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from typing import Any, Self


class AbstractNumber(abc.ABC):
    """A vector of numbers of one kind: affine arithmetic with plain ones, and what it knows.

    Two numbers of one kind are multiplied by a unit of two inputs (`units.Bilinear`), as forms need
    to be told where their columns are.
    """

    # arrays of numpy on the left leave `array @ number` and `array - number` to this class
    __array_ufunc__ = None

    @abc.abstractmethod
    def __len__(self) -> int:
        """How many numbers there are."""

    @abc.abstractmethod
    def __getitem__(self, index: Any) -> Self:
        """Some of the numbers."""

    @abc.abstractmethod
    def __add__(self, other: Any) -> Any:
        """Sums with numbers of this kind, or with plain ones."""

    def __radd__(self, other: Any) -> Any:
        return self + other

    @abc.abstractmethod
    def __neg__(self) -> Self:
        """The numbers with the other sign."""

    def __sub__(self, other: Any) -> Any:
        return self + (-other)

    def __rsub__(self, other: Any) -> Any:
        return (-self) + other

    @abc.abstractmethod
    def __rmul__(self, factor: Any) -> Self:
        """Each number times a plain one."""

    @abc.abstractmethod
    def __rmatmul__(self, matrix: Any) -> Self:
        """A plain matrix times the numbers."""

    @abc.abstractmethod
    def widened(self, by: Any) -> Self:
        """The numbers up to an error of so much each."""

    def over(self, divisor: Any, inverse: Any) -> Self:
        """Quotients by plain numbers, whose inverses are rounded once."""
        return inverse * self

    def nearly_times(self, factor: Any) -> Self:
        """Products with plain numbers that these factors are off by a few roundings."""
        return factor * self

    def flowed(self, flow: Any, given: tuple[Any, ...], unit: Callable[..., Any]) -> Any:
        """The state after one period of a flow: what is done at a layer of units.

        Args:
            flow: of a differential equation (`loops.flows`).
            given: these numbers, the input, and disturbances if there are any.
            unit: what is done at a layer of units.
        """
        return unit(flow, *given)

    def met(self, held: Callable[..., Any], *given: Any) -> Self:
        """The numbers with what is known of them besides, from other numbers, if that is kept."""
        return self

    def where_known(self, others: Sequence[Any]) -> Self:
        """The numbers, of which nothing is known where nothing is of others, if that is seen.

        Kinds of which nothing is proved alone may return them as they are.
        """
        return self


def size(number: Any) -> int:
    """How many numbers there are, along the last axis of an array."""
    return len(number) if isinstance(number, AbstractNumber) else number.shape[-1]


def part(number: Any, first: int, last: int) -> Any:
    """The numbers of a range."""
    if isinstance(number, AbstractNumber):
        return number[first:last]
    return number[..., first:last]


def split(number: Any, count: int) -> list[Any]:
    """So many parts of equal length that stand one behind the other."""
    each = size(number) // count
    return [part(number, k * each, (k + 1) * each) for k in range(count)]


def summed(number: Any, count: int) -> Any:
    """The sum of so many parts of equal length that stand one behind the other."""
    found, *parts = split(number, count)
    for other in parts:
        found = found + other
    return found


def widened(number: Any, by: Any) -> Any:
    """A number up to an error of so much."""
    return number.widened(by) if isinstance(number, AbstractNumber) else number


def over(number: Any, divisor: Any, inverse: Any) -> Any:
    """A quotient by plain numbers, whose inverses are rounded once."""
    if isinstance(number, AbstractNumber):
        return number.over(divisor, inverse)
    return inverse * number


def nearly_times(number: Any, factor: Any) -> Any:
    """A product with plain numbers that these factors are off by a few roundings."""
    return number.nearly_times(factor) if isinstance(number, AbstractNumber) else factor * number


def met(number: Any, held: Callable[..., Any], *given: Any) -> Any:
    """A number with what is known of it besides, from other numbers, if its kind keeps that."""
    return number.met(held, *given) if isinstance(number, AbstractNumber) else number


def where_known(number: Any, others: Sequence[Any]) -> Any:
    """A number of which nothing is known where nothing is of others, if its kind sees that."""
    others = [other for other in others if isinstance(other, AbstractNumber)]
    known = not others or not isinstance(number, AbstractNumber)
    return number if known else number.where_known(others)
