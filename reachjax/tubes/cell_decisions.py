"""Verdicts by cells: each cell of an initial set is proved, or halved, or left undecided.

Cells are bounded by forms, whose remainders fall with the third power of their widths: many in one
compiled call once there are as many. Those that are left over are bounded one by one
(`cell_tasks`). What a smooth loop's forms leave out, a half lowers eightfold for the price of a
form, so its cells get programs only where they are not halved any more. Halves are taken along the
coordinate that moves the inputs of units most. Of a cell nothing is kept but its box and its
margins.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Executor
from contextlib import closing
from functools import cached_property
from typing import Any

import jax
import numpy as np

from reachjax.loops.scenarios import Runs, Scenarios
from reachjax.numerics.budget import Budget
from reachjax.numerics.checks import described, whole_number, wrapped
from reachjax.proofs.witnesses import Simulations
from reachjax.sets import AbstractSet, Box
from reachjax.sets.cells import Cell, grid, halves_along
from reachjax.tubes.cell_jobs import CellJobs
from reachjax.tubes.cell_tasks import CellTask, Outcome, Unbounded, outcome_of
from reachjax.tubes.interruptions import Interrupted
from reachjax.tubes.refutations import Suspect, counterexample, suspects
from reachjax.tubes.sieve import TOGETHER, Margins, Sieve, no_margins
from reachjax.tubes.soundness import require_unbroken_cells
from reachjax.tubes.steps import boxed
from reachjax.tubes.verdicts import Counterexample, DecidedCell, Verdict, VerdictStatus

SHOTS, FEWER = 64, 8
"""How many trajectories are simulated from a cell that is not proved; and from each of many."""

AHEAD = 4
"""How many cells an executor is given for each of its workers."""

TRIED = 8
"""After so many cells of a size of which none was proved, one in so many is tried."""


def roots(X0: AbstractSet, cells: Any) -> tuple[list[Cell], int | None]:
    """The cells to begin with, and how many there may be in all.

    Raises:
        TypeError: `cells` is neither a number nor one for each coordinate.
        ValueError: there is not a positive number for each coordinate.
    """
    if isinstance(cells, np.ndarray | jax.Array) and cells.ndim < 2:
        cells = cells.tolist()
    if isinstance(cells, int | np.integer) and not isinstance(cells, bool):
        box = boxed(X0, "X0")
        return [Cell(box, X0)], whole_number("cells", cells, 1)
    if isinstance(cells, Sequence) and not isinstance(cells, str):
        return grid(X0, cells), None
    raise TypeError(
        f"cells must be a whole number, or one for each coordinate, but {described(cells)} arrived"
    )


def decided_by_cells(
    task: CellTask,
    X0: AbstractSet,
    begun: Sequence[Cell],
    most: int | None,
    simulations: Simulations | None,
    budget: Budget,
    executor: Executor | None = None,
    progress: Callable[[Iterable[Any]], Iterable[Any]] | None = None,
) -> Verdict:
    """The verdict on all cells.

    Args:
        task: what is decided.
        X0: the initial set.
        begun: the cells to begin with.
        most: how many cells there may be; None: as many as it takes.
        simulations: trajectories from the set.
        budget: of the call.
        executor: runs the cells; None: here.
        progress: wraps the iteration over cells.
    """
    run = _Run(task, X0, most, budget)
    if simulations is not None:
        run.seen(simulations.runs)
    if run.example is None:
        try:
            with closing(run.results(begun, executor)) as results:  # a bar may end before they do
                for _ in wrapped(progress, results):
                    if run.example is not None:
                        break
        except KeyboardInterrupt:
            message = (
                "interrupted: this exception's `found` is the verdict so far, whose `cells` that "
                "are not undecided need not be decided again"
            )
            raise Interrupted(message, run.verdict(interrupted=True)) from None
    return run.verdict()


class _Run:
    """What is known of all cells so far.

    Attributes:
        example: a counterexample, once one is found.
    """

    def __init__(self, task: CellTask, X0: AbstractSet, most: int | None, budget: Budget):
        self._task, self._X0, self._most, self._budget = task, X0, most, budget
        self._loop = jax.device_put(task.loop)
        self._scenarios = Scenarios.of(self._loop, X0, task.horizon, task.start)
        self._done: list[DecidedCell] = []
        self._count = 0
        self._blank, self._margins, self._simulated = (
            no_margins(task.required, task.horizon) for _ in range(3)
        )
        self.example: Counterexample | None = None
        self._tried: dict[int, deque[int]] = {}
        box = boxed(X0, "X0")
        sides = np.asarray(box.widths)
        self._size, self._sides = _size(box), np.where(sides > 0, sides, 1.0)
        # of a smooth loop programs are the last remedy, of an affine one the next
        self._first = task._replace(nodes=0) if task.loop.curved else task
        self._last = deque[Cell]()
        self._lost: tuple[Unbounded, list[float]] | None = None
        self._bounded = False

    @cached_property
    def _sieve(self) -> Sieve:
        """Made once there are enough cells for it."""
        task = self._task
        return Sieve(task.loop, task.horizon, task.start, task.required)

    def results(
        self, begun: Sequence[Cell], executor: Executor | None
    ) -> Generator[int, None, None]:
        """How many cells are decided, after each that is bounded."""
        open_cells, left_over = deque(begun), deque[tuple[Cell, Margins | None]]()
        self._count = len(open_cells)
        jobs = CellJobs[tuple[Cell, CellTask]](executor, AHEAD)
        try:
            while open_cells or left_over or self._last or jobs:
                while (open_cells or left_over) and len(jobs) < jobs.most:
                    if self._budget.overdue:
                        return
                    if not left_over and len(open_cells) >= TOGETHER and not self._budget.late:
                        some = [open_cells.popleft() for _ in range(TOGETHER)]
                        try:
                            left_over.extend(self._sifted(some))
                        except KeyboardInterrupt:
                            open_cells.extend(some)
                            raise
                        yield len(self._done)
                        continue
                    cell, known = left_over.popleft() if left_over else (open_cells.popleft(), None)
                    bounded = known is not None and not self._first.by_programs
                    axis = None if bounded else self._hopeless(cell)
                    if axis is not None:
                        open_cells.extend(self._halved(cell, axis))
                        continue
                    self._submit(jobs, cell, self._first, known)
                while self._last and not (open_cells or left_over) and len(jobs) < jobs.most:
                    if self._budget.late:
                        return
                    self._submit(jobs, self._last.popleft(), self._task)
                for (cell, task), outcome in jobs.finished():
                    try:
                        open_cells.extend(self._judged(cell, outcome, task is self._first))
                    except KeyboardInterrupt:
                        open_cells.append(cell)
                        raise
                    yield len(self._done)
                if self.example is not None:
                    return
        finally:
            left = [*open_cells, *(cell for cell, _ in (*left_over, *jobs.cancelled()))]
            left += self._last
            if self.example is None:
                for cell in left:
                    self._kept(cell, Outcome(False, self._blank, 0), VerdictStatus.UNKNOWN)

    def _submit(
        self,
        jobs: CellJobs[tuple[Cell, CellTask]],
        cell: Cell,
        task: CellTask,
        known: Margins | None = None,
    ) -> None:
        part = jax.device_get(cell.part)
        jobs.submit((cell, task), outcome_of, task, part, self._budget, known)

    def _sifted(self, cells: Sequence[Cell]) -> list[tuple[Cell, Margins | None]]:
        """The cells among some that forms do not prove, with the margins that these say.

        All of them, of which nothing is known, while it pays better to bound them one by one.
        """
        ends = [(np.asarray(cell.box.lower), np.asarray(cell.box.upper)) for cell in cells]
        if not self._sieve.pays(ends, self._budget):
            return [(cell, None) for cell in cells]
        found: list[tuple[Cell, Margins | None]] = []
        for cell, sifted in zip(cells, self._sieve.sifted(ends), strict=True):
            if sifted.proved:
                self._judged(cell, Outcome(True, sifted.margins, 0))
            else:
                found.append((cell, sifted.margins))
        return found

    def _judged(self, cell: Cell, outcome: Outcome, first: bool = True) -> list[Cell]:
        """The halves of a cell that is not proved, as long as there may be more.

        Where there may not, it is left to programs, if it had none at first.
        """
        if outcome.unbounded is not None:
            self._lost = outcome.unbounded, cell.box.widths.tolist()
        self._bounded = self._bounded or outcome.unbounded is None
        if outcome.axis < 0:
            widths = np.asarray(cell.box.widths) / self._sides
            outcome = outcome._replace(axis=int(widths.argmax()))
        if outcome.proved:
            self._kept(cell, outcome, VerdictStatus.PROVED)
            self._tried.pop(self._depth(cell), None)
            return []
        self._tried.setdefault(self._depth(cell), deque()).append(outcome.axis)
        self._shoot(cell)
        if self.example is not None or not first or not self._may_halve(cell, outcome.axis):
            later = first and self._first is not self._task and self._task.by_programs
            if later and self.example is None and not self._budget.late:
                self._last.append(cell)
                return []
            self._kept(cell, outcome, VerdictStatus.UNKNOWN)
            return []
        return self._halved(cell, outcome.axis)

    def _may_halve(self, cell: Cell, axis: int) -> bool:
        full = self._most is not None and self._count >= self._most
        return not (self._budget.late or full) and float(cell.box.widths[axis]) > 0

    def _halved(self, cell: Cell, axis: int) -> list[Cell]:
        found = halves_along(self._X0, cell.box, axis)
        self._count += len(found) - 1
        return found

    def _depth(self, cell: Cell) -> int:
        """How often the initial set was halved to get a cell."""
        return round(self._size - _size(cell.box))

    def _hopeless(self, cell: Cell) -> int | None:
        """Along which axis to halve a cell at once, if none of its size was proved lately."""
        tried = self._tried.get(self._depth(cell), deque())
        if len(tried) < TRIED or not self._may_halve(cell, tried[-1]):
            return None
        if len(tried) % TRIED == 0:  # this one is tried, and counted when it is judged
            tried.append(tried[-1])
            return None
        tried.append(tried[-1])
        return tried[-1]

    def _kept(self, cell: Cell, outcome: Outcome, status: VerdictStatus) -> None:
        lower, upper = np.asarray(cell.box.lower), np.asarray(cell.box.upper)
        if self.example is not None:
            first = self.example.states[0]
            inside = np.all((lower <= first) & (first <= upper))
            if inside and status is not VerdictStatus.PROVED:  # that would be a contradiction
                status = VerdictStatus.REFUTED
        self._done.append(DecidedCell(lower, upper, status, outcome.margin))
        for item in self._task.required:
            row, margin = self._margins[item.name], outcome.margins[item.name][item.time]
            if np.isnan(margin):
                margin = -np.inf  # nothing was looked at
            row[item.time] = np.fmin(row[item.time], margin)

    def _shoot(self, cell: Cell) -> None:
        """Simulate a few trajectories from a cell: corners and points."""
        rng = np.random.default_rng(len(self._done))
        lower, upper = np.asarray(cell.box.lower), np.asarray(cell.box.upper)
        shots = SHOTS if self._count < SHOTS else FEWER
        ends = rng.uniform(size=(shots, len(lower)))
        ends[: shots // 2] = ends[: shots // 2] > 0.5
        states = np.clip(lower + ends * (upper - lower), lower, upper)
        states = states[np.asarray(self._X0.contains(states))]
        if len(states):
            task, scenarios = self._task, self._scenarios.drawn(states, len(self._done))
            after = self._scenarios.runs(task.loop, scenarios, task.horizon, task.start)
            self.seen(Runs(scenarios, after))

    def seen(self, runs: Runs) -> None:
        """What trajectories show, a counterexample perhaps."""
        runs = runs.some(np.isfinite(runs.states).all(axis=(1, 2)))
        found: list[Suspect] = []
        for item in self._task.required if len(runs.states) else ():
            rooms = item.simulated(runs.states)
            row = self._simulated[item.name]
            row[item.time] = np.fmin(row[item.time], rooms.min())
            found += suspects(item, rooms, runs)
        self.example = counterexample(self._loop, self._X0, found, self._task.start)

    def verdict(self, interrupted: bool = False) -> Verdict:
        """The verdict from all cells that were looked at.

        Args:
            interrupted: whether somebody stopped that.

        Raises:
            UnboundedError: there is no cell over which all units have bounds.
            UnsoundError: a trajectory breaks what is proved.
        """
        if self._lost and not (self._bounded or self.example or interrupted):
            unbounded, widths = self._lost
            raise unbounded.error.after(len(self._done), widths)
        task = self._task
        known = task.horizon, task.start, task.required, self._done
        require_unbroken_cells(self._loop, self._X0, *known, self.example)
        statuses = {each.status for each in self._done}
        proved = statuses == {VerdictStatus.PROVED}
        status = VerdictStatus.PROVED if proved else VerdictStatus.UNKNOWN
        if self.example is not None:
            status = VerdictStatus.REFUTED
        return Verdict(
            status,
            self._margins,
            self._simulated,
            self.example,
            cells=tuple(self._done),
        )


def _size(box: Box) -> float:
    """The logarithm of a volume, in halvings; of coordinates that are flat none."""
    widths = np.asarray(box.widths)
    return float(np.log2(widths[widths > 0]).sum())
