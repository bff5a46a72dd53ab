"""Sets of a template around the states of loops, over cells of `X0` that any method bounds.

What forms leave out of smooth functions falls with the third power of a cell's width. So the cell
that decides the facet with the widest gap is halved, all steps being looked at together, until each
bound is attained by a trajectory up to the gap that may stay open. Cells that have no bounds at all
are halved first: the initial set is treated like any part of it.

Forms over a cell also bound any part of it, at next to no cost. So before anything is bounded anew,
halves are left aside over which the cell's own forms prove that no facet is larger than what is
attained already, up to that gap: they keep these forms, and what is left is smaller.

What forms leave out of units that switch falls slowly, and another method costs as much as many
forms. It is tried on the cell that decides most, once forms had their chance. Where it closes most
of what they leave open, the set is cut into as many cells as there is work for, the largest first,
and each that decides a facet is bounded by it. A loop that jumps is also followed along all ways in
which its decisions may go: if that leaves no more open than the other method, or that one closes
little, all cells are.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from reachjax.loops import ClosedLoop
from reachjax.loops.scenarios import Scenarios
from reachjax.loops.units import UnboundedError
from reachjax.methods.affine_forms import AffineForms, moving_cell, moving_offsets
from reachjax.methods.cell_tree import CellTree, Node
from reachjax.methods.ladder import LEAST_RANGE, ROUNDED, WORK
from reachjax.methods.problem import AbstractMethod, Problem, ReachSet, at
from reachjax.methods.searches import AbstractSearch, Question
from reachjax.methods.steps import overflow
from reachjax.numerics.budget import ENDLESS, Budget
from reachjax.numerics.checks import is_concrete, owned, require_kind, whole_number
from reachjax.numerics.derivatives import moved_by
from reachjax.programs.affine_steps import step_columns
from reachjax.programs.initial import SubboxColumns
from reachjax.programs.unrolled import ByForms, subbox_columns, unrolled
from reachjax.proofs.by_forms import CellCertificate
from reachjax.proofs.certificates import AbstractProof
from reachjax.proofs.proposal import SolverStatus
from reachjax.sets import Polytope

MULTIPLICATIONS = 1.5e11
"""Products of all cells together, of which one core does some ten to the tenth in a second."""

OVERHEAD = 2.5e7
"""The products that a step costs beside those of its matrices."""

FLOW, FUNCTIONS, LAYER = 2e8, 1e8, 1e7
"""The products that take as long, at each step, as the flow of a differential equation; as a plant
of functions; and as each layer of its units. Measured on eleven loops, which mostly wait for
these."""

PER_WORK = 300.0
"""The products that take as long as a unit of the work of linear programs."""

HORIZONS = 6
"""A method that goes through the horizon with facts costs so many forms, its programs aside."""

LOOKED = 8
"""After so many halvings, where cells say that facets are largest is simulated."""

CONSTANT = 1e-12
"""A facet whose values differ by no more than this part of the states' sizes is flat."""

GENERATIONS, FALL = 8, 0.1
"""A cell that is halved so often, and each coordinate twice, lowers a facet's bound by this part of
what is open, or the facet is done: what disturbances leave open, no halving closes. What smooth
functions leave open falls by a factor of 64 meanwhile."""

CLOSED = 0.5
"""A method is used on cells if it closes this part of what forms leave open of one."""

TRIAL, TRIED = 1 / 32, 1 / 8
"""The part of the work after which it is tried, and the part that it may take; of a limited time
it may take the other part."""

WAYS = 32
"""Along so many ways of its decisions a loop that jumps is followed over a cell: each takes as long
as another cell, but half of a cell may have as many."""

LEFT_TO_METHOD = 1 / 2
"""The part of a limited time that is kept from the first cell that is followed, where the other
method closes most: should that take longer, its halves could not be followed in time either."""

LEFT_ASIDE = 8
"""Cells are narrowed as long as there are fewer than so many times what may be bounded, with those
that were left aside, which take memory alone."""

ALIKE = 3 / 4
"""Sides longer than this part of the longest are as long: a cell is bounded anew once it is shorter
along one of these, as others, along which facets may be settled easily, may have no say in what
forms leave out."""

SEARCHING = 0.9
"""The part of the time in which cells are halved: sets, proofs and witnesses take the rest, 0.7 s
of two hundred steps where measured."""


@dataclasses.dataclass(frozen=True)
class Cells(AbstractMethod):
    """Cells of the initial set, each bounded by forms, or by another method where that pays.

    Attributes:
        inner: what bounds a cell where forms leave more open.
        most: how many cells may be bounded; those are not counted that forms over a cell settle.

    Raises:
        TypeError: `inner` is no method, or `most` no number.
        ValueError: `most` is below 1.
    """

    inner: AbstractMethod = AffineForms()  # noqa: RUF009  (immutable)
    most: int = 1000

    def __post_init__(self):
        require_kind("inner", self.inner, AbstractMethod, "a method, such as AffineForms()")
        whole_number("most", self.most, 1)

    def sets(self, problem: Problem, known: Sequence[ReachSet] = ()) -> Iterator[ReachSet]:
        """The smallest sets that are proved within the problem's gap and budget.

        Raises:
            KeyboardInterrupt: somebody stopped the search for cells, after all sets but the last.
            UnboundedError: a unit has no bounds over a cell of the smallest size.
            ValueError: states overflow.
        """
        problem.require_numbers()
        search, interrupted = _Search(self, problem, len(known)), False
        search.enclose()
        try:
            search.run()
        except KeyboardInterrupt:
            interrupted, search.end = True, SolverStatus.INTERRUPTED
        search.finish()
        directions, slopes = problem.directions, _Slopes(self.inner, problem, search)
        for k in range(len(known), problem.horizon):
            if interrupted and k == problem.horizon - 1:
                raise KeyboardInterrupt
            bounds = owned(search.bounds[k])
            if not is_concrete(problem.loop, problem.X0, directions):
                bounds = moved_by(bounds, slopes.of(k))
            facets, leaves = len(bounds), search.leaves
            first = 0 if k == len(known) else k  # of earlier ones nobody else has the proofs
            proofs = tuple(leaf.found.proofs(first, k) for leaf in leaves)
            proof = CellCertificate(
                loop=problem.loop,
                X0=problem.X0,
                directions=directions[k],
                axes=np.array(search.cells.roots[0].axes),
                proofs=proofs if any(proofs) else (),
                codes=search.codes(k),
                bounds=bounds,
                witnesses=np.full(facets, np.nan),
                witness_states=np.full((facets, 0), np.nan),
                seconds=np.full(facets, search.seconds / facets / (problem.horizon - len(known))),
                k=k + 1,
                start=problem.start,
                ways=search.ways,
            )
            yield ReachSet(Polytope(directions[k], bounds), proof, at(k + 1), search.farthest(k))


class _Bounds(NamedTuple):
    """What is known over a cell.

    Attributes:
        steps: for each step what forms say, as far as they say anything.
        offsets: `(N, f)`, upper bounds; infinite where there is none.
        lost: what has no bounds over it after these steps, if anything has not.
        sets: what another method says; nothing if that was not asked.
        levels: `(N, f)`, below which nothing was asked of it.
        effort: what they took, in units of a form of the whole horizon along one way.
    """

    steps: Sequence[ByForms]
    offsets: Float[np.ndarray, "N f"]
    lost: UnboundedError | None = None
    sets: Sequence[ReachSet] = ()
    levels: Float[np.ndarray, "N f"] = np.zeros((0, 0))
    effort: float = 1.0

    @property
    def is_bounded(self) -> bool:
        """Whether all facets have bounds."""
        return bool((self.offsets < np.inf).all())  # nothing is below where no state is

    @property
    def holds_over_parts(self) -> bool:
        """Whether forms over it also bound each of its parts."""
        every = len(self.steps) == len(self.offsets)
        return every and all(step.forms is not None for step in self.steps)

    def over(self, part: SubboxColumns, levels: Float[np.ndarray, "N f"]) -> _Bounds | None:
        """What the same forms say over a part; None where a bound is larger than its level."""
        steps = list[ByForms]()
        for step, level in zip(self.steps[::-1], levels[::-1], strict=True):  # late ones are wide
            steps.append(step.over_part(part))
            if not (steps[-1].offsets <= level).all():
                return None
        steps.reverse()
        return _Bounds(steps, np.array([step.offsets for step in steps]), effort=0.0)

    def proofs(self, first: int, k: int) -> tuple[AbstractProof, ...]:
        """The other method's proofs from one step on until `k`; none if it was not asked."""
        return tuple(each.proof for each in self.sets[first : k + 1])

    def by_method(self, k: int, facet: int) -> bool:
        """Whether the other method proves more of a facet than forms do."""
        if not self.sets:
            return False
        offsets = np.asarray(self.sets[k].region.facets[1])
        return bool(offsets[facet] < self.steps[k].offsets[facet])

    def met(self, sets: Sequence[ReachSet], levels: Float[np.ndarray, "N f"]) -> _Bounds:
        """What both forms and another method say."""
        offsets = np.array([np.asarray(each.region.facets[1]) for each in sets])
        both = np.fmin(self.offsets, offsets)
        return self._replace(offsets=both, sets=sets, levels=levels)


class _Halves(NamedTuple):
    """The halves of a cell.

    Attributes:
        axis: the coordinate along which it is halved.
        halves: those that the initial set reaches.
    """

    axis: int
    halves: list[Node]

    @property
    def leaves(self) -> list[Node]:
        """The cells that they consist of."""
        return [leaf for half in self.halves for leaf in half.leaves]

    @property
    def open_ones(self) -> list[Node]:
        """The halves that the forms over a cell do not settle."""
        return [half for half in self.halves if not half.height]


class _Search(AbstractSearch):
    """Cells so far, and what they prove.

    Args:
        method: how many cells there may be, and what bounds them.
        problem: the problem.
        known: of how many steps nothing is asked.

    Attributes:
        cells: their tree; leaves have `_Bounds`.
        bounds: `(N, f)`, what all cells prove.
        end: how the search ended for facets that leave more open than was asked for.
    """

    def __init__(self, method: Cells, problem: Problem, known: int):
        self._problem, self._known, self._method = problem, known, method
        self._budget = problem.budget.share(SEARCHING)
        loop, self._X0, _ = problem.fixed
        fixed = loop, jax.lax.stop_gradient(problem.directions)
        self._loop, self._directions = jax.device_get(fixed)
        self._scenarios = Scenarios.of(loop, self._X0, problem.horizon, problem.start)
        self.cells = CellTree.whole(self._X0, method.most)
        root = self.cells.roots[0]
        wide = int(np.sum(root.upper > root.lower))
        self._generations = max(GENERATIONS, 2 * wide)
        self._deepest = 2 * math.ceil(math.log2(method.most))
        self._longest = self._slowest = 0.0
        # derivatives are those of forms that hold each decision that is open
        known = is_concrete(problem.loop, problem.X0, problem.directions)
        self._follows = known and self._loop.jumps
        self._asks, self._price = method.inner.adds_to_forms(loop), 0.0
        self.ways = WAYS if self._follows and not self._asks else 1
        self._wanted_bounds: np.ndarray | None = None
        root.found = self._by_forms(root)
        steps, besides = problem.horizon, plant_products(self._loop)
        self._all = self._left = affordable(self._loop, steps, problem.budget, besides)
        self._form = MULTIPLICATIONS / affordable(self._loop, steps, Budget(), besides)
        self._stuck = False
        self._planned, self._wanted, self._halvings, self._looked = False, 1, 0, -1
        self.end = SolverStatus.UNKNOWN_GAP
        self._open_parts: np.ndarray | None = None
        self._note()

    @property
    def seconds(self) -> float:
        """What the search took so far."""
        return self._budget.elapsed

    def _by_forms(self, node: Node, budget: Budget = ENDLESS, ways: int | None = None) -> _Bounds:
        """What forms say over a cell, of as many steps as a budget has time for."""
        given = self._loop, node.part, node.box, self._directions, self._problem.start
        began, steps, lost = self._budget.elapsed, list[ByForms](), None
        try:
            for step in unrolled(*given, most=ways or self.ways, wanted=self._wanted_bounds):
                steps.append(step)
                if budget.late:
                    break
        except UnboundedError as error:  # of halves there may be bounds
            lost = error
        self._longest = max(self._longest, self._budget.elapsed - began)
        offsets = np.full(self._directions.shape[:2], np.inf)
        for row, step in zip(offsets, steps, strict=False):
            row[:] = np.where(np.isnan(step.offsets), np.inf, step.offsets)
        effort = max(1.0, sum(step.ways for step in steps) / max(1, len(offsets)))
        return _Bounds(steps, offsets, lost, effort=effort)

    def _by_method(self, node: Node, trial: bool = False) -> _Bounds:
        """What forms and the other method say over a cell, within a part of the work if tried."""
        forms, share = (TRIAL * self._all, TRIED) if trial else (self._left, 1.0)
        work, began = min(WORK, forms * self._form / PER_WORK), self._budget.elapsed
        budget = self._budget.share(share).with_work(work)
        problem = dataclasses.replace(self._problem, loop=self._problem.fixed[0])
        inner = self._method.inner.sets(problem.over(node.part, self._levels, budget))
        found = node.found.met(list(inner), self._levels)
        self._slowest = max(self._slowest, self._budget.elapsed - began)
        self._price = HORIZONS + (work - budget.work) * PER_WORK / self._form
        self._left -= self._price
        return found

    def _halves(self, node: Node, by_method: bool = False) -> _Halves:
        """The halves of a cell, and what is said over the cells that they consist of.

        They are those along its longest side, unless forms over the cell settle one along another
        that is as long. Of a half that they do not settle, all is left aside that they do.
        """
        room = LEFT_ASIDE * self._method.most - len(self.leaves)
        found = self._cut(node, node) if room > 0 else None
        room -= found is not None
        axis = self.cells.longest(node)
        found = found or _Halves(axis, self.cells.halved(node, axis))
        for part in found.open_ones:
            while room > 0 and (cut := self._cut(node, part)):
                part.axis, part.halves = cut
                part.found, room = node.found._replace(steps=(), sets=()), room - 1
                if not cut.open_ones:
                    break
                (part,) = cut.open_ones
            else:
                part.found = self._by_forms(part)
                if by_method and part.found.is_bounded:
                    part.found = self._by_method(part)
        return found

    def _cut(self, node: Node, part: Node) -> _Halves | None:
        """Halves of a part of a cell, one of which forms over that settle; None if none.

        Settled is where no facet is larger than what is attained, but for the gap that may stay
        open.
        """
        levels, source = self._wanted_bounds, node.found
        if levels is None or self._follows or not (node.is_box and source.holds_over_parts):
            return None
        widths = part.widths / self.cells.sides
        least = ALIKE * widths.max() if part is node else 0.0
        for axis in np.argsort(-widths, kind="stable").tolist():
            if widths[axis] <= least or not self.cells.can_halve(part, axis):
                continue
            halves = self.cells.halved(part, axis)
            for half in halves:
                columns = subbox_columns(self._loop, node.part, node.box, half.box)
                half.found = source.over(columns, levels)
                half.height = 0 if half.found is None else half.depth - node.depth
            if any(half.height for half in halves):
                return _Halves(axis, halves)
        return None

    def _note(self) -> None:
        self.leaves = self.cells.leaves
        every = np.array([leaf.found.offsets for leaf in self.leaves])
        self.deciding, self.bounds = every.argmax(axis=0), every.max(axis=0)

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
        while open_cells := [leaf for leaf in self.leaves if not leaf.found.is_bounded]:
            leaf = max(open_cells, key=lambda leaf: leaf.depth)  # soon the smallest
            spent = self._left < 2 or self._late or leaf.depth >= self._deepest
            if spent or not (self._can_halve(leaf) and self._halved(leaf, self._halves(leaf))):
                found = leaf.found
                if found.lost is not None:
                    raise found.lost.after(len(self.leaves), leaf.widths.tolist())
                k = int(np.argmin(np.isfinite(found.offsets).all(axis=1))) + 1
                raise overflow(self._problem.start + k, halved=True)
            self._problem.note(f"{len(self.leaves)} cells, {len(open_cells)} without bounds")

    def question(self, asked: int, workers: int) -> Question | None:
        """Which gap is closed next: by halves of a cell, or by another method over it."""
        if self._problem.simulations is None or asked or self._stuck:
            return None
        self._look()
        if self._late or self._left < 2 or (self.cells.is_full and not self._asks):
            self.end = SolverStatus.TIME if self._late else SolverStatus.BUDGET
            return None
        self.end = SolverStatus.STALLED
        node = self._widest()
        if node is None:
            return None
        if self._asks and (self._planned or self._due):
            return self._with_method(node)
        return Question([node], self._halves, (node,)) if self._can_halve(node) else None

    @property
    def _due(self) -> bool:
        """Whether forms had their chance; those along all ways cost more than a trial."""
        if self.cells.is_full or self._follows:
            return True
        if self._budget.timed:
            whole = self._budget.elapsed + self._budget.left
            return self._budget.elapsed >= TRIAL * whole
        return self._all - self._left >= TRIAL * self._all

    def _with_method(self, node: Node) -> Question | None:
        """The question about the cell that decides most, where another method may be asked."""
        if not self._planned:
            return Question([node], self._by_method, (node, True))
        if self.cells.count < self._wanted:
            matter = [leaf for leaf in self.leaves if (leaf.found.offsets > self._levels).any()]
            plain = [leaf for leaf in matter if not leaf.found.sets and self._can_halve(leaf)]
            if plain:
                largest = max(plain, key=self.cells.volume)
                return Question([largest], self._halves, (largest,))
        programs = self._slowest + self._longest
        if not node.found.sets:
            self.end = SolverStatus.TIME if self._budget.left < programs else SolverStatus.BUDGET
            enough = self._left >= self._price and self._budget.left >= programs
            return Question([node], self._by_method, (node,)) if enough else None
        if not self._can_halve(node):
            self.end = SolverStatus.BUDGET if self.cells.is_full else self.end
            return None
        self.end = SolverStatus.TIME if self._budget.left < 2 * programs else SolverStatus.BUDGET
        enough = self._left >= 2 + 2 * self._price and self._budget.left >= 2 * programs
        return Question([node], self._halves, (node, True)) if enough else None

    def answered(self, question: Question, answer: Any) -> int:
        """How many cells there are."""
        (node,) = question.nodes
        if isinstance(answer, _Bounds):
            if not self._planned:
                self._plan(node, answer)
            if self._asks:
                node.found = answer
            self._note()
        elif not self._halved(node, answer):
            self._stuck = True
        return self.cells.count

    def _plan(self, node: Node, tried: _Bounds) -> None:
        """Ask the other method of cells if it closes most of what forms leave open; of how many."""
        before, after = (self._beyond(found.offsets) for found in (node.found, tried))
        self._planned = True
        self._asks = bool(after.sum() <= (1 - CLOSED) * before.sum())
        if self._follows and (not self._asks or self._left >= 2 * WAYS):
            self._follow(node, float(after.sum()))
        if self._asks:
            most = self._left / (2 + self._price)
            seconds = 2 * self._longest + self._slowest
            if self._budget.timed and seconds:
                most = min(most, self._budget.left / seconds)
            gap = max(self._problem.gap, ROUNDED)
            self._wanted = int(min(most, 1 + float(after.max()) / gap))

    def _follow(self, node: Node, opened: float) -> None:
        """Follow cells along ways from now on, unless another method closes much and leaves less.

        Args:
            node: that one.
            opened: what the other method leaves open of it, of all facets together.
        """
        longest = self._longest
        share = self._budget.share(1 - LEFT_TO_METHOD if self._asks else 1.0)
        followed = self._by_forms(node, share, WAYS)
        self._left -= followed.effort
        known = followed.is_bounded
        if self._asks and not (known and self._beyond(followed.offsets).sum() <= opened):
            self._longest = longest
        elif known or not self._late:  # what is proved along fewer ways is kept as it is
            self._asks, self.ways = False, WAYS
            node.found = followed if known else node.found

    def _beyond(self, offsets: Float[np.ndarray, "N f"]) -> Float[np.ndarray, "N f"]:
        """What bounds leave open, in parts of ranges."""
        return np.fmax(offsets - self._levels, 0.0) / self._ranges

    def finish(self) -> None:
        """Take stock, also where somebody stopped the search."""
        self._note()
        if self._looked >= 0:
            self._open()

    def _look(self) -> None:
        """Simulate where cells say that facets are largest, now and then, and see what is open."""
        simulations = self._problem.simulations
        assert simulations is not None  # else nothing is looked at
        if self._looked < 0:
            self._least, self._most = self._simulated()
        often = self._asks and self._planned
        if often or (self._halvings % LOOKED == 0 and self._looked != self._halvings):
            simulations.include(*(self.farthest(k) for k in range(len(self.bounds))))
            self._least, self._most = self._simulated()
            self._looked = self._halvings
        self._open()

    def _open(self) -> None:
        """What is open of each facet, in the units of the states and in parts of its range."""
        least, most = self._least, self._most
        # of the bounds so far: those of a wide set say nothing of a range
        self._excess, half = self.bounds - most, np.fmax((most - least) / 2, self._floor())
        zero = np.zeros_like(half)
        open_parts = np.divide(self._excess, half, out=zero, where=self._excess > 0)
        open_parts[: self._known] = 0.0
        self._open_parts, self._ranges = open_parts, np.where(half > 0, half, 1.0)
        self._levels = most + self._problem.gap * half
        self._levels[: self._known] = np.inf
        self._wanted_bounds = self._levels

    def codes(self, k: int) -> Int[np.ndarray, " f"]:
        """How the search ended for each facet after `k + 1` steps, as values of `SolverStatus`."""
        if self._open_parts is None:
            return np.full(len(self.bounds[k]), int(self.end))
        shut = self._open_parts[k] <= self._problem.gap
        return np.where(shut, int(SolverStatus.SOLVED), int(self.end))

    def _widest(self) -> Node | None:
        """The leaf that decides the facet of the widest gap, of those that halving still closes."""
        open_parts = self._open_parts
        assert open_parts is not None  # it was looked
        for place in np.argsort(-open_parts, axis=None, kind="stable"):
            worst = np.unravel_index(place, open_parts.shape)
            if not open_parts[worst] > self._problem.gap:
                return None
            leaf = self.leaves[int(self.deciding[worst])]
            before = leaf.before(self._generations)
            if before:
                fall = before.found.offsets[worst] - leaf.found.offsets[worst]
                if fall < FALL * self._excess[worst]:
                    continue
            number, gap = len(self.leaves), open_parts[worst]
            self._problem.note(f"{number} cells, largest gap {gap:.1e}")
            return leaf
        return None

    def _floor(self) -> Float[np.ndarray, "N f"]:
        """What half a facet's range counts as, at least: of one that is flat, by states' sizes."""
        gap, simulations = self._problem.gap, self._problem.simulations
        floor = LEAST_RANGE * (self.bounds - self._least) / 2
        if not gap or simulations is None:
            return floor
        largest = np.maximum.accumulate(abs(simulations.runs.states).max(axis=0, initial=0.0))
        sizes = np.einsum("kfn,kn->kf", abs(self._directions), largest[1:])
        flat = self._most - self._least <= CONSTANT * sizes
        return np.fmax(floor, ROUNDED / gap * np.where(flat, sizes, abs(self.bounds)))

    def _simulated(self) -> tuple[np.ndarray, np.ndarray]:
        """The least and largest simulated values of all facets."""
        simulations = self._problem.simulations
        assert simulations is not None  # else nothing is looked at
        found = [simulations.values(k, rows) for k, rows in enumerate(self._directions, start=1)]
        return np.array([each.least for each in found]), np.array([each.most for each in found])

    def _can_halve(self, node: Node) -> bool:
        return self.cells.can_halve(node, self.cells.longest(node))

    def _halved(self, node: Node, found: _Halves) -> bool:
        """Whether halves stand in the place of a cell, which have bounds if it has."""
        if node.found.is_bounded and not all(leaf.found.is_bounded for leaf in found.leaves):
            return False
        self.cells.replace(node, found.halves, found.axis)
        node.found = node.found._replace(steps=(), sets=())
        self._left -= sum(leaf.found.effort for leaf in found.leaves)
        self._halvings += 1
        self._note()
        return True

    def farthest(self, k: int) -> Float[np.ndarray, "f s"]:
        """Scenarios at which the deciding cells say that facets are largest after `k + 1` steps."""
        found = []
        for facet, number in enumerate(self.deciding[k]):
            known, one = self.leaves[number].found, slice(facet, facet + 1)
            if known.sets and len(known.sets[k].worst) == len(self.deciding[k]):
                found.append(known.sets[k].worst[one])
                continue
            step = known.steps[k]
            drawn = [values[one] for values in step.drawn]
            found.append(self._scenarios.of_units(np.asarray(step.corners)[one], drawn))
        if len({each.shape[1] for each in found}) > 1:  # those of forms end at the step
            middle = self._scenarios.middle(np.asarray(self.cells.roots[0].box.center))
            found = [self._scenarios.completed(each, middle) for each in found]
        return np.concatenate(found)


class _Slopes:
    """Numbers with the derivatives of what cells prove, each by what decides it.

    Args:
        inner: what bounds cells where forms leave more open.
        problem: the problem, with derivatives.
        search: what was proved.
    """

    def __init__(self, inner: AbstractMethod, problem: Problem, search: _Search):
        self._inner, self._problem, self._search = inner, problem, search
        self._by_method: dict[int, list[Array]] = {}

    def of(self, k: int) -> Float[Array, " f"]:
        """The numbers of the facets after `k + 1` steps."""
        nodes = dict(enumerate(self._search.leaves[i] for i in self._search.deciding[k]))
        better = {facet: node for facet, node in nodes.items() if node.found.by_method(k, facet)}
        by_forms = {facet: node for facet, node in nodes.items() if facet not in better}
        found = moving_offsets(self._problem, by_forms, k)
        found |= {facet: self._moving(node)[k][facet] for facet, node in better.items()}
        return jnp.stack([found[facet] for facet in nodes])

    def _moving(self, node: Node) -> list[Array]:
        """The offsets that the other method proves over a cell, with their derivatives."""
        if id(node) not in self._by_method:
            part, _ = moving_cell(self._problem, node)
            budget = self._problem.budget.with_work(WORK)
            given = self._problem.over(part, node.found.levels, budget)
            self._by_method[id(node)] = [each.region.facets[1] for each in self._inner.sets(given)]
        return self._by_method[id(node)]


def plant_products(loop: ClosedLoop) -> float:
    """The products that take as long as a step of the plant; none of matrices alone."""
    if loop.plant.continuous:
        return FLOW
    layers = len(loop.plant_layers)
    return FUNCTIONS + LAYER * layers if layers else 0.0


def affordable(loop: ClosedLoop, horizon: int, budget: Budget, besides: float = 0.0) -> float:
    """How many cells may be bounded: any number where time is a limit.

    Args:
        loop: the closed loop.
        horizon: the number of steps.
        budget: of time.
        besides: products of each step; none for decisions, which are worth the wait.
    """
    if budget.timed:
        return np.inf
    more, between = step_columns(loop)
    columns = loop.states**2 + between + more * np.arange(1, horizon + 1)
    parameters = sum(np.size(leaf) for leaf in jax.tree.leaves(loop))
    return MULTIPLICATIONS / float(np.sum(OVERHEAD + besides + parameters * columns))
