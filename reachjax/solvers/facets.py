"""The offsets of facets: problem (sdp::poly), one optimal value for each."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, Self

import numpy as np
from jaxtyping import Array, Float, Int

from reachjax.numerics.host import all_finite
from reachjax.numerics.pytrees import pytree
from reachjax.programs.lmi import Program, Slopes, lagrangian_slopes
from reachjax.programs.relaxations import Products
from reachjax.proofs.facets import Certificate
from reachjax.proofs.proposal import Solution, SolverStatus
from reachjax.proofs.recheck import interval_offsets, sound_offsets
from reachjax.proofs.reported import Judged, judged_offsets
from reachjax.proofs.slopes import Held
from reachjax.sets import Polytope
from reachjax.solvers.base import AbstractSolver
from reachjax.solvers.cut_pool import NONE, CutPool, joint
from reachjax.solvers.faults import proposed
from reachjax.solvers.goals import AbstractGoal
from reachjax.solvers.rounds import Rounds, Shown, idle, in_rounds

NEAR = 1e-9
"""Offsets that differ by less, in parts of the facet's interval, are equally good."""


@pytree
class Facets(AbstractGoal):
    """The smallest offset for each facet: `b` of `directions x+ <= b`.

    Attributes:
        directions: `(f, n_x)`.
    """

    directions: Float[Array, "f n_x"]

    def rows(self, states: int) -> Float[Array, "f n_x"]:
        """The directions of the facets."""
        return self.directions

    def unknown(self, program: Program) -> Judged:
        """No offsets: NaN."""
        blank = Solution.blank_for(program)
        unknown = np.full(len(blank.offsets), np.nan)
        held = Held(np.full(blank.multipliers.shape, np.nan), np.full(blank.moments.shape, np.nan))
        return Judged(unknown, np.zeros(len(unknown), dtype=bool), held, blank)

    def judged(self, program: Program, solver: AbstractSolver) -> Judged:
        """Offsets that are proved with what the solver proposes."""
        if not all_finite(program):
            return self.unknown(program)
        return judged_offsets(program, proposed(solver, program))

    def in_rounds(
        self, program: Program, solver: AbstractSolver, rounds: Rounds
    ) -> tuple[Products, Judged]:
        """Each facet has its own products, and begins with those that the one before used."""
        pool = CutPool(program, rounds.layout)
        found, used = [], pool.addable(rounds.warm_start)
        for facet in range(len(program.objective.mid)):
            one = program.with_objective(slice(facet, facet + 1))
            attained = None if rounds.witness is None else partial(rounds.witness, facet)
            if rounds.budget.late:
                found.append(_unsolved(one, pool))
            else:
                found.append(_facet(one, pool, solver, rounds, attained, used))
            used = found[-1].in_use
        return _joined(program, pool, found)

    def slopes(
        self, program: Program, held: Held, cotangent: Float[np.ndarray, " f"]
    ) -> tuple[Slopes, Self]:
        """Slopes of the Lagrangian; the rows carry what the directions do."""
        slopes = lagrangian_slopes(program, held.multipliers, held.moments, cotangent)
        return slopes, self.replace(directions=np.zeros_like(self.directions))

    def region(self, value: Float[Array, " f"]) -> Polytope:
        """`directions x <= b`."""
        return Polytope(self.directions, value)

    def certificate(
        self, program: Program, value: Float[Array, " f"], proposal: Solution
    ) -> Certificate:
        """The proof of the offsets."""
        return Certificate.from_solution(program, value, proposal)


class _Round(NamedTuple):
    """One round of one facet: the products added, and what was proved with them."""

    pairs: Int[np.ndarray, "p 2"]
    judged: Judged

    @property
    def solution(self) -> Solution:
        """What the solver proposed."""
        return self.judged.proposal

    @property
    def offset(self) -> float:
        """What is proved."""
        return float(self.judged.value[0])

    @property
    def is_optimal(self) -> bool:
        """Whether the offset is the solver's optimum, to its tolerance."""
        solved = int(self.solution.statuses[0]) == SolverStatus.SOLVED
        return solved and bool(self.judged.optimal[0])

    @property
    def idle(self) -> np.ndarray:
        """Which of the products added have a multiplier at zero."""
        return idle(np.asarray(self.solution.multipliers[0]), len(self.pairs))

    @property
    def in_use(self) -> Int[np.ndarray, "q 2"]:
        """The products added that have a multiplier."""
        return self.pairs[~self.idle]


def _facet(
    program: Program,
    pool: CutPool,
    solver: AbstractSolver,
    rounds: Rounds,
    attained: Callable[[Float[np.ndarray, " n"]], float] | None,
    pairs: Int[np.ndarray, "p 2"],
) -> _Round:
    """The best round of one facet."""
    size = float(interval_offsets(program)[0] - program.objective.mid[0, -1])
    transform = np.asarray(program.transform)
    found: list[_Round] = []

    def solve(pairs: np.ndarray) -> Shown:
        given = program.replace(products=joint(pool.core, pairs))
        found.append(_Round(pairs, judged_offsets(given, proposed(solver, given))))
        moment = np.asarray(found[-1].solution.moments[0])
        if attained is None:
            return Shown(moment, found[-1].idle)
        least = min(each.offset for each in found)
        gap = least - attained(transform @ moment[:, -1])
        return Shown(moment, found[-1].idle, enough=gap <= (rounds.cuts.gap or 0.0) * size)

    in_rounds(pool, rounds, pairs, solve)
    least = min(each.offset for each in found)
    near = [each for each in found if each.offset <= least + NEAR * size]
    best = max(near, key=lambda each: each.is_optimal)  # the first that is, if any is
    seconds = np.sum([each.solution.seconds for each in found], axis=0)
    spent = best.judged._replace(proposal=best.solution._replace(seconds=seconds))
    return best._replace(judged=spent)


def _unsolved(program: Program, pool: CutPool) -> _Round:
    """What is proved of a facet without a solver, when the time is over."""
    given = program.replace(products=joint(pool.core, NONE))
    return _Round(NONE, judged_offsets(given, Solution.blank_for(given)))


def _joined(program: Program, pool: CutPool, found: list[_Round]) -> tuple[Products, Judged]:
    """All facets over the products that any of them has."""
    pairs = np.unique(np.concatenate([each.pairs for each in found]), axis=0)
    number = {tuple(pair): i for i, pair in enumerate(pairs)}
    products, core = joint(pool.core, pairs), len(pool.core.free)
    solution = Solution.blank(len(found), len(products.free), len(program.transform))
    held = np.zeros_like(solution.multipliers)
    for i, each in enumerate(found):
        mine = each.solution
        places = np.array([number[tuple(pair)] for pair in each.pairs], dtype=int)
        there = np.r_[np.arange(core), core + places]
        solution.multipliers[i, there] = mine.multipliers[0]
        held[i, there] = each.judged.held.multipliers[0]
        solution.offsets[i], solution.statuses[i] = mine.offsets[0], mine.statuses[0]
        solution.moments[i], solution.seconds[i] = mine.moments[0], mine.seconds[0]
    # proved with all products, which are in another order and so round otherwise
    whole = program.replace(products=products)
    again = np.fmin(sound_offsets(whole, np.asarray(solution.multipliers)), interval_offsets(whole))
    moments = np.concatenate([each.judged.held.moments for each in found])
    return products, Judged(
        value=np.fmax(np.array([each.offset for each in found]), again),
        optimal=np.array([each.judged.optimal[0] for each in found]),
        held=Held(held, moments),
        proposal=solution,
    )
