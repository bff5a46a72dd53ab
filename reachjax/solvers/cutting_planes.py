"""Cutting planes: products of facts that the dual says are violated, added round by round.

A facet's moment matrix `X` stands for the worst trajectories that the products so far allow. On a
true trajectory every entry of `F X F'` is nonnegative, so the most negative ones (rows of unit
norm) name the products that are missing. Rounds go on until a simulated witness attains the bound,
nothing is violated, or they run out. On the host, with one set of products for each facet: those
whose multipliers are at zero are dropped before the next facet.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from reachjax.lmi import Program
from reachjax.recheck import interval_offsets
from reachjax.relaxation import CuttingPlanes, FactLayout, LocalBounds, Products
from reachjax.solvers.accepted import accepted_offsets
from reachjax.solvers.base import AbstractSolver, Solution
from reachjax.solvers.differentiable import Judged
from reachjax.solvers.trimming import namespace, trimmed

VIOLATED = 1e-6
"""Products more negative than this are, rows of facts and the basis being of unit size."""

IDLE = 1e-7
"""Multipliers below this part of the largest are at zero."""

Witness = Callable[[int, Float[np.ndarray, " n"]], float]
"""The value of a facet that a simulation attains, given its number and a moment's last column."""


class Rounds(NamedTuple):
    """What the rounds of all facets ended with.

    Attributes:
        products: every facet's.
        judged: what was proposed, multipliers being those of `products`, and proved; a facet's
            offset is optimal with its own products.
    """

    products: Products
    judged: Judged


def solved_in_rounds(
    program: Program,
    layout: FactLayout,
    solver: AbstractSolver,
    cuts: CuttingPlanes,
    witness: Witness | None = None,
) -> Rounds:
    """Solve for every facet, products being added as they are needed.

    Args:
        program: whose leaves are numpy arrays, with the products of `cuts`.
        layout: of its facts.
        solver: of the programs of each round.
        cuts: how many rounds, and of how many products.
        witness: what simulations attain; rounds do not stop for them if it is None.
    """
    candidates = _Candidates(program, layout)
    found, used = [], np.zeros((0, 2), dtype=int)
    for facet in range(len(program.objective.mid)):
        one = program.seeking(slice(facet, facet + 1))
        attained = None if witness is None else partial(witness, facet)
        found.append(_facet(one, candidates, solver, cuts, attained, used))
        used = found[-1].of_use
    return _joined(program, candidates, found)


def with_cuts(
    program: Program, layout: FactLayout, solver: AbstractSolver, cuts: CuttingPlanes
) -> Program:
    """The program with products added round by round, for all facets at once. Traceable.

    There is room for `rounds` times `batch` products; room that is not needed stays empty.

    Args:
        program: with the products to begin with.
        layout: of its facts.
        solver: of the programs of each round.
        cuts: how many rounds, and of how many products.
    """
    count, empty = len(layout.linear), len(program.facts.mid)
    facts = jax.tree.map(lambda part: jnp.pad(part, ((0, 1), (0, 0))), program.facts)
    whole = program.replace(facts=facts)
    fixed = jax.lax.stop_gradient(whole)
    norms = jnp.linalg.norm(fixed.facts.mid[:count], axis=1, keepdims=True)
    rows = fixed.facts.mid[:count] / jnp.where(norms > 0, norms, 1.0)
    left, right = _linear_pairs(cuts, layout).T
    above = jnp.triu(jnp.ones((count, count), dtype=bool), 1).at[left, right].set(False)

    def more(number, carry):
        pairs, missing = carry
        moments = solver.propose(fixed.replace(products=_joint(program.products, pairs))).moments
        values = rows @ jnp.where(jnp.isfinite(moments), moments, 0.0) @ rows.T
        violation = jnp.where(missing, -values.min(axis=0), 0.0)
        worst, where = jax.lax.top_k(violation.ravel(), batch)
        ends = jnp.stack(jnp.unravel_index(where, violation.shape), axis=1)
        added = jnp.where((worst > VIOLATED)[:, None], ends, empty)
        pairs = jax.lax.dynamic_update_slice(pairs, added, (number * batch, 0))
        return pairs, missing.at[tuple(ends.T)].min(worst <= VIOLATED)

    batch = min(cuts.batch, count**2)
    pairs = jnp.full((cuts.rounds * batch, 2), empty)
    if cuts.rounds:
        pairs, _ = jax.lax.fori_loop(0, cuts.rounds, more, (pairs, above))
    return whole.replace(products=_joint(program.products, pairs))


def _linear_pairs(cuts: CuttingPlanes, layout: FactLayout) -> Int[np.ndarray, "p 2"]:
    """The pairs of linear facts that a program begins with, the smaller number first."""
    groups, _ = cuts.groups(layout)
    return np.sort(np.array([pair for group in groups for pair in group]).reshape(-1, 2), axis=1)


class _Result(NamedTuple):
    """One facet's best round: the products added, and what was proved with them."""

    pairs: Int[np.ndarray, "p 2"]
    offset: float
    optimal: bool
    solution: Solution
    seconds: float

    @property
    def of_use(self) -> Int[np.ndarray, "q 2"]:
        """The added products whose multipliers are not at zero."""
        weights = self.solution.multipliers[0]
        added = weights[len(weights) - len(self.pairs) :]
        return self.pairs[added > IDLE * max(1e-300, abs(weights).max(initial=0.0))]


class _Candidates:
    """The facts of a program that say something, and which of their products may be added.

    To begin with there are the products of the first set's facets and of the units that switch.
    What else `LocalBounds` has may be added like any other product.
    """

    def __init__(self, program: Program, layout: FactLayout):
        given, products = trimmed(program), program.products
        norms = np.sqrt((given.facts**2).sum(axis=1))
        linear = np.arange(len(norms)) < len(layout.linear)
        self.live = np.flatnonzero((norms > 0) & np.isfinite(norms) & linear)
        self.rows = given.facts[self.live] / norms[self.live, None]
        self.place = np.full(len(norms), -1)
        self.place[self.live] = np.arange(len(self.live))
        self.core = _restricted(products, given.kept & _of_facts(products, _first(program, layout)))
        self.open = np.triu(np.ones((len(self.live),) * 2, dtype=bool), 1)
        self.open[self._entries(np.stack([self.core.left, self.core.right], axis=1))] = False
        self.layout = layout

    @cached_property
    def promised(self) -> Bool[np.ndarray, "m m"]:
        """What `LocalBounds` has beyond the products to begin with."""
        groups, _ = LocalBounds(repeated=False).groups(self.layout)
        pairs = np.array(list(itertools.chain(*groups)), dtype=int).reshape(-1, 2)
        there = np.zeros_like(self.open)
        there[self._entries(pairs)] = True
        crossed = (
            self.place[np.array(kind, dtype=int)]
            for kind in (self.layout.output, self.layout.slack)
        )
        z, r = (places[places >= 0] for places in crossed)
        there[np.ix_(z, r)] = there[np.ix_(r, z)] = True
        return there & self.open

    def _entries(self, pairs: Int[np.ndarray, "p 2"]) -> tuple[np.ndarray, np.ndarray]:
        """Where these pairs stand, those of facts that say something."""
        left, right = np.sort(self.place[pairs], axis=1).T
        return left[left >= 0], right[left >= 0]

    def violated(
        self, moment: Float[np.ndarray, "n n"], pairs: Int[np.ndarray, "p 2"], batch: int | None
    ) -> Int[np.ndarray, "q 2"]:
        """The most violated pairs that are not there yet; None for all that `LocalBounds` has."""
        allowed = (self.promised if batch is None else self.open).copy()
        allowed[self._entries(pairs)] = False
        values = np.where(allowed, self.rows @ moment @ self.rows.T, 0.0)
        count = int((values < -VIOLATED).sum())
        count = count if batch is None else min(batch, count)
        if not count:
            return np.zeros((0, 2), dtype=int)
        worst = np.argpartition(values, count - 1, axis=None)[:count]
        return self.live[np.stack(np.unravel_index(worst, values.shape), axis=1)]


def _first(program: Program, layout: FactLayout) -> Bool[np.ndarray, " m"]:
    """The facts whose products a program begins with."""
    there = (program.facts.mid != 0).any(axis=1)
    first = np.zeros(len(there), dtype=bool)
    first[[0, *layout.set_facets[0], *layout.cone_rows]] = True
    switching = there[list(layout.output)] & there[list(layout.slack)]
    for kind in (layout.output, layout.slack, layout.output_cap, layout.slack_cap):
        first[np.array(kind, dtype=int)[switching]] = True
    return first


def _of_facts(products: Products, facts: Bool[np.ndarray, " m"]) -> Bool[np.ndarray, " K"]:
    """Which multipliers weigh products of these facts alone."""
    other = ~(facts[products.left] & facts[products.right])
    return np.bincount(products.multiplier, other, len(products.free)) == 0


def _facet(
    program: Program,
    candidates: _Candidates,
    solver: AbstractSolver,
    cuts: CuttingPlanes,
    attained: Callable[[Float[np.ndarray, " n"]], float] | None,
    pairs: Int[np.ndarray, "p 2"],
) -> _Result:
    """The rounds of one facet.

    When they have run out, the products of `LocalBounds` that are violated are added all the same,
    until none is: no bound is looser than its.
    """
    size = float(interval_offsets(program)[0] - program.objective.mid[0, -1])
    best, seconds = None, 0.0
    for number in itertools.count():
        given = program.replace(products=_joint(candidates.core, pairs))
        solution = solver.solve(given)
        seconds += float(solution.seconds[0])
        (offset,), (optimal,) = accepted_offsets(given, solution)
        if best is None or offset <= best.offset:
            best = _Result(pairs, float(offset), bool(optimal), solution, 0.0)
        moment = solution.moments[0]
        if not np.isfinite(moment).all():
            break
        if attained is not None:
            column = program.transform @ moment[:, -1]
            if best.offset - attained(column) <= cuts.gap * size:
                break
        more = candidates.violated(moment, pairs, cuts.batch if number < cuts.rounds else None)
        if not len(more):
            break
        pairs = np.concatenate([pairs, more])
    return best._replace(seconds=seconds)


def _restricted(products: Products, kept: np.ndarray) -> Products:
    """The products of these multipliers."""
    number, there = np.cumsum(kept) - 1, kept[products.multiplier]
    left, right, sign = (part[there] for part in (products.left, products.right, products.sign))
    return Products(left, right, sign, number[products.multiplier[there]], products.free[kept])


def _joint(core: Products, pairs: Any) -> Products:
    """Products and pairs of a multiplier each."""
    xp, count, more = namespace(pairs), len(core.free), len(pairs)
    return Products(
        left=xp.concatenate([core.left, pairs[:, 0]]),
        right=xp.concatenate([core.right, pairs[:, 1]]),
        sign=xp.concatenate([core.sign, xp.ones(more)]),
        multiplier=xp.concatenate([core.multiplier, count + xp.arange(more)]),
        free=xp.concatenate([core.free, xp.zeros(more, dtype=bool)]),
    )


def _joined(program: Program, candidates: _Candidates, found: list[_Result]) -> Rounds:
    """All facets over the products that any of them has."""
    pairs = np.unique(np.concatenate([result.pairs for result in found]), axis=0)
    number = {tuple(pair): i for i, pair in enumerate(pairs)}
    products, core = _joint(candidates.core, pairs), len(candidates.core.free)
    size = len(program.transform)
    solution = Solution.blank(len(found), len(products.free), size)
    for i, result in enumerate(found):
        mine = result.solution
        places = np.array([number[tuple(pair)] for pair in result.pairs], dtype=int)
        solution.multipliers[i, :core] = mine.multipliers[0, :core]
        solution.multipliers[i, core + places] = mine.multipliers[0, core:]
        solution.offsets[i], solution.statuses[i] = mine.offsets[0], mine.statuses[0]
        solution.moments[i], solution.seconds[i] = mine.moments[0], result.seconds
    offsets = np.array([result.offset for result in found])
    optimal = np.array([result.optimal for result in found])
    return Rounds(products, Judged(offsets, optimal, solution))
