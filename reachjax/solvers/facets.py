"""The offsets of facets: problem (sdp::poly), one optimal value for each."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float, Int

from reachjax.numerics.pytrees import pytree
from reachjax.programs.lmi import Program, Slopes, inequality_slopes
from reachjax.programs.presolve import Generators, NormalProgram, Pencil, Shape, presolved
from reachjax.programs.relaxations import Products
from reachjax.proofs.by_products import Certificate
from reachjax.proofs.gradients import held_offsets
from reachjax.proofs.proposal import Proposal, SolverStatus
from reachjax.proofs.recheck import clipped, interval_offsets, proved_offsets, sound_offsets
from reachjax.proofs.reported import Judged, judged_offsets
from reachjax.sets import Polytope
from reachjax.solvers.base import AbstractSolver, proposed
from reachjax.solvers.cutting_planes import NONE, CutPool, Rounds, Shown, idle, in_rounds, joint
from reachjax.solvers.goals import AbstractGoal

NEAR = 1e-9
"""Offsets that differ by less, in parts of the facet's interval, are equally good."""


@pytree
class Facets(AbstractGoal):
    """The smallest offset for each facet: `b` of `directions x+ <= b`.

    Attributes:
        directions: `(f, n_x)`.
    """

    directions: Float[Array, "f n_x"]

    named: ClassVar[str] = "facet {}"

    def rows(self, states: int) -> Float[Array, "f n_x"]:
        """The directions of the facets."""
        return self.directions

    def shape(self, program: Program) -> Shape:
        """A program for each facet, of one unknown."""
        facets, size = program.objective.mid.shape
        return Shape(facets, 1, size)

    def pencil(self, program: Program) -> Pencil:
        """`Z = 2 b e e' - p e' - e p' - F' Gamma F` for facets of unit 1-norm around zero."""
        normal = presolved(program)
        e = np.eye(normal.objective.shape[1])[-1:]
        corner = Generators(e, np.array([0]), np.array([0]), sp.csr_array([[2.0]]))
        return Pencil(
            normal=normal,
            terms=normal.generators.below(corner),
            constant=lambda i: -(e.T * normal.objective[i] + normal.objective[i][:, None] * e),
            sizes=np.full((1, 1, 1), -1.0),
            units=normal.units,
        )

    def absolute(
        self, normal: NormalProgram, i: int, unknowns: Float[np.ndarray, " u"]
    ) -> Float[np.ndarray, " u"]:
        """The offset, from that around the middle of the facet's interval."""
        return normal.centers[i] + unknowns

    def unknown(self, program: Program) -> Judged:
        """No offsets: NaN."""
        unknown = np.full(len(program.objective.mid), np.nan)
        nothing = np.zeros(len(unknown), dtype=bool)
        return Judged(unknown, nothing, nothing, Proposal.blank(program, self))

    def judged(self, program: Program, solver: AbstractSolver) -> Judged:
        """Offsets that are proved with what the solver proposes."""
        return judged_offsets(program, proposed(solver, program, self))

    def in_rounds(
        self, program: Program, solver: AbstractSolver, rounds: Rounds
    ) -> tuple[Products, Judged]:
        """Each facet has its own products, and begins with those that the one before used."""
        pool = CutPool(program, rounds.layout)
        found, pairs = list[_Round](), pool.addable(rounds.warm_start)
        for facet in range(len(program.objective.mid)):
            one = program.with_objective(slice(facet, facet + 1))
            if rounds.budget.late:
                given = one.replace(products=joint(pool.core, NONE))
                late = judged_offsets(given, Proposal.blank(given, self))
                found.append(_Round(NONE, late, np.zeros(0, dtype=bool)))
            else:
                attained = None if rounds.witness is None else partial(rounds.witness, facet)
                found.append(self._best(one, pool, solver, rounds, attained, pairs))
            pairs = found[-1].pairs[~found[-1].idle]
        return self._joined(program, pool, found)

    def _best(
        self,
        program: Program,
        pool: CutPool,
        solver: AbstractSolver,
        rounds: Rounds,
        attained: Callable[[Float[np.ndarray, " n"]], float] | None,
        pairs: Int[np.ndarray, "p 2"],
    ) -> _Round:
        """The best round of one facet, that begins with these pairs."""
        size = float(interval_offsets(program)[0] - program.objective.mid[0, -1])
        enough = (rounds.cuts.gap or 0.0) * size
        found: list[_Round] = []

        def solve(pairs: np.ndarray) -> Shown:
            judged = self.judged(program.replace(products=joint(pool.core, pairs)), solver)
            resting = idle(judged.proposal.multipliers[0], len(pairs))
            found.append(_Round(pairs, judged, resting))
            moment = judged.proposal.moments[0]
            if attained is None:
                return Shown(moment, resting)
            gap = min(each.offset for each in found) - attained(program.transform @ moment[:, -1])
            return Shown(moment, resting, gap <= enough)

        in_rounds(pool, rounds, pairs, solve)
        least = min(each.offset for each in found)
        near = [each for each in found if each.offset <= least + NEAR * size]
        best = max(near, key=lambda each: each.is_optimal)  # the first that is, if any is
        seconds = np.sum([each.judged.proposal.seconds for each in found], axis=0)
        proposal = best.judged.proposal._replace(seconds=seconds)
        return best._replace(judged=best.judged._replace(proposal=proposal))

    def _joined(
        self, program: Program, pool: CutPool, found: list[_Round]
    ) -> tuple[Products, Judged]:
        """All facets over the products that any of them has."""
        pairs = np.unique(np.concatenate([each.pairs for each in found]), axis=0)
        number = {tuple(pair): i for i, pair in enumerate(pairs)}
        products, core, own = joint(pool.core, pairs), len(pool.core.free), []
        for added, judged, _ in found:
            places = np.array([number[tuple(pair)] for pair in added], dtype=int)
            multipliers = np.zeros((1, len(products.free)))
            there = np.r_[np.arange(core), core + places]
            multipliers[:, there] = judged.proposal.multipliers
            proposal = judged.proposal._replace(multipliers=multipliers)
            own.append(judged._replace(proposal=proposal))
        judged = jax.tree.map(lambda *parts: np.concatenate(parts), *own)
        # proved with all products, which are in another order and so round otherwise
        whole = program.replace(products=products)
        again = proved_offsets(whole, judged.proposal.multipliers)
        return products, judged._replace(value=np.fmax(judged.value, again))

    def slopes(
        self, program: Program, judged: Judged, cotangent: Float[np.ndarray, " f"]
    ) -> tuple[Slopes, Facets]:
        """Slopes of the Lagrangian; the rows carry what the directions do."""
        multipliers = clipped(program, np.asarray(judged.proposal.multipliers))
        moments, held = np.array(judged.proposal.moments), np.flatnonzero(~judged.held)
        if len(held):
            own, weights = program.with_objective(held), multipliers[held]
            used = sound_offsets(own, weights) < interval_offsets(own)
            multipliers[held], moments[held] = held_offsets(own, weights, used)
        nothing: Any = np.zeros_like(self.directions)
        return offset_slopes(program, multipliers, moments, cotangent), Facets(nothing)

    def region(self, value: Float[Array, " f"]) -> Polytope:
        """`directions x <= b`."""
        return Polytope(self.directions, value)

    def certificate(
        self, program: Program, value: Float[Array, " f"], proposal: Proposal
    ) -> Certificate:
        """The proof of the offsets."""
        claims = proposal.unknowns[:, 0]
        return Certificate.of(program, proposal, bounds=value, solver_offsets=claims)


def offset_slopes(
    program: Program,
    multipliers: Float[np.ndarray, "f K"],
    moments: Float[np.ndarray, "f n n"],
    weights: Float[np.ndarray, " f"],
) -> Slopes:
    """The derivative of `<weights, offsets>`, multipliers and moments being held.

    An offset moves by half of what its matrix `Z` misses at the moments.
    """
    corner = slice(len(program.transform) - 1, None)
    facts, objective = np.zeros_like(program.facts.mid), np.zeros_like(program.objective.mid)
    for i in np.flatnonzero(weights):
        slopes = inequality_slopes(program, multipliers[i], moments[i], corner)
        facts -= weights[i] / 2 * slopes.facts
        objective[i] = weights[i] / 2 * slopes.objective[0]
    return Slopes(facts, objective)


class _Round(NamedTuple):
    """One round of one facet: the products added, what was proved, and which are at zero."""

    pairs: Int[np.ndarray, "p 2"]
    judged: Judged
    idle: Bool[np.ndarray, " p"]

    @property
    def offset(self) -> float:
        """What is proved."""
        return float(self.judged.value[0])

    @property
    def is_optimal(self) -> bool:
        """Whether the offset is the solver's optimum, to its tolerance."""
        solved = int(self.judged.proposal.statuses[0]) == SolverStatus.SOLVED
        return solved and bool(self.judged.optimal[0])
