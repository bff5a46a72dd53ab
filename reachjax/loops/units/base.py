"""What a nonlinear unit says of itself, so that no bound has to know which one it is.

A **unit** is a relation `z = f(y)` between two numbers. It states its value, its interval, an
affine function below and one above it, and its facts: what is never negative, and which products of
that are zero. An **activation** is what a network applies to a layer: a unit, or several of them
one after the other.

Interval, lines and facts are written for a whole layer at once and for any kind of number: arrays,
or rows over a basis.
"""

from __future__ import annotations

import abc
import enum
import math
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

from reachjax.numerics.numbers import summed
from reachjax.numerics.pytrees import Replaceable, pytree, static
from reachjax.numerics.rounding import gamma, namespace


class Mark(enum.Enum):
    """What a fact, or a product of two, rests on. A relaxation chooses by these.

    Attributes:
        SECTOR: on the value of one unit, whatever its input is.
        SLOPE: on two units: of a product `p q` the relaxation takes `p_i q_j + p_j q_i`.
        BOUND: on bounds of one unit's input.
    """

    SECTOR = "sector"
    SLOPE = "slope"
    BOUND = "bound"


@pytree
class Block:
    """Rows that are never negative, one for each unit of a layer.

    Attributes:
        rows: `(k,)` numbers, or rows over a basis.
        name: by which products speak of it.
        mark: what the facts rest on.
    """

    rows: Any
    name: str = static()
    mark: Mark = static()


class Product(NamedTuple):
    """Two blocks, named, whose product is of use, and what that rests on."""

    left: str
    right: str
    mark: Mark


@pytree
class Facts(Replaceable):
    """What holds of the units of a layer.

    Attributes:
        blocks: of facts.
        zero: pairs of blocks, named, whose product is zero unit by unit (complementarities).
        products: of blocks, that relaxations may take besides those of a fact and the constant.
    """

    blocks: tuple[Block, ...]
    zero: tuple[tuple[str, str], ...] = static()
    products: tuple[Product, ...] = static()

    def __getitem__(self, name: str) -> Any:
        """The rows of a block."""
        return next(block.rows for block in self.blocks if block.name == name)

    def map(self, change: Callable[[Block], Any]) -> Facts:
        """The same facts with other rows, those that `change` gives for each block."""
        blocks = (Block(change(block), block.name, block.mark) for block in self.blocks)
        return self.replace(blocks=tuple(blocks))


class Line(NamedTuple):
    """Affine functions `slope y + offset` `(k,)`, one for each unit.

    Of units of several inputs there is a slope for each of these, in the order of the inputs.
    """

    slope: Array
    offset: Array


class Lines(NamedTuple):
    """Affine functions with `below <= z <= above` on an interval; where they coincide, `z` is."""

    below: Line
    above: Line

    @property
    def affine(self) -> Bool[Array, " k"]:
        """Where the unit is affine, so that it need not stay in a basis."""
        (slope, offset), above = self.below, self.above
        same = slope == above.slope
        if same.shape != offset.shape:  # one row for each input of a unit
            same = same.reshape(-1, offset.shape[-1]).all(axis=0)
        return same & (offset == above.offset)


class AbstractActivation(abc.ABC):
    """What a network applies to a layer, entry by entry. Hashable: it is static in a network."""

    @abc.abstractmethod
    def propagate(self, y: Any, unit: AtUnit) -> Any:
        """The value for any kind of number, with `unit` at each unit that it is made of."""

    def __call__(self, y: Float[Array, "*k"], /) -> Float[Array, "*k"]:
        """The value `f(y)`."""
        return self.propagate(y, evaluate)


class AbstractUnit(AbstractActivation):
    """One relation `z = f(y)`, which adds one column to a basis.

    A layer whose values depend on all of its inputs is no row of such relations: it is not
    `separable`, is given whole, and sees to rounded ends of its inputs by itself.

    Units of several inputs are given as many vectors. Where these are one vector, as interval,
    lines and facts have them, they stand one behind the other.

    Attributes:
        separable: whether each value is of its own input alone.
        inputs: how many each unit has.
        curved: whether forms hold it by a model of degree two, and say all there is to know of it.
        nonexpansive: whether `|f(y) - f(y')| <= |y - y'|`. Where inputs are rounded, `loop_bounds`
            adds that to the values of such units, and widens the inputs of others.
        free: whether any value between its two lines, which are parallel, is possible, whatever
            the input is: then all that there is to know of it is that.
        stated: whether its facts are known of its inputs, so that they count where it is affine.
        closed: whether these bound the free units before it by themselves.
        jumps: whether its value changes at once where an input changes its sign, and nowhere else.
        breaks: whether its value is no continuous function of its inputs.
        line: where a user wrote it, of one that jumps.
    """

    separable: ClassVar[bool] = True
    curved: ClassVar[bool] = False
    inputs: ClassVar[int] = 1
    nonexpansive: ClassVar[bool] = True
    free: ClassVar[bool] = False
    stated: ClassVar[bool] = False
    jumps: ClassVar[bool] = False
    breaks: ClassVar[bool] = False
    closed: bool = False
    line: str = ""

    @property
    def limited(self) -> bool:
        """Whether it has a domain, or overflows: of some inputs it says nothing."""
        return False

    @property
    def kind(self) -> AbstractUnit:
        """The unit without what it may know of numbers."""
        return self

    @abc.abstractmethod
    def __call__(self, y: Float[Array, "*k"], /) -> Float[Array, "*k"]:
        """The value `f(y)`; units of several inputs take as many vectors."""

    def combined(self, y: Any) -> Any:
        """What the inputs of each unit add up to, for any kind of number: of one, itself."""
        return summed(y, self.inputs)

    @abc.abstractmethod
    def interval(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """Bounds of the value for inputs in `[lower, upper]`, rounding included."""

    def limits(self, least: Any, most: Any) -> tuple[Array, Array]:
        """Bounds of the value for inputs of which an end, or both, may be infinite."""
        return self.interval(least, most)

    def knowing(self, ends: Callable[[], tuple[float, float]]) -> AbstractUnit:
        """The unit with what it may know of its inputs, `ends` being their least and their most."""
        return self

    @abc.abstractmethod
    def lines(self, lower: Array, upper: Array) -> Lines:
        """Lines for inputs in `[lower, upper]`, rounding included; the same ones if it is affine.

        Whether they are the same is decided by the signs of bounds, and the slopes of such lines
        are at most 1 in size.
        """

    def remainder(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
        """Bounds of `f(y) - slope y` for inputs in `[lower, upper]`, rounding included.

        They hold for any slope, and are one number where the unit is affine and has this one. Here
        they come from the two lines; a unit that knows where it bends can do better.

        Args:
            slope: `(k,)`, finite; of several inputs one for each.
            lower: `(k,)`.
            upper: `(k,)`.
        """
        xp, size = namespace(slope, lower, upper), abs(lower) + abs(upper)
        ends = []
        for extreme, (its, offset) in zip(
            (xp.minimum, xp.maximum), self.lines(lower, upper), strict=True
        ):
            parts = extreme((its - slope) * lower, (its - slope) * upper)
            end = self.combined(parts) + offset
            error = gamma(2 + 2 * self.inputs)
            rounding = error * (self.combined(abs(its - slope) * size) + abs(end))
            other = self.combined(xp.where(its == slope, 0.0, 1.0))
            ends.append((end, xp.where(other == 0, 0.0, rounding)))
        (low, under), (high, over) = ends
        return low - under, high + over

    def open(self, lower: Any, upper: Any) -> Bool[Array, " k"]:
        """Inputs whose bounds are worth a program each: here those of units that are not affine."""
        return ~self.lines(lower, upper).affine

    def idle(self, values: Callable[[], Float[np.ndarray, "c k"]]) -> Bool[np.ndarray, " c"] | None:
        """Points, of which `values` are the inputs, at which nothing depends on the unit, if any.

        One of them may stand for all.
        """
        return None

    def implied(self, other: AbstractUnit, above: bool) -> bool:
        """Whether one that jumps, of the same inputs, being above (below) says that this one is."""
        return False

    def distance(self, y: Any, /) -> float:
        """How far inputs are from where the value jumps."""
        return math.inf

    def won(self, z: Float[np.ndarray, " k"], /) -> Float[np.ndarray, "m inputs"]:
        """Rows over the inputs that are not negative where the value of one that jumps is `z`."""
        return np.zeros((0, len(z)))

    @abc.abstractmethod
    def facts(self, y: Any, z: Any, lower: Array, upper: Array) -> Facts:
        """What holds for inputs `y`, values `z` and bounds `lower <= y <= upper`.

        Args:
            y: numbers with affine arithmetic, such as rows over a basis.
            z: of the same kind.
            lower: `(k,)`.
            upper: `(k,)`.
        """

    def on_tape(self, tape: Any, y: tuple[int, ...], apply: Any = None) -> int:
        """Its value on a tape of Taylor series (`loops.flows.series`): straight but for bends.

        Args:
            tape: the tape.
            y: the places of its inputs there.
            apply: what is done at it, where that was recorded.

        Returns:
            The place of the value.
        """
        return tape.straight(self, *y, apply)

    def propagate(self, y: Any, unit: AtUnit) -> Any:
        """What is done at this unit."""
        return unit(self, y)


AtUnit = Callable[..., Any]
"""What is done at a layer of units: `(unit, *inputs) -> values`."""


def evaluate(unit: AbstractUnit, *y: Float[Array, " k"]) -> Float[Array, " k"]:
    """Apply a unit to numbers: what a loop does with its units when it is simulated."""
    return unit(*y)
