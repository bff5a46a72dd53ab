"""The active sets of a projection onto a polytope: which facets can be active together.

Multipliers of `min |u - y|` over `C u <= d` can be chosen such that those that are not zero belong
to linearly independent facets `S` (Caratheodory). With excesses `y' = C y - d` and `G = C C'`,

    m_S = G_SS^-1 y'_S,    m = 0 elsewhere,    slacks  G m - y'  are zero on S:

both are linear in `y'`. Their matrices are computed in rational arithmetic and rounded once, so
that which facets are independent is known, and each entry is off by one rounding.
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

from reachjax.numerics.rounding import gamma, namespace

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
