"""Branch and bound on the phases of units, over linear programs of the whole horizon.

Of the two facts of a unit whose product is zero, one is zero at each state. A branch holds one of
them at zero, which frees the sign of its multiplier; the two branches together leave nothing out.
The node of the largest bound is split first, at the pair of facts that its solution violates most,
weighed by what the unit's column means to the bound. The bound is that of the largest leaf.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from reachjax.numerics.budget import ENDLESS, Budget
from reachjax.programs.affine import AffineForms
from reachjax.programs.horizon import Horizon
from reachjax.solvers.linear_programs import AbstractPrograms, Vertex

EXACT = 1e-9
"""A unit whose value is off by no more than this part of its gap is not split."""

SHARE = 0.1
"""What a column's share of the objective counts, where its reduced cost counts 1."""


BENT = 1e-6
"""A fact of a unit that is no more than this part of its gap is zero."""


class Node(NamedTuple):
    """A branch and what its linear program says.

    Attributes:
        phases: pairs of facts, by their numbers, and which of the two is held at zero.
        vertex: where its linear program ended.
    """

    phases: dict[int, int]
    vertex: Vertex


class Found(NamedTuple):
    """The leaves of a tree, by which a bound is proved.

    Attributes:
        phases: `(l, p)`, which of each pair of facts is zero, 0 or 1; -1 where neither is held.
        multipliers: `(l, m)`, of the facts.
        weights: `(l, r)`, of the rows of which the least is bounded.
        columns: `(l, n)`, where each attains its bound.
        nodes: how many linear programs were solved.
    """

    phases: Int[np.ndarray, "l p"]
    multipliers: Float[np.ndarray, "l m"]
    weights: Float[np.ndarray, "l r"]
    columns: Float[np.ndarray, "l n"]
    nodes: int


def affine_leaf(forms: AffineForms, horizon: Horizon) -> Found:
    """The leaf that takes nothing: the best bounded of some forms is bounded by itself.

    Args:
        forms: `r` of them.
        horizon: whose facts it does without.
    """
    start, facts = horizon.start, horizon.facts
    best = forms.ends(start)[1].argmin()
    row = forms.padded(facts.columns.shape[1]).columns[best]
    columns = np.sign(row)
    if start.round:
        first = row[: start.spread.shape[1]]
        length = np.linalg.norm(first)
        columns[: len(first)] = first / length if length > 0 else 0.0
    none = np.zeros((1, len(facts.rows)))
    phases = np.full((1, len(horizon.zero)), -1, dtype=np.int8)
    weights = np.eye(1, len(forms.rows), best)
    return Found(phases, none, weights, columns[None], nodes=0)


class Tree:
    """Branches that bound the largest value of a form, or of the least of several.

    It can be grown by turns with others; what its leaves prove holds at any moment.

    Args:
        horizon: whose facts hold.
        programs: over these.
        forms: `r` of them.
        attained: the largest value that is known to be attained, given columns of more solutions.
        enough: whether to stop, given the bound and what is attained.
        budget: of each program's time.

    Attributes:
        nodes: how many linear programs were solved.
    """

    def __init__(
        self,
        horizon: Horizon,
        programs: AbstractPrograms,
        forms: AffineForms,
        attained: Callable[[list[Float[np.ndarray, " n"]]], float],
        enough: Callable[[float, float], bool],
        budget: Budget = ENDLESS,
    ):
        forms = forms.padded(horizon.facts.columns.shape[1])
        self._rows, self._constants = np.asarray(forms.columns), np.asarray(forms.rows[:, 0])
        self._horizon, self._programs = horizon, programs
        self._attained, self._enough, self._budget = attained, enough, budget
        self._serial, self._stuck = itertools.count(), False
        self._heap: list[tuple[float, int, Node]] = []
        self._empty: list[Node] = []
        self._best, self.nodes = -np.inf, 1
        first = self._solved({})
        if first is not None and len(first.columns):  # facts of thin sets seem to hold nowhere
            self._push(first.value, Node({}, first))
            self._best = attained([first.columns])

    @property
    def is_open(self) -> bool:
        """Whether there is more to be had from it."""
        if self._stuck or not self._heap:
            return False
        return not self._enough(-self._heap[0][0], self._best)

    @property
    def gap(self) -> float:
        """Between what is proved and what is attained; zero where nothing is left to be split."""
        return -self._heap[0][0] - self._best if self._heap else 0.0

    def grow(self, budget: int) -> None:
        """Split leaves until it is closed, or so many more programs are solved."""
        budget += self.nodes
        while self.nodes < budget and self.is_open:
            pair = self._split_at(self._heap[0][-1])
            if pair is None or not self._split(pair):
                self._stuck = True

    def _split(self, pair: int) -> bool:
        """Whether the leaf of the largest bound could be split."""
        bound, _, node = self._heap[0]
        children = []
        for side in (0, 1):
            phases = node.phases | {pair: side}
            vertex = self._solved(phases, node.vertex.basis)
            self.nodes += 1
            children.append(None if vertex is None else Node(phases, vertex))
        if None in children:
            return False
        heapq.heappop(self._heap)
        if solutions := [each.vertex.columns for each in children if len(each.vertex.columns)]:
            self._best = max(self._best, self._attained(solutions))
        for child in children:
            if len(child.vertex.columns):
                self._push(min(child.vertex.value, -bound), child)
            else:
                proved = _proved_empty(child, node, self._best, self._horizon)
                self._empty.append(proved or Node(child.phases, node.vertex))
                self._stuck |= proved is None  # the bound falls no further
        return True

    def _push(self, value: float, node: Node) -> None:
        heapq.heappush(self._heap, (-value, next(self._serial), node))

    def _solved(self, phases: dict[int, int], basis: Any = None) -> Vertex | None:
        held = (self._horizon.zero[i, side] for i, side in phases.items())
        return self._programs.largest(self._rows, self._constants, held, self._budget, basis=basis)

    def _split_at(self, node: Node) -> int | None:
        """The pair to be split; None if all that is not held is as it should be."""
        horizon, rows = self._horizon, self._rows
        if not len(horizon.zero):
            return None
        facts = horizon.facts
        values = (facts.columns @ node.vertex.columns + facts.rows[:, 0])[horizon.zero]
        off = values.min(axis=1) / horizon.gaps
        off[list(node.phases)] = 0.0
        if off.max() <= EXACT:
            return None
        size = abs(rows).max(initial=0.0)
        weight = abs(node.vertex.reduced) + SHARE * abs(rows).max(axis=0) + EXACT * size
        return int(np.where(off > EXACT, off * weight[horizon.columns], -1.0).argmax())

    def found(self) -> Found | None:
        """The leaves; None where the first program had no answer."""
        leaves = [node for *_, node in self._heap] + self._empty
        if not leaves:
            return None
        phases = np.full((len(leaves), len(self._horizon.zero)), -1, dtype=np.int8)
        for leaf, held in zip(leaves, phases, strict=True):
            held[list(leaf.phases)] = list(leaf.phases.values())
        multipliers, weights, columns = (
            np.stack([getattr(leaf.vertex, name) for leaf in leaves])
            for name in ("multipliers", "weights", "columns")
        )
        return Found(phases, multipliers, weights, columns, self.nodes)


def attained_multipliers(
    horizon: Horizon,
    programs: AbstractPrograms,
    form: AffineForms,
    columns: Float[np.ndarray, " n"],
    leaves: Int[np.ndarray, "l p"],
    bound: float,
    budget: Budget = ENDLESS,
) -> Float[np.ndarray, " m"] | None:
    """Multipliers of a bound that is attained, with nothing of the lines that hold units.

    Every unit is held in the phase that it has where the bound is attained, but for those that
    are at their bend. What is left is the loop itself around that state: its multipliers are what
    a derivative needs.

    Args:
        horizon: whose facts hold.
        programs: over these.
        form: one.
        columns: where it is attained.
        leaves: phases of the pairs of facts in each leaf, in one of which it is.
        bound: that is proved.
        budget: of each program's time.

    Returns:
        None where the bound is not attained there.
    """
    facts, zero = horizon.facts, horizon.zero
    values = (facts.columns @ columns + facts.rows[:, 0])[zero] / horizon.gaps[:, None]
    vanishing = values <= BENT
    both, side = vanishing.all(axis=1), vanishing.argmax(axis=1)
    row, constant = np.asarray(form.columns), np.asarray(form.rows[:, 0])
    reach = np.full(facts.columns.shape[1], 2.0)
    reach[np.setdiff1d(horizon.free, horizon.enclosed)] = 1.0  # what bounds these are no lines
    attained, near = constant[0] + row[0] @ columns[: row.shape[1]], BENT * abs(row).sum()
    if bound - attained > near:
        return None
    for phases in leaves:
        if np.any((phases >= 0) & ~both & (phases != side)):
            continue
        there = np.where(both, phases, side)
        held = (zero[i, there[i]] for i in np.flatnonzero(there >= 0))
        vertex = programs.largest(row, constant, held, budget, reach=reach)
        if vertex is not None and abs(vertex.value - attained) <= near:
            return vertex.multipliers
    return None


def _proved_empty(child: Node, parent: Node, floor: float, horizon: Horizon) -> Node | None:
    """A branch without states, with multipliers that bound it by what is attained elsewhere.

    Those of its facts that show it to be empty are added to its parent's until they suffice; None
    if they do not show it.
    """
    vertex, rays = parent.vertex, np.outer([1.0, -1.0], child.vertex.multipliers)
    nothing = AffineForms(np.zeros((2, 2)), np.zeros((2, 2)))
    values = horizon.bounds(nothing, rays)
    value, ray = values.min(), rays[values.argmin()]
    if not value < 0:
        return None
    rest = vertex.value - floor if np.isfinite(floor) else 1.0 + abs(vertex.value)
    multipliers = vertex.multipliers - 2 * rest / value * ray
    return Node(child.phases, vertex._replace(multipliers=multipliers))
