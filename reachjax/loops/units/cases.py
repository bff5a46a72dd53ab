"""Bounds of the multipliers of a projection, active set by active set.

Given a box of excesses `y'`, a set `S` of facets can be active only if its multipliers can be
positive and the slacks of the others too. In each such case the multipliers are linear in `y'`,
and `y'_i = sum_j G_ij m_j - s_i`, with no slack for the members of `S`. What holds in all
cases holds.
Boxes are enlarged by some roundings of their ends: a compiler may round these anew where it uses
them again.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

from reachjax.loops.units.active_sets import ActiveSets
from reachjax.numerics.rounding import gamma, larger, namespace, smaller

SWEEPS = 2
"""How often bounds of multipliers are met with what those of the others leave."""


class Cases(NamedTuple):
    """What is possible on a box of excesses, in each of `N` cases.

    Attributes:
        sets: the active sets.
        faces: `(N,)`, those that can be active at all.
        possible: `(*c, N)`, those that can be active there.
        lower: `(*c, r)`, the box.
        upper: `(*c, r)`.
        least: `(*c, N, r)`, bounds of multipliers.
        most: `(*c, N, r)`.
        others: two of `(*c, N, r)`, bounds of `sum_j G_ij m_j` without `j = i`.
    """

    sets: ActiveSets
    faces: Bool[Array | np.ndarray, " N"]
    possible: Bool[Array, "*c N"]
    lower: Float[Array, "*c r"]
    upper: Float[Array, "*c r"]
    least: Float[Array, "*c N r"]
    most: Float[Array, "*c N r"]
    others: tuple[Float[Array, "*c N r"], Float[Array, "*c N r"]]

    @classmethod
    def of(cls, sets: ActiveSets, faces: Any, lower: Array, upper: Array) -> Cases:
        """The cases of a box.

        Args:
            sets: the active sets.
            faces: those that can be active at all.
            lower: `(*c, r)`.
            upper: `(*c, r)`.
        """
        xp, members = namespace(lower, upper), sets.members
        lower, upper = lower - gamma(16) * abs(lower), upper + gamma(16) * abs(upper)
        low, high = _ranges(sets.multipliers, lower, upper)
        least, most = xp.where(members, larger(low, 0.0), 0.0), xp.where(members, high, 0.0)
        own = sets.gram.diagonal()
        coupling = sets.gram - np.diag(own)
        left, right = lower[..., None, :], upper[..., None, :]
        size = larger(abs(left), abs(right))
        for _ in range(SWEEPS):
            under, over = _products(coupling, least, most)
            error = gamma(4) * (size + larger(abs(under), abs(over)))
            low, high = (left - over - error) / own, (right - under + error) / own
            low, high = low - gamma(4) * abs(low), high + gamma(4) * abs(high)
            least = xp.where(members, larger(least, low), 0.0)
            most = xp.where(members, smaller(most, high), 0.0)
        others = _products(coupling, least, most)
        # what is no number excludes nothing
        empty = xp.any(most < least, axis=-1)
        slack = smaller(_ranges(sets.slacks, lower, upper)[1], _difference(others[1], left))
        negative = xp.any(~members & (slack < 0), axis=-1)
        possible = faces & ~empty & ~negative
        possible = xp.where(xp.any(possible, axis=-1, keepdims=True), possible, faces)
        return cls(sets, faces, possible, lower, upper, least, most, others)

    @property
    def interval(self) -> tuple[Float[Array, "*c r"], Float[Array, "*c r"]]:
        """Bounds of the multipliers."""
        return self._joined(self.least, larger(self.most, self.least))

    @property
    def never(self) -> Bool[Array, "*c r"]:
        """Which facets surely are inactive."""
        xp = namespace(self.lower, self.upper)
        return ~xp.any(self.possible[..., None] & self.sets.members, axis=-2)

    @property
    def always(self) -> Bool[Array, "*c r"]:
        """Which facets surely are active."""
        xp = namespace(self.lower, self.upper)
        return xp.all(~self.possible[..., None] | self.sets.members, axis=-2)

    @property
    def largest_slack(self) -> Float[Array, "*c r"]:
        """Upper bounds of the slacks."""
        xp = namespace(self.lower, self.upper)
        slack = smaller(
            _ranges(self.sets.slacks, self.lower, self.upper)[1],
            _difference(self.others[1], self.lower[..., None, :]),
        )
        slack = xp.where(self.sets.members, 0.0, larger(slack, 0.0))
        return self._joined(slack, slack)[1]

    def rest(self, slope: Array) -> tuple[Float[Array, "*c r"], Float[Array, "*c r"]]:
        """Bounds of `m_i - slope_i y'_i`, for any slope `(*c, r)`."""
        xp, members = namespace(self.lower, self.upper), self.sets.members
        a, own = slope[..., None, :], self.sets.gram.diagonal()
        left, right = self.lower[..., None, :], self.upper[..., None, :]
        under, over = self.others
        # inactive: y'_i is what the others leave at most
        top = larger(smaller(right, over), left)
        idle = _ends(-a, left, top)
        # active: y'_i = G_ii m_i + others, or m linear in y', or both by themselves
        first = _sum(_ends(1 - a * own, self.least, self.most), _ends(-a, under, over))
        size = abs(a) * (own * abs(self.most) + larger(abs(under), abs(over))) + abs(self.most)
        first = _wider(first, gamma(8) * size)
        matrices = self.sets.multipliers
        diagonal = np.diagonal(matrices, axis1=1, axis2=2)
        rest = matrices * (1 - np.eye(len(own)))
        second = _sum(_ranges(rest, self.lower, self.upper), _ends(diagonal - a, left, right))
        second = _wider(second, gamma(8) * (abs(diagonal) + abs(a)) * larger(abs(left), abs(right)))
        third = _sum((self.least, self.most), _ends(-a, left, right))
        third = _wider(third, gamma(4) * abs(self.most))
        low = larger(larger(first[0], second[0]), third[0])
        high = smaller(smaller(first[1], second[1]), third[1])
        low, high = (
            xp.where(members, one, other) for one, other in zip((low, high), idle, strict=True)
        )
        return self._joined(low, larger(high, low))

    def _joined(self, low: Array, high: Array) -> tuple[Float[Array, "*c r"], Float[Array, "*c r"]]:
        """The least and the largest over all possible cases; NaN where the polytope is empty."""
        xp = namespace(self.lower, self.upper)
        there = self.possible[..., None]
        least = xp.where(there, low, np.inf).min(axis=-2)
        most = xp.where(there, high, -np.inf).max(axis=-2)
        some = self.faces.any()
        return xp.where(some, least, np.nan), xp.where(some, most, np.nan)


Ends = tuple[Any, Any]


def _ends(factor: Any, low: Any, high: Any) -> Ends:
    """Bounds of a factor times what is in between, rounded outwards."""
    one, other = factor * low, factor * high
    return _wider((smaller(one, other), larger(one, other)), 0.0)


def _sum(one: Ends, other: Ends) -> Ends:
    return _wider((one[0] + other[0], one[1] + other[1]), 0.0)


def _wider(ends: Ends, by: Any) -> Ends:
    """Enlarged by so much, and by some roundings of the ends themselves."""
    low, high = ends
    return low - gamma(4) * abs(low) - by, high + gamma(4) * abs(high) + by


def _difference(one: Any, other: Any) -> Any:
    """`one - other`, rounded up."""
    return one - other + gamma(2) * (abs(one) + abs(other))


def _ranges(matrices: np.ndarray, lower: Array, upper: Array) -> Ends:
    """Bounds `(*c, N, r)` of `N` matrices, each entry rounded once, times a vector in a box."""
    N, k, r = matrices.shape
    flat = matrices.reshape(N * k, r)
    ends = _products(flat, lower, upper)
    return tuple(end.reshape((*end.shape[:-1], N, k)) for end in ends)


def _products(matrix: np.ndarray, lower: Array, upper: Array) -> Ends:
    """Bounds `(*c, k)` of a matrix, each entry rounded once, times a vector in a box."""
    over, under = np.maximum(matrix, 0.0).T, np.minimum(matrix, 0.0).T
    size = larger(abs(lower), abs(upper))
    error = gamma(2 * matrix.shape[1] + 4) * (size @ abs(matrix).T)
    low, high = lower @ over + upper @ under, upper @ over + lower @ under
    return low - error, high + error
