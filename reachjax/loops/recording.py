"""A traced function as a list of steps over any kind of number.

Values that depend on the inputs are vectors of numbers of one kind, flattened, whose shapes the
trace knows. What depends on nothing but parameters is computed as the function says, once. Every
step is affine (a choice of entries, a matrix, a factor, a sum) or a layer of units.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from reachjax.loops.units import AbstractUnit, AtUnit, ReLU, UnboundedError
from reachjax.loops.units.powers import Square
from reachjax.numerics.checks import is_concrete
from reachjax.numerics.rounding import Ball, namespace

Shape = tuple[int, ...]


class Value:
    """Numbers that depend on the inputs.

    Attributes:
        place: where they stand among all values.
        shape: of the array that they are, flattened.
        link: a value of which they are `scale * value + offset`, entry by entry, if there is one.
    """

    def __init__(self, place: int, shape: Shape, link: Link | None = None):
        self.place, self.shape, self.link = place, shape, link

    @property
    def size(self) -> int:
        """How many numbers they are."""
        return math.prod(self.shape)


class Link(NamedTuple):
    """That a value is `scale * ancestor + offset`, entry by entry, in flat arrays or numbers."""

    ancestor: Value | None
    scale: Any
    offset: Any


class Comparison(NamedTuple):
    """Whether numbers are above zero; at zero it must not matter."""

    value: Value


Operand = Any
"""A `Value`, a `Comparison`, or a plain array that depends on no input."""

Step = Callable[[list[Any], AtUnit], Any]
"""What a value is, given those before and what is done at a unit."""


class Recorder:
    """The steps so far.

    Args:
        shapes: of the inputs.

    Attributes:
        inputs: their values.
        known: results of equations, and their operands, which are so kept alive.
        line: where a user wrote the equation at hand.
    """

    def __init__(self, shapes: Sequence[Shape]):
        self._steps: list[Step] = []
        self._count = len(shapes)
        self.line = ""
        self.known: dict[Any, tuple[list[Operand], Sequence[Operand]]] = {}
        self.inputs = [Value(place, shape) for place, shape in enumerate(shapes)]

    def run(self, numbers: Sequence[Any], unit: AtUnit, wanted: Value) -> Any:
        """The numbers of a value, from those of the inputs, of any one kind."""
        found = list(numbers)
        for step in self._steps:
            found.append(step(found, unit))
        return found[wanted.place]

    def _added(self, shape: Shape, step: Step, link: Link | None = None) -> Value:
        self._steps.append(step)
        self._count += 1
        return Value(self._count - 1, shape, link)

    def picked(self, value: Value, index: Int[np.ndarray, ...]) -> Value:
        """Entries of a value, by their numbers in the flat vector, as an array of that shape."""
        place, flat = value.place, np.asarray(index).ravel()
        if np.array_equal(flat, np.arange(value.size)):
            return Value(place, np.shape(index), value.link)
        return self._added(np.shape(index), lambda found, unit: found[place][flat])

    def broadcast(self, value: Value, shape: Shape) -> Value:
        """The same entries in a larger array."""
        index = np.arange(value.size).reshape(value.shape)
        return self.picked(value, np.broadcast_to(index, shape))

    def scaled(self, value: Value, factor: Any) -> Value:
        """Each entry times a plain number."""
        factor, place = _flat(factor, value), value.place
        link = Link(value, factor, 0.0)
        return self._added(value.shape, lambda found, unit: factor * found[place], link)

    def shifted(self, value: Value, by: Any) -> Value:
        """Each entry plus a plain number."""
        by, place = _flat(by, value), value.place
        link = Link(value, 1.0, by)
        return self._added(value.shape, lambda found, unit: found[place] + by, link)

    def added(self, one: Operand, other: Operand, sign: int = 1) -> Any:
        """`one + sign other`, both of one shape."""
        if not isinstance(other, Value):
            return self.shifted(one, sign * other) if isinstance(one, Value) else one + sign * other
        if not isinstance(one, Value):
            return self.shifted(other if sign > 0 else self.scaled(other, np.array(-1.0)), one)
        link, first, second = None, one.place, other.place
        if shared := common(one, other):
            by_one, by_other = shared
            scale = by_one.scale + sign * by_other.scale
            link = Link(by_one.ancestor, scale, by_one.offset + sign * by_other.offset)
        if sign > 0:
            return self._added(one.shape, lambda found, unit: found[first] + found[second], link)
        return self._added(one.shape, lambda found, unit: found[first] - found[second], link)

    def mapped(self, value: Value, matrix: Any, shape: Shape) -> Value:
        """A plain matrix times a value."""
        place = value.place
        return self._added(shape, lambda found, unit: matrix @ found[place])

    def joined(self, operands: Sequence[Operand]) -> Value:
        """All of these, one behind the other, as one vector; one of them at least is a value."""
        sizes = [part.size if isinstance(part, Value) else np.size(part) for part in operands]
        total, ends = sum(sizes), np.cumsum(sizes)
        eye, found, constants = np.eye(total), None, []
        for part, end, size in zip(operands, ends, sizes, strict=True):
            if isinstance(part, Value):
                placed = self.mapped(part, eye[:, end - size : end], (total,))
                found = placed if found is None else self.added(found, placed)
                constants.append(np.zeros(size))
            else:
                constants.append(part.reshape(-1))
        assert found is not None  # else it would be plain
        if all(isinstance(part, Value) for part in operands):
            return found
        return self.shifted(found, namespace(*constants).concatenate(constants))

    def unit(self, unit: AbstractUnit, value: Value) -> Value:
        """A layer of units."""
        place, line = value.place, self.line

        def applied(found: list[Any], at: AtUnit) -> Any:
            try:
                return at(unit, found[place])
            except UnboundedError as error:
                raise UnboundedError(*error.given, line=line) from None

        return self._added(value.shape, applied)

    def rectified(self, value: Value) -> Value:
        """`max(value, 0)`."""
        return self.unit(ReLU(), value)

    def product(self, one: Value, other: Value) -> Value:
        """`one * other = ((one + other)^2 - (one - other)^2) / 4`, entry by entry."""
        if one.place == other.place:
            return self.unit(Square(), one)
        total, difference = self.added(one, other), self.added(one, other, -1)
        squares = [self.unit(Square(), part) for part in (total, difference)]
        found = self.scaled(self.added(squares[0], squares[1], -1), np.array(0.25))
        first, second, third = one.place, other.place, found.place

        def met(numbers: list[Any], unit: AtUnit) -> Any:
            squares, factors = numbers[third], (numbers[first], numbers[second])
            # the difference of two squares forgets what a product of intervals knows
            known = type(squares) is Ball and all(type(each) is Ball for each in factors)
            return squares.meeting(factors[0].times(factors[1])) if known else squares

        return self._added(one.shape, met)


def _flat(plain: Any, value: Value) -> Any:
    return namespace(plain).broadcast_to(plain, value.shape).reshape(-1)


def _ancestors(operand: Operand) -> Iterator[Link]:
    """What an operand is an affine function of, entry by entry, the nearest first: itself."""
    if not isinstance(operand, Value):
        yield Link(None, 0.0, operand.reshape(-1))
        return
    found = Link(operand, 1.0, 0.0)
    while found.ancestor is not None:
        yield found
        up = found.ancestor.link
        if up is None:
            return
        offset = found.scale * up.offset + found.offset
        found = Link(up.ancestor, found.scale * up.scale, offset)


def common(*operands: Operand) -> list[Link] | None:
    """Each of them as an affine function of the nearest value that they have in common.

    None if there is no such value.
    """
    lines = [list(_ancestors(operand)) for operand in operands]
    first = next(line for line in lines if line[0].ancestor is not None)
    for candidate in first:
        found = []
        for line in lines:
            if line[0].ancestor is None:  # constants are of all
                found.append(line[0])
                continue
            place = candidate.ancestor and candidate.ancestor.place
            found += [link for link in line if link.ancestor and link.ancestor.place == place][:1]
        if len(found) == len(lines):
            return found
    return None


def is_known(*plain: Any) -> bool:
    """Whether plain arrays are concrete numbers."""
    return is_concrete(plain)
