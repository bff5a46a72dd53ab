"""Winning sets: from which initial states a specification surely holds, and from which it fails.

Cells of a domain are proved, or refuted, if it fails from every state of them, or halved. A few
trajectories say which of these to try, so that nothing is bounded where the boundary runs through.
Affine forms bound many cells at once; linear programs are for those that are left when there may be
no more of them. Proved cells are an inner estimate of the winning set; all that are not refuted, an
outer one.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Sequence
from concurrent.futures import Executor
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from reachjax.loops import ClosedLoop
from reachjax.loops.scenarios import Runs, Scenarios
from reachjax.methods.cell_tree import CellTree, Node
from reachjax.methods.propagation import known_numbers
from reachjax.methods.searches import AbstractSearch, Bar, Question
from reachjax.numerics.budget import Budget, Interrupted
from reachjax.numerics.checks import (
    require_bar,
    require_double_precision,
    require_executor,
    require_kind,
    same_size,
    whole_number,
)
from reachjax.numerics.deprecations import once_positional
from reachjax.numerics.flags import lenient
from reachjax.numerics.logs import logged
from reachjax.numerics.seals import seal_of
from reachjax.programs.relaxations import BranchAndCut
from reachjax.sets import Box
from reachjax.verdicts.cell_tasks import CellTask, outcome_of
from reachjax.verdicts.findings import rooms_of
from reachjax.verdicts.sieve import TOGETHER, Ends, Outcome, Sieve
from reachjax.verdicts.soundness import require_unbroken_cells
from reachjax.verdicts.specification import AvoidSets, Region, Timed, period_of, requirements
from reachjax.verdicts.verdict import DecidedCell, VerdictStatus, WinningSet

LAST_PROGRAMS = 10
"""Linear programs that a bound may take in a cell that is not halved any more."""

ROOM = 0.2
"""Linear programs are tried where the least room of trajectories is at least this part of what is
open between it and forms (measured: of 451 cells with less they proved none)."""

INNER = 8
"""How many points of a cell are simulated, besides the middles of its sides."""

NEARLY = 0.1
"""Coordinates whose influence differs by no more than this part are cut by turns."""

Waiting = tuple[float, int, Node]
"""A cell in a heap, the largest first."""

LONGEST = 256
"""A side that is so many times as long as another one, in parts of the domain's, is cut first."""

ENOUGH = 8
"""So many cells are worth a call that is compiled; fewer are bounded one by one."""


class Sorted(NamedTuple):
    """The status of a cell, and how to go on with it.

    Attributes:
        status: proved; refuted, from every state; or neither.
        margin: the smallest certified one; NaN where nothing was bounded.
        axis: along which it should be halved.
        promising: whether linear programs might prove what forms do not.
    """

    status: VerdictStatus
    margin: float
    axis: int
    promising: bool = False


@once_positional("goal", "safe", "avoid")
@logged
@lenient
def winning_set(
    loop: ClosedLoop,
    domain: Box,
    horizon: int,
    *,
    goal: Timed | None = None,
    safe: Region | None = None,
    avoid: AvoidSets | None = None,
    cells: int = 10_000,
    relaxation: BranchAndCut = BranchAndCut(nodes=LAST_PROGRAMS),  # noqa: B008  (immutable)
    start: int = 0,
    time_limit: float | None = None,
    known: WinningSet | None = None,
    executor: Executor | None = None,
    progress: Bar | None = None,
) -> WinningSet:
    """From which initial states of a box a specification holds: cells, refined at the boundary.

    Args:
        loop: the closed loop.
        domain: the initial states that are asked about.
        horizon: the number of steps.
        goal: where every state must be at the horizon; or a mapping from times, or from ranges of
            times, to where it must be then.
        safe: where every state must be at all times.
        avoid: closed sets in which no state may be: a sequence for all times, or a mapping from
            times, or from ranges of times, to sequences.
        cells: how many there may be. The largest that are undecided are halved.
        relaxation: how many linear programs a bound may take, once there are as many cells.
        start: the time of the initial states.
        time_limit: seconds, after which cells stay as they are.
        known: what an earlier call found of the same question, whose undecided cells are gone on
            with; None: to begin with the whole domain.
        executor: runs the cells: any with the interface of `concurrent.futures`, such as a
            `ProcessPoolExecutor`. None: one after the other, here.
        progress: wraps the iteration over cells to show a progress bar, such as `tqdm.tqdm`.

    Returns:
        All cells; of a loop with disturbances, proved for all of them, and refuted for all.

    Raises:
        Interrupted: Ctrl-C; its `found` is the winning set so far.
        RuntimeError: JAX's 64-bit floats are off.
        TypeError: an argument is of another kind, or a set is of a kind without facets.
        ValueError: nothing is required, dimensions disagree, a time is beyond the horizon, or what
            is known is of another question.
        UnsoundError: JAX runs the loop otherwise than it was proved or refuted: a defect to be
            reported.

    Example:
        >>> from reachjax import MLP, AffinePlant
        >>> net = MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
        >>> loop = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net, Box([-1.0], [1.0]))
        >>> found = winning_set(loop, Box([-8.0], [8.0]), 2, safe=Box([-4.0], [4.0]), cells=64)
        >>> found.contains([[0.0], [3.5], [5.0]]).tolist()
        [True, True, False]
        >>> 7.0 < found.volume(VerdictStatus.PROVED) <= 8.0
        True
    """
    require_kind("loop", loop, ClosedLoop, "a ClosedLoop")
    require_kind("domain", domain, Box, "a Box, around the initial states that are asked about")
    require_kind("relaxation", relaxation, BranchAndCut, "a BranchAndCut")
    require_double_precision(loop=loop, domain=domain)
    same_size(
        "the loop's number of states is",
        "the dimension of domain is",
        (loop.states, domain.dimension),
    )
    loop.check_horizon(horizon, start)
    most = whole_number("cells", cells, 1)
    require_executor(executor)
    require_bar(progress)
    required = requirements(
        loop.states, horizon, period_of(loop), goal=goal, safe=safe, avoid=avoid
    )
    loop, domain = jax.device_get(known_numbers("winning_set", loop, domain, "domain"))
    task = CellTask(loop, horizon, start, tuple(required), relaxation.nodes)
    asked = {
        f"{number}: {item.name}, {item.time}, {item.inside}{', since' * item.throughout}": (
            item.region,
            item.ball,
        )
        for number, item in enumerate(required)
    }

    def found_of(cells: tuple[DecidedCell, ...]) -> WinningSet:
        numbers = [[cell.lower, cell.upper, [cell.margin]] for cell in cells]
        codes = [[*VerdictStatus].index(cell.status) for cell in cells]
        said = [np.array([np.concatenate(each) for each in numbers]), np.array(codes, int)]
        return WinningSet(domain, cells, seal_of(loop, domain, asked, said, start=start))

    ends = np.asarray(domain.lower), np.asarray(domain.upper)
    given = [DecidedCell(*ends, VerdictStatus.UNKNOWN, np.nan)]
    if known is not None:
        require_kind("known", known, WinningSet, "a WinningSet, as winning_set(...) returns it")
        if not np.array_equal(known.seal, found_of(known.cells).seal):
            raise ValueError(
                "known must be of the same loop, domain, start, horizon and requirements, with the "
                "cells that were found, but others arrived: what was proved of another question "
                "says nothing of this one"
            )
        given = list(known.cells)
    roots = [Node(cell.lower, cell.upper, found=cell) for cell in given]
    search = _Winning(task, CellTree(domain, roots, most), Budget.of(time_limit))
    try:
        search.run(executor, progress)
        require_unbroken_cells(loop, domain, horizon, start, required, search.cells)
    except KeyboardInterrupt:
        found = found_of(search.cells)
        message = (
            f"interrupted with {len(found.cells)} cells: this exception's `found` is the winning "
            "set so far, and winning_set(..., known=found) goes on"
        )
        raise Interrupted(message, found) from None
    return found_of(search.cells)


class _Winning(AbstractSearch):
    """The cells of a domain, of which the largest that are open are asked about first.

    Each is a `DecidedCell`; those that programs are left to wait until no other is open.
    """

    ahead = 2  # more would be halved out of order

    def __init__(self, task: CellTask, cells: CellTree, budget: Budget):
        self._task, self._tree, self._budget = task, cells, budget
        self._serial, self._last = itertools.count(), False
        self._open, self._left = list[Waiting](), list[Waiting]()
        for node in cells.leaves:
            if node.found.status is VerdictStatus.UNKNOWN:
                self._push(self._open, node)

    @property
    def cells(self) -> tuple[DecidedCell, ...]:
        """What is known of all cells."""
        return tuple(DecidedCell(*node.ends, *node.found[2:]) for node in self._tree.leaves)

    def _push(self, waiting: list[Waiting], node: Node) -> None:
        heapq.heappush(waiting, (-self._tree.volume(node), next(self._serial), node))

    def question(self, asked: int, workers: int) -> Question | None:
        """Trajectories and forms of many cells; or programs for one, once no others are open."""
        self._last = not self._open and (self._last or not asked)
        waiting, together = (self._left, 1) if self._last else (self._open, TOGETHER)
        if self._budget.late or not waiting:
            return None
        nodes = [heapq.heappop(waiting)[-1] for _ in range(min(together, len(waiting)))]
        task = self._task if self._last else self._task._replace(nodes=0)
        boxes = [node.ends for node in nodes]
        return Question(nodes, sorted_cells, (task, boxes, self._tree.sides, self._budget))

    def answered(self, question: Question, answer: Sequence[Sorted]) -> int:
        """How many cells are decided, as far as a bar is concerned."""
        last = question.given[0] is self._task
        for node, found in reversed(list(zip(question.nodes, answer, strict=True))):
            self._judge(node, found, last)
        return self._tree.count - len(self._open) - len(self._left)

    def _judge(self, node: Node, found: Sorted, last: bool) -> None:
        """Keep a cell, or halve it as long as there may be more, or leave it to programs."""
        undecided = found.status is VerdictStatus.UNKNOWN
        node.found = node.found._replace(status=found.status, margin=found.margin)
        if undecided and self._tree.can_halve(node, found.axis):
            halves = self._tree.halved(node, found.axis)
            for half in halves:
                half.found = node.found
            self._tree.replace(node, halves, found.axis)
            for half in halves:
                self._push(self._open, half)
        elif found.promising and self._task.by_programs and not last:
            self._push(self._left, node)


@lenient
def sorted_cells(
    task: CellTask, boxes: Sequence[Ends], scale: Float[np.ndarray, " n"], budget: Budget
) -> list[Sorted]:
    """What is found of each of some boxes, wherever it runs.

    Args:
        task: what is decided.
        boxes: of the domain.
        scale: the unit in which each coordinate is measured.
        budget: of the call; of boxes that it is too late for, trajectories alone are known.
    """
    with jax.enable_x64(True):
        points = [_points(*box) for box in boxes]
        rooms = _rooms(task, np.concatenate(points), boxes)
        each = np.split(rooms, np.cumsum([len(part) for part in points])[:-1], axis=1)
        broken = [(part.min(axis=0) < 0) for part in each]
        alike = [number for number, some in enumerate(broken) if some.all() or not some.any()]
        sifted: dict[int, Outcome] = {}
        if len(alike) >= ENOUGH:
            sieve = Sieve(task.loop, task.horizon, task.start, task.required)
            some = [boxes[number] for number in alike]
            if sieve.pays(some, budget):
                sifted = dict(zip(alike, sieve.sifted(some), strict=True))
        return [
            _sorted(task, box, scale, part, sifted.get(number), budget)
            for number, (box, part) in enumerate(zip(boxes, each, strict=True))
        ]


def _axis(room: Float[np.ndarray, " c"], widths: Float[np.ndarray, " n"]) -> int:
    """The coordinate, of those that are long enough, along which a room differs most."""
    n = len(widths)
    with np.errstate(invalid="ignore"):
        moved = np.nan_to_num(abs(room[: 2 * n] - room[2 * n]), posinf=1.0)
    moved = np.where(widths * LONGEST > widths.max(), moved.reshape(n, 2).max(axis=1), -1.0)
    alike = moved >= (1 - NEARLY) * moved.max()
    return int(np.where(alike, widths, -1.0).argmax())


def _points(
    lower: Float[np.ndarray, " n"], upper: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "c n"]:
    """The middles of a box's sides, axis by axis, its own, and some of its points."""
    n, center = len(lower), lower + (upper - lower) / 2
    stars = np.repeat(center[None], 2 * n, axis=0)
    stars[np.arange(0, 2 * n, 2), np.arange(n)] = lower
    stars[np.arange(1, 2 * n, 2), np.arange(n)] = upper
    shares = np.random.default_rng(0).uniform(size=(INNER, n))
    shares[: INNER // 2] = shares[: INNER // 2] > 0.5
    return np.concatenate(
        [stars, center[None], np.clip(lower + shares * (upper - lower), lower, upper)]
    )


def _rooms(
    task: CellTask, states: Float[np.ndarray, "c n"], boxes: Sequence[Any]
) -> Float[np.ndarray, "r c"]:
    """How far trajectories are on the right side of each requirement; what overflows is not."""
    scenarios = Scenarios.of(task.loop, Box(*boxes[0]), task.horizon, task.start)
    drawn = scenarios.drawn(states, 0)
    runs = Runs(drawn, scenarios.runs(task.loop, drawn, task.horizon, task.start))
    rooms = np.stack([rooms_of(task.loop, item, runs, task.start) for item in task.required])
    return np.where(np.isfinite(rooms), rooms, -np.inf)


def _sorted(
    task: CellTask,
    ends: Ends,
    scale: Float[np.ndarray, " n"],
    rooms: Float[np.ndarray, "r c"],
    sifted: Outcome | None,
    budget: Budget,
) -> Sorted:
    """What is found of one box, given what trajectories from it do, and forms say of it."""
    least, widths = rooms.min(axis=0), (ends[1] - ends[0]) / scale
    if (least < 0).any() and (least >= 0).any():
        return Sorted(VerdictStatus.UNKNOWN, np.nan, _axis(least, widths))
    if sifted is None and budget.late:
        return Sorted(VerdictStatus.UNKNOWN, np.nan, _axis(least, widths))
    if sifted is None:
        broken = [bool(np.all(row < 0)) for row in rooms]
        sifted = outcome_of(task, jax.device_get(Box(*ends)), budget, broken=broken)
    number = np.argmin([sifted.margins[item.name][item.time] for item in task.required])
    status = VerdictStatus.REFUTED if sifted.refuted else VerdictStatus.UNKNOWN
    status = VerdictStatus.PROVED if sifted.proved else status
    margin = np.nan if sifted.refuted else sifted.margin
    return Sorted(status, margin, _axis(rooms[number], widths), _promising(least, margin))


def _promising(least: Float[np.ndarray, " c"], margin: float) -> bool:
    """Whether what trajectories leave as room is no small part of what a bound leaves open."""
    return bool(least.min() > 0 and least.min() >= ROOM * (least.min() - margin))
