"""The ladder of `BranchAndCut` over one horizon: affine forms, linear programs, splits.

Everything here is numpy on the host. It proposes leaves; what they prove, `proofs.branches` says.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.linalg import block_diag

from reachjax.loops import ClosedLoop
from reachjax.loops.scenarios import Scenarios
from reachjax.methods.witnesses import Simulated, in_blocks
from reachjax.numerics.budget import Budget
from reachjax.numerics.checks import is_concrete
from reachjax.numerics.rounding import namespace
from reachjax.programs.affine import AffineForms
from reachjax.programs.horizon import Horizon, joined
from reachjax.proofs.branches import (
    BranchCertificate,
    Branches,
    HorizonFacts,
    Rung,
    bounds_of,
    leaf_bounds,
)
from reachjax.proofs.certificates import AbstractProof
from reachjax.proofs.proposal import SolverStatus
from reachjax.sets import AbstractSet, Box
from reachjax.solvers.branching import Found, Tree, affine_leaf, attained_multipliers
from reachjax.solvers.linear_programs import ConicPrograms, LinearPrograms

LEAST_RANGE = 1e-6
"""A facet's range counts as this part of what affine forms say, at least."""

TURN = 200
"""How many linear programs a tree is grown by before others have their turn."""

WORK = 1e9
"""Rows and columns, squared, of all linear programs of a tube: half a minute where measured."""

ROUNDED = 1e-10
"""Gaps below this part of a bound are of rounding."""


class Target(NamedTuple):
    """What bounds are sought of one step, each of a form or of the least of several.

    Attributes:
        forms: of each bound.
        values: `(c, n_x) -> (c, g)`, what states have of it; None where nothing is simulated.
        enough: whether a bound will do, given its number, itself, and what is attained.
        simulated: what is known of their values.
    """

    forms: Sequence[AffineForms]
    values: Callable[[np.ndarray], np.ndarray] | None
    enough: Callable[[int, float, float], bool]
    simulated: Simulated

    def closed(
        self, bounds: Float[np.ndarray, " g"], attained: Float[np.ndarray, " g"]
    ) -> Bool[np.ndarray, " g"]:
        """Which bounds will do."""
        pairs = enumerate(zip(bounds, attained, strict=True))
        return np.array([self.enough(number, *pair) for number, pair in pairs], bool)


class StepBounds(NamedTuple):
    """Bounds of one step that the first three rungs prove.

    Attributes:
        about: rows over the columns of the horizon.
        branches: the leaves.
        bounds: `(g,)`, what they prove.
        attained: `(g,)`, the largest values that are known to be attained.
        worst: `(g, s)`, the scenarios of these.
        columns: `(g, n)`, where the leaf that decides attains its bound.
        multipliers: `(g, m)`, of that leaf.
        rungs: `(g,)`, values of `Rung`.
        nodes: `(g,)`, how many linear programs were solved.
        codes: `(g,)`, how the search for each ended, as values of `SolverStatus`.
        ended: `(c, s)`, scenarios at which they ended.
    """

    about: HorizonFacts
    branches: Branches
    bounds: Float[np.ndarray, " g"]
    attained: Float[np.ndarray, " g"]
    worst: Float[np.ndarray, "g s"]
    columns: Float[np.ndarray, "g n"]
    multipliers: Float[np.ndarray, "g m"]
    rungs: Int[np.ndarray, " g"]
    nodes: Int[np.ndarray, " g"]
    codes: Int[np.ndarray, " g"]
    ended: Float[np.ndarray, "c s"]


class Ladder:
    """The horizon and its linear programs, step after step.

    Args:
        loop: of numpy arrays.
        X0: the initial set, of numpy arrays.
        box: around it.
        scenarios: all of them, over as many steps as will be climbed, from this set.
        t: the time of the initial set.
        nodes: how many linear programs a bound may take.
        budget: what all linear programs may take, work in rows and columns, squared.
        note: is told what happens.
        between: whether what is in between samples is to be bounded too.

    Attributes:
        horizon: forms and facts.
    """

    def __init__(
        self,
        loop: ClosedLoop,
        X0: AbstractSet,
        box: Box,
        scenarios: Scenarios,
        t: int,
        nodes: int,
        budget: Budget,
        note: Callable[[str], None] = lambda note: None,
        between: bool = False,
    ):
        self._note, self._scenarios = note, scenarios
        self._middle = scenarios.middle(np.asarray(box.center))
        self._loop, self._t, self._nodes, self._budget = loop, t, nodes, budget
        self._jumps = loop.jumps
        self.horizon = Horizon(loop, X0, box, t, between)
        start = self.horizon.start
        columns = start.spread.shape[1]
        self._programs = (
            ConicPrograms(columns) if start.round else LinearPrograms(columns, start.cut is None)
        )

    def advance(self, tighten: bool = True, budget: Budget | None = None) -> None:
        """One step more.

        Args:
            tighten: whether the ranges of units that switch are bounded by linear programs.
            budget: a part of the ladder's, for these; None for all that is left.
        """
        # what a step proves depends on nothing but what it is about
        self._programs.forget()
        ranges = partial(self._ranges, budget or self._budget) if tighten and self._nodes else None
        self.horizon.advance(ranges)

    def repeat(self, proof: AbstractProof) -> None:
        """One step more, whose set is known with its proof.

        Ranges of units are those of the proof's multipliers, which are sound whatever they are. A
        proof that does not say them has them found again; one of another kind had none.
        """
        if not isinstance(proof, BranchCertificate):
            self.horizon.advance()
            return
        if proof.ranges is None:
            self.advance()
            return
        self.repeat_ranges(map(np.asarray, proof.ranges))

    def repeat_ranges(self, ranges: Iterable[Float[np.ndarray, "k m"]]) -> None:
        """One step more, with these multipliers for the ranges of its units, in their order.

        They are sound whatever they are: those that do not fit count as none.
        """
        known = iter(ranges)

        def multipliers(forms: AffineForms) -> tuple[np.ndarray, np.ndarray] | None:
            given, facts = next(known, np.zeros((0, 0))), self.horizon.facts
            if given.shape != (len(forms.rows), len(facts.rows)):
                return None
            unknown = np.full((len(given), facts.columns.shape[1]), np.nan)
            return np.where(np.isfinite(given), np.fmax(given, 0.0), 0.0), unknown

        self.horizon.advance(multipliers)

    def narrow(self, X: AbstractSet) -> Float[Array | np.ndarray, "2 n"]:
        """Meet the state with a set that surely holds it: with its facets along the axes.

        Returns:
            The bounds that these are, with their derivatives; infinite where there are none.
        """
        ends = _ends(*X.facets)
        self.horizon.narrow(*np.asarray(jax.lax.stop_gradient(ends)))
        return ends

    def _ranges(
        self, budget: Budget, forms: AffineForms
    ) -> tuple[Float[np.ndarray, "k m"], Float[np.ndarray, "k n"]] | None:
        """Multipliers that bound inputs of units from both sides, and where; None without time."""
        if budget.late or budget.work <= 0:
            return None
        facts = self.horizon.facts
        self._programs.grow(facts, self.horizon.varying)
        self._note(f"ranges of {len(forms.rows) // 2} units")
        found = np.zeros((len(forms.rows), len(facts.rows)))
        there = np.zeros((len(forms.rows), facts.columns.shape[1]))
        for number, row in enumerate(forms.columns):
            if budget.work <= 0 or budget.late:
                break
            self.spend(1)
            constant = np.asarray(forms.rows)[number, :1]
            vertex = self._programs.largest(row[None], constant, (), budget)
            if vertex is not None and len(vertex.columns):
                found[number] = np.maximum(vertex.multipliers, 0.0)
                there[number] = vertex.columns
        return found, there

    def about(self, forms: AffineForms) -> HorizonFacts:
        """What branches are about that bound these forms."""
        horizon, rows = self.horizon, forms.padded(self.width)
        return HorizonFacts(horizon.start, horizon.facts, horizon.zero, rows)

    @property
    def _size(self) -> int:
        """Rows and columns of a linear program."""
        return len(self.horizon.facts.rows) + len(self.horizon.varying)

    @property
    def width(self) -> int:
        """The columns of the horizon."""
        return self.horizon.facts.rows.shape[1] - 2

    def spend(self, programs: int) -> None:
        """Take so many linear programs of the size that they have now from the work."""
        self._budget.spend(programs * self._size**2)

    def facets(
        self, directions: Float[np.ndarray, "f n_x"], simulated: Simulated, gap: float
    ) -> Target:
        """Bounds of directions that are attained but for a part of their ranges.

        Args:
            directions: one row a facet.
            simulated: what is known of their values.
            gap: that part.
        """
        forms = directions @ self.horizon.state
        lower, upper = forms.ends(self.horizon.start)
        floor = LEAST_RANGE * (upper - lower) / 2
        if gap:
            floor = np.fmax(floor, ROUNDED / gap * np.fmax(abs(lower), abs(upper)))
        ranges = np.fmax((simulated.most - simulated.least) / 2, floor)

        def enough(facet: int, bound: float, attained: float) -> bool:
            return bound - attained <= gap * ranges[facet]

        each = [forms[i : i + 1] for i in range(len(directions))]
        return Target(each, lambda states: states @ directions.T, enough, simulated)

    def below(
        self,
        directions: Float[np.ndarray, "f n_x"],
        levels: Float[np.ndarray, " f"],
        middle: Float[np.ndarray, " s"],
    ) -> Target:
        """Bounds of directions that are no larger than levels, without any simulation.

        Args:
            directions: one row a facet.
            levels: of each.
            middle: some scenario.
        """
        forms = directions @ self.horizon.state
        each = [forms[i : i + 1] for i in range(len(directions))]

        def enough(facet: int, bound: float, attained: float) -> bool:
            return bound <= levels[facet]

        return Target(each, None, enough, Simulated.nothing(middle, len(directions)))

    def bounds(self, target: Target, left: int = 0, budget: Budget | None = None) -> StepBounds:
        """Bounds of the state after the steps so far.

        Args:
            target: what is sought.
            left: how many bounds are to be sought later.
            budget: a part of the ladder's, for these; None for all that is left.
        """
        horizon, budget = self.horizon, budget or self._budget
        best, worst = target.simulated.most.copy(), target.simulated.scenarios.copy()
        ended: list[np.ndarray] = []
        trees: dict[int, Tree] = {}
        for number, forms in enumerate(target.forms):

            def attained(columns: list[np.ndarray], number: int = number) -> float:
                if target.values is None:
                    return -np.inf
                tried = np.array(columns)
                begun = self._scenarios_at(tried)
                if self._jumps:
                    begun = np.concatenate([self._settled(tried), begun])
                ended.extend(begun)
                steps = len(horizon.steps)
                after = self._scenarios.runs(self._loop, begun, steps, self._t)[:, -1]
                values = np.nan_to_num(target.values(after)[:, number], nan=-np.inf)
                if values.max() > best[number]:
                    best[number], worst[number] = values.max(), begun[values.argmax()]
                return float(best[number])

            def enough(bound: float, attained: float, number: int = number) -> bool:
                return budget.late or target.enough(number, bound, attained)

            upper = forms.ends(horizon.start)[1].min()
            affordable = self._nodes and budget.work > 0
            if affordable and np.isfinite(upper) and not enough(upper, best[number]):
                if not trees:
                    self._programs.grow(horizon.facts, horizon.varying)
                trees[number] = Tree(horizon, self._programs, forms, attained, enough, budget)
                self.spend(1)
        self._grow(list(trees.values()), len(target.forms) / (left + len(target.forms)))
        found = [
            (number in trees and trees[number].found()) or affine_leaf(forms, horizon)
            for number, forms in enumerate(target.forms)
        ]
        judged = self._by_leaves(target, best, worst, found, ended)
        codes = [
            SolverStatus.SOLVED if closed else self._ended(trees.get(number), budget)
            for number, closed in enumerate(target.closed(judged.bounds, judged.attained))
        ]
        return judged._replace(codes=np.array(codes, int))

    def _ended(self, tree: Tree | None, budget: Budget) -> SolverStatus:
        """How the search for a bound ended that leaves more open than it should."""
        if not self._nodes:
            return SolverStatus.AFFINE_FORM
        if budget.late:
            return SolverStatus.TIME
        if tree is None:
            return SolverStatus.BUDGET if budget.work <= 0 else SolverStatus.FAILED
        if tree.found() is None:  # the first linear program had no answer
            return SolverStatus.FAILED
        return SolverStatus.BUDGET if tree.is_open else SolverStatus.STALLED

    def _grow(self, trees: list[Tree], share: float) -> None:
        """Grow trees by turns, until all are closed or this share of the work is done."""
        if not trees:
            return
        pool, count = share * self._budget.work / self._size**2, len(trees)
        while trees := [tree for tree in trees if tree.is_open and tree.nodes < self._nodes]:
            largest = max(tree.gap for tree in trees)
            closed = count - len(trees)
            self._note(f"splits, {closed} of {count} facets closed, largest gap {largest:.1e}")
            turn = min(pool / len(trees), TURN)
            if turn < 1:
                break
            for tree in trees:
                before = tree.nodes
                tree.grow(int(min(turn, self._nodes - before)))
                pool -= tree.nodes - before
                self.spend(tree.nodes - before)

    def scenarios_of(self, climbed: StepBounds) -> Float[np.ndarray, "f s"]:
        """The scenarios at which bounds would be attained, were they attained."""
        columns = climbed.columns
        return self._scenarios_at(self.horizon.settled(columns) if self._jumps else columns)

    def _settled(self, columns: Float[np.ndarray, "c n"]) -> Float[np.ndarray, "k s"]:
        """The scenarios beside columns where what is tied is won, those that there are."""
        moved = self._scenarios.clipped(self._scenarios_at(self.horizon.settled(columns)))
        return moved[in_blocks(self._scenarios.nearly_contains, moved)]

    def _scenarios_at(self, columns: Float[np.ndarray, "c n"]) -> Float[np.ndarray, "c s"]:
        """The scenarios that columns stand for.

        What is drawn may be beside an ellipsoid, but where the horizon takes it to be.
        """
        start = self.horizon.start
        spread = np.asarray(start.spread)
        states = np.asarray(start.center) + columns[:, : spread.shape[1]] @ spread.T
        found = self._scenarios.of_units(states, self.horizon.drawn_at(columns))
        return self._scenarios.completed(found, self._middle)

    def _by_leaves(
        self,
        target: Target,
        best: np.ndarray,
        worst: np.ndarray,
        found: list[Found],
        ended: list[np.ndarray],
    ) -> StepBounds:
        """The bounds that the leaves prove."""
        horizon, count = self.horizon, len(found)
        width = self.width
        owner = np.repeat(np.arange(count), [len(each.phases) for each in found])
        multipliers = np.concatenate([each.multipliers for each in found])
        leaves = Branches(
            owner=owner,
            phases=np.concatenate([each.phases for each in found]),
            multipliers=multipliers,
            weights=np.asarray(block_diag(*(each.weights for each in found))),
        )
        about = self.about(joined([forms.padded(width) for forms in target.forms]))
        each = leaf_bounds(about, leaves)
        uppers = [forms.ends(horizon.start)[1].min() for forms in target.forms]
        mine = (np.flatnonzero(owner == number) for number in range(count))
        deciding = np.array([leaf[each[leaf].argmax()] for leaf in mine])
        bounds, leaf_counts = bounds_of(leaves, each, count), np.bincount(owner)
        rungs = np.where(leaf_counts > 1, Rung.PHASE_SPLITS, Rung.LINEAR_PROGRAM)
        return StepBounds(
            about=about,
            branches=leaves,
            bounds=np.fmin(bounds, uppers),
            attained=best,
            worst=worst,
            columns=np.concatenate([leaf.columns for leaf in found])[deciding],
            multipliers=multipliers[deciding],
            rungs=np.where(bounds < uppers, rungs, Rung.AFFINE_FORM),
            nodes=np.array([leaf.nodes for leaf in found]),
            codes=np.full(count, int(SolverStatus.SOLVED)),
            ended=np.array(ended).reshape(-1, len(self._middle)),
        )

    def where_attained(
        self, climbed: StepBounds
    ) -> tuple[Float[np.ndarray, "f n"], Float[np.ndarray, "f m"], Bool[np.ndarray, " f"]]:
        """Columns and multipliers that derivatives of bounds hold, and which are attained."""
        found = climbed.multipliers.copy()
        columns, owner = climbed.columns.copy(), climbed.branches.owner
        there = np.zeros(len(found), bool)
        phases = np.asarray(climbed.branches.phases)
        self._programs.grow(self.horizon.facts, self.horizon.varying)
        for facet in range(len(found)):
            if self._budget.late:
                break
            form = climbed.about.rows[facet : facet + 1]
            worst, n = climbed.worst[facet], len(self.horizon.start.center)
            at = self.horizon.columns_at(worst[:n], self._scenarios.units_at(worst))
            leaves, bound = phases[owner == facet], climbed.bounds[facet]
            given = attained_multipliers(
                self.horizon, self._programs, form, at, leaves, bound, self._budget
            )
            if given is not None:
                found[facet], columns[facet], there[facet] = given, at, True
        return columns, found, there


def _ends(
    rows: Float[Array | np.ndarray, "f n"], offsets: Float[Array | np.ndarray, " f"]
) -> Float[Array | np.ndarray, "2 n"]:
    """Bounds of the state that facets along the axes are; infinite where there is none."""
    fixed, values = (np.asarray(jax.lax.stop_gradient(part)) for part in (rows, offsets))
    which = np.full((2, fixed.shape[1]), -1)
    for number, row in enumerate(fixed):
        (there,) = np.nonzero(row)
        if len(there) == 1 and abs(row[there[0]]) == 1.0:
            place = int(row[there[0]] > 0), there[0]
            if which[place] < 0 or values[number] < values[which[place]]:
                which[place] = number
    signs = np.array([[-1.0], [1.0]])
    if is_concrete(offsets):  # numpy compiles nothing
        offsets = values
    return namespace(offsets).where(which >= 0, signs * offsets[which], signs * np.inf)
