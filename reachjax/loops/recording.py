"""A traced function as a list of steps over any kind of number.

Values that depend on the inputs are vectors of numbers of one kind, flattened, whose shapes the
trace knows. What depends on nothing but parameters is computed as the function says, once. Every
step is affine (a choice of entries, a matrix, a factor, a sum) or a layer of units.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from reachjax.loops.rationals import Rationals
from reachjax.loops.units import AbstractUnit, AtUnit, ReLU, SmoothUnit, Square, UnboundedError
from reachjax.loops.values import Operand, Shape, Step, Term, UnsupportedError, Value, is_known
from reachjax.numerics.rounding import TINY, UNIT, Ball, larger, namespace


class Recorder:
    """The steps so far.

    Args:
        shapes: of the inputs.

    Attributes:
        inputs: their values.
        values: all of them, by their places.
        steps: that make them, the same; None for the inputs.
        known: results of equations, and their operands, which are so kept alive.
        line: where a user wrote the equation at hand.
    """

    def __init__(self, shapes: Sequence[Shape]):
        self.steps: list[Step | None] = [None] * len(shapes)
        self.line = ""
        self.known: dict[Any, tuple[list[Operand], Sequence[Operand]]] = {}
        self.inputs = [Value(place, shape) for place, shape in enumerate(shapes)]
        self.values = [*self.inputs]

    def run(self, numbers: Sequence[Any], unit: AtUnit, wanted: Value) -> Any:
        """The numbers of a value, from those of the inputs, of any one kind.

        What it does not depend on is left out: units there add no columns and need no bounds.
        """
        found = dict(enumerate(numbers))
        for place in self.between(wanted):
            step = self.steps[place]
            if step is not None:
                found[place] = step.apply(unit, *(found[parent] for parent in step.parents))
        return found[wanted.place]

    def between(self, wanted: Value, first: Value | None = None) -> list[int]:
        """Places of all that a value depends on, itself the last; back to another one, if given."""
        needed, todo = set(), [wanted.place]
        while todo:
            place = todo.pop()
            if place not in needed:
                needed.add(place)
                step = None if first is not None and place == first.place else self.steps[place]
                todo += step.parents if step is not None else ()
        return sorted(needed)

    def layer(self, shape: Shape, step: Step, **facts: Any) -> Value:
        """What a step makes of the values before; the rest is what is known of it."""
        made = Value(len(self.steps), shape, **facts)
        self.steps.append(step)
        self.values.append(made)
        return made

    def picked(self, value: Value, index: Int[np.ndarray, ...]) -> Value:
        """Entries of a value, by their numbers in the flat vector, as an array of that shape."""
        flat, known = np.asarray(index).ravel(), value.nonnegative
        if np.array_equal(flat, np.arange(value.size)):
            return Value(value.place, np.shape(index), value.terms, value.offset, known)
        step = Step(lambda unit, y: y[flat], (value.place,), entrywise=False)
        return self.layer(np.shape(index), step, nonnegative=known)

    def broadcast(self, value: Value, shape: Shape) -> Value:
        """The same entries in a larger array."""
        index = np.arange(value.size).reshape(value.shape)
        return self.picked(value, np.broadcast_to(index, shape))

    def scaled(self, value: Value, factor: Any) -> Value:
        """Each entry times a plain number."""
        factor = _flat(factor, value)
        known = value.nonnegative and is_known(factor) and bool(np.all(np.asarray(factor) >= 0))
        step = Step(lambda unit, y: factor * y, (value.place,))
        return self.layer(value.shape, step, terms=(Term(value, factor),), nonnegative=known)

    def divided(self, value: Value, divisor: Any) -> Value:
        """Each entry over a plain number: times its inverse, which is rounded.

        That is one rounding of the eight that `gamma` has to spare in a product with a number. Of
        traced divisors whose inverses are not normal numbers, nothing is known.

        Raises:
            UnsupportedError: a divisor is zero, or has no inverse.
        """
        divisor = _flat(divisor, value)
        normal = (abs(divisor) >= TINY) & (abs(divisor) <= 1 / TINY)
        if is_known(divisor) and not np.all(np.asarray(normal)):
            raise UnsupportedError("it divides by zero, or by what has no inverse in 64 bits")
        xp = namespace(divisor)
        inverse = xp.where(normal, 1.0 / xp.where(normal, divisor, 1.0), np.nan)
        known = value.nonnegative and is_known(divisor) and bool(np.all(np.asarray(divisor) > 0))

        def apply(unit: AtUnit, y: Any) -> Any:
            return y.over(divisor) if isinstance(y, Rationals) else inverse * y

        step, terms = Step(apply, (value.place,)), (Term(value, 1.0, divisor),)
        return self.layer(value.shape, step, terms=terms, nonnegative=known)

    def nearly_scaled(self, value: Value, factor: Any) -> Value:
        """Each entry times a number that this factor is off by a few roundings, three at most.

        As in `divided`; factors 1 and -1, which products take to be exact, are moved by one more.
        """
        factor = _flat(factor, value)
        factor = namespace(factor).where(abs(factor) == 1, factor * (1 - UNIT), factor)

        def apply(unit: AtUnit, y: Any) -> Any:
            return y.times_unknown() if isinstance(y, Rationals) else factor * y

        return self.layer(value.shape, Step(apply, (value.place,)))

    def shifted(self, value: Value, by: Any) -> Value:
        """Each entry plus a plain number."""
        by = _flat(by, value)
        known = value.nonnegative and is_known(by) and bool(np.all(np.asarray(by) >= 0))
        step = Step(lambda unit, y: y + by, (value.place,))
        return self.layer(value.shape, step, terms=(Term(value),), offset=by, nonnegative=known)

    def added(self, one: Operand, other: Operand, sign: int = 1) -> Any:
        """`one + sign other`, both of one shape."""
        if not isinstance(other, Value):
            return self.shifted(one, sign * other) if isinstance(one, Value) else one + sign * other
        if not isinstance(one, Value):
            return self.shifted(other if sign > 0 else self.scaled(other, np.array(-1.0)), one)
        known = sign > 0 and one.nonnegative and other.nonnegative
        step = Step(
            (lambda unit, y, z: y + z) if sign > 0 else (lambda unit, y, z: y - z),
            (one.place, other.place),
        )
        terms = Term(one), Term(other, float(sign))
        return self.layer(one.shape, step, terms=terms, nonnegative=known)

    def mapped(self, value: Value, matrix: Any, shape: Shape) -> Value:
        """A plain matrix times a value."""
        known = value.nonnegative and is_known(matrix) and bool(np.all(np.asarray(matrix) >= 0))
        step = Step(lambda unit, y: matrix @ y, (value.place,), entrywise=False)
        return self.layer(shape, step, nonnegative=known)

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
        line = self.line

        def applied(at: AtUnit, y: Any) -> Any:
            try:
                return at(unit, y)
            except UnboundedError as error:
                raise UnboundedError(*error.given, line=line) from None

        known = isinstance(unit, SmoothUnit) and unit.image[0] >= 0
        step = Step(applied, (value.place,), unit=unit)
        return self.layer(value.shape, step, nonnegative=known)

    def rectified(self, value: Value) -> Value:
        """`max(value, 0)`."""
        if value.nonnegative:
            return value
        found = self.unit(ReLU(), value)
        found.nonnegative = True
        return found

    def loosened(self, value: Value, by: np.ndarray) -> Value:
        """The same, up to an error of so much.

        `0 y + c - c` is zero, which no kind of number knows: it takes the first sum to be off by
        `gamma(1) c`, of which nothing is rounding. That is above `by` for `c = 2^51 by`.
        """
        large = by.reshape(-1) * 2.0**51

        def apply(unit: AtUnit, y: Any) -> Any:
            return y.unknown() if isinstance(y, Rationals) else y + ((0.0 * y + large) - large)

        return self.layer(value.shape, Step(apply, (value.place,)))

    def absolute(self, value: Value) -> Value:
        """`|value| = 2 max(value, 0) - value`."""
        if value.nonnegative:
            return value
        found = self.added(self.scaled(self.rectified(value), np.array(2.0)), value, -1)
        step = Step(_sized, (found.place, value.place))
        return self.layer(value.shape, step, terms=(Term(found),), nonnegative=True)

    def product(self, one: Value, other: Value) -> Value:
        """`one * other = ((one + other)^2 - (one - other)^2) / 4`, entry by entry."""
        if one.place == other.place:
            return self.unit(Square(), one)
        parts = self.added(one, other), self.added(one, other, -1)
        more, less = (self.unit(Square(), part) for part in parts)
        places = more.place, less.place, one.place, other.place
        known = one.nonnegative and other.nonnegative
        return self.layer(one.shape, Step(_multiplied, places), nonnegative=known)

    def replaced(self, wanted: Value, old: Value, new: Value, passing: dict[int, bool]) -> Value:
        """A value as it is where another one, of which alone it is made, is changed.

        Args:
            wanted: which one.
            old: the value that it is of, entry by entry.
            new: what takes its place.
            passing: rectifiers, by their places, that are now known to be their inputs, or zero.
        """
        found = {old.place: new}
        for place in self.between(wanted, old):
            step = self.steps[place]
            if place == old.place or step is None:
                continue
            parents = [found[parent] for parent in step.parents]
            if place in passing:
                found[place] = parents[0] if passing[place] else self.scaled(new, np.array(0.0))
                continue
            changed = step._replace(parents=tuple(parent.place for parent in parents))
            found[place] = self.layer(wanted.shape, changed)
        return found[wanted.place]


def _multiplied(unit: AtUnit, more: Any, less: Any, one: Any, other: Any) -> Any:
    """Products, from the squares of sums and of differences, and from the factors.

    Where factors are numbers, their product is: squares lose what is small beside them. Where they
    are intervals, theirs is met with it: a difference of two squares forgets what that knows.
    """
    if isinstance(one, np.ndarray | jax.Array | Rationals) or hasattr(one, "values"):
        return one * other
    squares = 0.25 * (more - less)
    known = type(squares) is Ball and all(type(each) is Ball for each in (one, other))
    return squares.meeting(one.times(other)) if known else squares


def _sized(unit: AtUnit, size: Any, y: Any) -> Any:
    """Sizes `|y|`; of intervals, met with what these know of them."""
    if type(size) is not Ball:
        return size
    least = larger(larger(y.lower, -y.upper), 0.0)
    return size.meeting(Ball.between(least, larger(larger(-y.lower, y.upper), least)))


def _flat(plain: Any, value: Value) -> Any:
    return namespace(plain).broadcast_to(plain, value.shape).reshape(-1)
