"""Jumps: a step, and a number that counts only where a decision holds.

A **step** is `z = 1` where `y > 0` and `z = 0` where `y < 0`. At zero, where a function jumps, both
are possible: what is certified is the closed law, whose graph contains all that rounding may make
of a tie. With `l <= y <= u` its facts are

    z >= 0,    1 - z >= 0,    z (1 - z) = 0,    u z - y >= 0,    y - l (1 - z) >= 0.

Its two phases are `z = 0`, where the third fact is `-y >= 0` and the last one nothing new, and
`z = 1`, where the last one is `y >= 0`. So branches that hold one of the first two facts at zero
know all there is to know.

A **gated** number is `z = s y` with `s` zero or one. With bounds of `y` it is between `l s` and
`u s`, and `y - z` between `l (1 - s)` and `u (1 - s)`: equations once it is known what `s` is
(McCormick, Mathematical Programming 1976).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Array, Bool, Float

from reachjax.loops.units.base import AbstractUnit, Block, Facts, Line, Lines, Mark, Product
from reachjax.numerics.rounding import TINY, gamma, larger, namespace, smaller

BINARY = (("on", "off"),)
"""Facts `z >= 0` and `1 - z >= 0` of what is zero or one, whose product is zero."""

PHASES = (
    Product("on", "not below", Mark.SECTOR),
    Product("off", "not above", Mark.SECTOR),
)
"""`z y >= 0` and `-(1 - z) y >= 0`, once the product of the facts of a binary number is zero."""


@dataclasses.dataclass(frozen=True)
class Step(AbstractUnit):
    """`1` above zero, `0` below, and both at zero.

    Args:
        at_zero: which one of them is computed at zero: 0 of `y > 0`, 1 of `y >= 0`. What is known
            of the two is the same, but they are two numbers, which at zero differ.

    Example:
        >>> Step()(np.array([-0.5, 0.0, 2.0])).tolist()
        [0.0, 0.0, 1.0]
        >>> [end.tolist() for end in Step().interval(np.array([0.0, 0.1]), np.array([1.0, 1.0]))]
        [[0.0, 1.0], [1.0, 1.0]]
    """

    at_zero: float = 0.0
    line: str = dataclasses.field(default="", compare=False, repr=False)

    nonexpansive: ClassVar[bool] = False
    jumps: ClassVar[bool] = True
    breaks: ClassVar[bool] = True

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """`1` above zero, `0` below; derivatives are zero."""
        return namespace(y).where(y >= 0 if self.at_zero else y > 0, 1.0, 0.0)

    def implied(self, other: AbstractUnit, above: bool) -> bool:
        """Whether one of the same inputs being above (below) says so: `>` says `>=`."""
        if not isinstance(other, Step):
            return False
        return other.at_zero <= self.at_zero if above else other.at_zero >= self.at_zero

    def distance(self, y: Float[np.ndarray, " k"], /) -> float:
        """How far the closest input is from where the value changes."""
        return float(abs(y).min(initial=np.inf))

    def won(self, z: Float[np.ndarray, " k"], /) -> Float[np.ndarray, "k k"]:
        """The inputs, or those below zero turned."""
        return np.diag(np.where(z > 0.5, 1.0, -1.0))

    def interval(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """`[0, 1]`, or one of the two where the sign is known."""
        xp, (always, never) = namespace(lower, upper), _decided(lower, upper)
        return xp.where(always, 1.0, 0.0), xp.where(never, 0.0, 1.0)

    def lines(self, lower: Array, upper: Array) -> Lines:
        """The constants 0 and 1, or one of them twice."""
        xp, (low, high) = namespace(lower, upper), self.interval(lower, upper)
        return Lines(Line(xp.zeros_like(low), low), Line(xp.zeros_like(high), high))

    def remainder(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
        """`-slope y` on the left of zero, and `1 - slope y` on the right."""
        xp, (always, never) = namespace(slope, lower, upper), _decided(lower, upper)
        left = _hull(-slope * smaller(lower, 0.0), -slope * smaller(upper, 0.0))
        right = _hull(1 - slope * larger(lower, 0.0), 1 - slope * larger(upper, 0.0))
        low, high = _either(xp, always, never, left, right)
        size = xp.where(slope == 0, 0.0, abs(slope) * larger(abs(lower), abs(upper)) + 1.0)
        return low - gamma(4) * size, high + gamma(4) * size

    def facts(self, y: Any, z: Any, lower: Array, upper: Array) -> Facts:
        """`z` is zero or one, and what bounds say of `y` then.

        The last two rest on bounds, but every relaxation needs them: without them a step would be
        any number between zero and one.
        """
        below, above = smaller(lower, 0.0), larger(upper, 0.0)
        blocks = (
            Block(z, "on", Mark.SECTOR),
            Block(1.0 - z, "off", Mark.SECTOR),
            Block(above * z - y, "not above", Mark.SECTOR),
            Block(y - below * (1.0 - z), "not below", Mark.SECTOR),
        )
        return Facts(blocks, BINARY, PHASES)


@dataclasses.dataclass(frozen=True)
class Gated(AbstractUnit):
    """`k` products `s y` of numbers that are zero or one with any numbers, as one layer.

    Inputs are the `s`, then the `y`; outputs are `k` zeros, then the products: a layer has as many
    outputs as inputs.

    Example:
        >>> Gated()(np.array([1.0, 0.0, 5.0, 7.0])).tolist()
        [0.0, 0.0, 5.0, 0.0]
        >>> lower, upper = np.array([0.0, 2.0]), np.array([1.0, 3.0])
        >>> [end.tolist() for end in Gated().interval(lower, upper)]
        [[0.0, 0.0], [0.0, 3.0]]
    """

    separable: ClassVar[bool] = False
    nonexpansive: ClassVar[bool] = False
    breaks: ClassVar[bool] = True

    def __call__(self, y: Float[Array, "*c n"]) -> Float[Array, "*c n"]:
        """The products, of an `s` that is not zero or one with the nearer one of these."""
        xp, k = namespace(y), y.shape[-1] // 2
        s, y = y[..., :k], y[..., k:]
        return xp.concatenate([xp.zeros_like(s), xp.where(s > 0.5, y, 0.0)], axis=-1)

    def interval(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """The range of `y` where `s` is one, zero where it is zero, or the hull of both."""
        xp = namespace(lower, upper)
        (always, never), (low, high) = _gates(lower, upper), _halves(lower, upper)[1]
        zero = xp.zeros_like(low)
        low, high = _either(xp, always, never, (zero, zero), (low, high))
        return xp.concatenate([zero, low], axis=-1), xp.concatenate([zero, high], axis=-1)

    def lines(self, lower: Array, upper: Array) -> Lines:
        """The input itself, or zero; between them two lines of slope one half."""
        xp = namespace(lower, upper)
        (always, never), (low, high) = _gates(lower, upper), _halves(lower, upper)[1]
        slope = xp.where(always, 1.0, xp.where(never, 0.0, 0.5))
        size = larger(abs(low), abs(high))  # half of the least number is zero
        gap = xp.where(always | never | (size == 0), 0.0, size / 2 + TINY)
        zero = xp.zeros_like(low)
        slope, below, above = (xp.concatenate([zero, part], axis=-1) for part in (slope, -gap, gap))
        return Lines(Line(slope, below), Line(slope, above))

    def remainder(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
        """`(1 - slope) y` where `s` is one, and `-slope y` where it is zero."""
        xp = namespace(slope, lower, upper)
        k = lower.shape[-1] // 2
        (always, never), (gates, (low, high)) = _gates(lower, upper), _halves(lower, upper)
        idle = _hull(*(-slope[..., :k] * end for end in gates))
        its = slope[..., k:]
        off, on = (_hull(factor * low, factor * high) for factor in (0.0 - its, 1.0 - its))
        off, on = (
            tuple(xp.where(factor == 0, 0.0, end) for end in ends)
            for factor, ends in ((its, off), (1.0 - its, on))
        )
        both = _either(xp, always, never, off, on)
        low, high = (xp.concatenate(ends, axis=-1) for ends in zip(idle, both, strict=True))
        flushed = xp.where((slope == 0) | (slope == 1), 0.0, TINY)  # else nothing is rounded
        return low - gamma(4) * abs(low) - flushed, high + gamma(4) * abs(high) + flushed

    def facts(self, y: Any, z: Any, lower: Array, upper: Array) -> Facts:
        """The four inequalities of a product whose one factor is zero or one."""
        k = lower.shape[-1] // 2
        low, high = _halves(lower, upper)[1]
        placed = np.eye(2 * k, k, -k)
        s, y, z = y[:k], y[k:], z[k:]
        blocks = (
            Block(placed @ (z - low * s), "least", Mark.SECTOR),
            Block(placed @ (high * s - z), "most", Mark.SECTOR),
            Block(placed @ ((y - z) - low * (1.0 - s)), "least left out", Mark.SECTOR),
            Block(placed @ (high * (1.0 - s) - (y - z)), "most left out", Mark.SECTOR),
        )
        return Facts(blocks, (), ())


@dataclasses.dataclass(frozen=True)
class Entered(AbstractUnit):
    """Numbers as a branch gets them: themselves, or where it surely is not taken any one of theirs.

    Inputs are `k` times whether the branch is taken, zero or one, then `k` numbers; outputs are `k`
    zeros, then the numbers. Of a branch that is not taken nothing counts. It gets a point, the
    middle of what the numbers may be, over which no unit switches.

    Example:
        >>> lower, upper = np.array([0.0, 2.0]), np.array([0.0, 3.0])
        >>> [end.tolist() for end in Entered().interval(lower, upper)]
        [[0.0, 2.5], [0.0, 2.5]]
    """

    separable: ClassVar[bool] = False
    nonexpansive: ClassVar[bool] = False

    def __call__(self, y: Float[Array, "*c n"]) -> Float[Array, "*c n"]:
        """The numbers, which do not matter where the branch is not taken."""
        xp, k = namespace(y), y.shape[-1] // 2
        return xp.concatenate([xp.zeros_like(y[..., :k]), y[..., k:]], axis=-1)

    def idle(self, values: Callable[[], Float[np.ndarray, "c k"]]) -> Bool[np.ndarray, " c"] | None:
        """Points that take no part of the branch."""
        taken, _ = np.split(values(), 2, axis=1)
        return ~np.any(taken, axis=1)

    def interval(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """The numbers, or their middle."""
        xp, (low, high), (never, middle) = self._parts(lower, upper)
        zero = xp.zeros_like(low)
        ends = (xp.where(never, middle, end) for end in (low, high))
        return tuple(xp.concatenate([zero, end], axis=-1) for end in ends)

    def lines(self, lower: Array, upper: Array) -> Lines:
        """The identity, or a constant."""
        xp, (low, _), (never, middle) = self._parts(lower, upper)
        zero = xp.zeros_like(low)
        slope = xp.concatenate([zero, xp.where(never, 0.0, 1.0)], axis=-1)
        offset = xp.concatenate([zero, xp.where(never, middle, 0.0)], axis=-1)
        return Lines(Line(slope, offset), Line(slope, offset))

    def facts(self, y: Any, z: Any, lower: Array, upper: Array) -> Facts:
        """The line, twice."""
        slope, offset = self.lines(lower, upper).above
        rest = z - slope * y - offset
        blocks = Block(rest, "at least", Mark.SECTOR), Block(-rest, "at most", Mark.SECTOR)
        return Facts(blocks, (), ())

    def _parts(self, lower: Array, upper: Array) -> tuple[Any, Any, Any]:
        """The namespace, the numbers, and where the branch is surely not taken, with middles."""
        (_, never), (low, high) = _gates(lower, upper), _halves(lower, upper)[1]
        middle = low / 2 + high / 2
        known = never & (abs(middle) < np.inf)
        return namespace(lower, upper), (low, high), (known, middle)


@dataclasses.dataclass(frozen=True)
class Floor(AbstractUnit):
    """The largest whole number up to `y + above`, whatever its range is; at an edge both.

    Of few whole numbers a sum of steps knows more: this unit has no phases.

    Args:
        above: 0 for the floor, 1/2 for the nearest whole number.
        even: whether of two that are as near the even one is computed, or that away from zero.

    Example:
        >>> [end.tolist() for end in Floor().interval(np.array([0.2, 1.0]), np.array([0.9, 2.5]))]
        [[0.0, 0.0], [0.0, 2.0]]
        >>> Floor(0.5)(np.array([0.5, 1.5, -0.7])).tolist()
        [0.0, 2.0, -1.0]
    """

    above: float = 0.0
    even: bool = True

    nonexpansive: ClassVar[bool] = False
    breaks: ClassVar[bool] = True

    def __call__(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """The whole number; its derivative is zero."""
        xp = namespace(y)
        if self.above != 0.5:
            return xp.floor(y + self.above)
        if self.even:
            return xp.round(y)
        whole = xp.trunc(y)  # what is left is exact, and half of it or more goes away from zero
        return whole + xp.where(abs(y - whole) >= 0.5, xp.sign(y), 0.0)

    def interval(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """The whole numbers of both ends; at an edge the one on its other side."""
        xp = namespace(lower, upper)
        upper = xp.where((upper < 0) & (upper > -TINY), 0.0, upper)  # which XLA takes for zero
        return xp.ceil(lower + self.above) - 1.0, xp.floor(upper + self.above)

    def lines(self, lower: Array, upper: Array) -> Lines:
        """Two lines of slope one, constants where these are nearer, or one of them twice."""
        xp, (low, high) = namespace(lower, upper), self.interval(lower, upper)
        flat, top = high - low <= 1.0, self.above
        slope = xp.where(flat, 0.0, 1.0)
        return Lines(
            Line(slope, xp.where(flat, low, top - 1.0)), Line(slope, xp.where(flat, high, top))
        )

    def facts(self, y: Any, z: Any, lower: Array, upper: Array) -> Facts:
        """`y + above - 1 <= z <= y + above`."""
        rest = (y - z) + self.above
        blocks = Block(rest, "above", Mark.SECTOR), Block(1.0 - rest, "below", Mark.SECTOR)
        return Facts(blocks, (), ())


def _decided(lower: Array, upper: Array) -> tuple[Bool[Array, " k"], Bool[Array, " k"]]:
    """Where inputs are surely above zero, and where below, also for what takes tiny numbers for 0.

    Half of the smallest float is zero to a computer, and XLA takes all below `TINY` for zero.
    """
    return lower >= TINY, upper <= -TINY


def _gates(lower: Array, upper: Array) -> tuple[Bool[Array, " k"], Bool[Array, " k"]]:
    """Where the first half of inputs, each zero or one, surely is one, and where zero."""
    low, high = _halves(lower, upper)[0]
    always = low > 0
    return always, (high < 1) & ~always


def _halves(lower: Array, upper: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Ends of the two halves of inputs."""
    k = lower.shape[-1] // 2
    return (lower[..., :k], upper[..., :k]), (lower[..., k:], upper[..., k:])


def _hull(one: Array, other: Array) -> tuple[Array, Array]:
    return smaller(one, other), larger(one, other)


def _either(xp: Any, always: Array, never: Array, off: Any, on: Any) -> tuple[Array, Array]:
    """The ends of one of two ranges where it is known which, and of both together elsewhere."""
    low, high = smaller(on[0], off[0]), larger(on[1], off[1])
    return tuple(
        xp.where(always, one, xp.where(never, other, both))
        for one, other, both in zip(on, off, (low, high), strict=True)
    )
