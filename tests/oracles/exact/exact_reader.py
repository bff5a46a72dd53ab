"""What a function of JAX is at points, without rounding: a reader that shares no code with others.

What depends on the point is a fraction, arithmetic on it is exact, and functions that have no
rational values are computed to sixty digits. What depends on constants alone is what JAX itself
makes of it, equation by equation, in the precision that the function asks for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend import core

from tests.oracles.exact.exact_rules import RULES
from tests.oracles.exact.varying import (
    DisagreeError,
    UndefinedError,
    UnreadError,
    Varying,
    fractions,
)

BITS = 4000
"""Fractions with more of them in their denominators are cut."""

KEPT = 400
"""To so many, some 120 digits."""

OFF = Fraction(1, 10**40)
"""What sixty digits may be off by after all, as a part of the value and of one."""

TURNS = 1000
"""A loop that takes more turns is not read to its end."""


class Unread(NamedTuple):
    """What a primitive that has no rule makes of numbers that vary.

    Attributes:
        name: of the primitive.
    """

    name: str


class Reader:
    """A jaxpr, read at several points at once.

    Args:
        points: how many.

    Attributes:
        is_cut: whether any number is known to some digits only.
    """

    def __init__(self, points: int):
        self.points = points
        self.is_cut = False

    def walk(self, closed: Any, operands: Sequence[Any]) -> list[Any]:
        """What a jaxpr makes of operands, which are plain arrays or vary."""
        jaxpr = getattr(closed, "jaxpr", closed)
        known = dict(zip(jaxpr.constvars, getattr(closed, "consts", ()), strict=True))
        known.update(zip(jaxpr.invars, operands, strict=True))

        def read(atom: Any) -> Any:
            return atom.val if isinstance(atom, core.Literal) else known[atom]

        for equation in jaxpr.eqns:
            found = self._read(equation, [read(each) for each in equation.invars])
            known.update(zip(equation.outvars, found, strict=True))
        return [read(each) for each in jaxpr.outvars]

    def _read(self, equation: Any, operands: Sequence[Any]) -> list[Any]:
        """What one equation makes of its operands."""
        if not any(isinstance(each, Varying | Unread) for each in operands):
            return _by_jax(equation, operands)
        name = equation.primitive.name
        rule = WAYS.get(name) or RULES.get(name)
        unread = next((each for each in operands if isinstance(each, Unread)), None)
        if rule is None or (unread and name not in IGNORING):
            return [unread or Unread(name)] * len(equation.outvars)
        try:
            found = rule(self, equation, operands)
        except DisagreeError:
            if self.points == 1:
                raise
            found = self._one_by_one(rule, equation, operands)
        except (ZeroDivisionError, OverflowError) as error:
            raise UndefinedError(f"{name}: {error}") from error
        found = found if isinstance(found, list) else [found]
        return [self._cut(each) for each in found]

    def _one_by_one(self, rule: Callable, equation: Any, operands: Sequence[Any]) -> list[Any]:
        columns, alone = [], Reader(1)
        for k in range(self.points):
            given = [
                Varying(each.numbers[:, k : k + 1], each.shape)
                if isinstance(each, Varying)
                else each
                for each in operands
            ]
            found = rule(alone, equation, given)
            columns.append(found if isinstance(found, list) else [found])
        self.is_cut |= alone.is_cut
        shapes = [each.aval.shape for each in equation.outvars]
        return [
            Varying(np.hstack([alone.of(each, shape).numbers for each in column]), shape)
            for column, shape in zip(zip(*columns, strict=True), shapes, strict=True)
        ]

    def of(self, operand: Any, shape: Sequence[int] | None = None) -> Varying:
        """An operand as numbers that vary, brought to a shape."""
        if not isinstance(operand, Varying):
            plain = fractions(operand)[..., None]
            operand = Varying(np.repeat(plain, self.points, axis=-1), plain.shape[:-1])
        if shape is None or tuple(shape) == operand.shape:
            return operand
        return Varying(np.broadcast_to(operand.array, (*shape, self.points)), shape)

    def settled(self, operand: Any) -> Any:
        """What decides where a function goes on: the same at all points, as a plain array."""
        if not isinstance(operand, Varying):
            return np.asarray(operand)
        first = operand.numbers[:, :1]
        if np.any(operand.numbers != first):
            raise DisagreeError
        return np.array([int(each) for each in first[:, 0]]).reshape(operand.shape)

    def _cut(self, operand: Any) -> Any:
        """Fractions of so many digits that they would take all memory, to fewer."""
        if not isinstance(operand, Varying):
            return operand
        for where, value in np.ndenumerate(operand.numbers):
            if isinstance(value, Fraction) and value.denominator.bit_length() > BITS:
                shift = KEPT + value.denominator.bit_length() - value.numerator.bit_length()
                operand.numbers[where] = Fraction(round(value * 2**shift), 2**shift)
                self.is_cut = True
        return operand


def _by_jax(equation: Any, operands: Sequence[Any]) -> list[Any]:
    """What JAX makes of plain arrays."""
    name, params = equation.primitive.name, equation.params
    if name.startswith("custom_") and "call_jaxpr" in params:
        return core.jaxpr_as_fun(params["call_jaxpr"])(*operands)
    with equation.ctx.manager:
        found = equation.primitive.bind(*operands, **params)
    return list(found) if equation.primitive.multiple_results else [found]


def _called(reader: Reader, equation: Any, operands: Sequence[Any]) -> list[Any]:
    params = equation.params
    (name,) = {"jaxpr", "call_jaxpr", "fun_jaxpr"} & params.keys()
    return reader.walk(params[name], operands)


def _scanned(reader: Reader, equation: Any, operands: Sequence[Any]) -> list[Any]:
    params = equation.params
    first, last = params["num_consts"], params["num_consts"] + params["num_carry"]
    constants, carry, streams = operands[:first], operands[first:last], operands[last:]
    rows: list[Any] = [None] * params["length"]
    for k in range(params["length"])[:: -1 if params["reverse"] else 1]:
        given = [
            Varying(each.array[k], each.shape[1:]) if isinstance(each, Varying) else each[k]
            for each in streams
        ]
        found = reader.walk(params["jaxpr"], [*constants, *carry, *given])
        carry, rows[k] = found[: last - first], found[last - first :]
    shapes = [each.aval.shape for each in equation.outvars[last - first :]]
    columns = zip(*rows, strict=True) if rows else [()] * len(shapes)
    return [*carry, *(_stacked(reader, *each) for each in zip(columns, shapes, strict=True))]


def _stacked(reader: Reader, column: Sequence[Any], shape: Sequence[int]) -> Any:
    if not any(isinstance(each, Varying) for each in column):
        return np.stack(column) if column else np.zeros(shape)
    return Varying(np.stack([reader.of(each).array for each in column]), shape)


def _repeated(reader: Reader, equation: Any, operands: Sequence[Any]) -> list[Any]:
    params = equation.params
    first, last = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
    asked, done, carry = operands[:first], operands[first:last], list(operands[last:])
    for _ in range(TURNS):
        (goes_on,) = reader.walk(params["cond_jaxpr"], [*asked, *carry])
        if not reader.settled(goes_on):
            return carry
        carry = reader.walk(params["body_jaxpr"], [*done, *carry])
    raise UndefinedError("a loop does not end")


def _branched(reader: Reader, equation: Any, operands: Sequence[Any]) -> list[Any]:
    branches = equation.params["branches"]
    which = np.clip(int(reader.settled(operands[0])), 0, len(branches) - 1)
    return reader.walk(branches[which], operands[1:])


# fmt: off
WAYS: dict[str, Callable[..., Any]] = {
    **dict.fromkeys(
        ["jit", "pjit", "closed_call", "core_call", "checkpoint", "remat", "remat2",
         "custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr"], _called
    ),
    "scan": _scanned,
    "while": _repeated,
    "cond": _branched,
    "debug_callback": lambda reader, equation, operands: [],
    "debug_print": lambda reader, equation, operands: [],
}
"""How jaxprs within equations are read."""
# fmt: on


IGNORING = (*WAYS, "custom_linear_solve")
"""What may take no notice of operands that could not be read, such as factors of a matrix."""


def images(function: Callable, points: np.ndarray) -> tuple[np.ndarray, Fraction]:
    """The values of a function at points, flattened, and what they may be off by.

    Args:
        function: of one vector.
        points: `(k, n)` floats.

    Returns:
        `(k, m)` fractions, and a part of these and of one: 0 if all of them are exact.

    Raises:
        UndefinedError: it has no finite value at one of the points.
        UnreadError: there is a primitive in it that has no rule here.

    Example:
        >>> found, off = images(lambda x: x * x, np.array([[0.1], [0.5]]))
        >>> found[1, 0], found[0, 0] == Fraction(0.1) ** 2, off
        (Fraction(1, 4), True, Fraction(0, 1))
    """
    closed = jax.make_jaxpr(function)(jax.ShapeDtypeStruct(points.shape[1:], float))
    reader = Reader(len(points))
    (found,) = reader.walk(closed, [Varying(fractions(points).T, points.shape[1:])])
    if isinstance(found, Unread):
        raise UnreadError(found.name)
    numbers = reader.of(found).numbers.T
    if not all(isinstance(each, Fraction | int) for each in numbers.flat):
        raise UndefinedError("a value is not finite")
    return numbers, OFF if reader.is_cut else Fraction(0)
