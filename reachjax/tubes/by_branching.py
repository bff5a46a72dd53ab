"""Sets of a template around the states of each step, each facet by the cheapest proof of it.

A facet climbs the ladder of `BranchAndCut` only while its gap is open: the gap between what is
proved and what a trajectory attains. All but the last rung go back to the initial set. What the
facets of a step prove bounds the units of the next one.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from reachjax.loops.scenarios import Scenarios
from reachjax.numerics.budget import Budget
from reachjax.numerics.checks import is_concrete, owned
from reachjax.numerics.derivatives import moved_by
from reachjax.programs.held import attained, held_bounds, sources
from reachjax.programs.moving import Moving, moving
from reachjax.proofs.branches import BranchCertificate, Rung
from reachjax.proofs.facets import Certificate
from reachjax.proofs.proposal import SolverStatus
from reachjax.proofs.replayed import Replay, replayed
from reachjax.proofs.witnesses import Simulated
from reachjax.sets import AbstractSet, Box, Polytope, Template
from reachjax.tubes.ladder import WORK, Ladder, StepBounds
from reachjax.tubes.steps import Reached, Setting, Step, overflow
from reachjax.tubes.successors import facets_by_products

PRODUCTS = 2.5e7
"""The fourth power of the horizon's columns, of all facets that get products: some tens of seconds.

A window that has fewer begins at a certified set, and hardly proves more than is known.
"""

LARGEST = 100
"""Columns of the horizon from which on no facet gets products, whatever the time."""


def sets_by_branching(
    setting: Setting,
    nodes: int,
    X0: AbstractSet,
    box: Box,
    template: Template,
    horizon: int,
    known: Sequence[Reached] = (),
) -> Iterator[Reached]:
    """The smallest sets that are proved within the setting's gap, nodes and time.

    Args:
        setting: what all steps have in common.
        nodes: how many linear programs a facet may take.
        X0: the initial set.
        box: around it.
        template: what the sets look like.
        horizon: how many steps there are.
        known: the first ones.

    Raises:
        ValueError: states overflow.
    """
    loop, begun, around = jax.device_get(jax.lax.stop_gradient((setting.loop, X0, box)))
    timed = setting.budget.timed  # then that is the budget
    of_programs, work = (np.inf, np.inf) if timed else (WORK, PRODUCTS)
    budget = setting.budget.with_work(of_programs)
    scenarios = Scenarios.of(loop, begun, horizon, setting.start)
    ladder = Ladder(loop, begun, around, scenarios, setting.start, nodes, budget, setting.note)
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
        began = time.perf_counter()
        steps.append(Step(setting, X, k - 1, tuple(steps)))
        directions = template.at(k).directions
        rows = np.asarray(jax.lax.stop_gradient(directions))
        share = budget.share(1 / (horizon - k + 1))
        ladder.advance(budget=share)
        simulated = Simulated.nothing(scenarios.middle(around.center), len(rows))
        if setting.simulations is not None:
            simulated = setting.simulations.values(k, rows)
        target, ranges = ladder.facets(rows, simulated, setting.gap)
        half = share.share(1 / 2)  # the other one is for products
        climbed = ladder.bounds(target, (horizon - k) * len(rows), half)
        if not np.isfinite(climbed.bounds).all():
            raise overflow(setting.start + k)
        offsets = proved = owned(climbed.bounds)
        if not is_concrete(setting.loop, X0, directions):
            moving = _moving(setting, X0, box, directions, climbed, ladder, ends, horizon)
            offsets = moved_by(proved, moving)
        gaps = climbed.bounds - climbed.attained
        opened = np.flatnonzero(gaps > setting.gap * ranges)
        opened = opened[np.argsort(-gaps[opened], kind="stable")]
        products = None
        if ladder.width <= LARGEST and not loop.curved and not share.late:
            cost = ladder.width**4
            opened = opened[: int(min(work / cost, len(opened)))]
            work -= len(opened) * cost
        else:
            opened = opened[:0]
        if len(opened):
            setting.note(f"products for {len(opened)} facets, largest gap {gaps.max():.1e}")
            offsets, products = _with_products(steps[-1], directions, offsets, opened, share)
        X = Polytope(directions, offsets)
        seconds = time.perf_counter() - began
        shut = np.asarray(jax.lax.stop_gradient(offsets)) - climbed.attained <= setting.gap * ranges
        codes = np.where(shut, int(SolverStatus.SOLVED), climbed.codes)
        proof = _certificate(climbed, codes, offsets, products, opened, seconds).replace(
            ranges=tuple(ladder.horizon.tightened), time=setting.start + k
        )
        yield Reached(X, proof, climbed.ended, climb=False)
        ends.append(ladder.narrow(X))


def _moving(
    setting: Setting,
    X0: AbstractSet,
    box: Box,
    directions: Float[Array, "f n_x"],
    climbed: StepBounds,
    ladder: Ladder,
    known: Sequence[Float[Array | np.ndarray, "2 n_x"]],
    horizon: int,
) -> Float[Array, " f"]:
    """Numbers with the derivatives of what is proved.

    Where trajectories attain all of it, theirs; else those of forms and of the facts that decide:
    forms of smooth loops leave something out.
    """
    k, begun = len(ladder.horizon.steps), ladder.horizon
    columns, multipliers, witnessed = ladder.where_attained(climbed)
    if witnessed.all():
        held = Replay.of(begun, columns, multipliers, horizon)
        return replayed(setting.loop, X0, box, directions, held, k, setting.start)
    rows = climbed.about.rows
    bounds = sources(begun.start, rows, climbed.bounds, None)
    for i in np.flatnonzero(witnessed | (climbed.rungs != Rung.AFFINE_FORM)):
        bounds[i] = attained(begun, rows[i : i + 1], multipliers[i], columns[i])
    ends = [*known, *[jnp.zeros((2, len(directions.T)))] * (horizon - len(known))]
    held = held_bounds(begun, bounds, horizon)
    parts = Moving(setting.loop, X0, box, directions, jnp.stack(ends))
    return moving(parts, held, k, setting.start)


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
