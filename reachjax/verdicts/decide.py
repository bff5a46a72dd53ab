"""Verdicts without a tube: only what a decision needs is bounded, and no further.

The directions of the requirements themselves, at the times that they speak of. A trajectory that
breaks one is looked for first: among samples, then where each linear program is largest. To be
inside, the excess over each facet must be below zero; to be outside, the depth in the set must be,
which is the least room to its facets. Each climbs the ladder of `BranchAndCut`, but for products,
until it is decided. Between its forms and its programs a smooth loop is halved into cells.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import Executor
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from reachjax.loops import ClosedLoop
from reachjax.loops.scenarios import Runs, Scenarios
from reachjax.loops.units import UnboundedError
from reachjax.methods.cell_tree import CellTree
from reachjax.methods.cells import WAYS, affordable
from reachjax.methods.ladder import WORK, Ladder, StepBounds
from reachjax.methods.propagation import (
    Progress,
    known_numbers,
    require_kinds,
    simulations_from,
)
from reachjax.methods.steps import boxed
from reachjax.methods.witnesses import Simulated, Simulations
from reachjax.numerics.budget import Budget, Interrupted
from reachjax.numerics.checks import (
    owned,
    require_bar,
    require_double_precision,
    require_executor,
    require_kind,
    same_size,
    whole_number,
)
from reachjax.numerics.deprecations import once_positional
from reachjax.numerics.flags import lenient
from reachjax.numerics.host import in_numpy
from reachjax.numerics.logs import logged
from reachjax.programs.followed import OpenDecision, open_decisions
from reachjax.programs.relaxations import BranchAndCut
from reachjax.proofs.branches import BranchCertificate, Rung
from reachjax.proofs.proposal import SolverStatus
from reachjax.sets import AbstractSet
from reachjax.verdicts.cell_decisions import decided_by_cells
from reachjax.verdicts.cell_tasks import CellTask, far_from, is_beyond
from reachjax.verdicts.closing import closed
from reachjax.verdicts.compiled import compiled_runs
from reachjax.verdicts.findings import Findings
from reachjax.verdicts.grounds import Asked, ClimbRecord, Grounds
from reachjax.verdicts.soundness import require_unbroken, worst_of
from reachjax.verdicts.specification import (
    AvoidSets,
    Region,
    Requirement,
    Timed,
    period_of,
    requirements,
)
from reachjax.verdicts.targets import target_of
from reachjax.verdicts.verdict import Verdict, VerdictStatus

FIRST_PROGRAMS = 50
"""Linear programs that each bound may take at first, while ranges are those of affine forms."""

FOR_CELLS, FOR_CELLS_OF_FLOWS = 0.5, 0.9
"""The part of its time that a smooth loop's cells get, by forms; the rest is for programs over the
whole set, which close what cells do not where much is switched and little is smooth. What a flow
leaves out no program closes."""

TO_CLOSE = 50
"""Linear programs that a bound may take from a set that shall be come back to: there are others."""

HALVES = 16
"""So many cells such a set may be halved into."""

FEW = 200
"""So many trajectories are simulated from such a set."""

PULLS = 1.0, 1 - 1e-12, 1 - 1e-9, 1 - 1e-6
"""How far an initial state is brought towards the middle of the set, so that it surely is in it."""


@once_positional("goal", "safe", "avoid")
@logged
@lenient
def decide(
    loop: ClosedLoop,
    X0: AbstractSet,
    horizon: int,
    *,
    goal: Timed | None = None,
    safe: Region | None = None,
    avoid: AvoidSets | None = None,
    relaxation: BranchAndCut = BranchAndCut(),  # noqa: B008  (immutable)
    start: int = 0,
    samples: int = 1000,
    seed: int = 0,
    time_limit: float | None = None,
    cells: int | Sequence[int] | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Verdict:
    """Decide a reach-avoid specification without a tube.

    Args:
        loop: the closed loop.
        X0: the set of initial states.
        horizon: the number `N` of steps.
        goal: where every state must be at the horizon; or a mapping from times, or from ranges of
            times, to where it must be then.
        safe: where every state must be at all times (its complement is avoided).
        avoid: closed sets in which no state may be: a sequence for all times, or a mapping from
            times, or from ranges of times, to sequences. Of a differential equation a time after
            the first one stands for all of its period, since the sample before.
        relaxation: how many linear programs a bound may take.
        start: the time of `X0`, for time-varying loops.
        samples: how many trajectories are simulated in search of a counterexample, besides those
            from corners.
        seed: of the samples.
        time_limit: seconds, after which nothing is solved any more. None: until all is decided or
            budgets are used up.
        cells: a number for each coordinate: the equal parts of the box around the initial set to
            begin with. Or a number in all, which begins with the whole set. Cells that stay
            undecided are halved where it matters most, until all are decided or the time is over,
            or there are as many as the number says. None: the whole set is bounded at once, and has
            certificates; of a smooth loop of which forms do not prove it, cells of the whole set
            are tried next, as many as `relaxation` says, before its programs.
        executor: runs the cells, whoever asked for them: any with the interface of
            `concurrent.futures`, such as a `ProcessPoolExecutor`. None: one after the other, here.
        progress: wraps the iteration over cells to show a progress bar, such as `tqdm.tqdm`.

    Returns:
        The verdict, with a certificate of each requirement that is proved after the first time, or
        with what is known of each cell. Of a long horizon whose states come into a set that they
        come back to, its `recurrence` says where; later times have no certificates of their own,
        and what is required at the last of them holds for ever.

    Raises:
        Interrupted: Ctrl-C; its `found` is the verdict so far.
        RuntimeError: JAX's 64-bit floats are off.
        TypeError: an argument is of another kind, or a set is of a kind without facets.
        ValueError: nothing is required, dimensions disagree, a time is beyond the horizon, `X0` is
            empty or unbounded, or numbers are traced inside `jax.jit`.
        UnsoundError: JAX runs the loop otherwise than it was proved or refuted: a defect to be
            reported.

    Source: equations (reach_avoid) of Hu, Fazlyab, Morari, Pappas (CDC 2020).

    Example:
        >>> from reachjax import MLP, AffinePlant, Box
        >>> net = MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
        >>> loop = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net, Box([-1.0], [1.0]))
        >>> X0 = Box([1.0], [2.0])
        >>> decide(loop, X0, 3, goal=Box([0.0], [0.5]), safe=Box([0.0], [2.0])).status.name
        'PROVED'
        >>> decide(loop, X0, 3, avoid=[Box([0.4], [0.43])]).status.name
        'REFUTED'
    """
    require_kinds(loop=loop, X0=X0)
    require_kind("relaxation", relaxation, BranchAndCut, "a BranchAndCut")
    require_double_precision(loop=loop, X0=X0)
    same_size(
        "the loop's number of states is", "the dimension of X0 is", (loop.states, X0.dimension)
    )
    loop.check_horizon(horizon, start)
    whole_number("samples", samples, 1)
    whole_number("seed", seed, 0)
    budget, (loop, X0) = Budget.of(time_limit), known_numbers("decide", loop, X0, "X0")
    loop = in_numpy(loop)
    required = requirements(
        loop.states, horizon, period_of(loop), goal=goal, safe=safe, avoid=avoid
    )
    if cells is not None:
        CellTree.over(X0, cells)  # its errors come first
    require_executor(executor)
    require_bar(progress)
    asked = _Asked(loop, start, relaxation, samples, seed)
    return asked.decided(X0, horizon, required, budget, cells, executor, progress)


class _Asked(NamedTuple):
    """What is the same for all sets from which requirements are decided.

    Attributes:
        loop: the closed loop, of numpy arrays.
        start: the time of the sets, in a loop that varies in time.
        relaxation: how many linear programs a bound may take.
        samples: how many trajectories are simulated.
        seed: of these.
    """

    loop: ClosedLoop
    start: int
    relaxation: BranchAndCut
    samples: int
    seed: int

    def decided(
        self,
        X0: AbstractSet,
        horizon: int,
        required: list[Requirement],
        budget: Budget,
        cells: int | Sequence[int] | None = None,
        executor: Executor | None = None,
        progress: Progress | None = None,
    ) -> Verdict:
        """The verdict, by a set that later states come into where that is proved."""
        drawn = X0, horizon, self.start, self.samples, self.seed
        simulations = simulations_from(self.loop, *drawn)
        by = {"cells": cells, "executor": executor, "progress": progress}

        def first(X: AbstractSet, steps: int, some: list[Requirement], share: Budget) -> Verdict:
            begun = simulations_from(self.loop, X, steps, *drawn[2:])
            return self._to_the_end(X, steps, some, share, begun, **by)

        if simulations is not None:
            given = self.loop, X0, horizon, self.start, required, simulations
            few = self.relaxation
            few = dataclasses.replace(
                few, nodes=min(few.nodes, TO_CLOSE), cells=min(few.cells, HALVES)
            )
            later = self._replace(relaxation=few, samples=min(self.samples, FEW)).decided
            found = closed(*given, first, later, cells is not None, budget)
            if found is not None:
                return found
        return self._to_the_end(X0, horizon, required, budget, simulations, **by)

    def _to_the_end(
        self,
        X0: AbstractSet,
        horizon: int,
        required: list[Requirement],
        budget: Budget,
        simulations: Simulations | None,
        cells: int | Sequence[int] | None = None,
        executor: Executor | None = None,
        progress: Progress | None = None,
    ) -> Verdict:
        """The verdict step by step until the horizon."""
        loop, start, relaxation = self.loop, self.start, self.relaxation
        if cells is not None:
            parts = CellTree.over(X0, cells)
            counts = () if isinstance(cells, int | np.integer) else tuple(map(int, cells))
            given = tuple(required), relaxation.nodes, far_from(simulations)
            task = CellTask(loop, horizon, start, *given)
            given = task, X0, parts, simulations, budget, executor, progress
            return decided_by_cells(*given, counts=counts)
        decision = _Decision(loop, X0, horizon, start, required, simulations, budget)
        try:
            by = relaxation, budget, executor, progress
            return _by_remedies(decision, loop, X0, horizon, start, required, *by)
        except Interrupted:
            raise
        except KeyboardInterrupt:
            message = "interrupted: this exception's `found` is the verdict so far"
            raise Interrupted(message, decision.verdict()) from None


def _by_remedies(
    decision: _Decision,
    loop: ClosedLoop,
    X0: AbstractSet,
    horizon: int,
    start: int,
    required: list[Requirement],
    relaxation: BranchAndCut,
    budget: Budget,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Verdict:
    """The verdict by remedies in the order in which they pay.

    Forms; of a smooth loop halves of the set, each of which costs a form and leaves out an eighth;
    then programs, few of each bound first.
    """
    decision.at_first()
    begun, around = map(in_numpy, (X0, boxed(X0, "X0")))
    beyond = far_from(decision.simulations) if loop.curved else None

    def climb(nodes: int, cells_follow: bool = False) -> None:
        if not decision.ended:
            scenarios = Scenarios.of(loop, begun, horizon, start)
            own = budget.with_work(np.inf if budget.timed else WORK)
            between = any(item.throughout for item in required)
            given = loop, begun, around, scenarios, start, nodes, own
            ladder = Ladder(*given, between=between)
            # a flow costs much where bounds are wide, and cells begin anew
            ends = cells_follow and loop.plant.continuous
            far = beyond if cells_follow else None
            tighten = nodes > FIRST_PROGRAMS
            decision.climb(ladder, tighten=tighten, to_first_open=ends, beyond=far)

    by_cells, most = None, 1
    if loop.curved:
        each = 2 * WAYS if loop.jumps else 2
        most = int(min(relaxation.cells, 1 + affordable(loop, horizon, budget) / each))
    if most > 1:
        programs_may_follow = relaxation.nodes > 0
        try:
            climb(0, cells_follow=True)
        except UnboundedError:  # of halves there may be bounds; programs have nothing to begin with
            programs_may_follow = False
        if decision.ended:
            return decision.verdict()
        task = CellTask(loop, horizon, start, tuple(required), nodes=0, beyond=beyond)
        part = FOR_CELLS_OF_FLOWS if loop.plant.continuous else FOR_CELLS
        share = budget.share(part if programs_may_follow else 1.0)
        parts = CellTree.whole(X0, most)
        given = task, X0, parts, decision.simulations, share, executor, progress
        by_cells = decided_by_cells(*given)
        if by_cells.status is not VerdictStatus.UNKNOWN or not programs_may_follow:
            return by_cells
    try:
        for nodes in dict.fromkeys((min(FIRST_PROGRAMS, relaxation.nodes), relaxation.nodes)):
            climb(nodes)
    except UnboundedError:
        if by_cells is None:
            raise
    return decision.verdict() if by_cells is None or decision.ended else by_cells


class _Decision:
    """What is known of each requirement so far.

    Args:
        loop: the closed loop, of numpy arrays.
        X0: the initial set.
        horizon: the number of steps.
        start: the time of the initial set.
        required: the requirements.
        simulations: trajectories from the set; None if it is too thin for any.
        budget: of the call.

    Attributes:
        simulations: as given.
    """

    def __init__(
        self,
        loop: ClosedLoop,
        X0: AbstractSet,
        horizon: int,
        start: int,
        required: list[Requirement],
        simulations: Simulations | None,
        budget: Budget,
    ):
        self._loop, self._start, self._budget = loop, start, budget
        self._horizon, self._X0 = horizon, X0
        self._scenarios = Scenarios.of(loop, X0, horizon, start)
        lower, upper = map(np.asarray, boxed(X0, "X0").intervals)
        self._middle = self._scenarios.middle((lower + upper) / 2)
        self._findings = Findings(loop, X0, horizon, start, required)
        self._certificates: dict[tuple[str, int], BranchCertificate] = {}
        self._climbs = list[ClimbRecord]()
        self._asked = Asked(jax.device_put(loop), X0, horizon, start, tuple(required))
        self._ends: dict[tuple[str, int], np.ndarray] = {}
        self._decisions: tuple[OpenDecision, ...] = ()
        self.simulations = simulations
        if simulations is not None:
            self._findings.simulate(simulations.runs)

    @property
    def ended(self) -> bool:
        """Whether nothing is left to be decided."""
        return self._findings.ended

    def verdict(self) -> Verdict:
        """The verdict from everything proved and simulated so far.

        Raises:
            UnsoundError: a trajectory breaks what is proved.
        """
        self._require_unbroken()
        ends = Counter(SolverStatus(int(code)) for codes in self._ends.values() for code in codes)
        climbs = tuple(each.climb for each in self._climbs if each.climb is not None)
        more = {"asked": self._asked, "grounds": Grounds(climbs=(climbs,))}
        more |= {"certificates": self._certificates, "decisions": self._decisions}
        return self._findings.verdict(dict(ends), **more)

    def _require_unbroken(self) -> None:
        """Raise an error if a trajectory, as JAX runs it, breaks what is proved."""
        claims = [claim for claim in self._findings.claims if claim.proved]
        if claims:
            rows = self._middle[None]
            if self.simulations is not None:
                rows = worst_of(self.simulations.runs, [claim.item for claim in claims])
            runs = compiled_runs(self._loop, self._scenarios, rows, self._start)
            require_unbroken(self._loop, self._scenarios, self._start, runs, claims)

    def at_first(self) -> None:
        """Decide what is required of the initial set itself."""
        for item in list(self._findings.open.values()):
            if item.time == 0:
                compared = item.compared_with(self._X0)
                self._findings.prove(item, compared.least_margin, item.proved(compared))

    def climb(
        self,
        ladder: Ladder,
        tighten: bool,
        to_first_open: bool = False,
        beyond: Float[np.ndarray, "2 n_x"] | None = None,
    ) -> None:
        """Climb until all is decided, or nothing more can be.

        Args:
            ladder: at the initial set.
            tighten: whether the ranges of units are bounded by linear programs.
            to_first_open: whether nothing later matters where a requirement is not proved.
            beyond: ends of a box where nothing is worth going on once bounds leave it; None for
                everywhere.
        """
        last = max(time for _, time in self._findings.open)
        self._climbs.append(ClimbRecord())
        self._decisions = ()
        for k in range(1, last + 1):
            ladder.advance(tighten)
            self._climbs[-1].advanced(ladder.horizon.tightened)
            self._decisions += open_decisions(ladder.horizon.steps[-1], self._start + k - 1)
            if self._budget.overdue or is_beyond(ladder, beyond):
                return
            for key, item in list(self._findings.open.items()):
                if item.time == k and not self.ended:
                    self._decided(key, item, ladder)
            if self.ended or (to_first_open and any(time == k for _, time in self._findings.open)):
                return

    def _decided(self, key: tuple[str, int], item: Requirement, ladder: Ladder) -> None:
        """Bound one requirement at the time that the ladder has come to."""
        target, units = target_of(item, ladder, self.simulations, self._middle)
        left = sum(other.time >= item.time for other in self._findings.open.values())
        share = self._budget.share(1 / left)
        climbed = ladder.bounds(target, (left - 1) * len(target.forms), share)
        right = climbed.bounds <= 0 if item.inside else climbed.bounds < 0
        margin = float(np.min(-climbed.bounds / units))
        holds, one_of_several = bool(np.all(right)), not (item.inside or item.throughout)
        self._findings.prove(item, margin, holds)
        self._ends[key] = climbed.codes
        if holds:
            by_forms = np.all(climbed.rungs == Rung.AFFINE_FORM)
            self._climbs[-1].proved(item, None if by_forms else climbed.branches)
            self._certificates[key] = _certificate(climbed, target.simulated, one_of_several)
        if not np.all(right):
            worst, middle = climbed.worst[climbed.attained > 0], self._middle
            pulled = np.concatenate([middle + p * (worst - middle) for p in PULLS])
            self._tried(item, self._scenarios.clipped(pulled))

    def _tried(self, item: Requirement, scenarios: np.ndarray) -> None:
        """Simulate scenarios that may break a requirement."""
        if self.simulations is not None:
            runs = self.simulations.include(scenarios)
        else:
            given = self._loop, scenarios, self._horizon, self._start
            runs = Runs(scenarios, self._scenarios.runs(*given))
        self._findings.simulate(runs, [item])


def _certificate(climbed: StepBounds, known: Simulated, least: bool) -> BranchCertificate:
    """The proof of a requirement."""
    count = len(climbed.bounds)
    proof = BranchCertificate(
        codes=climbed.codes,
        bounds=climbed.bounds,
        witnesses=known.most,
        witness_states=known.scenarios,
        seconds=np.full(count, np.nan),
        about=climbed.about,
        branches=climbed.branches,
        products=None,
        by_products=np.zeros(0, dtype=int),
        rungs=climbed.rungs,
        nodes=climbed.nodes,
        least=least,
    )
    return owned(proof)
