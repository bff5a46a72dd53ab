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
    row = forms.widened(facts.columns.shape[1]).columns[best]
    columns = np.sign(row)
    if start.round:
        first = row[: start.spread.shape[1]]
        length = np.linalg.norm(first)
        columns[: len(first)] = first / length if length > 0 else 0.0
    none = np.zeros((1, len(facts.rows)))
    phases = np.full((1, len(horizon.zero)), -1, dtype=np.int8)
    weights = np.eye(1, len(forms.rows), best)
    return Found(phases, none, weights, columns[None], nodes=0)


def branched(
    horizon: Horizon,
    programs: AbstractPrograms,
    forms: AffineForms,
    attained: Callable[[list[Float[np.ndarray, " n"]]], float],
    enough: Callable[[float, float], bool],
    budget: int,
) -> Found | None:
    """Bound the largest value of a form, or of the least of several.

    Args:
        horizon: whose facts hold.
        programs: over these.
        forms: `r` of them.
        attained: the largest value that is known to be attained, given columns of more solutions.
        enough: whether to stop, given the bound and what is attained.
        budget: how many linear programs may be solved.

    Returns:
        The leaves; None where the first program has no answer.
    """
    zero, facts = horizon.zero, horizon.facts
    forms = forms.widened(facts.columns.shape[1])
    rows, constants = np.asarray(forms.columns), np.asarray(forms.rows[:, 0])
    size = abs(rows).max(initial=0.0)

    def solved(phases: dict[int, int], basis: Any = None) -> Vertex | None:
        held = (zero[i, side] for i, side in phases.items())
        return programs.largest(rows, constants, held, basis=basis)

    def split_at(node: Node) -> int | None:
        """The pair to be split; None if all that is not held is as it should be."""
        if not len(zero):
            return None
        values = facts.columns @ node.vertex.columns + facts.rows[:, 0]
        off = np.minimum(values[zero[:, 0]], values[zero[:, 1]]) / horizon.gaps
        off[list(node.phases)] = 0.0
        if off.max() <= EXACT:
            return None
        weight = abs(node.vertex.reduced) + SHARE * abs(rows).max(axis=0) + EXACT * size
        return int(np.where(off > EXACT, off * weight[horizon.columns], -1.0).argmax())

    first = solved({})
    if first is None or not len(first.columns):  # or facts of thin sets seem to hold nowhere
        return None
    count, serial = 1, itertools.count()
    heap: list[tuple[float, int, Node]] = [(-first.value, next(serial), Node({}, first))]
    empty: list[Node] = []
    best = attained([first.columns]) if len(first.columns) else -np.inf
    while heap and count < budget and not enough(-heap[0][0], best):
        bound, _, node = heap[0]
        pair = split_at(node)
        if pair is None:
            break
        children = []
        for side in (0, 1):
            phases = node.phases | {pair: side}
            vertex = solved(phases, node.vertex.basis)
            count += 1
            children.append(None if vertex is None else Node(phases, vertex))
        if None in children:
            break
        heapq.heappop(heap)
        if solutions := [each.vertex.columns for each in children if len(each.vertex.columns)]:
            best = max(best, attained(solutions))
        for child in children:
            if len(child.vertex.columns):
                value = min(child.vertex.value, -bound)
                heapq.heappush(heap, (-value, next(serial), child))
            else:
                empty.append(_proved_empty(child, node, best, horizon))
    return _found([node for *_, node in heap] + empty, len(zero), count)


def settled(
    horizon: Horizon,
    programs: AbstractPrograms,
    form: AffineForms,
    columns: Float[np.ndarray, " n"],
    leaves: Int[np.ndarray, "l p"],
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

    Returns:
        None where the bound is another one.
    """
    facts, zero = horizon.facts, horizon.zero
    values = (facts.columns @ columns + facts.rows[:, 0])[zero] / horizon.gaps[:, None]
    vanishing = values <= BENT
    both, side = vanishing.all(axis=1), vanishing.argmax(axis=1)
    row, constant = np.asarray(form.columns), np.asarray(form.rows[:, 0])
    attained, size = constant[0] + row[0] @ columns[: row.shape[1]], abs(row).sum()
    for phases in leaves:
        if np.any((phases >= 0) & ~both & (phases != side)):
            continue
        there = np.where(both, phases, side)
        held = (zero[i, there[i]] for i in np.flatnonzero(there >= 0))
        vertex = programs.largest(row, constant, held, reach=2.0)
        if vertex is not None and abs(vertex.value - attained) <= BENT * size:
            return vertex.multipliers
    return None


def _proved_empty(child: Node, parent: Node, floor: float, horizon: Horizon) -> Node:
    """A branch without states, with multipliers that bound it by what is attained elsewhere.

    Those of its facts that show it to be empty are added to its parent's until they suffice.
    """
    vertex, rays = parent.vertex, np.outer([1.0, -1.0], child.vertex.multipliers)
    nothing = AffineForms(np.zeros((2, 2)), np.zeros((2, 2)))
    values = horizon.bounds(nothing, rays)
    value, ray = values.min(), rays[values.argmin()]
    if not value < 0:
        return Node(child.phases, vertex)
    rest = vertex.value - floor if np.isfinite(floor) else 1.0 + abs(vertex.value)
    multipliers = vertex.multipliers - 2 * rest / value * ray
    return Node(child.phases, vertex._replace(multipliers=multipliers))


def _found(leaves: list[Node], pairs: int, nodes: int) -> Found:
    """The leaves as arrays."""
    phases = np.full((len(leaves), pairs), -1, dtype=np.int8)
    for leaf, held in zip(leaves, phases, strict=True):
        held[list(leaf.phases)] = list(leaf.phases.values())
    vertices = [leaf.vertex for leaf in leaves]
    multipliers, weights, columns = (
        np.stack([getattr(vertex, name) for vertex in vertices])
        for name in ("multipliers", "weights", "columns")
    )
    return Found(phases, multipliers, weights, columns, nodes)
