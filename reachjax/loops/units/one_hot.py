"""The largest of several numbers as one layer: `z_i = 1` for the winner, zeros for the others.

At a tie every winner is possible, and one of them it is. With `y_i - y_j >= l_ij`,

    z_i >= 0,    1 - z_i >= 0,    z_i (1 - z_i) = 0,    sum_i z_i = 1,
    y_i - y_j - l_ij (1 - z_i) >= 0    for all j,

of which the last says that `y_i` is the largest where `z_i` is one, and nothing where it is zero.
Phases are the winners: a branch that holds `1 - z_i` at zero knows that `y_i` is the largest.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Array, Bool, Float

from reachjax.loops.units.base import AbstractUnit, Block, Facts, Line, Lines, Mark
from reachjax.loops.units.step import BINARY
from reachjax.numerics.rounding import TINY, gamma, larger, namespace, smaller


@dataclasses.dataclass(frozen=True)
class OneHot(AbstractUnit):
    """Which of `count` numbers is the largest.

    Inputs are these numbers, then their differences `y_i - y_j` for `i < j`, in the order of
    `itertools.combinations`, whose bounds know what the numbers have in common. Outputs are the
    `z`, then as many zeros as there are differences.

    Args:
        count: how many numbers there are.

    Example:
        >>> unit = OneHot(2)
        >>> unit(np.array([1.0, 3.0, -2.0])).tolist()
        [0.0, 1.0, 0.0]
        >>> lower, upper = np.array([0.0, 0.0, -1.0]), np.array([1.0, 1.0, 1.0])
        >>> [end.tolist() for end in unit.interval(lower, upper)]
        [[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]]
    """

    count: int
    line: str = dataclasses.field(default="", compare=False, repr=False)

    separable: ClassVar[bool] = False
    nonexpansive: ClassVar[bool] = False
    jumps: ClassVar[bool] = True
    breaks: ClassVar[bool] = True

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Numbers whose differences are inputs."""
        return [*itertools.combinations(range(self.count), 2)]

    def __call__(self, y: Float[Array, "*c n"]) -> Float[Array, "*c n"]:
        """The first of the largest."""
        xp, scores = namespace(y), y[..., : self.count]
        winner = scores.argmax(axis=-1)[..., None]
        z = xp.where(winner == np.arange(self.count), 1.0, 0.0)
        return xp.concatenate([z, xp.zeros_like(y[..., self.count :])], axis=-1)

    def distance(self, y: Float[np.ndarray, " n"], /) -> float:
        """By how much the largest number exceeds the second."""
        *_, second, first = np.sort(y[: self.count])
        return float(first - second)

    def won(self, z: Float[np.ndarray, " n"], /) -> Float[np.ndarray, "k n"]:
        """The largest number less each of the others."""
        places = np.eye(self.count, len(z))
        first = int(np.argmax(z[: self.count]))
        return places[first] - np.delete(places, first, axis=0)

    def interval(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """Zero of what surely loses, and one of what alone may win."""
        xp, possible = namespace(lower, upper), self._possible(lower, upper)
        alone = possible & (possible.sum(axis=-1, keepdims=True) == 1)
        rest = xp.zeros_like(lower[..., self.count :])
        return tuple(
            xp.concatenate([xp.where(which, 1.0, 0.0), rest], axis=-1)
            for which in (alone, possible)
        )

    def lines(self, lower: Array, upper: Array) -> Lines:
        """The constants 0 and 1, or one of them twice."""
        xp, (low, high) = namespace(lower, upper), self.interval(lower, upper)
        return Lines(Line(xp.zeros_like(low), low), Line(xp.zeros_like(high), high))

    def remainder(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
        """The constants less `slope y`."""
        xp, (low, high) = namespace(lower, upper), self.interval(lower, upper)
        ends = -slope * lower, -slope * upper
        size = xp.where(slope == 0, 0.0, larger(abs(ends[0]), abs(ends[1])) + 1.0)
        low, high = (
            xp.where(slope == 0, end, end + extreme(*ends))
            for end, extreme in ((low, smaller), (high, larger))
        )
        return low - gamma(4) * size, high + gamma(4) * size

    def facts(self, y: Any, z: Any, lower: Array, upper: Array) -> Facts:
        """One of them is one, and then it is the largest."""
        k, (low, high) = self.count, (lower[..., self.count :], upper[..., self.count :])
        placed, total = np.eye(lower.shape[-1], k), np.ones((lower.shape[-1], k))
        z, differences = z[:k], y[k:]
        blocks = [
            Block(placed @ z, "on", Mark.SECTOR),
            Block(placed @ (1.0 - z), "off", Mark.SECTOR),
            Block(total @ z - 1.0, "some", Mark.SECTOR),
            Block(1.0 - total @ z, "no other", Mark.SECTOR),
        ]
        xp = namespace(lower, upper)
        for shift in range(1, k):
            turned, ends = np.zeros((k, len(self.pairs))), []
            for i in range(k):
                j = (i + shift) % k
                pair = self.pairs.index((min(i, j), max(i, j)))
                turned[i, pair] = 1.0 if i < j else -1.0
                ends.append(low[..., pair] if i < j else -high[..., pair])
            least = smaller(xp.stack(ends, axis=-1), 0.0)
            row = turned @ differences - least * (1.0 - z)
            blocks.append(Block(placed @ row, f"above {shift} further", Mark.SECTOR))
        return Facts(tuple(blocks), BINARY, ())

    def open(self, lower: Any, upper: Any) -> Bool[Array, " n"]:
        """Differences of numbers of which each may be the larger, and may be the largest."""
        xp, possible = namespace(lower, upper), self._possible(lower, upper)
        first, second = (np.array(each) for each in zip(*self.pairs, strict=True))
        both = possible[..., first] & possible[..., second]
        return xp.concatenate([xp.zeros_like(possible), both], axis=-1)

    def _possible(self, lower: Array, upper: Array) -> Bool[Array, "*c k"]:
        """Which numbers may be the largest; all where bounds contradict each other."""
        xp, k = namespace(lower, upper), self.count
        low, high = lower[..., k:], upper[..., k:]
        losing = [xp.zeros(lower.shape[:-1], bool)] * k
        for number, (i, j) in enumerate(self.pairs):
            losing[i] = losing[i] | (high[..., number] <= -TINY)
            losing[j] = losing[j] | (low[..., number] >= TINY)
        possible = ~xp.stack(losing, axis=-1)
        return possible | ~possible.any(axis=-1, keepdims=True)
