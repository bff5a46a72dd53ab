"""Cutting planes: products of facts that the dual says are violated, added round by round.

A facet's moment matrix `X` stands for the worst trajectories that the products so far allow. On a
true trajectory every entry of `F X F'` is nonnegative, so the most negative ones (rows of unit
norm) name the products that are missing. Rounds go on until a simulated witness attains the bound,
nothing is violated, or they run out. On the host, with one set of products for each facet: those
whose multipliers are at zero are dropped before the next facet.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from reachjax.lmi import Program
from reachjax.recheck import interval_offsets
from reachjax.relaxation import CuttingPlanes, FactLayout, Products
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
        pairs: `(p, 2)`, the products added that were in use at last.
    """

    products: Products
    judged: Judged
    pairs: Int[np.ndarray, "p 2"]


def solved_in_rounds(
    program: Program,
    solver: AbstractSolver,
    cuts: CuttingPlanes,
    witness: Witness | None = None,
    offered: Int[np.ndarray, "p 2"] | None = None,
) -> Rounds:
    """Solve for every facet, products being added as they are needed.

    Args:
        program: whose leaves are numpy arrays, with the products to begin with.
        solver: of the programs of each round.
        cuts: how many rounds, and of how many products.
        witness: what simulations attain; rounds do not stop for them if it is None.
        offered: products that were of use before.
    """
    candidates = _Candidates(program)
    facets = len(program.objective.mid)
    found, used = [], candidates.known(offered)
    for facet in range(facets):
        one = program.seeking(slice(facet, facet + 1))
        attained = None if witness is None else (lambda column, i=facet: witness(i, column))
        result = _facet(one, candidates, solver, cuts, attained, used)
        found.append(result)
        used = candidates.of_use(result)
    return _joined(program, candidates, found, used)


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
    """One facet's last round: its added products, and what was proved with them."""

    pairs: Int[np.ndarray, "p 2"]
    offset: float
    optimal: bool
    solution: Solution
    seconds: float


class _Candidates:
    """The facts of a program that say something, and the products they have without cuts."""

    def __init__(self, program: Program):
        given = trimmed(program)
        norms = np.sqrt((given.facts**2).sum(axis=1))
        cone = np.zeros(len(norms), dtype=bool)
        cone[np.r_[program.products.left, program.products.right][_cone(program.products)]] = True
        self.live = np.flatnonzero((norms > 0) & np.isfinite(norms) & ~cone)
        self.rows = given.facts[self.live] / norms[self.live, None]
        self.columns = given.columns
        self.core = _restricted(program.products, given.kept)
        self.kept = np.flatnonzero(given.kept)
        place = np.full(len(norms), -1)
        place[self.live] = np.arange(len(self.live))
        self.place = place
        self.open = np.triu(np.ones((len(self.live),) * 2, dtype=bool), 1)
        left, right = place[self.core.left], place[self.core.right]
        there = (left >= 0) & (right >= 0)
        self._close(left[there], right[there])

    def _close(self, left, right):
        self.open[np.minimum(left, right), np.maximum(left, right)] = False

    def known(self, pairs: np.ndarray | None) -> np.ndarray:
        """Those of the pairs that may be added."""
        if pairs is None or not len(pairs):
            return np.zeros((0, 2), dtype=int)
        left, right = np.sort(self.place[pairs], axis=1).T
        return pairs[(left >= 0) & self.open[left, right]]

    def violated(self, moment: np.ndarray, pairs: np.ndarray, batch: int) -> np.ndarray:
        """The most violated pairs that are not there yet, at most so many."""
        values = np.where(self.open, self.rows @ moment @ self.rows.T, 0.0)
        left, right = np.sort(self.place[pairs], axis=1).T
        values[left, right] = 0.0
        count = min(batch, int((values < -VIOLATED).sum()))
        if not count:
            return np.zeros((0, 2), dtype=int)
        worst = np.argpartition(values, count - 1, axis=None)[:count]
        return self.live[np.stack(np.unravel_index(worst, values.shape), axis=1)]

    def with_pairs(self, program: Program, pairs: np.ndarray) -> Program:
        """The program with the products to begin with and these."""
        return program.replace(products=_joint(self.core, pairs))

    def of_use(self, result: _Result) -> np.ndarray:
        """The added products whose multipliers are not at zero."""
        weights = result.solution.multipliers[0, len(self.core.free) :]
        return result.pairs[weights > IDLE * max(1e-300, weights.max(initial=0.0))]


def _facet(program, candidates, solver, cuts, attained, pairs) -> _Result:
    """The rounds of one facet."""
    size = float(interval_offsets(program)[0] - program.objective.mid[0, -1])
    best, seconds = None, 0.0
    for round_ in range(cuts.rounds + 1):
        given = candidates.with_pairs(program, pairs)
        solution = solver.solve(given)
        seconds += float(solution.seconds[0])
        (offset,), (optimal,) = accepted_offsets(given, solution)
        if best is None or offset <= best.offset:
            best = _Result(pairs, float(offset), bool(optimal), solution, 0.0)
        moment = solution.moments[0]
        if round_ == cuts.rounds or not np.isfinite(moment).all():
            break
        if attained is not None:
            column = program.transform @ moment[:, -1]
            if best.offset - attained(column) <= cuts.gap * size:
                break
        more = candidates.violated(moment, pairs, cuts.batch)
        if not len(more):
            break
        pairs = np.concatenate([pairs, more])
    return best._replace(seconds=seconds)


def _cone(products: Products) -> np.ndarray:
    """Which ends of pairs are rows of the cone, left ends first."""
    cone = products.sign < 0
    squares = np.isin(products.multiplier, products.multiplier[cone])
    return np.r_[squares, squares]


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


def _joined(program, candidates, found: list[_Result], used: np.ndarray) -> Rounds:
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
    return Rounds(products, Judged(offsets, optimal, solution), used)
