"""The active sets of a projection onto a polytope: which facets can be active together.

Multipliers of `min |u - y|` over `C u <= d` can be chosen such that those that are not zero belong
to linearly independent facets `S` (Caratheodory). With excesses `y' = C y - d` and `G = C C'`,

    m_S = G_SS^-1 y'_S,    m = 0 elsewhere,    slacks  G m - y'  are zero on S:

both are linear in `y'`. Their matrices are computed in rational arithmetic and rounded once, so
that which facets are independent is known, and each entry is off by one rounding.

Given a box of excesses `y'`, a set `S` of facets can be active only if its multipliers can be
positive and the slacks of the others too. In each such case the multipliers are linear in `y'`,
and `y'_i = sum_j G_ij m_j - s_i`, with no slack for the members of `S`. What holds in all
cases holds.
Boxes are enlarged by some roundings of their ends: a compiler may round these anew where it uses
them again.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from fractions import Fraction
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

from reachjax.numerics.rounding import gamma, larger, namespace, smaller

MOST_SETS = 512
"""So many sets of facets are looked at for each input: eight facets in four dimensions have 163."""

Normals = tuple[tuple[float, ...], ...]
"""Facet normals, hashable: `r` rows of `n` numbers."""


class ActiveSets(NamedTuple):
    """All sets of linearly independent facets; `N` of `r` facets.

    The smallest come first, and of one size those of moderate matrices.

    Attributes:
        members: `(N, r)`.
        multipliers: `(N, r, r)`, `m` of excesses.
        slacks: `(N, r, r)`, the slacks of excesses; zero for the members.
        gram: `(r, r)`, `C C'`.
        largest: `(M,)`, the numbers of the sets that no facet can be added to.
        within: `(N, M)`, whether a set is a part of one of these.
    """

    members: Bool[np.ndarray, "N r"]
    multipliers: Float[np.ndarray, "N r r"]
    slacks: Float[np.ndarray, "N r r"]
    gram: Float[np.ndarray, "r r"]
    largest: Any
    within: Bool[np.ndarray, "N M"]

    def faces(
        self, offsets: Float[Array | np.ndarray, " r"] | None
    ) -> Bool[Array | np.ndarray, " N"]:
        """Which sets can be active, given the offsets `d`: `C_S u = d_S` on some of the polytope.

        Where it is, there is a largest set of facets around it that meet in the polytope, and the
        slacks of all facets are constant where these meet. None is missing; rounding may add some.
        """
        if offsets is None:
            return np.ones(len(self.members), bool)
        xp, matrices = namespace(offsets), -self.slacks[self.largest]
        rounding = gamma(len(self.gram) + 4) * (abs(matrices) @ abs(offsets))
        meet = xp.all(matrices @ offsets + rounding >= 0, axis=-1)
        return xp.any(self.within & meet, axis=-1)


@lru_cache(maxsize=64)
def active_sets(normals: Normals) -> ActiveSets:
    """The active sets of facets with these normals.

    Raises:
        ValueError: there are too many.

    Example:
        >>> sets = active_sets(((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0)))
        >>> [np.flatnonzero(row).tolist() for row in sets.members]
        [[], [0], [1], [2], [0, 1], [1, 2]]
    """
    r, n = len(normals), len(normals[0])
    count = sum(math.comb(r, size) for size in range(min(r, n) + 1))
    if count > MOST_SETS:
        raise ValueError(
            f"input_box has {r} facets for {n} inputs, which are {count} sets of facets that may "
            f"be active together: the projection onto it looks at {MOST_SETS} at most"
        )
    G = _gram(normals)
    subsets = itertools.chain(*(itertools.combinations(range(r), k) for k in range(min(r, n) + 1)))
    found = [(S, inverse) for S in subsets if (inverse := _inverse(G, S)) is not None]
    members = np.zeros((len(found), r), bool)
    multipliers, slacks = np.zeros((2, len(found), r, r))
    for number, (S, inverse) in enumerate(found):
        here = list(S)
        members[number, here] = True
        slacks[number] = -np.diag(1.0 - members[number])
        for j, column in enumerate(zip(*inverse, strict=True)):
            multipliers[number, here, S[j]] = [float(entry) for entry in column]
            for k in set(range(r)) - set(S):
                slacks[number, k, S[j]] = float(_dot([G[k][i] for i in S], column))
    order = np.lexsort((abs(multipliers).max(axis=(1, 2)).round(9), members.sum(axis=1)))
    members, multipliers, slacks = members[order], multipliers[order], slacks[order]
    sizes = members.sum(axis=1)
    largest = np.flatnonzero(sizes == sizes.max())
    within = ~np.any(members[:, None] & ~members[largest], axis=2)
    gram = np.array([[float(entry) for entry in row] for row in G])
    return ActiveSets(members, multipliers, slacks, gram, largest, within)


def has_points(normals: Normals, offsets: Float[np.ndarray, " r"]) -> bool:
    """Whether `C u <= d` has any, in exact arithmetic: facets that can be active together do meet.

    Example:
        >>> has_points(((1.0,), (-1.0,)), np.array([0.5, -0.5]))
        True
        >>> has_points(((1.0,), (-1.0,)), np.array([0.5, -0.6]))
        False
    """
    sets, G, d = active_sets(normals), _gram(normals), [Fraction(entry) for entry in offsets]
    for number in sets.largest[sets.faces(offsets)[sets.largest]]:
        S = tuple(np.flatnonzero(sets.members[number]).tolist())
        inverse = _inverse(G, S)
        assert inverse is not None  # as it is a set of active ones
        weights = [_dot(row, [d[i] for i in S]) for row in inverse]
        if all(
            _dot([row[i] for i in S], weights) <= limit for row, limit in zip(G, d, strict=True)
        ):
            return True
    return False


def _dot(one: Iterable[Fraction], other: Iterable[Fraction]) -> Fraction:
    return sum(map(Fraction.__mul__, one, other), Fraction(0))


def _gram(normals: Normals) -> list[list[Fraction]]:
    """The Gram matrix `C C'`."""
    C = [[Fraction(entry) for entry in row] for row in normals]
    return [[_dot(one, other) for other in C] for one in C]


def _inverse(G: list[list[Fraction]], S: tuple[int, ...]) -> list[list[Fraction]] | None:
    """The inverse of `G_SS`, by elimination; None where there is none."""
    k = len(S)
    rows = [[G[i][j] for j in S] + [Fraction(i == j) for j in S] for i in S]
    for pivot in range(k):  # G_SS is positive semidefinite: no exchange of rows is needed
        if rows[pivot][pivot] == 0:
            return None
        rows[pivot] = [entry / rows[pivot][pivot] for entry in rows[pivot]]
        for other in set(range(k)) - {pivot}:
            by = rows[other][pivot]
            rows[other] = [a - by * b for a, b in zip(rows[other], rows[pivot], strict=True)]
    return [row[k:] for row in rows]


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
