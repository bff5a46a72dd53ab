"""Partitions: tubes from the cells of an initial set, whose union holds every state.

Smaller sets leave fewer neurons undecided, so each cell's tube is tighter. Cells are independent
programs, which any executor may run.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Float, Int

from reachjax.loops import ClosedLoop
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
from reachjax.numerics.pytrees import Replaceable, pytree
from reachjax.programs.relaxations import AbstractRelaxation, BranchAndCut
from reachjax.sets import AbstractSet, Template
from reachjax.sets.cells import grid, halves
from reachjax.solvers import AbstractSolver, Auto
from reachjax.tubes.displays import SAMPLES as SHOWN
from reachjax.tubes.displays import display, picture, table
from reachjax.tubes.kept import keep
from reachjax.tubes.propagation import GAP, SAMPLES
from reachjax.tubes.reach import ReachTube, reach
from reachjax.tubes.seals import Seal, require_sealed, seal_of
from reachjax.tubes.tables import frame, rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame

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

    Raises:
        RuntimeError: JAX's 64-bit floats are off.
        TypeError: an argument is of another kind.
        ValueError: as `reach`; or the arguments are traced.

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
    own = ThreadPoolExecutor() if executor is None else None
    try:
        run = _Run(loop, template, options, own or executor, progress)
        counts: Any = cells
        if isinstance(cells, np.ndarray | jax.Array) and cells.ndim < 2:
            counts = cells.tolist()
        if isinstance(counts, int | np.integer):
            tubes = _guided(run, X0, whole_number("cells", counts, 1), gap)
        elif isinstance(counts, Sequence) and not isinstance(counts, str):
            tubes = run.tubes([cell.part for cell in grid(X0, counts)])
        else:
            raise TypeError(
                "cells must be a whole number, or one for each coordinate, but "
                f"{described(cells)} arrived"
            )
    finally:
        if own is not None:
            own.shutdown(cancel_futures=True)
    return PartitionedTube.sealed(X0, tuple(tubes))


class _Run:
    """Tubes of one loop, computed by an executor, cell by cell."""

    def __init__(
        self,
        loop: ClosedLoop,
        template: Template,
        options: dict,
        executor: Any,
        progress: Bar | None,
    ):
        self._loop, self._template = jax.device_get((loop, template))
        self._options = options
        self._executor, self._progress = executor, progress

    def tubes(self, cells: Sequence[AbstractSet]) -> list[ReachTube]:
        """One for each cell, in their order; the first error ends the run."""
        given = self._template, self._options
        arrays = jax.device_get(list(cells))
        futures = [self._executor.submit(_tube, self._loop, cell, *given) for cell in arrays]
        try:
            done = _results(futures)
            for _ in wrapped(self._progress, done):
                pass
        except BaseException:
            for future in futures:
                future.cancel()
            raise
        return [jax.device_put(future.result()) for future in futures]


def _results(futures: list[Future]) -> Iterator[Any]:
    """Each result as it comes."""
    for future in as_completed(futures):
        yield future.result()


def _tube(loop: ClosedLoop, cell: AbstractSet, template: Template, options: dict) -> ReachTube:
    """One cell's tube, from numpy arrays to numpy arrays, wherever it runs."""
    with jax.enable_x64(True):
        loop, cell, template = jax.device_put((loop, cell, template))
        return jax.device_get(reach(loop, cell, template=template, **options))


def _guided(run: _Run, X0: AbstractSet, count: int, gap: float) -> list[ReachTube]:
    """Halve the cells at which the union's gap is widest, along their longest side."""
    boxes, tubes = [X0.bounding_box()], run.tubes([X0])
    sides = np.asarray(boxes[0].widths)
    sides = np.where(sides > 0, sides, np.inf)  # a side without length is not halved
    widths = _widths(tubes[0])
    while len(tubes) < count:
        some = min(math.ceil(len(tubes) / 4), count - len(tubes))
        worst = _worst(X0, tubes, widths, gap)[:some]
        if not worst:
            break
        parts = [half for i in worst for half in halves(X0, boxes[i], sides)]
        others = [i for i in range(len(tubes)) if i not in worst]
        boxes = [boxes[i] for i in others] + [half.box for half in parts]
        tubes = [tubes[i] for i in others] + run.tubes([half.part for half in parts])
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
