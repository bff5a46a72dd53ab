"""Sets of a template around the states of smooth loops, by affine forms over cells of `X0`.

What forms leave out of smooth functions falls with the third power of a cell's width. So the cell
that decides the facet with the widest gap is halved, all steps being looked at together, until each
bound is attained by a trajectory up to the gap that may stay open. Cells that have no bounds at all
are halved first: the initial set is treated like any part of it.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from reachjax.loops import ClosedLoop
from reachjax.loops.scenarios import Scenarios
from reachjax.loops.units import UnboundedError
from reachjax.numerics.budget import Budget
from reachjax.numerics.checks import is_concrete, owned
from reachjax.numerics.derivatives import moved_by
from reachjax.programs.affine_steps import step_columns
from reachjax.programs.unrolled import ByForms, unrolled
from reachjax.proofs.cells import CellCertificate
from reachjax.proofs.proposal import SolverStatus
from reachjax.sets import AbstractSet, Box, Polytope, Template
from reachjax.sets.cells import Cell, halves_along
from reachjax.tubes.cell_slopes import moving_offsets
from reachjax.tubes.ladder import LEAST_RANGE, ROUNDED
from reachjax.tubes.steps import Reached, Setting, overflow

MULTIPLICATIONS = 1.5e11
"""Products of all cells together, of which one core does some ten to the tenth in a second."""

OVERHEAD = 2.5e7
"""The products that a step costs beside those of its matrices."""

LOOKED = 8
"""After so many halvings, where cells say that facets are largest is simulated."""

CONSTANT = 1e-12
"""A facet whose values differ by no more than this part of the states' sizes is flat."""

GENERATIONS, FALL = 8, 0.1
"""A cell that is halved so often, and each coordinate twice, lowers a facet's bound by this part of
what is open, or the facet is done: what disturbances leave open, no halving closes. What smooth
functions leave open falls by a factor of 64 meanwhile."""


SEARCHING = 0.9
"""The part of the time in which cells are halved: sets, proofs and witnesses take the rest, 0.7 s
of two hundred steps where measured."""


class _Node:
    """A part of the initial set, with its halves or what forms over it say.

    Args:
        cell: the part.
        steps: for each step what forms say, as far as they say anything.
        shape: of the offsets of all steps.
        parent: what it is a half of; None of the initial set.
        lost: what has no bounds over it after these steps, if anything has not.
    """

    def __init__(
        self,
        cell: Cell,
        steps: list[ByForms],
        shape: tuple[int, ...],
        parent: _Node | None = None,
        lost: UnboundedError | None = None,
    ):
        self.cell, self.steps, self.lost, self._parent = cell, steps, lost, parent
        self.offsets = np.full(shape, np.inf)
        for row, step in zip(self.offsets, steps, strict=False):
            row[:] = np.where(np.isnan(step.offsets), np.inf, step.offsets)
        self.axis, self.halves = -1, list[_Node]()

    @property
    def axes(self) -> list[int]:
        """Along which coordinates it and its parts are halved, as `from_tree` takes them."""
        found, left = list[int](), [self]
        while left:
            node = left.pop()
            found.append(node.axis)
            left += node.halves[::-1]
        return found

    @property
    def is_bounded(self) -> bool:
        """Whether all facets have bounds over it."""
        return bool(np.isfinite(self.offsets).all())

    @property
    def depth(self) -> int:
        """How many halvings it is away from the initial set."""
        return 0 if self._parent is None else 1 + self._parent.depth

    def before(self, generations: int) -> _Node | None:
        """What it is left of after so many halvings; None if there were fewer."""
        node: _Node | None = self
        for _ in range(generations):
            node = node and node._parent
        return node


def sets_by_cells(
    setting: Setting,
    most: int,
    X0: AbstractSet,
    box: Box,
    template: Template,
    horizon: int,
    known: int = 0,
) -> Iterator[Reached]:
    """The smallest sets that are proved within the setting's gap and time, and so many cells.

    Args:
        setting: what all steps have in common.
        most: how many cells there may be.
        X0: the initial set.
        box: around it.
        template: what the sets look like.
        horizon: how many steps there are.
        known: how many of them are known.

    Raises:
        KeyboardInterrupt: somebody stopped the search for cells, after all sets but the last.
        UnboundedError: a unit has no bounds over a cell of the smallest size.
        ValueError: states overflow.
    """
    began, interrupted = time.perf_counter(), False
    directions = jnp.stack([template.at(k).directions for k in range(1, horizon + 1)])
    fixed = jax.lax.stop_gradient((setting.loop, X0, directions))
    search = _Search(setting, *fixed, most, known)
    search.enclose()
    try:
        search.run()
    except KeyboardInterrupt:
        interrupted, search.ended = True, SolverStatus.INTERRUPTED
    seconds = time.perf_counter() - began
    for k in range(known, horizon):
        if interrupted and k == horizon - 1:
            raise KeyboardInterrupt
        offsets, deciding = search.bounds[k], search.deciding[k]
        bounds = owned(offsets)
        if not is_concrete(setting.loop, X0, directions):
            cells = [search.leaves[i].cell for i in deciding]
            bounds = moved_by(bounds, moving_offsets(setting, X0, box, directions, cells, k))
        facets = len(offsets)
        proof = CellCertificate(
            loop=setting.loop,
            X0=X0,
            directions=directions[k],
            axes=np.array(search.axes),
            codes=search.codes(k),
            bounds=bounds,
            witnesses=np.full(facets, np.nan),
            witness_states=np.full((facets, 0), np.nan),
            seconds=np.full(facets, seconds / facets / (horizon - known)),
            k=k + 1,
            start=setting.start,
        )
        yield Reached(Polytope(directions[k], bounds), proof, search.farthest(k), climb=False)


class _Search:
    """Cells so far, and what they prove.

    Args:
        setting: what all steps have in common.
        loop: of numbers.
        X0: the initial set.
        directions: `(N, f, n_x)`.
        most: how many cells there may be.
        known: of how many steps nothing is asked.

    Attributes:
        ended: how the search ended for facets that leave more open than was asked for.
    """

    def __init__(
        self,
        setting: Setting,
        loop: ClosedLoop,
        X0: AbstractSet,
        directions: Float[Array, "N f n_x"],
        most: int,
        known: int,
    ):
        self._setting, self._X0, self._known = setting, X0, known
        self._budget = setting.budget.share(SEARCHING)
        self._loop, self._directions = jax.device_get((loop, directions))
        self._scenarios = Scenarios.of(loop, X0, len(directions), setting.start)
        cell = Cell(X0.bounding_box(), X0)
        sides = np.asarray(cell.box.widths)
        self._sides = np.where(sides > 0, sides, 1.0)  # a side without length is not halved
        self._generations = max(GENERATIONS, 2 * int(np.sum(sides > 0)))
        self._deepest = 2 * math.ceil(math.log2(most))
        self._longest = 0.0
        self._root = self._made(cell)
        self.leaves = [self._root]
        self._note()
        self._left = min(2 * most - 2, affordable(self._loop, len(directions), setting.budget))
        self.ended = SolverStatus.UNKNOWN_GAP
        self._open_parts: np.ndarray | None = None

    def _made(self, cell: Cell, parent: _Node | None = None) -> _Node:
        given = self._loop, cell.part, cell.box, self._directions, self._setting.start
        began, steps, lost = time.monotonic(), list[ByForms](), None
        try:
            steps.extend(unrolled(*given))
        except UnboundedError as error:  # of halves there may be bounds
            lost = error
        self._longest = max(self._longest, time.monotonic() - began)
        return _Node(cell, steps, self._directions.shape[:2], parent, lost)

    def _note(self) -> None:
        every = np.array([leaf.offsets for leaf in self.leaves])
        self.deciding, self.bounds = every.argmax(axis=0), every.max(axis=0)

    @property
    def axes(self) -> list[int]:
        """The tree of all cells."""
        return self._root.axes

    @property
    def _late(self) -> bool:
        """Whether no time is left for two halves of a cell, as long as one took at most."""
        return self._budget.left < 2 * self._longest

    def enclose(self) -> None:
        """Halve cells that have no bounds until all have.

        Raises:
            UnboundedError: a unit has none over a cell of the smallest size.
            ValueError: states overflow.
        """
        while True:
            open_cells = [i for i, leaf in enumerate(self.leaves) if not leaf.is_bounded]
            if not open_cells:
                return self._note()
            number = max(open_cells, key=lambda i: self.leaves[i].depth)  # soon the smallest
            leaf = self.leaves[number]
            spent = self._left < 2 or self._late or leaf.depth >= self._deepest
            if spent or not self._halve(number):
                break
            self._setting.note(f"{len(self.leaves)} cells, {len(open_cells)} without bounds")
        if leaf.lost is not None:
            raise leaf.lost.after(len(self.leaves), leaf.cell.box.widths.tolist())
        k = int(np.argmin(np.isfinite(leaf.offsets).all(axis=1))) + 1
        raise overflow(self._setting.start + k, halved=True)

    def run(self) -> None:
        """Halve cells until gaps are closed, or nothing is left."""
        simulations = self._setting.simulations
        if simulations is None:
            return
        least, most = self._simulated()
        for count in itertools.count():
            if count % LOOKED == 0:
                simulations.include(*(self.farthest(k) for k in range(len(self.bounds))))
                least, most = self._simulated()
            # of the bounds so far: those of a wide set say nothing of a range
            excess, open_parts = self._open(least, most, self._floor(least, most))
            if self._left < 2 or self._late:
                self.ended = SolverStatus.TIME if self._late else SolverStatus.BUDGET
                return
            self.ended = SolverStatus.STALLED
            number = self._widest(open_parts, excess)
            if number is None or not self._halve(number):
                return
            self._note()

    def _open(self, least: np.ndarray, most: np.ndarray, floor: np.ndarray) -> tuple[Any, Any]:
        """What is open of each facet, in the units of the states and in parts of its range."""
        excess, half = self.bounds - most, np.fmax((most - least) / 2, floor)
        open_parts = np.divide(excess, half, out=np.zeros_like(excess), where=excess > 0)
        open_parts[: self._known] = 0.0
        self._open_parts = open_parts
        return excess, open_parts

    def codes(self, k: int) -> Int[np.ndarray, " f"]:
        """How the search ended for each facet after `k + 1` steps, as values of `SolverStatus`."""
        if self._open_parts is None:
            return np.full(len(self.bounds[k]), int(self.ended))
        shut = self._open_parts[k] <= self._setting.gap
        return np.where(shut, int(SolverStatus.SOLVED), int(self.ended))

    def _widest(
        self, open_parts: Float[np.ndarray, "N f"], excess: Float[np.ndarray, "N f"]
    ) -> int | None:
        """The leaf that decides the facet of the widest gap, of those that halving still closes."""
        for place in np.argsort(-open_parts, axis=None, kind="stable"):
            worst = np.unravel_index(place, open_parts.shape)
            if not open_parts[worst] > self._setting.gap:
                return None
            number = int(self.deciding[worst])
            leaf = self.leaves[number]
            before = leaf.before(self._generations)
            if before and before.offsets[worst] - leaf.offsets[worst] < FALL * excess[worst]:
                continue
            self._setting.note(f"{len(self.leaves)} cells, largest gap {open_parts[worst]:.1e}")
            return number
        return None

    def _floor(
        self, least: Float[np.ndarray, "N f"], most: Float[np.ndarray, "N f"]
    ) -> Float[np.ndarray, "N f"]:
        """What half a facet's range counts as, at least: of one that is flat, by states' sizes."""
        gap, simulations = self._setting.gap, self._setting.simulations
        floor = LEAST_RANGE * (self.bounds - least) / 2
        if not gap or simulations is None:
            return floor
        largest = np.maximum.accumulate(abs(simulations.runs.states).max(axis=0, initial=0.0))
        sizes = np.einsum("kfn,kn->kf", abs(self._directions), largest[1:])
        flat = most - least <= CONSTANT * sizes
        return np.fmax(floor, ROUNDED / gap * np.where(flat, sizes, abs(self.bounds)))

    def _simulated(self) -> tuple[np.ndarray, np.ndarray]:
        """The least and largest simulated values of all facets."""
        simulations = self._setting.simulations
        assert simulations is not None  # else nothing is looked at
        found = [simulations.values(k, rows) for k, rows in enumerate(self._directions, start=1)]
        return np.array([each.least for each in found]), np.array([each.most for each in found])

    def _halve(self, number: int) -> bool:
        """Whether a leaf could be halved, along the side of which most is left."""
        leaf = self.leaves[number]
        widths = np.asarray(leaf.cell.box.widths) / self._sides
        axis = int(widths.argmax())
        if not widths[axis] > 0:
            return False
        halves = [self._made(half, leaf) for half in halves_along(self._X0, leaf.cell.box, axis)]
        if leaf.is_bounded and not all(half.is_bounded for half in halves):
            return False
        leaf.axis, leaf.halves, leaf.steps = axis, halves, []
        self.leaves[number : number + 1] = halves
        self._left -= len(halves)
        return True

    def farthest(self, k: int) -> Float[np.ndarray, "f s"]:
        """Scenarios at which the deciding cells say that facets are largest after `k + 1` steps."""
        found = []
        for facet, number in enumerate(self.deciding[k]):
            step, one = self.leaves[number].steps[k], slice(facet, facet + 1)
            drawn = [values[one] for values in step.drawn]
            found.append(self._scenarios.of_units(np.asarray(step.corners)[one], drawn))
        return np.concatenate(found)


def affordable(loop: ClosedLoop, horizon: int, budget: Budget) -> float:
    """How many cells may be bounded: any number where time is a limit."""
    if budget.timed:
        return np.inf
    more, between = step_columns(loop)
    columns = loop.states**2 + between + more * np.arange(1, horizon + 1)
    parameters = sum(np.size(leaf) for leaf in jax.tree.leaves(loop))
    return MULTIPLICATIONS / float(np.sum(OVERHEAD + parameters * columns))
