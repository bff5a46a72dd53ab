"""A traced function as a list of steps over any kind of number.

Values that depend on the inputs are vectors of numbers of one kind, flattened, whose shapes the
trace knows. What depends on nothing but parameters is computed as the function says, once. Every
step is affine (a choice of entries, a matrix, a factor, a sum) or a layer of units.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Container, Sequence
from typing import Any, cast

import numpy as np
from jaxtyping import Int

from reachjax.loops.tracing.limits import ConstantLimits, Limits
from reachjax.loops.tracing.values import (
    Fact,
    Operand,
    Parameter,
    Shape,
    Step,
    Term,
    UnsupportedError,
    Value,
    is_constant,
    is_known,
)
from reachjax.loops.units import (
    AbstractUnit,
    AtUnit,
    Bilinear,
    ReLU,
    Square,
    UnboundedError,
)
from reachjax.numerics import numbers
from reachjax.numerics.rounding import TINY, UNIT, Ball, larger, namespace

NONE = Limits.of(0.0)
"""Limits of the number zero."""


Entry = tuple[int, int]
"""A number: the place of the value that it is an entry of, and which one."""


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
        required: values, by their places, that must be real numbers, as what is read rests on
            that, whether or not the result depends on them.
        factored: the matrices of which triangular ones are the factors, by the places of these.
        maxima: of which numbers each entry of a value is the largest, by the place of the value.
    """

    def __init__(self, shapes: Sequence[Shape]):
        self.steps: list[Step | None] = [None] * len(shapes)
        self.line = ""
        self.known: dict[Any, tuple[list[Operand], Sequence[Operand]]] = {}
        self.required: dict[int, Value] = {}
        self.factored: dict[int, Operand] = {}
        self.maxima: dict[int, list[frozenset[Entry]]] = {}
        self.inputs = [Value(place, shape) for place, shape in enumerate(shapes)]
        self.values = [*self.inputs]
        self._made: dict[Any, Value] = {}
        self._limits: dict[type[Limits], dict[int, Limits]] = {}

    def run(self, given: Sequence[Any], unit: AtUnit, wanted: Value) -> Any:
        """The numbers of a value, from those of the inputs, of any one kind.

        What it does not depend on is left out, but for what is required: units there add no columns
        and need no bounds. Where what is required has none, as sums overflow, nor has the value.
        """
        found = dict(enumerate(given))
        for place in self.needed(wanted):
            step = self.steps[place]
            if step is not None:
                found[place] = step.apply(unit, *(found[parent] for parent in step.parents))
        return numbers.where_known(found[wanted.place], [found[place] for place in self.required])

    def needed(self, wanted: Value) -> list[int]:
        """Places of all that a value, and what is required, depends on, in their order."""
        places = {*self.between(wanted)}
        for each in self.required.values():
            places.update(self.between(each, done=places))
        return sorted(places)

    def require(self, operand: Operand, sums: bool = False) -> None:
        """Let numbers be real ones: units that they depend on must have bounds.

        Args:
            operand: the numbers.
            sums: whether they must have bounds too where all these units have some everywhere, as
                sums, multiples and squares overflow.
        """
        if isinstance(operand, Value) and (sums or self._is_limited(operand)):
            self.required[operand.place] = operand

    def _is_limited(self, value: Value) -> bool:
        """Whether a value depends on a unit that says nothing of some inputs."""
        steps = (self.steps[place] for place in self.between(value))
        units = (step.unit for step in steps if step is not None)
        return any(unit is not None and unit.limited for unit in units)

    def between(
        self, wanted: Value, first: Value | None = None, done: Container[int] = ()
    ) -> list[int]:
        """Places of all that a value depends on, itself the last.

        Args:
            wanted: the value.
            first: where to stop, if anywhere: what this one depends on is left out.
            done: places that are left out, with what these depend on.
        """
        needed, todo = set(), [wanted.place]
        while todo:
            place = todo.pop()
            if place not in needed and place not in done:
                needed.add(place)
                step = None if first is not None and place == first.place else self.steps[place]
                todo += step.parents if step is not None else ()
        return sorted(needed)

    def layer(self, shape: Shape, step: Step, key: Any = None, **facts: Any) -> Value:
        """What a step makes of the values before; the rest is what is known of it.

        Args:
            shape: of the array.
            step: which one.
            key: what makes it the step that it is; what is there already is not made again.
            **facts: of the value.
        """
        if key is not None and key in self._made:
            return self.reshaped(self._made[key], shape)
        made = Value(len(self.steps), shape, **facts)
        self.steps.append(step)
        self.values.append(made)
        if key is not None:
            self._made[key] = made
        return made

    def reshaped(self, value: Value, shape: Shape) -> Value:
        """The same entries as another array."""
        if value.shape == shape:
            return value
        return Value(value.place, shape, value.terms, value.offset, value.source)

    def limits(self, operand: Operand, kind: type[Limits] = Limits) -> Limits:
        """Between what numbers operands are, whatever the inputs are.

        Args:
            operand: a value, or plain numbers.
            kind: what is taken to be known.
        """
        if not isinstance(operand, Value):
            return kind.of(operand)
        known = self._limits.setdefault(kind, {})
        for place in self.between(operand, done=known):
            step, value = self.steps[place], self.values[place]
            if step is None:
                known[place] = kind.unknown(value.size)
                continue
            given = (known[parent] for parent in step.parents)
            known[place] = step.apply(lambda unit, y, *others: y.at(unit, *others), *given)
            if value.fact is not None:
                also = value.fact(lambda operand: self.limits(operand, kind))
                known[place] = known[place].meeting(also)
        return known[operand.place]

    def limited(self, value: Value, fact: Fact) -> Value:
        """A value of which more is known than how it came about says: limits, from others."""
        self.values[value.place].fact = fact
        for known in self._limits.values():
            known.pop(value.place, None)
        return value

    def largest_of(self, value: Value) -> list[frozenset[Entry]]:
        """The numbers that each entry is the largest of, itself if it is no maximum."""
        base, index = value.source or (value, np.arange(value.size))
        known = self.maxima.get(base.place)
        return [frozenset({(base.place, k)}) if known is None else known[k] for k in index.tolist()]

    def is_nonnegative(self, value: Value) -> bool:
        """Whether numbers are squares, say, or sums of them: never below zero."""
        return self.limits(value, ConstantLimits).nonnegative

    def picked(self, value: Value, index: Int[np.ndarray, ...]) -> Value:
        """Entries of a value, by their numbers in the flat vector, as an array of that shape."""
        flat, shape = np.asarray(index).ravel(), np.shape(index)
        if np.array_equal(flat, np.arange(value.size)):
            return self.reshaped(value, shape)
        if value.source is not None:
            value, before = value.source
            return self.picked(value, before[flat].reshape(shape))
        step = Step(
            lambda unit, y: y[flat],
            (value.place,),
            entrywise=False,
            again=lambda y: self.picked(y, flat),
            linear=True,
        )
        key = "picked", value.place, flat.tobytes()
        return self.layer(shape, step, key, source=(self.values[value.place], flat))

    def taken(self, value: Value, index: Int[np.ndarray, ...]) -> Value:
        """Entries as `picked`, but of sums as sums of entries, which comparisons look into."""
        if value.terms is None:
            return self.picked(value, index)
        key = "taken", value.place, np.ravel(index).astype(np.int64).tobytes()
        if key in self._made:
            return self.reshaped(self._made[key], np.shape(index))
        found: Any = None
        for term in value.terms:
            part = self.taken(term.value, index)
            factor, divisor = (_entries_of(plain, index) for plain in term[1:])
            part = (
                part if is_constant(factor) and np.all(factor == 1) else self.scaled(part, factor)
            )
            one = is_constant(divisor) and np.all(divisor == 1)
            part = part if one else self.divided(part, divisor)
            found = part if found is None else self.added(found, part)
        self._made[key] = self.shifted(found, _entries_of(value.offset, index))
        return self._made[key]

    def broadcast(self, value: Value, shape: Shape) -> Value:
        """The same entries in a larger array."""
        index = np.arange(value.size).reshape(value.shape)
        return self.picked(value, np.broadcast_to(index, shape))

    def scaled(self, value: Value, factor: Any) -> Value:
        """Each entry times a plain number."""
        factor = _flat(factor, value)
        step = Step(
            lambda unit, y: factor * y,
            (value.place,),
            again=lambda y: self.scaled(y, factor),
            linear=is_constant(factor),
        )
        key = _key("scaled", value.place, factor)
        return self.layer(value.shape, step, key, terms=(Term(value, factor),))

    def divided(self, value: Value, divisor: Any) -> Value:
        """Each entry over a plain number: times its inverse, which is rounded.

        That is one rounding of the eight that `gamma` has to spare in a product with a number. Of
        traced divisors whose inverses are not normal numbers, nothing is known.

        Raises:
            UnsupportedError: a divisor is zero, or has no inverse.
        """
        divisor = _flat(divisor, value)
        kind = np.finfo(divisor.dtype)  # of 32 bits where 64 are off
        least, most = max(TINY, float(kind.tiny)), min(1 / TINY, float(kind.max))
        normal = (abs(divisor) >= least) & (abs(divisor) <= most)
        if is_known(divisor) and not np.all(np.asarray(normal)):
            raise UnsupportedError(
                "it divides by zero, or by what has no inverse in 64 bits: keep divisors away from "
                "zero"
            )
        xp = namespace(divisor)
        inverse = xp.where(normal, 1.0 / xp.where(normal, divisor, 1.0), np.nan)

        step = Step(
            lambda unit, y: numbers.over(y, divisor, inverse),
            (value.place,),
            again=lambda y: self.divided(y, divisor),
            linear=is_constant(divisor),
        )
        key = _key("divided", value.place, divisor)
        return self.layer(value.shape, step, key, terms=(Term(value, 1.0, divisor),))

    def nearly_scaled(self, value: Value, factor: Any) -> Value:
        """Each entry times a number that this factor is off by a few roundings, three at most.

        As in `divided`; factors 1 and -1, which products take to be exact, are moved by one more.
        """
        factor = _flat(factor, value)
        factor = namespace(factor).where(abs(factor) == 1, factor * (1 - UNIT), factor)

        step = Step(
            lambda unit, y: numbers.nearly_times(y, factor),
            (value.place,),
            again=lambda y: self.nearly_scaled(y, factor),
        )
        return self.layer(value.shape, step, _key("nearly", value.place, factor))

    def rescaled(self, value: Value, terms: Sequence[Term]) -> Value:
        """A value with factors and divisors of terms, the last ones first."""
        for _, factor, divisor in reversed(terms):
            plain = np.ndim(divisor) == 0
            value = (
                self.scaled(value, np.reshape(factor, value.shape) if np.ndim(factor) else factor)
                if plain
                else self.divided(value, divisor.reshape(value.shape))
            )
        return value

    def shifted(self, value: Value, by: Any) -> Value:
        """Each entry plus a plain number."""
        by = _flat(by, value)
        step = Step(
            lambda unit, y: y + by,
            (value.place,),
            again=lambda y: self.shifted(y, by),
            linear=is_constant(by),
        )
        key = _key("shifted", value.place, by)
        return self.layer(value.shape, step, key, terms=(Term(value),), offset=by)

    def added(self, one: Operand, other: Operand, sign: int = 1) -> Any:
        """`one + sign other`, both of one shape."""
        if not isinstance(other, Value):
            return self.shifted(one, sign * other) if isinstance(one, Value) else one + sign * other
        if not isinstance(one, Value):
            return self.shifted(other if sign > 0 else self.scaled(other, np.array(-1.0)), one)
        step = Step(
            (lambda unit, y, z: y + z) if sign > 0 else (lambda unit, y, z: y - z),
            (one.place, other.place),
            again=lambda y, z: self.added(y, z, sign),
            linear=True,
        )
        terms = Term(one), Term(other, float(sign))
        return self.layer(one.shape, step, ("added", *step.parents, sign), terms=terms)

    def mapped(self, value: Value, matrix: Any, shape: Shape) -> Value:
        """A plain matrix times a value."""
        step = Step(
            lambda unit, y: matrix @ y,
            (value.place,),
            entrywise=False,
            again=lambda y: self.mapped(y, matrix, shape),
            linear=is_constant(matrix),
        )
        return self.layer(shape, step, _key("mapped", value.place, matrix))

    def joined(self, operands: Sequence[Operand]) -> Value:
        """Operands one behind the other, as one vector; one of them at least is a value."""
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
        """A layer of units, of which smooth ones are told between what numbers their inputs are."""

        def ends() -> tuple[float, float]:
            limits = self.limits(value)
            return float(limits.least.min()), float(limits.most.max())

        unit = unit.knowing(ends) if value.size else unit
        if unit.jumps and not unit.line:
            unit = dataclasses.replace(cast(Any, unit), line=self.line)
        again = lambda y: self.unit(unit, y)  # noqa: E731
        step = Step(self._applied(unit), (value.place,), unit=unit, again=again, line=self.line)
        return self.layer(value.shape, step, ("unit", unit, value.place))

    def _applied(self, unit: AbstractUnit) -> Any:
        """What is done at a unit of this line; its errors name it."""
        line = self.line

        def applied(at: AtUnit, *y: Any) -> Any:
            try:
                return at(unit, *y)
            except UnboundedError as error:
                raise UnboundedError(*error.given, line=line) from None

        return applied

    def rectified(self, value: Value) -> Value:
        """The rectifier `max(value, 0)`."""
        return value if self.is_nonnegative(value) else self.unit(ReLU(), value)

    def loosened(self, value: Value, by: np.ndarray) -> Value:
        """A value up to an error of so much."""
        flat = by.reshape(-1)
        step = Step(
            lambda unit, y: numbers.widened(y, flat),
            (value.place,),
            again=lambda y: self.loosened(y, by),
        )
        return self.layer(value.shape, step)

    def absolute(self, value: Value) -> Value:
        """`|value| = 2 max(value, 0) - value`."""
        if self.is_nonnegative(value):
            return value
        found = self.added(self.scaled(self.rectified(value), np.array(2.0)), value, -1)
        again = lambda _, y: self.absolute(y)  # noqa: E731
        sized = self.met(found, [value], _size, again, terms=(Term(found),))
        return self.limited(sized, lambda limits: limits(value).larger(-limits(value)).larger(NONE))

    def met(
        self, value: Value, others: Sequence[Value], held: Any, again: Any, **facts: Any
    ) -> Value:
        """A value whose intervals are met with what those of others say of it.

        Args:
            value: which one.
            others: the values that more is known from.
            held: from intervals of these to one that holds the value.
            again: how the step is recorded of other values.
            **facts: of the result.
        """
        step = Step(
            lambda unit, y, *given: numbers.met(y, held, *given),
            (value.place, *(each.place for each in others)),
            again=again,
        )
        return self.layer(value.shape, step, ("met", held, *step.parents), **facts)

    def product(self, one: Value, other: Value) -> Value:
        """`one * other`, entry by entry: squares where both are multiples of one number."""
        below = {value.place: terms for value, terms in other.levels()}
        for value, terms in one.levels():
            if value.place in below:
                square = self.reshaped(self.unit(Square(), value), one.shape)
                return self.rescaled(square, (*terms, *below[value.place]))
        return self._bilinear(Bilinear(), one, other, one.shape)

    def inner_products(
        self, one: Value, other: Value, shape: Shape, pairs: tuple[np.ndarray, np.ndarray]
    ) -> Value:
        """Sums of products of entries of two values.

        Args:
            one: the first factors are its entries.
            other: the second ones.
            shape: of the result.
            pairs: `(terms, k)`, the numbers of the entries, of each of its `k` entries.
        """
        factors = [
            self.picked(each, index) for each, index in zip((one, other), pairs, strict=True)
        ]
        (first, numbers), (second, others) = (
            each.source or (each, np.arange(each.size)) for each in factors
        )
        alike = np.reshape(numbers == others, pairs[0].shape) & (first.place == second.place)
        squares = np.asarray(alike.all(axis=0))
        if len(alike) == 1:
            return self.reshaped(self.product(*factors), shape)
        if squares.all():
            sums = np.tile(np.eye(len(squares)), len(alike))
            return self.mapped(self.product(*factors), sums, shape)
        if not squares.any():
            return self._bilinear(Bilinear(len(alike)), factors[0], factors[1], shape)
        parts, places = [], []
        for here in map(np.flatnonzero, (squares, ~squares)):
            own = pairs[0][:, here], pairs[1][:, here]
            parts.append(self.inner_products(one, other, (len(here),), own))
            places.append(here)
        order = np.argsort(np.concatenate(places))
        return self.reshaped(self.picked(self.joined(parts), order), shape)

    def _bilinear(self, unit: Bilinear, one: Value, other: Value, shape: Shape) -> Value:
        """A layer of sums of products."""
        one, other = sorted((one, other), key=lambda value: value.place)
        step = Step(
            self._applied(unit),
            (one.place, other.place),
            entrywise=unit.terms == 1,
            unit=unit,
            again=lambda y, z: self._bilinear(unit, y, z, shape),
        )
        return self.layer(shape, step, (unit, one.place, other.place))

    def replaced(self, wanted: Value, old: Value, new: Value, passing: dict[int, bool]) -> Value:
        """A value as it is where another one, of which alone it is made, is changed.

        Args:
            wanted: which one.
            old: the value that it is of, entry by entry.
            new: what takes its place.
            passing: rectifiers, by their places, that are now known to be their inputs, or zero.
        """
        new = self.reshaped(new, (new.size,))
        found = {old.place: new}
        for place in self.between(wanted, old):
            step = self.steps[place]
            if place == old.place or step is None:
                continue
            parents = [found[parent] for parent in step.parents]
            if place in passing:
                found[place] = parents[0] if passing[place] else self.scaled(new, np.array(0.0))
                continue
            assert step.again is not None  # every step that is made of others can be made again
            found[place] = step.again(*parents)
        return self.reshaped(found[wanted.place], wanted.shape)


def _key(kind: str, place: int, plain: Any) -> Any:
    """What makes a step the one that it is, by plain numbers; None if these are traced."""
    if not isinstance(plain, np.ndarray):
        return None
    return kind, place, type(plain), plain.shape, str(plain.dtype), plain.tobytes()


def _size(y: Ball) -> Ball:
    """Sizes `|y|` of intervals."""
    least = larger(larger(y.lower, -y.upper), 0.0)
    return Ball.between(least, larger(larger(-y.lower, y.upper), least))


def _entries_of(flat: Any, index: np.ndarray) -> Any:
    """Entries of a flat array, of its kind; a number stands for all of them."""
    return flat[np.ravel(index)].reshape(np.shape(index)) if np.ndim(flat) else flat


def _flat(plain: Any, value: Value) -> Any:
    if np.ndim(plain) and np.size(plain) == value.size:
        return plain.reshape(-1)
    if isinstance(plain, Parameter):
        return np.broadcast_to(plain, value.shape, subok=True).reshape(-1)
    return namespace(plain).broadcast_to(plain, value.shape).reshape(-1)
