"""Rows that decide requirements: directions, and what their upper bounds are compared with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from reachjax.sets.balance import balanced
from reachjax.verdicts.specification import Requirement, parts_of_periods


class FacetRows(NamedTuple):
    """Directions whose upper bounds decide a requirement, and the limits of these.

    To be inside, all of `C x <= d`; to be outside, one of `-C x < -d`. The other way round, by
    limits that are rounded the other way, it surely fails.

    Attributes:
        item: the requirement.
        first: the number of its first direction among those of its time.
        directions: `(r, n_x)`, `k` that prove it, then those that refute it if they are asked for.
        limits: `(r,)`.
        units: `(k,)`, what a distance of 1 in the units of the state changes the first by.
    """

    item: Requirement
    first: int
    directions: Float[np.ndarray, "r n_x"]
    limits: Float[np.ndarray, " r"]
    units: Float[np.ndarray, " k"]

    @classmethod
    def of(cls, item: Requirement, first: int, refuting: bool = True) -> FacetRows:
        """The rows of a requirement, those that refute it only if they are asked for."""
        C, d, norms = (np.asarray(part) for part in item.region.facets_in_units(item.inside))
        sign = 1.0 if item.inside else -1.0
        sides = [(sign * C, sign * d)]
        if refuting:
            facets = (np.asarray(part) for part in item.looser.facets)
            D, e = balanced(*facets, inner=not item.inside)
            sides.append((-sign * D, -sign * e))
        directions, limits = map(np.concatenate, zip(*sides, strict=True))
        return cls(item, first, directions, limits, norms)

    @property
    def proving(self) -> slice:
        """Which directions of its time prove it."""
        return slice(self.first, self.first + len(self.units))

    @property
    def end(self) -> int:
        """The number of the first direction after its own."""
        return self.first + len(self.limits)

    def judged(self, uppers: Float[np.ndarray, "*p m"]) -> tuple[bool, bool, float]:
        """Whether it surely holds, or surely fails, and its margin.

        Without rows that refute it, it never surely fails.

        Args:
            uppers: bounds at its time, or in each part of the period before.
        """
        found, k = np.atleast_2d(uppers)[:, self.first : self.end], len(self.units)
        room = (self.limits - found)[:, :k] / self.units
        known = np.isfinite(found)
        below, under = known & (found < self.limits), known & (found <= self.limits)
        if self.item.inside:
            holds, fails = under[:, :k].all(), below[:, k:].any()
            margin = room.min(initial=np.inf)
        else:
            holds, beyond = below[:, :k].any(axis=1).all(), under[:, k:]
            fails = beyond.shape[1] > 0 and beyond.all(axis=1).any()
            margin = np.fmax.reduce(room, axis=1).min()
        return bool(holds), bool(fails), float(np.nan_to_num(margin, nan=-np.inf))


class FacetRowsByTime(NamedTuple):
    """The rows of all requirements, time by time, filled up with zeros to arrays.

    Attributes:
        each: the rows of each requirement.
        directions: `(h + 1, m, n_x)`.
        whole: `(h + 1, m)`, which are bounded at all times since the sample before.
    """

    each: tuple[FacetRows, ...]
    directions: Float[np.ndarray, "h+1 m n_x"]
    whole: Bool[np.ndarray, "h+1 m"]

    @property
    def parts(self) -> tuple[int, ...]:
        """Into how many parts steps of a flow are cut for each direction, `(m,)`.

        Zero where it is bounded at samples alone, at each time.
        """
        most = parts_of_periods(rows.item for rows in self.each)
        return tuple(np.where(self.whole.any(axis=0), most, 0).tolist())

    @classmethod
    def of(
        cls, required: Sequence[Requirement], horizon: int, states: int, refuting: bool = True
    ) -> FacetRowsByTime:
        """The rows of requirements.

        Args:
            required: the requirements.
            horizon: the number of steps.
            states: of the loop.
            refuting: whether rows that refute them are there too.
        """
        ends, each = np.zeros(horizon + 1, dtype=int), list[FacetRows]()
        # what is meant in between samples comes first, so that as few numbers as can be are
        for item in sorted(required, key=lambda item: not item.throughout):
            each.append(FacetRows.of(item, int(ends[item.time]), refuting))
            ends[item.time] = each[-1].end
        directions = np.zeros((horizon + 1, int(ends.max()), states))
        whole = np.zeros(directions.shape[:2], dtype=bool)
        for rows in each:
            directions[rows.item.time, rows.first : rows.end] = rows.directions
            whole[rows.item.time, rows.first : rows.end] = rows.item.throughout
        return cls(tuple(each), directions, whole)
