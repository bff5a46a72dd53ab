"""Products added round by round, on the host: solve, see what the moments violate, solve again.

Each facet has its own products and begins with those that the one before found of use.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from reachjax.programs.facts import FactLayout
from reachjax.programs.lmi import Program
from reachjax.programs.relaxations import CuttingPlanes, Products
from reachjax.proofs.proposal import Solution, SolverStatus
from reachjax.proofs.recheck import interval_offsets, sound_offsets
from reachjax.proofs.reported import Judged, judged
from reachjax.sets import NormalForm
from reachjax.solvers.base import AbstractSolver
from reachjax.solvers.cut_pool import NONE, CutPool, joint
from reachjax.solvers.faults import proposed, proposed_enclosure

IDLE = 1e-7
"""Multipliers below this part of the largest are at zero."""

NEAR = 1e-9
"""Offsets that differ by less, in parts of the facet's interval, are equally good."""

Witness = Callable[[int, Float[np.ndarray, " n"]], float]
"""The value of a facet that a simulation attains, given its number and a moment's last column."""


class Rounds(NamedTuple):
    """What the rounds of all facets ended with.

    Attributes:
        products: every facet's.
        judged: what was proposed, multipliers being those of `products`, and proved; a facet's
            offset is optimal with its own products.
    """

    products: Products
    judged: Judged


def solved_in_rounds(
    program: Program,
    layout: FactLayout,
    solver: AbstractSolver,
    cuts: CuttingPlanes,
    witness: Witness | None = None,
    offered: Int[np.ndarray, "p 2"] = NONE,
) -> Rounds:
    """Solve for every facet, products being added as they are needed.

    Args:
        program: whose leaves are numpy arrays, with the products of `cuts`.
        layout: of its facts.
        solver: of the programs of each round.
        cuts: how many rounds, and of how many products.
        witness: what simulations attain; rounds do not stop for them if it is None.
        offered: products that the first facet begins with, those that may be added.
    """
    pool = CutPool(program, layout)
    found, used = [], pool.addable(offered)
    for facet in range(len(program.objective.mid)):
        one = program.seeking(slice(facet, facet + 1))
        attained = None if witness is None else partial(witness, facet)
        found.append(_facet(one, pool, solver, cuts, attained, used))
        used = found[-1].of_use
    return _joined(program, pool, found)


def products_around(
    program: Program,
    layout: FactLayout,
    solver: AbstractSolver,
    cuts: CuttingPlanes,
    form: NormalForm | None = None,
) -> Products:
    """The products of the smallest ellipsoid, found round by round.

    Args:
        program: whose leaves are numpy arrays, with the products of `cuts`.
        layout: of its facts.
        solver: of the programs of each round.
        cuts: how many rounds, and of how many products.
        form: the ellipsoid up to a factor on `A` and `b`; free if it is None.
    """
    pool, n = CutPool(program, layout), len(program.transform)

    def solve(pairs: np.ndarray) -> _Round:
        given = program.replace(products=joint(pool.core, pairs))
        enclosure = proposed_enclosure(solver, given, form)
        moments = np.asarray(enclosure.moments)
        moment = moments[:n, :n] / moments[n - 1, n - 1]
        return _Round(moment, _idle(np.asarray(enclosure.multipliers), len(pairs)), False)

    return joint(pool.core, _in_rounds(pool, cuts, NONE, solve))


class _Round(NamedTuple):
    """What one round shows: the moments, which added products are idle, whether that is enough."""

    moment: Float[np.ndarray, "n n"]
    idle: Bool[np.ndarray, " p"]
    enough: bool


def _idle(multipliers: Float[np.ndarray, " K"], added: int) -> Bool[np.ndarray, " p"]:
    """Which of the products added, the last ones, have a multiplier at zero."""
    largest = abs(multipliers).max(initial=0.0)
    return multipliers[len(multipliers) - added :] <= IDLE * largest


class _Result(NamedTuple):
    """One facet's best round: the products added, and what was proved with them."""

    pairs: Int[np.ndarray, "p 2"]
    judged: Judged

    @property
    def solution(self) -> Solution:
        """What the solver proposed."""
        return self.judged.solution

    @property
    def offset(self) -> float:
        """What is proved."""
        return float(self.judged.offsets[0])

    @property
    def is_optimal(self) -> bool:
        """Whether the offset is the solver's optimum, to its tolerance."""
        solved = int(self.solution.statuses[0]) == SolverStatus.SOLVED
        return solved and bool(self.judged.optimal[0])

    @property
    def of_use(self) -> Int[np.ndarray, "q 2"]:
        """The added products whose multipliers are not at zero."""
        return self.pairs[~_idle(np.asarray(self.solution.multipliers[0]), len(self.pairs))]


def _in_rounds(
    pool: CutPool,
    cuts: CuttingPlanes,
    pairs: Int[np.ndarray, "p 2"],
    solve: Callable[[Int[np.ndarray, "q 2"]], _Round],
) -> Int[np.ndarray, "q 2"]:
    """Solve and add what is violated, by turns; returns what there was at last.

    Products that stay idle for two rounds are dropped. When there are enough or the rounds have run
    out, the products of `LocalBounds` that are violated are added all the same, until none is: no
    bound is looser than its.

    Args:
        pool: what may be added.
        cuts: how many rounds, and of how many products.
        pairs: what is added from the beginning.
        solve: what a round with these products shows.
    """
    idle = np.zeros(len(pairs), dtype=bool)
    for number in itertools.count():
        shown = solve(pairs)
        if not np.isfinite(shown.moment).all():
            if number == 0 and len(missing := pool.missing(pairs)):
                pairs = np.concatenate([pairs, missing])  # no moment to choose by: all that is due
                solve(pairs)
            break
        last = shown.enough or number >= cuts.rounds
        more = pool.violated(shown.moment, pairs, None if last else cuts.batch)
        if not len(more):
            break
        kept = np.full(len(pairs), True) if last else ~(idle & shown.idle)
        pairs = np.concatenate([pairs[kept], more])
        idle = np.concatenate([shown.idle[kept], np.zeros(len(more), dtype=bool)])
    return pairs


def _facet(
    program: Program,
    pool: CutPool,
    solver: AbstractSolver,
    cuts: CuttingPlanes,
    attained: Callable[[Float[np.ndarray, " n"]], float] | None,
    pairs: Int[np.ndarray, "p 2"],
) -> _Result:
    """The rounds of one facet."""
    size = float(interval_offsets(program)[0] - program.objective.mid[0, -1])
    transform = np.asarray(program.transform)
    results: list[_Result] = []

    def solve(pairs: np.ndarray) -> _Round:
        given = program.replace(products=joint(pool.core, pairs))
        solution = proposed(solver, given)
        results.append(_Result(pairs, judged(given, solution)))
        moment = np.asarray(solution.moments[0])
        idle = _idle(np.asarray(solution.multipliers[0]), len(pairs))
        if attained is None:
            return _Round(moment, idle, False)
        least = min(result.offset for result in results)
        enough = least - attained(transform @ moment[:, -1]) <= cuts.gap * size
        return _Round(moment, idle, enough)

    _in_rounds(pool, cuts, pairs, solve)
    least = min(result.offset for result in results)
    near = [result for result in results if result.offset <= least + NEAR * size]
    best = max(near, key=lambda result: result.is_optimal)  # the first that is, if any is
    seconds = np.sum([result.solution.seconds for result in results], axis=0)
    spent = best.judged._replace(solution=best.solution._replace(seconds=seconds))
    return best._replace(judged=spent)


def _joined(program: Program, pool: CutPool, found: list[_Result]) -> Rounds:
    """All facets over the products that any of them has."""
    pairs = np.unique(np.concatenate([result.pairs for result in found]), axis=0)
    number = {tuple(pair): i for i, pair in enumerate(pairs)}
    products, core = joint(pool.core, pairs), len(pool.core.free)
    size = len(program.transform)
    solution = Solution.blank(len(found), len(products.free), size)
    held = np.zeros_like(solution.multipliers)
    for i, result in enumerate(found):
        mine = result.solution
        places = np.array([number[tuple(pair)] for pair in result.pairs], dtype=int)
        there = np.r_[np.arange(core), core + places]
        solution.multipliers[i, there] = mine.multipliers[0]
        held[i, there] = result.judged.multipliers[0]
        solution.offsets[i], solution.statuses[i] = mine.offsets[0], mine.statuses[0]
        solution.moments[i], solution.seconds[i] = mine.moments[0], mine.seconds[0]
    # proved with all products, which are in another order and so round otherwise
    whole = program.replace(products=products)
    again = np.fmin(sound_offsets(whole, np.asarray(solution.multipliers)), interval_offsets(whole))
    joined = Judged(
        offsets=np.fmax(np.array([result.offset for result in found]), again),
        optimal=np.array([result.judged.optimal[0] for result in found]),
        multipliers=held,
        moments=np.concatenate([result.judged.moments for result in found]),
        solution=solution,
    )
    return Rounds(products, joined)
