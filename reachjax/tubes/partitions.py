"""Partitions: tubes from the cells of an initial set, whose union holds every state.

Smaller sets leave fewer neurons undecided, so each cell's tube is tighter. Cells are independent
programs, which any executor may run.
"""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import closing
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Float, Int

from reachjax.loops import ClosedLoop
from reachjax.numerics.budget import Budget
from reachjax.numerics.checks import (
    described,
    is_concrete,
    owned,
    real_number,
    require_bar,
    require_double_precision,
    require_executor,
    require_kind,
    whole_number,
    wrapped,
)
from reachjax.numerics.files import writable
from reachjax.numerics.flags import lenient
from reachjax.numerics.logs import logged
from reachjax.numerics.pytrees import Replaceable, pytree
from reachjax.programs.relaxations import AbstractRelaxation, BranchAndCut
from reachjax.sets import AbstractSet, Box, Template
from reachjax.sets.cells import grid, halves
from reachjax.solvers import AbstractSolver, Auto
from reachjax.tubes.cell_jobs import CellJobs
from reachjax.tubes.displays import SAMPLES as SHOWN
from reachjax.tubes.displays import display, picture, table
from reachjax.tubes.interruptions import Interrupted
from reachjax.tubes.kept import keep
from reachjax.tubes.propagation import GAP, SAMPLES, Options, Task
from reachjax.tubes.reach import ReachTube, tube_of
from reachjax.tubes.seals import Seal, require_sealed, seal_of
from reachjax.tubes.tables import frame, rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame

AHEAD = 1
"""How many cells an executor is given for each of its workers: they share what time is left."""

Bar = Callable[[Iterable[Any]], Iterable[Any]]
"""Wraps an iteration over cells, such as `tqdm.tqdm`."""

BESIDE = 1e-9
"""States that are further beside the initial set than this are not in it."""


@pytree
class PartitionedTube(Replaceable):
    """Tubes from cells that cover an initial set: each state is surely in one of them.

    Attributes:
        X0: the initial set.
        tubes: one for each cell.
        seal: a hash of both, as `reach_partitioned` returned them.

    Raises:
        ValueError: a part was exchanged for another one. These tubes come from `reach_partitioned`.
    """

    X0: AbstractSet
    tubes: tuple[ReachTube, ...]
    seal: Seal | None = None

    def __post_init__(self):
        self.require_sealed()

    @classmethod
    def sealed(cls, X0: AbstractSet, tubes: tuple[ReachTube, ...]) -> PartitionedTube:
        """The tubes of cells of this set, which were proved together."""
        return cls(X0, tubes, seal_of(X0, [tube.seal for tube in tubes]))

    def require_sealed(self) -> None:
        """Raise an error unless both parts are those that `reach_partitioned` returned together.

        Raises:
            ValueError: a part was changed, or exchanged for another one.
        """
        require_sealed("the tube", self.seal, self.X0, [tube.seal for tube in self.tubes])

    def __repr__(self) -> str:
        return f"PartitionedTube(cells={len(self.tubes)}, horizon={self.horizon})"

    @property
    def horizon(self) -> int:
        """The number of steps."""
        return self.tubes[0].horizon

    def save(self, path: str | os.PathLike[str]) -> None:
        """Keep the tubes of all cells in one file, as `ReachTube.save` does."""
        self.require_sealed()
        keep(writable("path", path), self, self.tubes[0].loop)

    def __len__(self) -> int:
        """The number of cells."""
        return len(self.tubes)

    def __getitem__(self, cell: int | slice) -> Any:
        """The tube of a cell, or a tuple of them."""
        return self.tubes[cell]

    def __iter__(self) -> Iterator[ReachTube]:
        return iter(self.tubes)

    def to_dataframe(self) -> DataFrame:
        """The rows of `ReachTube.to_dataframe`, with the number of the cell before them.

        Raises:
            ImportError: pandas is missing; it comes with `pip install 'reachjax[tables]'`.
        """
        numbered = enumerate(self.tubes)
        return frame([{"cell": cell} | row for cell, tube in numbered for row in rows(tube)])

    def plot(self, ax: Axes | None = None, **options: Any) -> Axes:
        """Draw the sets of all cells: `reachjax.plot_tube(tube, ax, **options)`."""
        from reachjax.tubes.plotting import plot_tube

        return plot_tube(self, ax, **options)

    def _repr_html_(self) -> str:
        times = range(1, self.horizon + 1)
        steps = [[t, float(np.max(self.gaps(t)))] for t in times]
        few = max(1, SHOWN // len(self))
        several = self.tubes[0].loop.states > 1
        drawn = picture(lambda ax: self.plot(ax, samples=few)) if several else ""
        return display(repr(self), table(["t", "largest gap"], steps), drawn)

    def sets(self, t: int) -> tuple[AbstractSet, ...]:
        """One set of each cell: every state at time `t` is surely in one of them."""
        return tuple(tube.sets[t] for tube in self.tubes)

    def bounds(self, t: int) -> Float[np.ndarray, " m"]:
        """What every facet's value at time `t` surely does not exceed: the largest of the cells'.

        Raises:
            ValueError: there is no certificate for this time.
        """
        return np.max([tube.proof(t).bounds for tube in self.tubes], axis=0)

    def witnesses(self, t: int) -> Float[np.ndarray, " m"]:
        """The largest simulated value of every facet at time `t`, from states of the initial set.

        Raises:
            ValueError: there is no certificate for this time.
        """
        return np.max([_attained(self.X0, tube, t) for tube in self.tubes], axis=0)

    def gaps(self, t: int) -> Float[np.ndarray, " m"]:
        """`bounds - witnesses`: how much tightness may be left in the union's facets.

        Raises:
            ValueError: there is no certificate for this time.
        """
        return self.bounds(t) - self.witnesses(t)


@logged
@lenient
def reach_partitioned(
    loop: ClosedLoop,
    X0: AbstractSet,
    horizon: int,
    template: Template,
    relaxation: AbstractRelaxation = BranchAndCut(),  # noqa: B008  (immutable)
    window: int | None = None,
    solver: AbstractSolver = Auto(),  # noqa: B008
    *,
    cells: int | Sequence[int] | Int[np.ndarray, " n_x"],
    executor: Executor | None = None,
    start: int = 0,
    samples: int = SAMPLES,
    seed: int = 0,
    progress: Bar | None = None,
    gap: float = GAP,
    time_limit: float | None = None,
    known: Sequence[ReachTube] = (),
) -> PartitionedTube:
    """Tubes from cells of an initial set, which together hold every state.

    Args:
        loop: the closed loop.
        X0: the set of initial states.
        horizon: the number `N` of steps.
        template: the facets of every set.
        relaxation: which products of facts are used.
        window: over how many steps each program reaches back; None: as many as the solver bears.
        solver: what solves the semidefinite programs.
        cells: a number for each coordinate: equal parts of the box around the initial set. Or how
            many in all: then those cells are halved at which the union's gap is widest, until there
            are as many or no gap is left.
        executor: runs the cells' programs: any with the interface of `concurrent.futures`; threads
            by default. Arguments are sent as numpy arrays.
        start: the time of `X0`, for time-varying loops.
        samples: how many trajectories are simulated in each cell for witnesses.
        seed: of the samples.
        progress: wraps the iteration over tubes to show a progress bar, such as `tqdm.tqdm`.
        gap: what may be left open of a facet, as a part of its half-range: in each cell, as `reach`
            takes it, and in the union, where it ends the halving of cells.
        time_limit: seconds for the whole call, shared out among the cells. Cells that there is no
            time for are not halved, or one tube from all of the set stands for them.
        known: tubes of cells that an interrupted call of the same question had done by then: these
            cells are not bounded again.

    Raises:
        Interrupted: Ctrl-C; its `found` has the tubes of the cells that were done.
        RuntimeError: JAX's 64-bit floats are off.
        TypeError: an argument is of another kind.
        ValueError: as `reach`; or the arguments are traced, or what is known is of another loop,
            template, horizon or start.

    Example:
        >>> from reachjax import MLP, AffinePlant, Box
        >>> net = MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
        >>> loop = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net, Box([-1.0], [1.0]))
        >>> tube = reach_partitioned(loop, Box([-1.0], [2.0]), 2, Template.box(1), cells=(3,))
        >>> tube.bounds(2).round(6).tolist()
        [0.72, 0.36]
    """
    require_kind("loop", loop, ClosedLoop, "a ClosedLoop")
    require_kind("X0", X0, AbstractSet, "a set such as Box(lower, upper)")
    require_kind("template", template, Template, "a template of facets, such as Template.box(n)")
    require_double_precision(loop=loop, X0=X0, template=template)
    if not is_concrete(loop, X0, template):
        raise ValueError("partitions need numbers: call reach_partitioned outside of jax.jit")
    require_executor(executor)
    require_bar(progress)
    X0 = owned(X0)
    options = {
        "horizon": horizon,
        "relaxation": relaxation,
        "window": window,
        "solver": solver,
        "start": start,
        "samples": samples,
        "seed": seed,
        "gap": real_number("gap", gap, 0.0),
    }
    budget = Budget.of(time_limit)
    own = ThreadPoolExecutor(os.cpu_count()) if executor is None else None
    run = _Run(loop, template, options, own or executor, progress, budget)
    run.remember(known)
    try:
        counts: Any = cells
        if isinstance(cells, np.ndarray | jax.Array) and cells.ndim < 2:
            counts = cells.tolist()
        if isinstance(counts, int | np.integer):
            tubes = _guided(run, X0, whole_number("cells", counts, 1), gap)
        elif isinstance(counts, Sequence) and not isinstance(counts, str):
            parts = [cell.part for cell in grid(X0, counts)]
            tubes = [tube for tube in run.tubes(parts, len(parts)) if tube is not None]
            if len(tubes) < len(parts):  # one tube from all of the set stands for the others
                tubes.append(run.whole(X0))
        else:
            raise TypeError(
                "cells must be a whole number, or one for each coordinate, but "
                f"{described(cells)} arrived"
            )
    except KeyboardInterrupt:
        budget.stop()  # threads look at the clock, and end by themselves
        if not run.done:
            raise
        message = (
            f"interrupted with {len(run.done)} cells done: this exception's `found` has their "
            "tubes, and reach_partitioned(..., known=found) goes on"
        )
        raise Interrupted(message, tuple(run.done)) from None
    finally:
        if own is not None:
            own.shutdown(wait=False, cancel_futures=True)
    return PartitionedTube.sealed(X0, tuple(tubes))


class _Run:
    """Tubes of one loop, computed by an executor, cell by cell.

    Attributes:
        done: the tubes so far.
    """

    def __init__(
        self,
        loop: ClosedLoop,
        template: Template,
        options: dict,
        executor: Any,
        progress: Bar | None,
        budget: Budget,
    ):
        self._loop, self._template = jax.device_get((loop, template))
        self._options, self._budget = options, budget
        self._executor, self._progress = executor, progress
        self._known: dict[bytes, ReachTube] = {}

    @property
    def done(self) -> list[ReachTube]:
        """The tubes so far."""
        return list(self._known.values())

    def remember(self, tubes: Sequence[ReachTube]) -> None:
        """Take tubes for those of their cells.

        Raises:
            TypeError: one is no tube.
            ValueError: one was changed, or is of another question.
        """
        own = self._loop, self._template, self._options["horizon"], self._options["start"]
        for tube in tubes:
            require_kind("known", tube, ReachTube, "the tubes that an interrupted call had done")
            tube.require_sealed()
            theirs = tube.loop, tube.template, tube.horizon, tube.start
            if _question(*own) != _question(*theirs):
                raise ValueError(
                    "known must be tubes of the same loop, template, horizon and start, but one of "
                    "another question arrived: what was proved of that says nothing of this one"
                )
            self._known[_question(tube.sets[0])] = tube

    def tubes(self, cells: Sequence[AbstractSet], later: int) -> list[ReachTube | None]:
        """One for each cell, in their order; None of those that there was no time for.

        Args:
            cells: the cells.
            later: how many there will be in all, these included; they share the time.

        Raises:
            Exception: the first error of a cell ends the run.
        """
        names = [_question(cell) for cell in cells]
        left = deque(i for i, name in enumerate(names) if name not in self._known)
        with closing(self._results(cells, names, left, later)) as results:
            for _ in wrapped(self._progress, results):
                pass
            for _ in results:  # what a bar left out
                pass
        return [self._known.get(name) for name in names]

    def _results(
        self, cells: Sequence[AbstractSet], names: Sequence[bytes], left: deque[int], later: int
    ) -> Generator[ReachTube, None, None]:
        """Each tube as it comes."""
        given = self._loop, self._template, self._options
        jobs = CellJobs[int](self._executor, AHEAD)
        try:
            while (left and not self._budget.late) or jobs:
                while left and len(jobs) < jobs.most and not self._budget.late:
                    part = min(1.0, jobs.workers / max(later, 1))
                    later -= 1
                    number = left.popleft()
                    cell = jax.device_get(cells[number])
                    jobs.submit(number, _tube, cell, *given, self._budget, part)
                for number, tube in jobs.finished():
                    found = self._known[names[number]] = jax.device_put(tube)
                    yield found
        finally:
            jobs.cancelled()

    def whole(self, X0: AbstractSet) -> ReachTube:
        """The tube from all of a set, here and whatever the time."""
        given = jax.device_get(X0), self._loop, self._template, self._options
        return jax.device_put(_tube(*given, self._budget, 1.0))


def _question(*parts: Any) -> bytes:
    """What tells one question from another: a hash of all arrays and of what holds them."""
    return np.asarray(seal_of(*jax.device_put(parts))).tobytes()


@lenient
def _tube(
    cell: AbstractSet,
    loop: ClosedLoop,
    template: Template,
    options: dict,
    budget: Budget,
    part: float,
) -> ReachTube:
    """One cell's tube, from numpy arrays to numpy arrays, wherever it runs.

    It takes this part of the time that is left when it begins.
    """
    with jax.enable_x64(True):
        loop, cell, template = jax.device_put((loop, cell, template))
        task = Task(loop, cell, options["horizon"], template, options["start"])
        others = {name: options[name] for name in Options._fields if name in options}
        return jax.device_get(tube_of(task, Options(**others, time_limit=budget.share(part))))


def _guided(run: _Run, X0: AbstractSet, count: int, gap: float) -> list[ReachTube]:
    """Halve the cells at which the union's gap is widest, along their longest side."""
    first, *_ = run.tubes([X0], 2 * count - 1)
    boxes, tubes = [X0.bounding_box()], [first or run.whole(X0)]
    sides = np.asarray(boxes[0].widths)
    sides = np.where(sides > 0, sides, np.inf)  # a side without length is not halved
    widths = _widths(tubes[0])
    while len(tubes) < count:
        some = min(math.ceil(len(tubes) / 4), count - len(tubes))
        worst = _worst(X0, tubes, widths, gap)[:some]
        if not worst:
            break
        parts = [halves(X0, boxes[i], sides) for i in worst]
        flat = [half.part for pair in parts for half in pair]
        found = iter(run.tubes(flat, 2 * (count - len(tubes))))
        kept = dict(enumerate(zip(boxes, tubes, strict=True)))
        done = list[tuple[Box, ReachTube]]()
        for i, pair in zip(worst, parts, strict=True):
            those = [(half.box, tube) for half in pair if (tube := next(found)) is not None]
            if len(those) == len(pair):  # else the cell stays as it is: the time is over
                del kept[i]
                done += those
        if not done:
            break
        boxes, tubes = map(list, zip(*kept.values(), *done, strict=True))
    return tubes


def _attained(X0: AbstractSet, tube: ReachTube, t: int) -> Float[np.ndarray, " m"]:
    """What a cell's witnesses attain; those beside the initial set do not count."""
    proof = tube.proof(t)
    inside = np.asarray(X0.contains(proof.witness_states[:, : X0.dimension], BESIDE))
    return np.where(inside, proof.witnesses, -np.inf)


def _widths(tube: ReachTube) -> Float[np.ndarray, "h m"]:
    """The width of each set in the direction of each facet."""
    facets = ((X, *X.facets) for X in tube.sets[1:])
    return np.array([b + X.support(-A) for X, A, b in facets])


def _worst(
    X0: AbstractSet, tubes: list[ReachTube], widths: Float[np.ndarray, "h m"], gap: float
) -> list[int]:
    """The cells whose bounds leave gaps in the union, the widest first, in units of its widths."""
    steps = range(1, tubes[0].horizon + 1)
    bounds = np.array([[tube.proof(t).bounds for t in steps] for tube in tubes])
    attained = np.array([[_attained(X0, tube, t) for t in steps] for tube in tubes])
    witnesses = attained.max(axis=0)
    beyond = (bounds - witnesses) / np.where(widths > 0, widths, np.inf)
    widest = beyond.max(axis=(1, 2))
    return [int(i) for i in np.argsort(-widest, stable=True) if widest[i] > gap / 2]
