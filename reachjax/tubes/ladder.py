"""The ladder of `BranchAndCut` over one horizon: affine forms, linear programs, splits.

Everything here is numpy on the host. It proposes leaves; what they prove, `proofs.branches` says.
"""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from reachjax.loops import ClosedLoop
from reachjax.loops.batches import trajectories
from reachjax.programs.affine import AffineForms
from reachjax.programs.horizon import Horizon
from reachjax.proofs.branches import Branches, HorizonFacts, Rung, bounds_of, leaf_bounds
from reachjax.proofs.witnesses import Simulated
from reachjax.sets import AbstractSet, Box
from reachjax.solvers.branching import Found, affine_leaf, branched, settled
from reachjax.solvers.conic_programs import ConicPrograms
from reachjax.solvers.linear_programs import LinearPrograms

FLAT = 1e-6
"""A facet's range counts as this part of what affine forms say, at least."""

LEAST_NODES = 8
"""What each facet may take, whatever the others took."""

WORK = 3e6
"""Rows and columns of all linear programs of a tube, in all: some tens of seconds."""


class Climbed(NamedTuple):
    """What the first three rungs prove of some facets of one step.

    Attributes:
        about: rows over the columns of the horizon.
        branches: the leaves.
        bounds: `(f,)`, what they prove.
        attained: `(f,)`, the largest values of trajectories that were met on the way.
        gaps: `(f,)`, what is between them, as parts of the facets' ranges.
        columns: `(f, n)`, where the leaf that decides attains its bound.
        multipliers: `(f, m)`, of that leaf.
        worst: `(f, n_x)`, the initial states of what is attained.
        rungs: `(f,)`, values of `Rung`.
        nodes: `(f,)`, how many linear programs were solved.
        states: `(c, n_x)`, initial states at which they ended.
    """

    about: HorizonFacts
    branches: Branches
    bounds: Float[np.ndarray, " f"]
    attained: Float[np.ndarray, " f"]
    gaps: Float[np.ndarray, " f"]
    columns: Float[np.ndarray, "f n"]
    multipliers: Float[np.ndarray, "f m"]
    worst: Float[np.ndarray, "f n_x"]
    rungs: Int[np.ndarray, " f"]
    nodes: Int[np.ndarray, " f"]
    states: Float[np.ndarray, "c n_x"]


class Ladder:
    """The horizon and its linear programs, step after step.

    Args:
        loop: of numpy arrays.
        X0: the initial set, of numpy arrays.
        box: around it.
        t: the time of the initial set.
        nodes: how many linear programs a facet may take.
        gap: what may stay open of a facet, as a part of its range.
        deadline: after which nothing is solved, as `time.monotonic` says it.

    Attributes:
        horizon: forms and facts.
    """

    def __init__(
        self,
        loop: ClosedLoop,
        X0: AbstractSet,
        box: Box,
        t: int,
        nodes: int,
        gap: float,
        deadline: float,
    ):
        self._loop, self._t = loop, t
        self._nodes, self._gap, self._deadline = nodes, gap, deadline
        self._work = WORK
        self.horizon = Horizon(loop, X0, box, t)
        start = self.horizon.start
        columns = start.spread.shape[1]
        self._programs = (
            ConicPrograms(columns) if start.round else LinearPrograms(columns, start.cut is None)
        )

    @property
    def late(self) -> bool:
        """Whether the time is over."""
        return time.monotonic() >= self._deadline

    def advance(self) -> None:
        """One step more, the ranges of units being bounded by linear programs."""
        self.horizon.advance(self._ranges if self._nodes else None)

    def _ranges(self, forms: AffineForms) -> Float[np.ndarray, "k m"]:
        """Multipliers that bound the inputs of units from both sides."""
        facts = self.horizon.facts
        self._programs.grow(facts, self.horizon.varying)
        found = np.zeros((len(forms.rows), len(facts.rows)))
        for row, constant, multipliers in zip(forms.columns, forms.rows, found, strict=True):
            if self.late or self._work <= 0:
                break
            self._spend(1)
            vertex = self._programs.largest(row[None], constant[:1], ())
            if vertex is not None and len(vertex.columns):
                multipliers[:] = np.maximum(vertex.multipliers, 0.0)
        return found

    def _spend(self, programs: int) -> None:
        self._work -= programs * self._size

    @property
    def _size(self) -> int:
        """Rows and columns of a linear program."""
        return len(self.horizon.facts.rows) + len(self.horizon.varying)

    def climbed(
        self,
        directions: Float[np.ndarray, "f n_x"],
        simulated: Simulated,
        left: int,
    ) -> Climbed:
        """Bounds of directions of the state after the steps so far.

        Args:
            directions: one row a facet.
            simulated: what is known of their values.
            left: how many facets are to come in later steps.
        """
        horizon, start = self.horizon, self.horizon.start
        facts = horizon.facts
        self._programs.grow(facts, horizon.varying)
        forms = (directions @ horizon.state).widened(facts.columns.shape[1])
        lower, upper = forms.ends(start)
        floor = FLAT * (upper - lower) / 2
        ranges = np.fmax((simulated.most - simulated.least) / 2, floor)
        best, worst, states = simulated.most.copy(), simulated.states.copy(), []
        found: list[Found] = []
        for facet in range(len(directions)):

            def attained(columns: list[np.ndarray], facet: int = facet) -> float:
                begun = self._initial(np.array(columns))
                states.extend(begun)
                after = trajectories(self._loop, begun, len(horizon.steps), self._t)[:, -1]
                values = after @ directions[facet]
                if np.fmax.reduce(values) > best[facet]:
                    best[facet], worst[facet] = np.nanmax(values), begun[np.nanargmax(values)]
                return float(best[facet])

            def enough(bound: float, attained: float, facet: int = facet) -> bool:
                return self.late or bound - attained <= self._gap * ranges[facet]

            one = forms[facet : facet + 1]
            budget = self._budget(left + len(directions) - facet)
            leaves = None
            if budget and np.isfinite(upper[facet]) and not enough(upper[facet], best[facet]):
                leaves = branched(horizon, self._programs, one, attained, enough, budget)
                self._spend(leaves.nodes if leaves else 1)
            found.append(leaves or affine_leaf(one, horizon))
        return self._judged(forms, upper, (best, worst), ranges, found, states)

    def settled(
        self, climbed: Climbed
    ) -> tuple[Float[np.ndarray, "f n"], Float[np.ndarray, "f m"]]:
        """Columns and multipliers that derivatives of the bounds hold."""
        found = climbed.multipliers.copy()
        columns, leaves = climbed.columns.copy(), climbed.branches
        for facet in range(len(found)):
            form, mine = climbed.about.rows[facet : facet + 1], leaves.owner == facet
            at = self.horizon.columns_at(climbed.worst[facet])
            given = settled(self.horizon, self._programs, form, at, leaves.phases[mine])
            if given is not None:
                found[facet], columns[facet] = given, at
        return columns, found

    def _budget(self, facets: int) -> int:
        """How many linear programs one of so many facets may take."""
        if self._work <= 0:
            return 0
        affordable = int(2 * self._work / (facets * sum(self.horizon.facts.rows.shape)))
        return min(self._nodes, max(LEAST_NODES, affordable))

    def _initial(self, columns: Float[np.ndarray, "c n"]) -> Float[np.ndarray, "c n_x"]:
        start = self.horizon.start
        return start.center + columns[:, : start.spread.shape[1]] @ start.spread.T

    def _judged(
        self,
        forms: AffineForms,
        upper: np.ndarray,
        attained: tuple[np.ndarray, np.ndarray],
        ranges: np.ndarray,
        found: list[Found],
        states: list[np.ndarray],
    ) -> Climbed:
        """What the leaves prove."""
        (best, worst), horizon, facets = attained, self.horizon, len(found)
        owner = np.repeat(np.arange(facets), [len(each.phases) for each in found])
        leaves = Branches(
            owner=owner,
            phases=np.concatenate([each.phases for each in found]),
            multipliers=np.concatenate([each.multipliers for each in found]),
            weights=np.eye(facets)[owner],
        )
        about = HorizonFacts(horizon.start, horizon.facts, horizon.zero, forms)
        each = leaf_bounds(about, leaves)
        bounds = np.fmin(bounds_of(about, leaves, facets), upper)
        deciding = np.array(
            [np.flatnonzero(owner == k)[each[owner == k].argmax()] for k in range(facets)]
        )
        nodes = np.array([leaf.nodes for leaf in found])
        rungs = np.where(nodes > 1, Rung.PHASE_SPLITS, Rung.LINEAR_PROGRAM)
        rungs = np.where(nodes == 0, Rung.AFFINE_FORM, rungs)
        return Climbed(
            about=about,
            branches=leaves,
            bounds=bounds,
            attained=best,
            gaps=(bounds - best) / np.where(ranges > 0, ranges, 1.0),
            columns=np.concatenate([leaf.columns for leaf in found])[deciding],
            multipliers=leaves.multipliers[deciding],
            worst=worst,
            rungs=rungs,
            nodes=nodes,
            states=np.array(states).reshape(-1, len(horizon.start.center)),
        )
