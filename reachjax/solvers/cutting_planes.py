"""Cutting planes: products of facts that the dual says are violated, added round by round.

A facet's moment matrix `X` stands for the worst trajectories that the products so far allow. On a
true trajectory every entry of `F X F'` is nonnegative, so the most negative ones (rows of unit
norm) name the products that are missing. Rounds go on until a simulated witness attains the bound,
nothing is violated, or they run out: on the host where numbers are known (`rounds`), else as many
as there may be, with room for all that they may add.
"""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from reachjax.numerics.checks import is_concrete
from reachjax.programs.facts import FactLayout
from reachjax.programs.lmi import Program
from reachjax.programs.relaxations import CuttingPlanes, LocalBounds
from reachjax.proofs.proposal import Solution
from reachjax.sets import NormalForm
from reachjax.solvers.base import AbstractSolver
from reachjax.solvers.candidates import NONE, VIOLATED, joint
from reachjax.solvers.differentiable import enveloped, proved_offsets
from reachjax.solvers.rounds import Witness, products_around, solved_in_rounds
from reachjax.solvers.smoothing import CentralPath


def proved_with_cuts(
    program: Program,
    layout: FactLayout,
    solver: AbstractSolver,
    cuts: CuttingPlanes,
    witness: Witness | None = None,
    offered: Int[np.ndarray, "p 2"] = NONE,
) -> tuple[Program, Float[Array, " f"], Solution]:
    """`proved_offsets`, with products added round by round.

    Args:
        program: with the products of `cuts`.
        layout: of its facts.
        solver: of the programs of each round.
        cuts: how many rounds, and of how many products.
        witness: what simulations attain; rounds do not stop for them if it is None.
        offered: products to begin with, as numbers of facts, where numbers are known.

    Returns:
        The program with the products that were added, the proved offsets `(f,)`, and what the
        solver proposed for it.
    """
    fixed = jax.lax.stop_gradient(program)
    if not is_concrete(fixed):
        whole = with_cuts(program, layout, solver, cuts)
        return whole, *proved_offsets(whole, solver)
    given, by = jax.device_get(fixed), solver.for_rounds
    rounds = solved_in_rounds(given, layout, by, cuts, witness, offered)
    whole = program.replace(products=jax.device_put(rounds.products))
    if isinstance(solver, CentralPath):  # not the optimum, but the centre with these products
        return whole, *proved_offsets(whole, solver)
    return whole, *enveloped(whole, rounds.judged)


def with_cuts_around(
    program: Program,
    layout: FactLayout,
    solver: AbstractSolver,
    cuts: CuttingPlanes,
    form: NormalForm | None = None,
) -> Program:
    """The program of an ellipsoid, with products added round by round; traced, with `LocalBounds`.

    Args:
        program: with the products of `cuts`.
        layout: of its facts.
        solver: of the programs of each round.
        cuts: how many rounds, and of how many products.
        form: the ellipsoid up to a factor on `A` and `b`; free if it is None.
    """
    fixed = jax.lax.stop_gradient((program, form))
    if not is_concrete(fixed):
        return program.replace(products=LocalBounds().products(layout))
    given, shape = jax.device_get(fixed)
    products = products_around(given, layout, solver.for_rounds, cuts, shape)
    return program.replace(products=jax.device_put(products))


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
        moments = solver.propose(fixed.replace(products=joint(program.products, pairs))).moments
        values = rows @ jnp.where(jnp.isfinite(moments), moments, 0.0) @ rows.T
        violation = jnp.where(missing, -values.min(axis=0), 0.0)
        worst, where = jax.lax.top_k(violation.ravel(), batch)
        ends = jnp.stack(jnp.unravel_index(where, violation.shape), axis=1)
        added = jnp.where((worst > VIOLATED)[:, None], ends, empty).astype(pairs.dtype)
        pairs = jax.lax.dynamic_update_slice(pairs, added, (number * batch, 0))
        return pairs, missing.at[tuple(ends.T)].min(worst <= VIOLATED)

    batch = min(cuts.batch, count**2)
    pairs = jnp.full((cuts.rounds * batch, 2), empty, dtype=jnp.int32)
    if cuts.rounds:
        pairs, _ = jax.lax.fori_loop(0, cuts.rounds, more, (pairs, above))
    return whole.replace(products=joint(program.products, pairs))


def _linear_pairs(cuts: CuttingPlanes, layout: FactLayout) -> Int[np.ndarray, "p 2"]:
    """The pairs of linear facts that a program begins with, the smaller number first."""
    pairs = list(itertools.chain.from_iterable(cuts.groups(layout)[0]))
    return np.sort(np.array(pairs, dtype=int).reshape(-1, 2), axis=1)
