"""Products added round by round, on the host: solve, see what the moments violate, solve again.

A moment matrix `X` stands for the worst trajectories that the products so far allow. On a true
trajectory every entry of `F X F'` is nonnegative, so the most negative ones (rows of unit norm)
name the products that are missing. Rounds go on until a simulated witness attains the bound,
nothing is violated, or they run out.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from reachjax.numerics.budget import ENDLESS, Budget
from reachjax.programs.facts import FactLayout
from reachjax.programs.relaxations import CuttingPlanes
from reachjax.solvers.cut_pool import NONE, CutPool

IDLE = 1e-7
"""Multipliers below this part of the largest are at zero."""

Witness = Callable[[int, Float[np.ndarray, " n"]], float]
"""The value of a facet that a simulation attains, given its number and a moment's last column."""


class Rounds(NamedTuple):
    """By what products are added.

    Attributes:
        layout: of the program's facts.
        cuts: how many rounds, and of how many products.
        witness: what simulations attain of a facet; rounds do not stop for them if it is None.
        warm_start: products that the first facet begins with, those that may be added.
        budget: of the time.
    """

    layout: FactLayout
    cuts: CuttingPlanes
    witness: Witness | None = None
    warm_start: Int[np.ndarray, "p 2"] = NONE
    budget: Budget = ENDLESS


class Shown(NamedTuple):
    """What one round shows: the moments, which added products are idle, whether that is enough."""

    moment: Float[np.ndarray, "n n"]
    idle: Bool[np.ndarray, " p"]
    enough: bool = False


def idle(multipliers: Float[np.ndarray, " K"], added: int) -> Bool[np.ndarray, " p"]:
    """Which of the products added, the last ones, have a multiplier at zero."""
    largest = abs(multipliers).max(initial=0.0)
    return multipliers[len(multipliers) - added :] <= IDLE * largest


def in_rounds(
    pool: CutPool,
    rounds: Rounds,
    pairs: Int[np.ndarray, "p 2"],
    solve: Callable[[Int[np.ndarray, "q 2"]], Shown],
) -> Int[np.ndarray, "q 2"]:
    """Solve and add what is violated, by turns; returns what there was at last.

    Products that stay idle for two rounds are dropped. When there are enough or the rounds have run
    out, the products of `LocalBounds` that are violated are added all the same, until none is: no
    bound is looser than its.

    Args:
        pool: what may be added.
        rounds: how many, of how many products, and until when.
        pairs: what is added from the beginning.
        solve: what a round with these products shows.
    """
    cuts = rounds.cuts
    resting = np.zeros(len(pairs), dtype=bool)
    for number in itertools.count():
        shown = solve(pairs)
        if rounds.budget.late:
            break
        if not np.isfinite(shown.moment).all():
            if number == 0 and len(missing := pool.missing(pairs)):
                pairs = np.concatenate([pairs, missing])  # no moment to choose by: all that is due
                solve(pairs)
            break
        last = shown.enough or number >= cuts.rounds
        more = pool.violated(shown.moment, pairs, None if last else cuts.batch)
        if not len(more):
            break
        kept = np.full(len(pairs), True) if last else ~(resting & shown.idle)
        pairs = np.concatenate([pairs[kept], more])
        resting = np.concatenate([shown.idle[kept], np.zeros(len(more), dtype=bool)])
    return pairs
