"""Sets of a template around the states of each step, each facet by the cheapest proof of it.

A facet climbs the ladder of `BranchAndCut` only while its gap is open: the gap between what is
proved and what a trajectory attains. All but the last rung go back to the initial set. What the
facets of a step prove bounds the units of the next one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from reachjax.loops import ClosedLoop
from reachjax.loops.scenarios import Scenarios
from reachjax.methods.ladder import WORK, Ladder, StepBounds, Target
from reachjax.methods.problem import AbstractMethod, Problem, ReachSet, at
from reachjax.methods.recursion import facets_by_products, setting_of
from reachjax.methods.steps import Step, overflow
from reachjax.methods.witnesses import Simulated
from reachjax.numerics.budget import Budget
from reachjax.numerics.checks import is_concrete, owned
from reachjax.numerics.derivatives import moved_by
from reachjax.programs.held import attained, held_bounds, sources
from reachjax.programs.moving import Moving, moving
from reachjax.programs.relaxations import BranchAndCut
from reachjax.proofs.branches import BranchCertificate, Rung
from reachjax.proofs.by_products import Certificate
from reachjax.proofs.gradients import Replay, replayed
from reachjax.proofs.proposal import SolverStatus
from reachjax.sets import Box, Polytope
from reachjax.solvers import AbstractSolver, Auto

PRODUCTS = 2.5e7
"""The fourth power of the horizon's columns, of all facets that get products: some tens of seconds.

A window that has fewer begins at a certified set, and hardly proves more than is known.
"""

LARGEST = 100
"""Columns of the horizon from which on no facet gets products, whatever the time."""


@dataclasses.dataclass(frozen=True)
class Branching(AbstractMethod):
    """The ladder of `BranchAndCut`: forms, linear programs, splits by phases, products.

    Attributes:
        relaxation: how many linear programs a facet may take, and the rounds of products.
        solver: what solves the semidefinite programs of products.
    """

    relaxation: BranchAndCut = BranchAndCut()  # noqa: RUF009  (immutable)
    solver: AbstractSolver = Auto()  # noqa: RUF009

    def sets(self, problem: Problem, known: Sequence[ReachSet] = ()) -> Iterator[ReachSet]:
        """The smallest sets that are proved within the problem's gap, nodes and budget."""
        problem.require_numbers()
        setting = setting_of(problem, self.relaxation, None, self.solver)
        X0, box, horizon = problem.X0, problem.box, problem.horizon
        loop, begun, around = jax.device_get(jax.lax.stop_gradient((problem.loop, X0, box)))
        given = problem.budget
        timed = given.timed or given.work < np.inf  # then that is the budget
        of_programs, work = (given.work, np.inf) if timed else (WORK, PRODUCTS)
        budget = given.with_work(of_programs)
        scenarios = Scenarios.of(loop, begun, horizon, problem.start)
        limits = self.relaxation.nodes, budget, problem.note
        ladder = Ladder(loop, begun, around, scenarios, problem.start, *limits)
        X, steps, ends = X0, list[Step](), list[Array | np.ndarray]()
        for k, (region, proof, *_) in enumerate(known, start=1):
            steps.append(Step(setting, X, k - 1, tuple(steps)))
            X = region
            ladder.repeat(proof)
            if isinstance(proof, BranchCertificate):
                ladder.spend(int(np.sum(proof.nodes)))
                work -= len(proof.by_products) * ladder.width**4
            ends.append(ladder.narrow(X))
        left = (horizon - len(known)) / horizon
        budget.grant(left * of_programs)
        work = max(work, left * PRODUCTS)
        for k in range(len(known) + 1, horizon + 1):
            share = budget.share(1 / (horizon - k + 1))
            steps.append(Step(setting, X, k - 1, tuple(steps)))
            directions = problem.facets.at(k).directions
            rows = np.asarray(jax.lax.stop_gradient(directions))
            ladder.advance(budget=share)
            target = self._target(problem, ladder, k, rows, scenarios.middle(around.center))
            half = share.share(1 / 2)  # the other one is for products
            climbed = ladder.bounds(target, (horizon - k) * len(rows), half)
            if not np.isfinite(climbed.bounds).all():
                raise overflow(problem.start + k)
            offsets = owned(climbed.bounds)
            if not is_concrete(problem.loop, X0, directions):
                moving = _moving(problem, box, directions, climbed, ladder, ends)
                offsets = moved_by(offsets, moving)
            gaps = climbed.bounds - climbed.attained
            opened = np.flatnonzero(~target.closed(climbed.bounds, climbed.attained))
            opened = opened[np.argsort(-gaps[opened], kind="stable")]
            products = None
            if ladder.width <= LARGEST and not loop.curved and not share.late:
                cost = ladder.width**4
                opened = opened[: int(min(work / cost, len(opened)))]
                work -= len(opened) * cost
            else:
                opened = opened[:0]
            if len(opened):
                problem.note(f"products for {len(opened)} facets, largest gap {gaps.max():.1e}")
                offsets, products = _with_products(steps[-1], directions, offsets, opened, share)
            X = Polytope(directions, offsets)
            found = np.asarray(jax.lax.stop_gradient(offsets))
            shut = target.closed(found, climbed.attained)
            codes = np.where(shut, int(SolverStatus.SOLVED), climbed.codes)
            proof = _certificate(climbed, codes, offsets, products, opened, share.elapsed)
            proof = proof.replace(ranges=tuple(ladder.horizon.tightened), time=problem.start + k)
            worst = climbed.ended if problem.levels is None else ladder.scenarios_of(climbed)
            yield ReachSet(X, proof, at(k), worst)
            ends.append(ladder.narrow(X))

    def adds_to_forms(self, loop: ClosedLoop) -> bool:
        """Where units switch, of which linear programs know more."""
        units = (layer.unit for layer in loop.unit_layers)
        smooth = (unit.curved and unit.inputs == 1 for unit in units)
        return self.relaxation.nodes > 0 and not all(smooth)

    @staticmethod
    def _target(
        problem: Problem,
        ladder: Ladder,
        k: int,
        rows: Float[np.ndarray, "f n_x"],
        middle: Float[np.ndarray, " s"],
    ) -> Target:
        """What bounds are sought after `k` steps."""
        if problem.levels is not None:
            return ladder.below(rows, problem.levels[k - 1], middle)
        simulated = Simulated.nothing(middle, len(rows))
        if problem.simulations is not None:
            simulated = problem.simulations.values(k, rows)
        return ladder.facets(rows, simulated, problem.gap)


def _moving(
    problem: Problem,
    box: Box,
    directions: Float[Array, "f n_x"],
    climbed: StepBounds,
    ladder: Ladder,
    known: Sequence[Float[Array | np.ndarray, "2 n_x"]],
) -> Float[Array, " f"]:
    """Numbers with the derivatives of what is proved.

    Where trajectories attain all of it, theirs; else those of forms and of the facts that decide:
    forms of smooth loops leave something out.
    """
    loop, X0, horizon = problem.loop, problem.X0, problem.horizon
    k, begun = len(ladder.horizon.steps), ladder.horizon
    columns, multipliers, witnessed = ladder.where_attained(climbed)
    if witnessed.all():
        held = Replay.of(begun, columns, multipliers, horizon)
        return replayed(loop, X0, box, directions, held, k, problem.start)
    rows = climbed.about.rows
    bounds = sources(begun.start, rows, climbed.bounds, None)
    for i in np.flatnonzero(witnessed | (climbed.rungs != Rung.AFFINE_FORM)):
        bounds[i] = attained(begun, rows[i : i + 1], multipliers[i], columns[i])
    ends = [*known, *[jnp.zeros((2, len(directions.T)))] * (horizon - len(known))]
    held = held_bounds(begun, bounds, horizon)
    parts = Moving(loop, X0, box, directions, jnp.stack(ends))
    return moving(parts, held, k, problem.start)


def _with_products(
    step: Step,
    directions: Float[Array, "f n_x"],
    offsets: Float[Array, " f"],
    opened: np.ndarray,
    budget: Budget,
) -> tuple[Float[Array, " f"], Certificate]:
    """The better of what is proved and what products prove of some facets within a budget."""
    found, proof = facets_by_products(step, directions[opened], budget)
    better = found < offsets[opened]
    return offsets.at[opened].set(jnp.where(better, found, offsets[opened])), proof


def _certificate(
    climbed: StepBounds,
    codes: Int[np.ndarray, " f"],
    offsets: Float[Array, " f"],
    products: Certificate | None,
    opened: np.ndarray,
    seconds: float,
) -> BranchCertificate:
    """The proof of all facets; witnesses are not known yet."""
    facets, rungs = len(climbed.bounds), climbed.rungs.copy()
    better = np.asarray(jax.lax.stop_gradient(offsets)) < climbed.bounds
    rungs[better] = Rung.PRODUCTS
    beside_forms = better & (codes == SolverStatus.AFFINE_FORM)
    codes = np.where(beside_forms, int(SolverStatus.STALLED), codes)
    return BranchCertificate(
        codes=codes,
        bounds=offsets,
        witnesses=np.full(facets, np.nan),
        witness_states=np.full((facets, 0), np.nan),
        seconds=np.full(facets, seconds / facets),
        about=climbed.about,
        branches=climbed.branches,
        products=products,
        by_products=opened,
        rungs=rungs,
        nodes=climbed.nodes,
    )
