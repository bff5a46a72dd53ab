"""Taylor series of functions, through what was recorded of them, over any kind of number.

With `x(t) = sum_k x_k t^k` and `y = f(x)`, each recorded step has a recurrence for its coefficients:
affine ones act on each of them, those of a product are `sum_j a_j b_{k-j}`, and a unit `z = f(y)`
with `z' = g y'` has, for `k >= 1`,

    k z_k = sum_{j=1}^k j y_j g_{k-j},

`g` being a function of `y` and `z` that is made of products and units again: `z` itself of an
exponential, `1 - z^2` of a hyperbolic tangent (Moore, Interval Analysis, 1966; Griewank, Walther,
Evaluating Derivatives, chapter 13). A differential equation `x' = f(x)` gives its own coefficients,
one after the other: `(k + 1) x_{k+1} = [f]_k`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from reachjax.loops.flows.taylor_models import TaylorModels, image, joined, product, straight, zeros
from reachjax.loops.recording import Recorder, product_of
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
    Sin,
    SmoothUnit,
    Softplus,
    Sqrt,
    Square,
    Tanh,
    Within,
    XLogX,
    evaluate,
)
from reachjax.loops.values import UnsupportedError, Value
from reachjax.numerics.rounding import UNIT, Ball


class Node(NamedTuple):
    """A number of a series.

    Attributes:
        parents: the numbers that it is made of.
        apply: an affine function of them, or what is done at a unit; None of a product.
        unit: which one it is the value of, if it is of one.
    """

    parents: tuple[int, ...]
    apply: Callable[..., Any] | None = None
    unit: AbstractUnit | None = None


class Tape:
    """What a recording is for series: inputs, affine steps, products and units.

    Args:
        recorder: of the steps.
        wanted: what they end in.

    Attributes:
        nodes: in the order in which they are computed; None for inputs.
        slopes: of units that bend, the number `g`.
        result: which number is wanted.

    Raises:
        UnsupportedError: a unit has no derivative.
    """

    def __init__(self, recorder: Recorder, wanted: Value):
        self.nodes: list[Node | None] = [None] * len(recorder.inputs)
        self.slopes: dict[int, int] = {}
        self._units: dict[tuple[AbstractUnit, int], int] = {}
        found = {value.place: value.place for value in recorder.inputs}
        for place in _needed(recorder, wanted):
            step = recorder.steps[place]
            assert step is not None  # inputs are there
            factors = product_of(step)
            if factors is not None:
                found[place] = self.product(*(found[parent] for parent in factors))
            elif step.unit is not None:
                (parent,) = step.parents
                found[place] = self.unit(step.unit, found[parent], step.apply)
            else:
                parents = tuple(found[parent] for parent in step.parents)
                found[place] = self._added(Node(parents, step.apply))
        self.result = found[wanted.place]

    def _added(self, node: Node) -> int:
        self.nodes.append(node)
        return len(self.nodes) - 1

    def affine(self, apply: Callable[..., Any], *parents: int) -> int:
        """An affine function of numbers."""
        return self._added(Node(parents, lambda unit, *given: apply(*given)))

    def product(self, one: int, other: int) -> int:
        """A product."""
        return self._added(Node((one, other)))

    def unit(self, unit: AbstractUnit, y: int, apply: Callable[..., Any] | None = None) -> int:
        """The value of a unit, and its slope as another number, which may be made of it.

        Args:
            unit: which one.
            y: its input.
            apply: what is done at it, where that was recorded.

        Raises:
            UnsupportedError: it has no derivative that is known.
        """
        key = unit.kind, y
        if key in self._units:
            return self._units[key]
        z = self._added(Node((y,), apply or (lambda at, y: at(unit, y)), unit))
        self._units[key] = z
        if isinstance(unit, SmoothUnit) and type(unit) not in (Square, Within):
            slope = SLOPES.get(type(unit))
            if slope is None:
                raise UnsupportedError(
                    f"the derivatives of {type(unit).__name__} are not known, of which the flow of "
                    "a differential equation is made"
                )
            self.slopes[z] = slope(self, y, z)
        elif not unit.separable or unit.free:
            raise UnsupportedError(f"{type(unit).__name__} has no derivatives")
        return z


def _needed(recorder: Recorder, wanted: Value) -> list[int]:
    """Places of the steps that a value rests on, factors of products in place of their squares."""
    needed, todo = set(), [wanted.place]
    while todo:
        place = todo.pop()
        step = recorder.steps[place]
        if place not in needed and step is not None:
            needed.add(place)
            todo += product_of(step) or step.parents
    return sorted(needed)


def _less_square(tape: Tape, one: float, y: int) -> int:
    """`one - y^2`."""
    return tape.affine(lambda square: one - square, tape.unit(Square(), y))


def _inverse_of_more(tape: Tape, y: int) -> int:
    """`1 / (1 + y^2)`."""
    more = tape.affine(lambda square: square + 1.0, tape.unit(Square(), y))
    return tape.unit(Reciprocal(least=1.0), more)


def _inverse_root(tape: Tape, y: int) -> int:
    return tape.unit(Reciprocal(), tape.unit(Sqrt(), y))


def _inverse_length(tape: Tape, y: int) -> int:
    """`1 / sqrt(1 + y^2)`."""
    more = tape.affine(lambda square: square + 1.0, tape.unit(Square(), y))
    return _inverse_root(tape, more)


def _negative(tape: Tape, y: int) -> int:
    return tape.affine(lambda number: -1.0 * number, y)


def _bell(tape: Tape, y: int) -> int:
    """`2 / sqrt(pi) exp(-y^2)`, whose factor is not exact."""
    bell = tape.unit(Exp(), _negative(tape, tape.unit(Square(), y)))
    return tape.affine(lambda number: 2 / math.sqrt(math.pi) * number, bell)


def _logistic(tape: Tape, y: int) -> int:
    half = tape.unit(Tanh(), tape.affine(lambda number: 0.5 * number, y))
    return tape.affine(lambda number: 0.5 * number + 0.5, half)


def _cube(tape: Tape, y: int) -> int:
    return tape.product(tape.unit(Square(), y), y)


SLOPES: dict[type[AbstractUnit], Callable[[Tape, int, int], int]] = {
    Exp: lambda tape, y, z: z,
    Log: lambda tape, y, z: tape.unit(Reciprocal(), y),
    XLogX: lambda tape, y, z: tape.affine(lambda number: number + 1.0, tape.unit(Log(), y)),
    Tanh: lambda tape, y, z: _less_square(tape, 1.0, z),
    Softplus: lambda tape, y, z: _logistic(tape, y),
    Sqrt: lambda tape, y, z: tape.affine(lambda n: 0.5 * n, tape.unit(Reciprocal(), z)),
    Reciprocal: lambda tape, y, z: _negative(tape, tape.unit(Square(), z)),
    Sin: lambda tape, y, z: tape.unit(Cos(), y),
    Cos: lambda tape, y, z: _negative(tape, tape.unit(Sin(), y)),
    Atan: lambda tape, y, z: _inverse_of_more(tape, y),
    Asin: lambda tape, y, z: _inverse_root(tape, _less_square(tape, 1.0, y)),
    Asinh: lambda tape, y, z: _inverse_length(tape, y),
    Erf: lambda tape, y, z: _bell(tape, y),
    ISRU: lambda tape, y, z: _cube(tape, _inverse_length(tape, y)),
}
"""Derivatives of units, from their inputs and values."""


class Change:
    """A coefficient after the first: affine functions add nothing constant to it."""

    # numpy arrays on the left leave `array @ change` and `array - change` to this class
    __array_ufunc__ = None

    def __init__(self, number: Any):
        self.number = number

    def __rmatmul__(self, matrix: Any) -> Change:
        return Change(matrix @ self.number)

    def __mul__(self, factor: Any) -> Change:
        return Change(factor * self.number)

    __rmul__ = __mul__

    def __add__(self, other: Any) -> Change:
        return Change(self.number + other.number) if isinstance(other, Change) else self

    __radd__ = __add__

    def __neg__(self) -> Change:
        return Change(-1.0 * self.number)

    def __sub__(self, other: Any) -> Change:
        return Change(self.number - other.number) if isinstance(other, Change) else self

    def __rsub__(self, other: Any) -> Change:
        return -self

    def __getitem__(self, index: Any) -> Change:
        return Change(self.number[index])


class Series:
    """The coefficients of everything on a tape, one after the other.

    Args:
        tape: of a function.
    """

    def __init__(self, tape: Tape):
        self._tape = tape
        self._known: list[list[Any]] = [[] for _ in tape.nodes]

    def copy(self) -> Series:
        """The coefficients so far, which may go on in another way."""
        found = Series(self._tape)
        found._known = [[*each] for each in self._known]
        return found

    def advance(self, inputs: Sequence[Any]) -> Any:
        """The next coefficient of the result, from those of the inputs.

        Raises:
            UnboundedError: a unit has no bounds, in numpy.
        """
        tape, known = self._tape, self._known
        k = len(known[0])
        for place, node in enumerate(tape.nodes):
            if node is None:
                known[place].append(inputs[place])
            else:
                known[place].append(self._first(node) if k == 0 else self._next(place, node, k))
        return known[tape.result][k]

    def _first(self, node: Node) -> Any:
        given = [self._known[parent][0] for parent in node.parents]
        return product(*given) if node.apply is None else node.apply(valued, *given)

    def _next(self, place: int, node: Node, k: int) -> Any:
        known = self._known
        one, *others = (known[parent] for parent in node.parents)
        if node.apply is None:
            return _convolved(one, others[0][k::-1], None)
        if node.unit is None:
            return node.apply(None, *(Change(each[k]) for each in (one, *others))).number
        if isinstance(node.unit, Square):
            return _convolved(one, one[k::-1], None)
        if isinstance(node.unit, Within):
            return one[k]
        if not isinstance(node.unit, SmoothUnit):
            return _slope(node.unit, one[0]) * one[k]
        slopes = known[self._tape.slopes[place]]
        return _convolved(one[1:], slopes[k - 1 :: -1], np.arange(1, k + 1) / k)


def _convolved(ones: Sequence[Any], others: Sequence[Any], weights: np.ndarray | None) -> Any:
    """The weighed sum of products of these numbers."""
    pairs = [*zip(ones, others, strict=False)]
    if len(pairs) == 1:
        found = product(*pairs[0])
        return found if weights is None or weights[0] == 1 else float(weights[0]) * found
    size = _size(pairs[0][0])
    matrix = np.kron(np.ones(len(pairs)) if weights is None else weights, np.eye(size))
    return matrix @ product(*(joined([*part]) for part in zip(*pairs, strict=True)))


def _size(number: Any) -> int:
    return len(number.mid) if isinstance(number, Ball) else len(number)


def _slope(unit: AbstractUnit, y: Any) -> Any:
    """The slope of a unit that is not smooth, where no input reaches a bend."""
    if isinstance(y, Ball):
        return straight(unit, y.lower, y.upper)[0]
    if isinstance(y, TaylorModels):
        return straight(unit, *y.ends())[0]
    return unit.lines(y, y).above.slope


def valued(unit: AbstractUnit, y: Any) -> Any:
    """The value of a unit for any kind of number."""
    if isinstance(y, Ball):
        return image(unit, y)
    return y.at(unit) if isinstance(y, TaylorModels) else evaluate(unit, y)


class Solution:
    """The coefficients of a solution, as many as are asked for.

    Args:
        tape: of `f`.
        x: the first one, of any kind of number.
        others: the other arguments, which do not vary.
        h: the unit of time.
    """

    def __init__(self, tape: Tape, x: Any, others: Sequence[Any], h: Any):
        self._series, self._last, self._h, self._k = Series(tape), x, h, 0
        self._others = [*others]

    def advance(self) -> Any:
        """The next coefficient."""
        others = self._others if self._k == 0 else [zeros(each) for each in self._others]
        rate = self._series.advance([self._last, *others])
        self._k += 1
        step = self._h if self._k == 1 else self._h * (1.0 / self._k)
        self._last = _rounded(step, self._k) * rate
        return self._last


def _rounded(step: Any, k: int) -> Any:
    """A factor that is off by roundings, which products then take to be inexact."""
    if k & (k - 1) == 0:
        return step
    one = jax.numpy if isinstance(step, jax.Array) else np
    return one.where(abs(step) == 1, step * (1 - UNIT), step)
