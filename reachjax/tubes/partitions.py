"""Partitions: tubes from the cells of an initial set, whose union holds every state.

Smaller sets leave fewer neurons undecided, so each cell's tube is tighter. Cells are independent
programs, which any executor may run.
"""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Float, Int

from reachjax.loops import ClosedLoop
from reachjax.methods.cell_tree import CellTree, Node
from reachjax.methods.problem import AbstractMethod, Problem
from reachjax.methods.propagation import GAP, SAMPLES, Options, template_of
from reachjax.methods.searches import AbstractSearch, Bar, Question
from reachjax.numerics.archives import writable
from reachjax.numerics.budget import Budget, Interrupted
from reachjax.numerics.checks import (
    is_concrete,
    owned,
    real_number,
    require_bar,
    require_double_precision,
    require_executor,
    require_kind,
)
from reachjax.numerics.flags import lenient
from reachjax.numerics.logs import logged
from reachjax.numerics.pytrees import Replaceable, pytree
from reachjax.numerics.seals import Seal, require_sealed, seal_of
from reachjax.programs.relaxations import AbstractRelaxation, BranchAndCut
from reachjax.sets import AbstractSet, Template
from reachjax.sets.pictures import draw_flowpipes
from reachjax.solvers import AbstractSolver, Auto
from reachjax.tubes.displays import DRAWN, SHOWN, display, frame, picture, rows, table
from reachjax.tubes.reach import ReachTube, tube_of
from reachjax.tubes.saving import keep

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame

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
        return frame(
            [
                {"cell": cell} | row
                for cell, tube in enumerate(self.tubes)
                for row in rows(tube.template, tube.certificates)
            ]
        )

    def plot(
        self, ax: Axes | None = None, samples: int = DRAWN, coordinates: tuple[int, int] = (0, 1)
    ) -> Axes:
        """Draw the sets of all cells over simulated states, see `reachjax.plot_tube`."""
        flowpipes = [tube.flowpipe(samples) for tube in self.tubes]
        return draw_flowpipes(flowpipes, ax, coordinates)

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
    template: Template | None = None,
    relaxation: AbstractRelaxation | AbstractMethod = BranchAndCut(),  # noqa: B008
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
        template: the facets of every set. None: octagons in two dimensions, boxes in others
            (`Template.default`).
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
    facets = "a template of facets, such as Template.box(n), or None"
    template = require_kind("template", template_of(loop, template), Template, facets)
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
    search = _Tubes(X0, CellTree.over(X0, cells), loop, template, options, budget)
    search.remember(known)
    own = ThreadPoolExecutor(os.cpu_count()) if executor is None else None
    try:
        search.all_of(own or executor, progress)
        tubes = search.union
    except KeyboardInterrupt:
        budget.stop()  # threads look at the clock, and end by themselves
        if not search.done:
            raise
        message = (
            f"interrupted with {len(search.done)} cells done: this exception's `found` has their "
            "tubes, and reach_partitioned(..., known=found) goes on"
        )
        raise Interrupted(message, tuple(search.done)) from None
    finally:
        if own is not None:
            own.shutdown(wait=False, cancel_futures=True)
    return PartitionedTube.sealed(X0, tuple(tubes))


class _Tubes(AbstractSearch):
    """Tubes of one loop from the cells of a set.

    Where cells are to be halved, that happens in rounds: the quarter of them whose bounds leave the
    widest gaps in the union.

    Args:
        X0: the set.
        cells: of it, to begin with; each has its tube, or None.
        loop: the closed loop.
        template: the facets of every set.
        options: of each tube.
        budget: of the call.
    """

    def __init__(
        self,
        X0: AbstractSet,
        cells: CellTree,
        loop: ClosedLoop,
        template: Template,
        options: dict[str, Any],
        budget: Budget,
    ):
        self._X0, self._cells, self._options, self._budget = X0, cells, options, budget
        self._loop, self._template = jax.device_get((loop, template))
        self._known: dict[bytes, ReachTube] = {}
        self._round, self._halves = cells.leaves, dict[Node, list[Node]]()
        self._asked = deque[Node]()
        self._left = len(self._round) if cells.most is None else 2 * cells.most - 1
        self._widths: np.ndarray | None = None

    @property
    def done(self) -> list[ReachTube]:
        """The tubes so far."""
        return list(self._known.values())

    @property
    def union(self) -> tuple[ReachTube, ...]:
        """Tubes that hold all states; one from all of the set stands for those that are missing."""
        tubes = [node.found for node in self._cells.leaves]
        found = [tube for tube in tubes if tube is not None]
        return (*found, self._whole()) if len(found) < len(tubes) else tuple(found)

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

    def all_of(self, executor: Executor | None, progress: Bar | None) -> None:
        """All tubes, round by round; those that a bar leaves out, too."""
        while self._round:
            for bar in (progress, None):
                self._asked = deque(node for node in self._round if node.found is None)
                self.run(executor, bar)
            self._round = [] if self._cells.most is None else self._next_round()

    def question(self, asked: int, workers: int) -> Question | None:
        """The tube of the next cell that has none."""
        while self._asked and not self._budget.late:
            node = self._asked.popleft()
            node.found = self._known.get(_question(node.part))
            if node.found is None:
                part = min(1.0, workers / max(self._left, 1))
                self._left -= 1
                given = self._loop, self._template, self._options, self._budget, part
                return Question([node], _tube, (jax.device_get(node.part), *given))
        return None

    def answered(self, question: Question, answer: ReachTube) -> ReachTube:
        """The tube, as a bar sees it."""
        (node,) = question.nodes
        tube = jax.device_put(answer)
        node.found = self._known[_question(node.part)] = tube
        return tube

    def _whole(self) -> ReachTube:
        """The tube from all of a set, here and whatever the time."""
        given = jax.device_get(self._X0), self._loop, self._template, self._options
        return jax.device_put(_tube(*given, self._budget, 1.0))

    def _next_round(self) -> list[Node]:
        """The halves that are asked about now that those of the last round are known."""
        for node, halves in self._halves.items():
            if all(half.found is not None for half in halves):  # else the time is over
                self._cells.replace(node, halves, self._cells.longest(node))
        leaves, left = self._cells.leaves, (self._cells.most or 0) - self._cells.count
        fruitless = self._halves and not any(node.halves for node in self._halves)
        if fruitless or left <= 0 or leaves[0].found is None:
            return []
        tubes = [leaf.found for leaf in leaves]
        if self._widths is None:
            self._widths = _widths(tubes[0])
        worst = [leaves[i] for i in _worst(self._X0, tubes, self._widths, self._options["gap"])]
        axes = {node: self._cells.longest(node) for node in worst}
        some = [node for node in worst if self._cells.can_halve(node, axes[node])]
        some = some[: min(math.ceil(len(leaves) / 4), left)]
        self._halves = {node: self._cells.halved(node, axes[node]) for node in some}
        self._left = 2 * left
        return [half for pair in self._halves.values() for half in pair]


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
        problem = Problem(loop, cell, template, options["horizon"], options["start"])
        others = {name: options[name] for name in Options._fields if name in options}
        return jax.device_get(tube_of(problem, Options(**others, time_limit=budget.share(part))))


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


@lenient
def plot_tube(
    tube: ReachTube | PartitionedTube,
    ax: Axes | None = None,
    samples: int = DRAWN,
    coordinates: tuple[int, int] = (0, 1),
) -> Axes:
    """Draw the sets of a tube over simulated states: shadows, where there are more than two.

    Args:
        tube: of a loop with two or more states.
        ax: where to draw; a new figure with a legend by default.
        samples: how many trajectories to show; of a partitioned tube so many from each cell.
        coordinates: the two states to draw, counted from 0: the horizontal axis, then the vertical
            one.

    Raises:
        TypeError: the tube is none.
        ValueError: the loop has one state, or the coordinates are not two of its states.
    """
    require_kind(
        "tube", tube, (ReachTube, PartitionedTube), "a ReachTube, as reach(...) returns it"
    )
    return tube.plot(ax, samples, coordinates)
