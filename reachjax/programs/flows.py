"""What the flow of a differential equation makes of affine forms.

It is a function of the initial columns and of one symbol for all else that there is to each state,
input and disturbance (`loops.flows`). What stands for such a symbol in a form is again a row over
all columns, so the derivatives by the symbols carry these on, and nothing is wrapped. What the flow
leaves out of a state is part of its radius, which gets a column.
"""

from __future__ import annotations

from functools import lru_cache, reduce
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from reachjax.loops.flows.flow import AbstractFlow
from reachjax.loops.flows.taylor_models import Symbols, TaylorModels
from reachjax.loops.flows.taylor_models import joined as together
from reachjax.numerics.numbers import split
from reachjax.numerics.rounding import Ball, gamma, larger, namespace, settled
from reachjax.programs.affine import AffineForms, joined
from reachjax.programs.initial import InitialColumns

Parts = int | tuple[int, ...]
"""Into how many parts steps are cut: one number, or one for each direction."""


class Between(NamedTuple):
    """The states in between two samples, as hulls of control points, one after the other.

    Attributes:
        points: for each step of the period four of them, forms of a state each.
        ends: when each step ends, `(s,)`, as parts of the period.
    """

    points: tuple[tuple[AffineForms, ...], ...]
    ends: tuple[float, ...]

    def values(self, directions: Float[Array | np.ndarray, "m n_x"], parts: int = 1) -> AffineForms:
        """Forms of directions at control points: part by part, four points each, `m` of each.

        Within a part a direction does not exceed all four. The last ones are of the next sample.

        Args:
            directions: one row each.
            parts: a power of two, into so many each step is cut.
        """
        return self._through(directions, _cut(parts))

    def bounds(
        self,
        directions: Float[Array | np.ndarray, "m n_x"],
        start: InitialColumns,
        parts: Parts = 1,
    ) -> Float[Array | np.ndarray, "p m"]:
        """Upper bounds of directions at all times of each part of a period.

        Args:
            directions: one row each.
            start: what the first columns are.
            parts: as of `values`; or for each direction, with 0 where it is not asked for, of which
                bounds are infinite. Bounds are of as many parts as the largest number says.
        """
        counts = np.broadcast_to(parts, len(directions))
        numbers, most = np.unique(counts), int(counts.max(initial=1))
        places = [np.flatnonzero(counts == count) for count in numbers]
        given = zip(numbers.tolist(), places, strict=True)
        found = [self._hulls(directions[rows], start, count, most) for count, rows in given]
        if len(found) == 1:
            return found[0]
        return namespace(*found).concatenate(found, axis=1)[:, np.argsort(np.concatenate(places))]

    def _hulls(
        self,
        directions: Float[Array | np.ndarray, "m n_x"],
        start: InitialColumns,
        parts: int,
        most: int,
    ) -> Float[Array | np.ndarray, "p m"]:
        """Upper bounds of directions that are cut alike, each repeated up to the largest number."""
        steps, m = len(self.points), len(directions)
        if not parts:
            return np.full((steps * most, m), np.inf)
        ends = self._through(directions, _points(parts)).uppers(start, True)
        points = ends.reshape(steps, 3 * parts + 1, m)
        fours = [points[:, k : k + 3 * parts - 2 : 3].reshape(-1, m) for k in range(4)]
        xp = namespace(ends)
        unknown = reduce(xp.logical_or, map(xp.isnan, fours))
        largest = xp.where(unknown, xp.inf, reduce(larger, fours))
        return xp.repeat(largest, most // parts, axis=0)

    def _through(
        self, directions: Float[Array | np.ndarray, "m n_x"], cut: Float[np.ndarray, "p 4"]
    ) -> AffineForms:
        """Forms of directions at what a matrix makes of the four points of each step."""
        fours = [joined([directions @ point for point in four]) for four in self.points]
        if len(cut) > 4:  # else the points are these four, without a product and its rounding
            each = np.kron(cut, np.eye(len(directions)))
            fours = [each @ four for four in fours]
        return joined(fours)


@lru_cache
def _cut(parts: int) -> Float[np.ndarray, "p 4"]:
    """From the control points of a cubic to those of its equal parts, by de Casteljau: exactly.

    Weights are nonnegative and add up to one, so what is known of a cubic up to an error that is
    the same at all four points is known of its parts.
    """
    if parts == 1:
        return np.eye(4)
    first, half = np.zeros((4, 4)), np.eye(4)
    for k in range(4):
        first[k] = half[0]
        half = (half[:-1] + half[1:]) / 2
    return np.vstack([_cut(parts // 2) @ first, _cut(parts // 2) @ first[::-1, ::-1]])


@lru_cache
def _points(parts: int) -> Float[np.ndarray, "p 4"]:
    """From the control points of a cubic to those of its equal parts, shared ones once.

    A part begins where the one before it ends.
    """
    return np.vstack([_cut(parts)[:1], np.delete(_cut(parts), np.s_[::4], axis=0)])


def flowed_forms(
    flow: AbstractFlow, given: tuple[AffineForms, ...], start: InitialColumns, between: bool = False
) -> tuple[AffineForms, Between]:
    """The state after one period, and those in between if they are asked for.

    Args:
        flow: of the plant.
        given: the state, the input, and disturbances if there are any, over the same columns.
        start: what the first columns are.
        between: whether the states in between are asked for.

    Raises:
        UnboundedError: solutions escape, leave a domain, or are too fast, in numpy.
    """
    forms = joined(given)
    cut = start.cut is not None and not start.cut.needs_programs
    box = Ball.between(*settled(given[0].ends(start, cut)))
    symbols, models = _condensed(forms, [len(each) for each in given], start)
    found = flow.followed(models, box, between)
    states = [found.state, *(point for each in found.controls for point in each.points)]
    state, *points = split(_expanded(together(states), forms, symbols), len(states))
    parts = [each.part for each in found.controls]
    ends = tuple(sum(parts[: k + 1]) for k in range(len(parts)))
    fours = tuple(tuple(points[k : k + 4]) for k in range(0, len(points), 4))
    return state, Between(fours, ends)


def _condensed(
    forms: AffineForms, sizes: list[int], start: InitialColumns
) -> tuple[Symbols, list[TaylorModels]]:
    """Forms as numbers of the initial columns, and of a symbol each for all the rest."""
    xp, first = namespace(forms.rows), 2 + start.count
    rest = abs(forms.rows[:, first:]).sum(axis=1) * (1 + gamma(forms.rows.shape[1]))
    radii = (rest + forms.off) * (1 + gamma(2))
    symbols = Symbols(len(start.spread), start.curved, radii)
    rows = xp.concatenate([forms.rows[:, :1], forms.rows[:, 2:first], xp.eye(len(radii))], axis=1)
    whole, parts = TaylorModels(rows, xp.zeros_like(radii), symbols), list[TaylorModels]()
    for size in sizes:
        parts.append(whole[sum(map(len, parts)) :][:size])
    return symbols, parts


def _expanded(found: TaylorModels, forms: AffineForms, symbols: Symbols) -> AffineForms:
    """Numbers of such symbols as forms over all columns.

    They have radii also where rounding is not counted: what the flow leaves out.
    """
    xp, count = namespace(forms.rows), symbols.own
    first, none = xp.zeros((len(forms.rows), 2 + count)), xp.zeros(len(forms.rows))
    radii = xp.stack([none + forms.off, none], axis=1)
    rest = AffineForms(xp.concatenate([first, forms.rows[:, 2 + count :]], axis=1), radii)
    rest = found.rows[:, 1 + count :] @ rest
    interval = found.ball
    constants = found.rows[:, :1], interval.mid[:, None]
    rows = xp.concatenate([*constants, found.rows[:, 1 : 1 + count], rest.rows[:, 2 + count :]], 1)
    radii = (rest.radii[:, 0] + found.radii) * (1 + gamma(2))
    return AffineForms(rows, xp.stack([radii, interval.rad], axis=1))
