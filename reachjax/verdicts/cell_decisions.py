"""Verdicts by cells: each cell of an initial set is proved, or halved, or left undecided.

Cells are bounded by forms, whose remainders fall with the third power of their widths: many in one
compiled call once there are as many. Those that are left over are bounded one by one
(`cell_tasks`). What a smooth loop's forms leave out, a half lowers eightfold for the price of a
form, so its cells get programs only where they are not halved any more. Halves are taken along the
coordinate that what is left out is due to, and of a cell that failed early the halves are halved at
once. Of a cell nothing is kept but its box and its margins.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from concurrent.futures import Executor
from typing import Any

import jax
import numpy as np

from reachjax.loops.scenarios import Runs, Scenarios
from reachjax.methods.cell_tree import CellTree, Node
from reachjax.methods.searches import AbstractSearch, Bar, Question
from reachjax.methods.witnesses import Simulations
from reachjax.numerics.budget import Budget, Interrupted
from reachjax.numerics.flags import lenient
from reachjax.sets import AbstractSet
from reachjax.verdicts.cell_tasks import CellTask, outcome_of
from reachjax.verdicts.findings import Findings
from reachjax.verdicts.grounds import Asked, Climb, Grounds
from reachjax.verdicts.sieve import TOGETHER, Ends, Margins, Outcome, Sieve, Unbounded, no_margins
from reachjax.verdicts.soundness import require_unbroken_cells
from reachjax.verdicts.verdict import DecidedCell, Verdict, VerdictStatus

PROGRAMS = 50
"""Linear programs that a bound may take in a cell: halving it is the other way."""

SHOTS, FEWER = 64, 8
"""How many trajectories are simulated from a cell that is not proved; and from each of many."""

AT_ONCE = 8
"""Cells are shot from once they are this part of all: many trajectories take hardly longer than one
does."""

FEW_OF_A_FLOW = 4
"""So many cells of a flow are worth a compiled call for more, which is filled up."""

TRIED = 8
"""After so many cells of a size of which none was proved, one in so many is tried."""


def decided_by_cells(
    task: CellTask,
    X0: AbstractSet,
    cells: CellTree,
    simulations: Simulations | None,
    budget: Budget,
    executor: Executor | None = None,
    progress: Bar | None = None,
    counts: tuple[int, ...] = (),
) -> Verdict:
    """The verdict on all cells.

    Args:
        task: what is decided.
        X0: the initial set.
        cells: of it, to begin with.
        simulations: trajectories from the set.
        budget: of the call.
        executor: runs the cells; None: here.
        progress: wraps the iteration over cells.
        counts: equal parts of each coordinate to begin with; none for the whole set.
    """
    search = _Decisions(task, X0, cells, budget, counts)
    if simulations is not None:
        search.findings.simulate(simulations.runs)
    try:
        search.run(executor, progress)
        search.shoot_the_last()
        return search.verdict()
    except KeyboardInterrupt:
        message = (
            "interrupted: this exception's `found` is the verdict so far, whose `cells` that "
            "are not undecided need not be decided again"
        )
        raise Interrupted(message, search.verdict(interrupted=True)) from None


@lenient
def sifted(
    task: CellTask, cells: Sequence[Ends], budget: Budget, calls: float | None = None
) -> list[Outcome | None]:
    """What forms of many cells say in one compiled call; None where they pay better one by one.

    Args:
        task: what is to be proved of each.
        cells: at most `TOGETHER` of them.
        budget: of the whole call.
        calls: how many such calls are to be made by who waits for the compilation.
    """
    with jax.enable_x64(True):
        sieve = Sieve(task.loop, task.horizon, task.start, task.required)
        pays = sieve.pays(cells, budget, calls)
        return [*sieve.sifted(cells)] if pays else [None] * len(cells)


class _Decisions(AbstractSearch):
    """What is known of all cells so far.

    Attributes:
        findings: what trajectories show.
    """

    ahead = 4

    def __init__(
        self,
        task: CellTask,
        X0: AbstractSet,
        cells: CellTree,
        budget: Budget,
        counts: tuple[int, ...] = (),
    ):
        self._counts = counts
        self._task = task._replace(nodes=min(PROGRAMS, task.nodes))
        self._X0, self._cells, self._budget = X0, cells, budget
        self._loop = jax.device_put(task.loop)
        self._scenarios = Scenarios.of(self._loop, X0, task.horizon, task.start)
        self.findings = Findings(self._loop, X0, task.horizon, task.start, task.required)
        self._tried: dict[int, deque[int]] = {}
        # of a smooth loop programs are the last remedy, of an affine one the next
        self._first = self._task._replace(nodes=0) if task.loop.curved else self._task
        self._open, self._last = deque(cells.leaves), deque[Node]()
        self._left_over = deque[tuple[Node, Margins | None]]()
        self._unshot, self._shot = list[Node](), 0
        self._sifts, self._waits = True, False
        self._compared: Node | None = None
        self._lost: tuple[Unbounded, list[float]] | None = None
        self._bounded = False

    @property
    def ended(self) -> bool:
        """Whether a counterexample is found."""
        return self.findings.example is not None

    def question(self, asked: int, workers: int) -> Question | None:
        """Forms of many cells, of one, or what programs say of one that is not halved any more."""
        if self._waits:
            return None
        while (self._open or self._left_over) and not self._budget.overdue:
            if not self._left_over and self._many and not self._budget.late:
                some = [self._open.popleft() for _ in range(min(TOGETHER, len(self._open)))]
                given = self._task, [node.ends for node in some], self._budget
                return Question(some, sifted, given)
            left = self._left_over
            node, known = left.popleft() if left else (self._open.popleft(), None)
            bounded = known is not None and not self._first.by_programs
            tried = self._tried.get(self._cells.halvings(node))
            # to bound a flow again costs more than to halve it where one of its size was halved
            again = self._bounded and self._task.loop.plant.continuous
            if known is not None and bounded and again and tried:
                self._judge(node, Outcome(False, known, axis=tried[-1]))
                if self.ended:
                    return None
                continue
            axis = None if bounded or node is self._compared else self._hopeless(node)
            if axis is None:
                self._waits = node is self._compared
                return self._about(node, self._first, known)
            self._halve(node, axis)
        if self._last and not (self._open or self._left_over or self._budget.late):
            return self._about(self._last.popleft(), self._task)
        return None

    @property
    def _many(self) -> bool:
        """Whether there are cells for a compiled call, if that says something of this loop.

        Of flows it takes less than a few one by one do.
        """
        loop = self._task.loop
        return (
            self._sifts
            and not loop.jumps
            and len(self._open) >= (FEW_OF_A_FLOW if loop.plant.continuous else TOGETHER)
        )

    def _about(self, node: Node, task: CellTask, known: Margins | None = None) -> Question:
        return Question([node], outcome_of, (task, jax.device_get(node.part), self._budget, known))

    def answered(self, question: Question, answer: Any) -> int:
        """How many cells are decided, as far as a bar is concerned."""
        if question.function is sifted:
            self._sort(question.nodes, answer)
        else:
            (node,), (task, *_) = question.nodes, question.given
            if node is self._compared:
                self._compare(answer)
            self._judge(node, answer, task is self._first)
        waiting = len(self._open) + len(self._left_over) + len(self._last)
        return self._cells.count - waiting

    def _sort(self, nodes: Sequence[Node], outcomes: Sequence[Outcome | None]) -> None:
        """Keep what a compiled call proves, and leave over what it does not.

        Compiled code cannot halve the steps of a flow. Where it proves none of many cells, one that
        it loses in the first period is bounded on the host, which does, before anything else is
        asked.
        """
        proved = any(outcome is not None and outcome.proved for outcome in outcomes)
        compares = self._task.loop.plant.continuous and not proved and self._compared is None
        for node, outcome in zip(nodes, outcomes, strict=True):
            if outcome is not None and outcome.proved:
                self._judge(node, outcome)
                continue
            known = None if outcome is None or not self._sifts else outcome.margins
            if compares and known is not None and _lost_at_once(known):
                self._compared, compares, known = node, False, None
            self._left_over.append((node, known))

    def _compare(self, answer: Outcome) -> None:
        """Compile nothing any more if forms prove on the host what a compiled call lost."""
        self._compared, self._waits = None, False
        if answer.proved and not answer.leaves:
            self._sifts = False
            nodes = [node for node, _ in self._left_over]
            self._left_over.clear()
            self._left_over.extend((node, None) for node in nodes)

    def _judge(self, node: Node, outcome: Outcome, first: bool = True) -> None:
        """Keep what is found of a cell, or halve it, as long as there may be more.

        Where there may not, it is left to programs, if it had none at first.
        """
        if outcome.unbounded is not None:
            self._lost = outcome.unbounded, node.widths.tolist()
        self._bounded = self._bounded or outcome.unbounded is None
        node.found = outcome
        depth = self._cells.halvings(node)
        if outcome.proved:
            self._tried.pop(depth, None)
            return
        axis = outcome.axis if outcome.axis >= 0 else self._cells.longest(node)
        self._tried.setdefault(depth, deque()).append(axis)
        self._unshot.append(node)
        if AT_ONCE * len(self._unshot) >= self._cells.count:
            self._shoot()
        if self.ended:
            return
        if first and self._may_halve(node, axis):
            self._halve(node, axis, outcome.then)
        elif first and self._first is not self._task and self._task.by_programs:
            self._last.append(node)

    def _may_halve(self, node: Node, axis: int) -> bool:
        return not self._budget.late and self._cells.can_halve(node, axis)

    def _halve(self, node: Node, axis: int, then: int = -1) -> None:
        halves = self._cells.halved(node, axis)
        self._cells.replace(node, halves, axis)
        node.found = None
        for half in halves:
            if then >= 0 and self._may_halve(half, then):
                self._halve(half, then)
            else:
                self._open.append(half)

    def _hopeless(self, node: Node) -> int | None:
        """Along which axis to halve a cell at once, if none of its size was proved lately."""
        tried = self._tried.get(self._cells.halvings(node), deque())
        if len(tried) < TRIED or not self._may_halve(node, tried[-1]):
            return None
        if len(tried) % TRIED == 0:  # this one is tried, and counted when it is judged
            tried.append(tried[-1])
            return None
        tried.append(tried[-1])
        return tried[-1]

    def shoot_the_last(self) -> None:
        """Simulate from the cells that still wait for it, if there is time."""
        if self._unshot and not (self.ended or self._budget.late):
            self._shoot()

    def _shoot(self) -> None:
        """Simulate a few trajectories from each cell that waits for it: corners and points."""
        self._shot += 1
        rng, found = np.random.default_rng(self._shot), list[np.ndarray]()
        shots = SHOTS if self._cells.count < SHOTS else FEWER
        for node in self._unshot:
            lower, upper = node.ends
            ends = rng.uniform(size=(shots, len(lower)))
            ends[: shots // 2] = ends[: shots // 2] > 0.5
            found.append(np.clip(lower + ends * (upper - lower), lower, upper))
        self._unshot.clear()
        states = np.concatenate(found)
        states = states[np.asarray(self._X0.contains(states))]
        if len(states):
            task, drawn = self._task, self._scenarios.drawn(states, self._shot)
            after = self._scenarios.runs(task.loop, drawn, task.horizon, task.start)
            self.findings.simulate(Runs(drawn, after))

    def verdict(self, interrupted: bool = False) -> Verdict:
        """The verdict from all cells that were looked at.

        Args:
            interrupted: whether somebody stopped that.

        Raises:
            UnboundedError: there is no cell over which all units have bounds.
            UnsoundError: a trajectory breaks what is proved.
        """
        task, example = self._task, self.findings.example
        if self._lost and not (self._bounded or example or interrupted):
            unbounded, widths = self._lost
            raise unbounded.error.after(self._cells.count, widths)
        blank = Outcome(False, no_margins(task.required, task.horizon))
        found = [(node, node.found or blank) for node in self._cells.leaves]
        cells = tuple(self._decided(node, outcome) for node, outcome in found)
        known = task.horizon, task.start, task.required, cells
        require_unbroken_cells(self._loop, self._X0, *known, example)
        proved = bool(found) and all(outcome.proved for _, outcome in found)
        for item in task.required:
            margins = np.array([outcome.margins[item.name][item.time] for _, outcome in found])
            least = -np.inf if np.isnan(margins).any() else float(margins.min(initial=np.inf))
            if proved:
                self.findings.prove(item, least, True)
            else:
                self.findings.bound(item, least)
        decisions = tuple(decision for _, outcome in found for decision in outcome.open)
        asked = Asked(self._loop, self._X0, task.horizon, task.start, task.required)
        more = {"asked": asked, "grounds": self._grounds() if proved else None}
        return self.findings.verdict(cells=cells, decisions=decisions, **more)

    def _grounds(self) -> Grounds:
        """What proves every cell anew."""
        climbs = tuple(
            (Climb(leaves=node.found.leaves),) if node.found.leaves else ()
            for node in self._cells.leaves
        )
        return Grounds(self._counts, tuple(tuple(each.axes) for each in self._cells.roots), climbs)

    def _decided(self, node: Node, outcome: Outcome) -> DecidedCell:
        """What is said of a cell; a counterexample from a proved one would be a contradiction."""
        status = VerdictStatus.PROVED if outcome.proved else VerdictStatus.UNKNOWN
        example = self.findings.example
        if example is not None and not outcome.proved:
            first = example.states[0]
            if np.all((node.lower <= first) & (first <= node.upper)):
                status = VerdictStatus.REFUTED
        return DecidedCell(*node.ends, status, outcome.margin)


def _lost_at_once(margins: Margins) -> bool:
    """Whether something is not proved of the first period."""
    return any(bool(row[1] <= 0) for row in margins.values() if len(row) > 1)
