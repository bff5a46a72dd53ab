"""Taylor series of functions, through what was recorded of them, over any kind of number.

With `x(t) = sum_k x_k t^k` and `y = f(x)`, each recorded step has a recurrence for its
coefficients: affine ones act on each of them, those of a product are `sum_j a_j b_{k-j}`, and a
unit `z = f(y)` with `z' = g y'` has, for `k >= 1`,

    k z_k = sum_{j=1}^k j y_j g_{k-j},

`g` being a function of `y` and `z` that is made of products and units again: `z` itself of an
exponential, `1 - z^2` of a hyperbolic tangent (Moore, Interval Analysis, 1966; Griewank, Walther,
Evaluating Derivatives, chapter 13). A differential equation `x' = f(x)` gives its own coefficients,
one after the other: `(k + 1) x_{k+1} = [f]_k`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reachjax.loops.flows.taylor_models import (
    TaylorModels,
    arrays,
    image,
    joined,
    product,
    rebuilt,
    settled_number,
    straight,
    zeros,
)
from reachjax.loops.tracing.recording import Recorder
from reachjax.loops.tracing.values import Step, UnsupportedError, Value
from reachjax.loops.units import AbstractUnit, Sin, SmoothUnit, evaluate
from reachjax.numerics.numbers import AbstractNumber, size, widened
from reachjax.numerics.rounding import UNIT, Ball, is_counted, namespace

Apply = Callable[..., Any] | None
"""What is done at a unit, where that was recorded."""


class Node(NamedTuple):
    """A number of a series.

    Attributes:
        parents: the numbers that it is made of.
        first: its first coefficient, from theirs.
        following: any later one, from the columns of all numbers and its place.
    """

    parents: tuple[int, ...]
    first: Callable[..., Any]
    following: Callable[[list[Any], Any], Any]


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
        self.sizes = [value.size for value in recorder.inputs]
        self.slopes: dict[int, int] = {}
        self._units: dict[tuple[AbstractUnit, int], int] = {}
        self._waves: dict[int, tuple[int, int]] = {}
        found = {value.place: value.place for value in recorder.inputs}
        for place in recorder.needed(wanted):
            step = recorder.steps[place]
            if step is None:
                continue
            parents = tuple(found[parent] for parent in step.parents)
            if step.unit is None:
                size = recorder.values[place].size
                found[place] = self._added(_affine(parents, step.apply), size)
            else:
                _require_no_jump(step)
                found[place] = step.unit.on_tape(self, parents, step.apply)
        required = [found[place] for place in recorder.required]
        self.result = self._where_known(found[wanted.place], required)
        self.needed = self._of_values()

    def _where_known(self, wanted: int, others: Sequence[int]) -> int:
        """A number plus zero times others, which is not known where one of these is not."""
        if not others:
            return wanted
        zeros = [np.zeros((self.sizes[wanted], self.sizes[each])) for each in others]

        def known(number: Any, *given: Any) -> Any:
            for zero, each in zip(zeros, given, strict=True):
                number = number + zero @ each
            return number

        return self.affine(known, wanted, *others)

    def _of_values(self) -> set[int]:
        """The numbers that values of the result rest on, its series left aside."""
        needed, todo = set(), [self.result]
        while todo:
            place = todo.pop()
            node = self.nodes[place]
            if place not in needed:
                needed.add(place)
                todo += () if node is None else node.parents
        return needed

    def _added(self, node: Node, size: int) -> int:
        self.nodes.append(node)
        self.sizes.append(size)
        return len(self.nodes) - 1

    def affine(self, apply: Callable[..., Any], *parents: int, size: int | None = None) -> int:
        """An affine function of numbers, of as many as they are unless a size is given."""
        node = _affine(parents, lambda unit, *given: apply(*given))
        return self._added(node, size or self.sizes[parents[0]])

    def product(self, one: int, other: int, terms: int = 1) -> int:
        """A product, or the sum of so many, which stand one behind the other."""
        node = Node((one, other), product, lambda by, k: _convolved(by[one], by[other], k))
        found = self._added(node, self.sizes[one])
        if terms == 1:
            return found
        size = self.sizes[one] // terms
        matrix = np.kron(np.ones(terms), np.eye(size))
        return self.affine(lambda number: matrix @ number, found, size=size)

    def wave(self, y: int) -> tuple[int, int]:
        """The sine and the cosine, by one layer: the cosine is the sine a quarter turn on."""
        if y not in self._waves:
            self._waves[y] = self._wave(y)
        return self._waves[y]

    def _wave(self, y: int) -> tuple[int, int]:
        n = self.sizes[y]
        eye, none = np.eye(n), np.zeros((n, n))
        twice, turn = np.vstack([eye, eye]), np.repeat([0.0, math.pi / 2], n)
        quarter = np.block([[none, eye], [-eye, none]])
        error = np.repeat([0.0, UNIT], n)

        def turned(number: Any) -> Any:
            return widened(twice @ number + turn, error)

        angles = self.affine(turned, y, size=2 * n)
        both = self._value(Sin(), angles, None, self._by_slope(angles))
        self.slopes[both] = self.affine(lambda number: quarter @ number, both)
        sine = self.affine(lambda number: number[:n], both, size=n)
        return sine, self.affine(lambda number: number[n:], both, size=n)

    def unit(self, unit: AbstractUnit, y: int) -> int:
        """The value of a unit.

        Raises:
            UnsupportedError: it has no derivative that is known.
        """
        return unit.on_tape(self, (y,))

    def smooth(self, unit: SmoothUnit, y: int, apply: Apply = None) -> int:
        """The value of a smooth unit, and its slope as another number, which may be made of it.

        Args:
            unit: which one.
            y: its input.
            apply: what is done at it, where that was recorded.

        Raises:
            UnsupportedError: its derivative is not known.
        """
        z = self._value(unit, y, apply, self._by_slope(y))
        if z not in self.slopes:
            slope = unit.slope_on_tape(self, y, z)
            if slope is None:
                raise UnsupportedError(
                    f"the derivatives of {type(unit).__name__} are not known, of which the flow of "
                    "a differential equation is made"
                )
            self.slopes[z] = slope
        return z

    def squared(self, unit: AbstractUnit, y: int, apply: Apply = None) -> int:
        """The value of a unit that is a number times itself; arguments as of `smooth`."""
        return self._value(unit, y, apply, lambda by, z, k: _convolved(by[y], by[y], k))

    def same(self, unit: AbstractUnit, y: int, apply: Apply = None) -> int:
        """The value of a unit that is its input; arguments as of `smooth`."""
        return self._value(unit, y, apply, lambda by, z, k: _newest(by[y]))

    def straight(self, unit: AbstractUnit, y: int, apply: Apply = None) -> int:
        """The value of a unit that is straight but for bends; arguments as of `smooth`.

        Raises:
            UnsupportedError: it is no function of each input alone.
        """
        if not unit.separable or unit.free:
            raise UnsupportedError(f"{type(unit).__name__} has no derivatives")

        def following(by: list[Any], z: int, k: Any) -> Any:
            first = by[y].first if isinstance(by[y], _Stack) else by[y][0]
            return _slope(unit, first) * _newest(by[y])

        return self._value(unit, y, apply, following)

    def _by_slope(self, y: int) -> Callable[[list[Any], int, Any], Any]:
        """How the coefficients of a smooth unit follow from those of its input and slope."""
        slopes = self.slopes

        def following(by: list[Any], z: int, k: Any) -> Any:
            slope = slopes[z]
            return _convolved(by[y], by[slope], k, True, slope < z)

        return following

    def _value(
        self,
        unit: AbstractUnit,
        y: int,
        apply: Apply,
        following: Callable[[list[Any], int, Any], Any],
    ) -> int:
        """The value of a unit, once for each input."""
        key = unit.kind, y
        if key not in self._units:
            apply, z = apply or (lambda at, y: at(unit, y)), len(self.nodes)
            node = Node((y,), partial(apply, valued), lambda by, k: following(by, z, k))
            self._units[key] = self._added(node, self.sizes[y])
        return self._units[key]


def _affine(parents: tuple[int, ...], apply: Callable[..., Any]) -> Node:
    """An affine step, from what is done at a unit and the numbers of others."""

    def following(by: list[Any], k: Any) -> Any:
        return apply(None, *(Change(_newest(by[parent])) for parent in parents)).number

    return Node(parents, partial(apply, valued), following)


def _require_no_jump(step: Step) -> None:
    """Raise an error at a unit that jumps.

    Raises:
        UnsupportedError: it is one.
    """
    if step.unit is not None and step.unit.breaks:
        raise UnsupportedError(
            f"it jumps{step.line}, and solutions may slide along where it does: let the "
            "controller decide, whose input is held from one sample to the next, or take a "
            "function without jumps, such as jnp.tanh(50 * y) for jnp.sign(y)"
        )


class Change(AbstractNumber):
    """A coefficient after the first: affine functions add nothing constant to it."""

    def __init__(self, number: Any):
        self.number = number

    def __rmatmul__(self, matrix: Any) -> Change:
        return Change(matrix @ self.number)

    def __len__(self) -> int:
        return size(self.number)

    def __rmul__(self, factor: Any) -> Change:
        return Change(factor * self.number)

    def __add__(self, other: Any) -> Change:
        return Change(self.number + other.number) if isinstance(other, Change) else self

    def __neg__(self) -> Change:
        return Change(-1.0 * self.number)

    def widened(self, by: Any) -> Change:
        """The coefficient itself: what constants are off by does not vary."""
        return self

    def __getitem__(self, index: Any) -> Change:
        return Change(self.number[index])


class Series:
    """The coefficients of everything on a tape, one after the other.

    Args:
        tape: of a function.
    """

    def __init__(self, tape: Tape, columns: list[Any] | None = None):
        self._tape = tape
        self.columns: list[Any] = [[] for _ in tape.nodes] if columns is None else columns

    def copy(self) -> Series:
        """The coefficients so far, which may go on in another way."""
        return Series(self._tape, [[*each] for each in self.columns])

    def advance(self, inputs: Sequence[Any]) -> Any:
        """The next coefficient of the result, from those of the inputs.

        Raises:
            UnboundedError: a unit has no bounds, in numpy.
        """
        k = len(self.columns[0])
        for place, node in enumerate(self._tape.nodes):
            if node is None:
                found = inputs[place]
            else:
                found = self._first(node) if k == 0 else self._next(node, k)
            self.columns[place].append(found)
        return self.columns[self._tape.result][k]

    @classmethod
    def value(cls, tape: Tape, inputs: Sequence[Any]) -> Any:
        """The value of a function.

        Raises:
            UnboundedError: a unit has no bounds, in numpy.
        """
        series = cls(tape)
        for place, node in enumerate(tape.nodes[: tape.result + 1]):
            found = inputs[place] if node is None else None
            if node is not None and place in tape.needed:
                found = series._first(node)
            series.columns[place].append(found)
        return series.columns[tape.result][0]

    def coefficient(self, k: Any, inputs: Sequence[Any]) -> None:
        """All coefficients at another place than the first, in compiled code."""
        for place, node in enumerate(self._tape.nodes):
            found = inputs[place] if node is None else self._next(node, k)
            self.columns[place] = self.columns[place].set(k, found)

    def _first(self, node: Node) -> Any:
        return settled_number(node.first(*(self.columns[each][0] for each in node.parents)))

    def _next(self, node: Node, k: Any) -> Any:
        return settled_number(node.following(self.columns, k))


def _newest(column: Any) -> Any:
    """The last coefficient that is known."""
    return column.newest if isinstance(column, _Stack) else column[-1]


def _convolved(ones: Any, others: Any, k: Any, slope: bool = False, known: bool = True) -> Any:
    """The sum of products of coefficients whose places add up to `k`, as `_Stack.convolved`."""
    if isinstance(ones, _Stack):
        return ones.convolved(others, k, slope, known)
    first = 1 if slope else 0
    pairs = [(ones[j], others[k - j]) for j in range(first, k + 1)]
    if len(pairs) == 1:
        return product(*pairs[0])
    matrix = _summing(len(pairs), size(pairs[0][0]), slope)
    return matrix @ product(*(joined([*part]) for part in zip(*pairs, strict=True)))


@lru_cache(maxsize=256)
def _summing(count: int, size: int, slope: bool) -> np.ndarray:
    """The matrix of a sum of so many vectors, those of a slope by their places."""
    weights = np.arange(1, count + 1) / count if slope else np.ones(count)
    return np.kron(weights, np.eye(size))


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
        self._last = _part(self._h, self._k) * rate
        return self._last


def _part(h: Any, k: Any) -> Any:
    """The quotient `h / k`, moved by a rounding where products would take it to be exact."""
    part = h / k
    return namespace(part).where((abs(part) == 1) & (k != 1), part * (1 - UNIT), part)


def solved(tape: Tape, x: Any, others: Sequence[Any], h: Any, order: int) -> list[Any]:
    """Coefficients `h^k x_k` of a solution, `k = 1 .. order`.

    In compiled code all but the first are computed by one `scan`: what is written once is compiled
    once, and what a compiler fuses does not grow with the order. Where rounding is not counted the
    order is low, and what a scan hands on takes longer than what it computes.

    Raises:
        UnboundedError: a unit has no bounds, in numpy.
    """
    if namespace(*arrays(x)) is np or order == 1 or not is_counted():
        solution = Solution(tape, x, others, h)
        return [solution.advance() for _ in range(order)]
    series = Series(tape)
    first = h * series.advance([x, *others])
    stacks = [_Stack.of(column[0], order) for column in series.columns]
    nothing = [zeros(each) for each in others]

    def advance(carry: Any, k: Any) -> tuple[Any, Any]:
        known, parts = carry
        own = Series(tape, [each.holding(*part) for each, part in zip(stacks, known, strict=True)])
        own.coefficient(k, [rebuilt(x, parts), *nothing])
        following = arrays(_part(h, k + 1) * own.columns[tape.result].newest)
        return ([each.parts for each in own.columns], following), following

    begun = [stack.parts for stack in stacks], arrays(first)
    _, rest = jax.lax.scan(advance, begun, jnp.arange(1, order))
    every = [
        [jax.lax.index_in_dim(part, k, keepdims=False) for part in rest] for k in range(order - 1)
    ]
    return [first, *(rebuilt(x, parts) for parts in every)]


class _Stack:
    """Coefficients of a number in compiled code, those that are not known yet being zero.

    They are kept in both orders, so that convolutions look nothing up by a traced place.

    Attributes:
        parts: the arrays of numbers, with a leading axis: of coefficients, and of these backwards
            from the newest one.
    """

    def __init__(self, like: Any, forward: list[Any], backward: list[Any]):
        self._like, self.parts = like, (forward, backward)

    @classmethod
    def of(cls, first: Any, order: int) -> _Stack:
        """The first coefficient, and as many to come as there are before this order."""
        parts = [
            jnp.concatenate([part[None], jnp.zeros((order - 1, *part.shape))])
            for part in map(jnp.asarray, arrays(first))
        ]
        return cls(first, parts, parts)

    def holding(self, forward: list[Any], backward: list[Any]) -> _Stack:
        """Other coefficients of the same number."""
        return _Stack(self._like, forward, backward)

    @property
    def first(self) -> Any:
        """The first coefficient."""
        return self._at_front(self.parts[0])

    @property
    def newest(self) -> Any:
        """The last one that is known."""
        return self._at_front(self.parts[1])

    def _at_front(self, parts: list[Any]) -> Any:
        found = [jax.lax.index_in_dim(part, 0, keepdims=False) for part in parts]
        return rebuilt(self._like, found)

    def set(self, k: Any, number: Any) -> _Stack:
        """The coefficients with the next one, whose place is `k`."""
        forward, backward = [], []
        for new, one, other in zip(arrays(number), *self.parts, strict=True):
            here = jnp.arange(len(one)).reshape(-1, *[1] * new.ndim) == k
            forward.append(jnp.where(here, new[None], one))
            backward.append(jnp.concatenate([new[None], other[:-1]]))
        return _Stack(self._like, forward, backward)

    def convolved(self, other: _Stack, k: Any, slope: bool, known: bool = True) -> Any:
        """The sum of products of coefficients whose places add up to `k`.

        Args:
            other: of the other number.
            k: which one is wanted.
            slope: whether those of this number count by their places over `k`, so that the first
                one does not.
            known: whether that of the other number at this place is known.
        """
        first, count = int(slope), len(self.parts[0][0])
        skipped = 0 if slope and not known else first
        ones = [self._flat(part[first:]) for part in self.parts[0]]
        others = [self._flat(part[skipped : skipped + count - first]) for part in other.parts[1]]
        weights = jnp.arange(first, count) / k if slope else jnp.ones(count)
        matrix = jnp.kron(weights, np.eye(self.parts[0][0].shape[1]))
        return matrix @ product(rebuilt(self._like, ones), rebuilt(other._like, others))

    def _flat(self, part: Any) -> Any:
        return part.reshape(-1, *part.shape[2:])
