"""The primal-dual method for facets, from its starting point to its end. Traceable.

**When it stalls.** The iterate with the smallest residuals is kept. It is reported as inaccurate,
its multipliers are nonnegative and finite, and what they prove is what counts (`recheck`).

**Where it starts.** Always at the same point: 16 to 25 iterations on programs that grew by 60
products a round. Runs from an iterate of the round before, moved inwards, stalled.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from reachjax.solvers.generators import Generators
from reachjax.solvers.primal_dual import Point, start, step
from reachjax.solvers.proposals import SolverStatus

FURTHER = 1e-3
"""Iterates go on to this part of the tolerance, as long as they gain."""

PATIENCE = 12
"""Iterations without a better iterate after which a run has stalled."""

SHORT = 1e-4
"""So have runs whose steps stay below this length."""


class Search(NamedTuple):
    """Where a run is.

    Attributes:
        point: the iterate.
        best: the one with the smallest merit so far.
        merit: of the best.
        iterations: how many are done.
        idle: iterations since the best.
        short: consecutive iterations with a short step.
        over: whether nothing more is to be gained.
    """

    point: Point
    best: Point
    merit: Float[Array, ""]
    iterations: Int[Array, ""]
    idle: Int[Array, ""]
    short: Int[Array, ""]
    over: Bool[Array, ""]


class Facet(NamedTuple):
    """What a run found for one facet, in the scaling of its generators.

    Attributes:
        offset: `b`, NaN where there is none.
        multipliers: `(K,)`.
        moment: `(n, n)`, with corner 1.
        status: a value of `SolverStatus`.
        merit: the largest relative residual or gap.
        iterations: how many.
    """

    offset: Float[Array, ""]
    multipliers: Float[Array, " K"]
    moment: Float[Array, "n n"]
    status: Int[Array, ""]
    merit: Float[Array, ""]
    iterations: Int[Array, ""]


def solve_facet(
    generators: Generators,
    row: Float[Array, " n"],
    tolerance: Float[Array, ""] | float,
    max_iterations: Int[Array, ""] | int,
) -> Facet:
    """Minimise the offset of one facet. Traceable.

    Args:
        generators: what the multipliers weigh.
        row: the objective, of unit 1-norm.
        tolerance: relative, of residuals and gap.
        max_iterations: how many at most.
    """

    def going(search: Search):
        return ~search.over & (search.iterations < max_iterations)

    def iterate(search: Search) -> Search:
        following, missed, length = step(generators, row, search.point)
        merit = missed.merit
        better = merit < search.merit
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), search.point, search.best)
        short = jnp.where(length < SHORT, search.short + 1, 0)
        idle = jnp.where(better, 0, search.idle + 1)
        least = jnp.minimum(jnp.where(jnp.isnan(merit), jnp.inf, merit), search.merit)
        lost = ~jnp.isfinite(merit) | (idle > PATIENCE) | (short > 3)
        enough = (least <= FURTHER * tolerance) | ((least <= tolerance) & (idle > 2))
        return Search(following, best, least, search.iterations + 1, idle, short, lost | enough)

    point, zero = start(generators), jnp.array(0)
    first = Search(point, point, jnp.array(jnp.inf), zero, zero, zero, jnp.array(False))
    search = jax.lax.while_loop(going, iterate, first)
    return _found(search, tolerance, max_iterations)


def solve_facets(
    generators: Generators,
    rows: Float[Array, "f n"],
    tolerance: Float[Array, ""] | float,
    max_iterations: Int[Array, ""] | int,
) -> Facet:
    """`solve_facet` for several objectives; every array of the result has an axis for them.

    Batched on an accelerator. On a CPU one after the other: batches of factorisations inside a
    `while_loop` hang there (jaxlib 0.10.2, two cores: two facets of 69 columns did, eight of 25
    did not).
    """
    if jax.default_backend() == "cpu":
        return jax.lax.map(lambda row: _one(generators, row, tolerance, max_iterations), rows)
    return jax.vmap(solve_facet, (None, 0, None, None))(generators, rows, tolerance, max_iterations)


@jax.custom_batching.sequential_vmap
def _one(generators: Generators, row: Array, tolerance: Array, limit: Array) -> Facet:
    """`solve_facet`, one after the other also under `jax.vmap`."""
    return solve_facet(generators, row, tolerance, limit)


def _found(search: Search, tolerance, max_iterations) -> Facet:
    best, corner = search.best, search.best.X[-1, -1]
    finite = jnp.isfinite(search.merit) & (corner > 0)
    for part in best:
        finite &= jnp.isfinite(part).all()
    ended = jnp.where(search.over, SolverStatus.INACCURATE, SolverStatus.LIMIT)
    status = jnp.where(search.merit <= tolerance, SolverStatus.SOLVED, ended)
    return Facet(
        offset=jnp.where(finite, best.y[-1], jnp.nan),
        multipliers=jnp.where(finite, best.y, 0.0),
        moment=jnp.where(finite, best.X / jnp.where(corner > 0, corner, 1.0), jnp.nan),
        status=jnp.where(finite, status, SolverStatus.FAILED),
        merit=search.merit,
        iterations=search.iterations,
    )
