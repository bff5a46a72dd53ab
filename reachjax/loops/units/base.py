"""What a nonlinear unit says of itself, so that nothing else has to know which one it is.

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
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

from jaxtyping import Array, Bool, Float

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
    """Affine functions `slope y + offset` `(k,)`, one for each unit."""

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
        return (slope == above.slope) & (offset == above.offset)


class AbstractActivation(abc.ABC):
    """What a network applies to a layer, entry by entry. Hashable: it is static in a network."""

    @abc.abstractmethod
    def propagate(self, y: Any, unit: AtUnit) -> Any:
        """The value for any kind of number, with `unit` at each unit that it is made of."""

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """The value `f(y)`."""
        return self.propagate(y, evaluate)


class AbstractUnit(AbstractActivation):
    """One relation `z = f(y)`, which adds one column to a basis.

    A layer whose values depend on all of its inputs is no row of such relations: it is not
    `separable`, is given whole, and sees to rounded ends of its inputs by itself.

    Attributes:
        separable: whether each value is of its own input alone.
        nonexpansive: whether `|f(y) - f(y')| <= |y - y'|`. Where inputs are rounded, `loop_bounds`
            adds that to the values of such units, and widens the inputs of others.
        free: whether any value between its two lines, which are parallel, is possible, whatever
            the input is: then all that there is to know of it is that.
        stated: whether its facts are known of its inputs, so that they count where it is affine.
        closed: whether these bound the free units before it by themselves.
    """

    separable: ClassVar[bool] = True
    nonexpansive: ClassVar[bool] = True
    free: ClassVar[bool] = False
    stated: ClassVar[bool] = False
    closed: bool = False

    @property
    def kind(self) -> AbstractUnit:
        """The unit without what it may know of numbers."""
        return self

    @abc.abstractmethod
    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """The value `f(y)`."""

    @abc.abstractmethod
    def interval(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """Bounds of the value for inputs in `[lower, upper]`, rounding included."""

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
            slope: `(k,)`, finite.
            lower: `(k,)`.
            upper: `(k,)`.
        """
        xp, size = namespace(slope, lower, upper), abs(lower) + abs(upper)
        ends = []
        for extreme, (its, offset) in zip(
            (xp.minimum, xp.maximum), self.lines(lower, upper), strict=True
        ):
            end = extreme((its - slope) * lower, (its - slope) * upper) + offset
            rounding = gamma(4) * (abs(its - slope) * size + abs(end))
            ends.append((end, xp.where(its == slope, 0.0, rounding)))
        (low, under), (high, over) = ends
        return low - under, high + over

    def open(self, lower: Array, upper: Array) -> Bool[Array, " k"]:
        """Inputs whose bounds are worth a program each: here those of units that are not affine."""
        return ~self.lines(lower, upper).affine

    @abc.abstractmethod
    def facts(self, y: Any, z: Any, lower: Array, upper: Array) -> Facts:
        """What holds for inputs `y`, values `z` and bounds `lower <= y <= upper`.

        Args:
            y: numbers with affine arithmetic, such as rows over a basis.
            z: of the same kind.
            lower: `(k,)`.
            upper: `(k,)`.
        """

    def propagate(self, y: Any, unit: AtUnit) -> Any:
        """What is done at this unit."""
        return unit(self, y)


AtUnit = Callable[[AbstractUnit, Any], Any]
"""What is done at a layer of units: `(unit, inputs) -> values`."""


def evaluate(unit: AbstractUnit, y: Float[Array, " k"]) -> Float[Array, " k"]:
    """Apply a unit to numbers: what a loop does with its units when it is simulated."""
    return unit(y)
