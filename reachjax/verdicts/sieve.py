"""Which of many cells affine forms decide, all in one compiled call.

What one cell takes in numpy, ten take together, but only once the call is compiled: that is done
beside cells that are bounded one by one, once there were so many of these that it pays. Cells that
are left over are for whoever can do more: linear programs, or halving them.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from reachjax.loops import ClosedLoop
from reachjax.loops.tracing.functions import numbers_within, with_constants
from reachjax.loops.units import UnboundedError
from reachjax.numerics.budget import Budget
from reachjax.numerics.compilations import CompiledBeside
from reachjax.numerics.host import in_numpy
from reachjax.numerics.rounding import TINY, gamma, holds_subnormals
from reachjax.programs.followed import OpenDecision
from reachjax.programs.unrolled import ByForms, along_ways, unrolled, unrolled_from_boxes
from reachjax.sets import AbstractSet, Box
from reachjax.verdicts.facet_rows import FacetRowsByTime
from reachjax.verdicts.grounds import Leaves
from reachjax.verdicts.specification import Requirement

TOGETHER = 32
"""So many cells are a call: fewer are filled up, so that one shape is compiled."""

PASSES = 7
"""In numpy a period of a flow goes through its right-hand side so many times as often as it stands
in compiled code, for steps that are tried, enclosures and every coefficient."""

MEASURED = 2
"""So many periods of a flow say what all of them take."""

SIFT = CompiledBeside(unrolled_from_boxes)

Margins = dict[str, Float[np.ndarray, " h+1"]]

Ends = tuple[Float[np.ndarray, " n_x"], Float[np.ndarray, " n_x"]]
"""Lower and upper corners of a cell."""


def no_margins(required: Iterable[Requirement], horizon: int) -> Margins:
    """Margins of requirements of which nothing is known."""
    return {item.name: np.full(horizon + 1, np.nan) for item in required}


def smallest(margins: Margins) -> float:
    """The smallest that is known; minus infinity where none is."""
    known = [np.nanmin(row) for row in margins.values() if not np.isnan(row).all()]
    return float(min(known, default=-np.inf))


class Unbounded(NamedTuple):
    """An `UnboundedError` as other processes can send it.

    Attributes:
        given: what it was made of.
    """

    given: tuple[Any, ...]

    @classmethod
    def of(cls, error: UnboundedError) -> Unbounded:
        """The record of an error."""
        return cls((*error.given, error.line))

    @property
    def error(self) -> UnboundedError:
        """The error, to be raised."""
        return UnboundedError(*self.given)


class Outcome(NamedTuple):
    """What is found of a cell.

    Attributes:
        proved: whether all requirements hold from every state of it.
        margins: of those that were looked at; NaN of the others.
        refuted: whether one of them fails from every state of it.
        axis: along which it should be halved; -1 where nothing says that.
        then: along which its halves should be before they are bounded; -1 if they should not.
        unbounded: the unit that has no bounds over it, if there is one.
        leaves: of requirements that forms alone do not prove.
        open: decisions that may go either way from it, as far as that was looked at.
    """

    proved: bool
    margins: Margins
    refuted: bool = False
    axis: int = -1
    unbounded: Unbounded | None = None
    leaves: tuple[Leaves, ...] = ()
    open: tuple[OpenDecision, ...] = ()
    then: int = -1

    @property
    def margin(self) -> float:
        """The smallest known margin."""
        return smallest(self.margins)


class Sieve:
    """Affine forms over many cells, and what they decide.

    Args:
        loop: the closed loop.
        horizon: the number of steps.
        start: the time of the cells.
        required: the requirements.
    """

    def __init__(self, loop: ClosedLoop, horizon: int, start: int, required: Sequence[Requirement]):
        # what depends on parameters alone is an argument of what is compiled, and no part of it
        self._loop, self._on_host = jax.device_put(with_constants(loop)), in_numpy(loop)
        self._start = start
        by_time = FacetRowsByTime.of(required, horizon, loop.states)
        self._rows, self._directions, self._parts = by_time.each, by_time.directions, by_time.parts
        self._later = jnp.asarray(self._directions[1:])
        self._whole = by_time.whole[1:] if by_time.whole.any() else None

    def pays(self, cells: Sequence[Ends], budget: Budget, calls: float | None = None) -> bool:
        """Whether the compiled call is there, and faster than what these cells take one by one.

        It takes numbers that are no normal ones for zero, so it is not for cells or loops of these.

        Args:
            cells: that may be bounded so, or else will be one by one.
            budget: of the whole call.
            calls: how many such calls are to be made by who waits for the compilation.
        """
        if self._of_subnormals or holds_subnormals(cells):
            return False
        steps = max(len(self._directions) - 1, 1)
        passes = PASSES if self._loop.plant.continuous else 1
        return SIFT.pays(
            *self._given(cells),
            seconds=lambda: self._measured(cells[0]),
            evaluations=TOGETHER * steps * passes,
            left=budget.left,
            share=len(cells) / TOGETHER,
            calls=calls,
            **self._static,
        )

    @property
    def _static(self) -> dict[str, Any]:
        """What the compiled call is compiled for."""
        return {"t": self._start, "between": self._parts}

    @cached_property
    def _of_subnormals(self) -> bool:
        """Whether the loop, or what is required, has numbers that compiled code takes for zero."""
        return holds_subnormals((self._loop, self._later, numbers_within(self._loop)))

    def _measured(self, cell: Ends) -> float | None:
        """The seconds that a call takes one by one; None where this cell has no bounds."""
        box, began = in_numpy(Box(*cell)), time.perf_counter()
        try:
            given = self._on_host, box, box, self._directions[1:], self._start
            steps = unrolled(*given, between=self._parts)
            if self._loop.plant.continuous:  # a flow costs about the same in each
                steps = itertools.islice(steps, MEASURED)
            count = len(list(steps))
        except UnboundedError:
            return None
        whole = (len(self._directions) - 1) / max(count, 1)
        return TOGETHER * whole * (time.perf_counter() - began)

    def _given(self, cells: Sequence[Ends]) -> tuple[Any, ...]:
        """The arguments of the compiled call."""
        filled = [*cells, *[cells[-1]] * (TOGETHER - len(cells))]
        lower, upper = (np.stack(ends) for ends in zip(*filled, strict=True))
        whole = None if self._whole is None else jnp.asarray(self._whole)
        return self._loop, lower, upper, self._later, whole

    def sifted(self, cells: Sequence[Ends]) -> list[Outcome]:
        """What is found of each cell, at most `TOGETHER` of them."""
        _, lower, upper, *_ = given = self._given(cells)
        bounds = np.asarray(SIFT(*given, **self._static))
        first = _at_first(self._directions[0], lower, upper)[:, None, None]
        first = np.broadcast_to(first, (len(first), 1, *bounds.shape[2:]))
        bounds = np.concatenate([first, bounds], axis=1)
        with np.errstate(invalid="ignore"):
            return [self._judged(uppers) for uppers in bounds[: len(cells)]]

    def followed(self, part: AbstractSet, box: Box, most: int, budget: Budget) -> Outcome:
        """What is found of one cell along all ways of its decisions, on the host.

        It ends with the first step at which a requirement is not proved.

        Args:
            part: the cell.
            box: around it.
            most: along how many ways.
            budget: of the whole call.

        Raises:
            UnboundedError: a unit has no bounds over it.
        """
        items, horizon = [rows.item for rows in self._rows], len(self._directions) - 1
        margins, still_open = no_margins(items, horizon), dict[OpenDecision, None]()
        ends = np.asarray(box.lower)[None], np.asarray(box.upper)[None]
        begun = _at_first(self._directions[0], *ends)[0]
        first = ByForms(begun, np.zeros(0), np.zeros((0, 0)))
        given = self._on_host, part, box, self._directions[1:], self._start
        later = along_ways(*given, between=self._parts, most=most)
        for k, each in enumerate(itertools.chain([[first]], later)):
            still_open |= dict.fromkeys(decision for one in each for decision in one.open)
            uppers = [np.asarray(one.offsets) for one in each]
            if self._whole is not None and k:
                # without states there is nothing in between them
                inner = (one.offsets if one.between is None else one.between for one in each)
                both = zip(map(np.asarray, inner), uppers, strict=True)
                uppers = [np.where(self._whole[k - 1], *pair) for pair in both]
            uppers = [upper for upper in uppers if not np.isneginf(upper).all()]  # no states
            for rows in self._rows:
                if rows.item.time == k:
                    found = [rows.judged(upper) for upper in uppers]
                    least = min((margin for *_, margin in found), default=np.inf)
                    margins[rows.item.name][k] = least
                    if not all(holds for holds, *_ in found):
                        axis = _deciding_axis(each)
                        return Outcome(False, margins, axis=axis, open=tuple(still_open))
            if budget.overdue:
                return Outcome(False, margins, open=tuple(still_open))
        return Outcome(True, margins)

    def _judged(self, uppers: Float[np.ndarray, "h+1 p m"]) -> Outcome:
        """What bounds say of one cell."""
        items, proved, refuted = [rows.item for rows in self._rows], True, False
        margins = no_margins(items, len(uppers) - 1)
        for rows in self._rows:
            item = rows.item
            holds, fails, margin = rows.judged(uppers[item.time])
            margins[item.name][item.time] = margin
            proved, refuted = proved and holds, refuted or fails
        return Outcome(proved, margins, refuted)


def _deciding_axis(each: Sequence[ByForms]) -> int:
    """The coordinate that moves what decides between ways most; -1 where none does.

    Of its halves most have fewer ways. Along the longest side three times as many cells were needed
    for a cart-pole whose pole moves decisions, and not the place of the cart.
    """
    moved = np.sum([one.moved for one in each if len(one.moved)], axis=0)
    return int(np.argmax(moved)) if np.max(moved, initial=0.0) > 0 else -1


def _at_first(
    rows: Float[np.ndarray, "m n"], lower: Float[np.ndarray, "c n"], upper: Float[np.ndarray, "c n"]
) -> Float[np.ndarray, "c m"]:
    """What rows attain on boxes: exactly, if each is a coordinate, else rounded up."""
    largest = np.maximum(rows * lower[:, None], rows * upper[:, None])
    whole = np.isin(rows, (-1.0, 0.0, 1.0)).all(axis=1) & (np.count_nonzero(rows, axis=1) < 2)
    error = gamma(2 * rows.shape[1]) * abs(largest).sum(axis=2) + rows.shape[1] * TINY
    return largest.sum(axis=2) + np.where(whole, 0.0, error)
