"""Verdicts by cells: each cell of an initial set is proved, or halved, or left undecided.

Cells are bounded by forms, whose remainders fall with the third power of their widths: many in one
compiled call once there are as many. Those that are left over are bounded one by one, where
rectifiers switch by linear programs, and left at the first requirement that is not proved: what
comes later would only be worse. Halves are taken along the coordinate that moves the inputs of
units most. Of a cell nothing is kept but its box and its margins.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from reachjax.loops import ClosedLoop
from reachjax.loops.scenarios import Runs, Scenarios
from reachjax.loops.units import SmoothUnit
from reachjax.numerics.checks import described, whole_number, wrapped
from reachjax.proofs.witnesses import Simulations
from reachjax.sets import AbstractSet, Box
from reachjax.sets.balance import balanced
from reachjax.sets.cells import Cell, grid, halves_along
from reachjax.tubes.ladder import WORK, Ladder
from reachjax.tubes.refutations import Suspect, counterexample, suspects
from reachjax.tubes.requirements import Requirement
from reachjax.tubes.sieve import TOGETHER, Margins, Sieve
from reachjax.tubes.steps import boxed
from reachjax.tubes.targets import target_of, values_of
from reachjax.tubes.verdicts import Counterexample, DecidedCell, Verdict, VerdictStatus

SHOTS, FEWER = 64, 8
"""How many trajectories are simulated from a cell that is not proved; and from each of many."""

FEW = 50
"""Linear programs that a bound may take in a cell: halving it is the other way."""

TRIED = 8
"""After so many cells of a size of which none was proved, one in so many is tried."""

AHEAD = 4
"""How many cells an executor is given for each of its workers, at least."""


class CellTask(NamedTuple):
    """What is decided of every cell.

    Attributes:
        loop: of numpy arrays.
        horizon: the number of steps.
        start: the time of the initial set.
        required: the requirements.
        nodes: how many linear programs a bound may take.
    """

    loop: ClosedLoop
    horizon: int
    start: int
    required: tuple[Requirement, ...]
    nodes: int

    @property
    def by_programs(self) -> bool:
        """Whether linear programs may prove what forms do not."""
        layers = self.loop.unit_layers
        return self.nodes > 0 and not all(isinstance(each.unit, SmoothUnit) for each in layers)


class Outcome(NamedTuple):
    """What is found of a cell.

    Attributes:
        proved: whether all requirements are.
        margins: of those that were looked at; NaN of the others.
        axis: along which it should be halved.
    """

    proved: bool
    margins: Margins
    axis: int

    @property
    def margin(self) -> float:
        """The smallest."""
        known = [np.nanmin(row) for row in self.margins.values() if not np.isnan(row).all()]
        return float(min(known, default=-np.inf))


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
    deadline: float,
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
        deadline: when to stop, as `time.monotonic` says it.
        executor: runs the cells; None: here.
        progress: wraps the iteration over cells.
    """
    run = _Run(task, X0, most, deadline)
    if simulations is not None:
        run.seen(simulations.runs)
    if run.example is None:
        for _ in wrapped(progress, run.results(begun, executor)):
            if run.example is not None:
                break
    return run.verdict()


class _Run:
    """What is known of all cells so far.

    Attributes:
        example: a counterexample, once one is found.
    """

    def __init__(self, task: CellTask, X0: AbstractSet, most: int | None, deadline: float):
        self._task, self._X0, self._most, self._deadline = task, X0, most, deadline
        self._loop = jax.device_put(task.loop)
        self._scenarios = Scenarios.of(self._loop, X0, task.horizon, task.start)
        self._done: list[DecidedCell] = []
        self._count = 0
        blank = {item.name: np.full(task.horizon + 1, np.nan) for item in task.required}
        self._margins, self._simulated = blank, {name: row.copy() for name, row in blank.items()}
        self.example: Counterexample | None = None
        self._tried: dict[int, deque[int]] = {}
        self._size = _size(boxed(X0, "X0"))
        self._sieve = Sieve(task.loop, task.horizon, task.start, task.required)

    def results(self, begun: Sequence[Cell], executor: Executor | None) -> Iterator[int]:
        """How many cells are decided, after each that is bounded."""
        open_cells, left_over = deque(begun), deque[tuple[Cell, Margins | None]]()
        self._count = len(open_cells)
        running: dict[Future, tuple[Cell, Margins | None]] = {}
        workers = 1 if executor is None else AHEAD * getattr(executor, "_max_workers", AHEAD)
        try:
            while open_cells or left_over or running:
                while (open_cells or left_over) and len(running) < workers:
                    if not left_over and len(open_cells) >= TOGETHER and not self._late:
                        some = [open_cells.popleft() for _ in range(TOGETHER)]
                        left_over.extend(self._sifted(some))
                        yield len(self._done)
                        continue
                    cell, known = left_over.popleft() if left_over else (open_cells.popleft(), None)
                    bounded = known is not None and not self._task.by_programs
                    axis = None if bounded else self._hopeless(cell)
                    if axis is not None:
                        open_cells.extend(self._halved(cell, axis))
                        continue
                    part = jax.device_get(cell.part)
                    given = executor, self._task, part, self._deadline, known
                    running[_submitted(*given)] = cell, known
                finished, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in finished:
                    open_cells.extend(self._judged(running.pop(future)[0], future.result()))
                    yield len(self._done)
                if self.example is not None:
                    return
        finally:
            for future in running:
                future.cancel()

    def _sifted(self, cells: Sequence[Cell]) -> list[tuple[Cell, Margins | None]]:
        """Those of some cells that forms do not prove, with the margins that these say."""
        ends = [(np.asarray(cell.box.lower), np.asarray(cell.box.upper)) for cell in cells]
        found: list[tuple[Cell, Margins | None]] = []
        for cell, sifted in zip(cells, self._sieve.sifted(ends), strict=True):
            if sifted.proved:
                self._judged(cell, Outcome(True, sifted.margins, 0))
            else:
                found.append((cell, sifted.margins))
        return found

    def _judged(self, cell: Cell, outcome: Outcome) -> list[Cell]:
        """The halves of a cell that is not proved, as long as there may be more."""
        if outcome.proved:
            self._kept(cell, outcome, VerdictStatus.PROVED)
            self._tried.pop(self._depth(cell), None)
            return []
        self._tried.setdefault(self._depth(cell), deque()).append(outcome.axis)
        self._shoot(cell)
        if self.example is not None or not self._may_halve(cell, outcome.axis):
            self._kept(cell, outcome, VerdictStatus.UNKNOWN)
            return []
        return self._halved(cell, outcome.axis)

    @property
    def _late(self) -> bool:
        return time.monotonic() >= self._deadline

    def _may_halve(self, cell: Cell, axis: int) -> bool:
        full = self._most is not None and self._count >= self._most
        return not (self._late or full) and float(cell.box.widths[axis]) > 0

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
            if np.all((lower <= first) & (first <= upper)):
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

    def verdict(self) -> Verdict:
        """All of it."""
        statuses = {each.status for each in self._done}
        status = VerdictStatus.PROVED if statuses == {VerdictStatus.PROVED} else None
        if self.example is not None:
            status = VerdictStatus.REFUTED
        return Verdict(
            status or VerdictStatus.UNKNOWN,
            self._margins,
            self._simulated,
            self.example,
            cells=tuple(self._done),
        )


def _size(box: Box) -> float:
    """The logarithm of a volume, in halvings; of coordinates that are flat none."""
    widths = np.asarray(box.widths)
    return float(np.log2(widths[widths > 0]).sum())


def _submitted(executor: Executor | None, *given: Any) -> Future:
    if executor is not None:
        return executor.submit(outcome_of, *given)
    future: Future = Future()
    future.set_result(outcome_of(*given))
    return future


def outcome_of(
    task: CellTask, part: AbstractSet, deadline: float, known: Margins | None = None
) -> Outcome:
    """What is found of one cell, wherever it runs.

    Args:
        task: what is decided.
        part: of the initial set, of numpy arrays.
        deadline: when to stop, as `time.monotonic` says it.
        known: the margins by forms over the cell's box, which do not prove all; None if unknown.
    """
    with jax.enable_x64(True):
        box = boxed(jax.device_put(part), "X0")
        begun = _open_box(part, box)
        around = jax.device_get(box)
        blank = {item.name: np.full(task.horizon + 1, np.nan) for item in task.required}
        margins = {name: row.copy() for name, row in (known or blank).items()}
        scenarios = Scenarios.of(task.loop, begun, task.horizon, task.start)
        limits = min(FEW, task.nodes), deadline, WORK
        ladder = Ladder(task.loop, begun, around, scenarios, task.start, *limits)
        if known is not None and isinstance(begun, Box) and not task.by_programs:
            ladder.advance(tighten=False)  # nothing but forms could be tried again
            return Outcome(False, margins, _axis(ladder, _least(task.required, margins)))
        for k in range(task.horizon + 1):
            if k:
                ladder.advance(tighten=False)
            for item in task.required:
                if item.time == k:
                    middle = scenarios.middle(np.asarray(around.center))
                    proved, margin = bounded(item, ladder, part, middle)
                    margins[item.name][k] = np.fmax(margins[item.name][k], margin)
                    if not proved:
                        return Outcome(False, margins, _axis(ladder, item))
        return Outcome(True, margins, 0)


def _least(required: Sequence[Requirement], margins: Margins) -> Requirement:
    """The first requirement that is not proved, in time."""
    broken = [item for item in required if not margins[item.name][item.time] > 0]
    return min(broken or required, key=lambda item: item.time)


def _open_box(part: AbstractSet, box: Box) -> AbstractSet:
    """The cell as it is; a polytope that is its box as a box."""
    return jax.device_get(box) if isinstance(part, Box) else part


def bounded(
    item: Requirement, ladder: Ladder, part: AbstractSet, middle: Float[np.ndarray, " s"]
) -> tuple[bool, float]:
    """Whether a requirement surely holds where the ladder has come to, and its margin."""
    if item.time == 0:
        compared = item.compared_with(jax.device_put(part))
        return item.proved(compared), float(compared.margins.min())
    rows, units = values_of(item, ladder)
    uppers = rows.ends(ladder.horizon.start)[1]
    bounds = uppers if item.inside else uppers.min(keepdims=True)
    if not _all_right(item, bounds) and len(ladder.horizon.zero):
        bounds = ladder.climbed(target_of(item, ladder, None, middle)[0]).bounds
    return _all_right(item, bounds), float(np.min(-bounds / units))


def fails_everywhere(item: Requirement, ladder: Ladder) -> bool:
    """Whether every state surely breaks a requirement at the time that the ladder has come to."""
    facets = (np.asarray(part) for part in item.looser.facets)
    C, d = balanced(*facets, inner=not item.inside)
    lower, upper = (C @ ladder.horizon.state + (-d)).ends(ladder.horizon.start)
    return bool((lower > 0).any() if item.inside else (upper <= 0).all())


def _all_right(item: Requirement, bounds: Float[np.ndarray, " g"]) -> bool:
    return bool(np.all(bounds <= 0 if item.inside else bounds < 0))


def _axis(ladder: Ladder, item: Requirement) -> int:
    """The coordinate that moves the inputs of the first step's units most, or what is required."""
    horizon = ladder.horizon
    n = len(horizon.start.center)
    size = np.zeros(n)
    for layer in horizon.steps[0] if horizon.steps else ():
        bent = isinstance(layer.unit, SmoothUnit) | (layer.places >= 0)
        size += abs(layer.inputs.columns[:, :n])[np.broadcast_to(bent, layer.places.shape)].sum(0)
    if not size.any():
        C = np.asarray(item.region.facets[0])
        size = abs(C @ horizon.start.spread).sum(axis=0)
    return int(size.argmax())
