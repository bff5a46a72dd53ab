"""Cutting planes: products of facts that the dual says are violated, added round by round.

A facet's moment matrix `X` stands for the worst trajectories that the products so far allow. On a
true trajectory every entry of `F X F'` is nonnegative, so the most negative ones (rows of unit
norm) name the products that are missing. Rounds go on until a simulated witness attains the bound,
nothing is violated, or they run out. They need numbers: where these are traced, the products are
those of `LocalBounds`.
"""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from reachjax.numerics.checks import is_concrete
from reachjax.programs.facts import FactLayout
from reachjax.programs.lmi import Program
from reachjax.programs.relaxations import CuttingPlanes, LocalBounds
from reachjax.proofs.proposal import Solution
from reachjax.sets import NormalForm
from reachjax.solvers.base import AbstractSolver
from reachjax.solvers.cut_pool import NONE
from reachjax.solvers.differentiable import enveloped, proved_offsets
from reachjax.solvers.rounds import Witness, products_around, solved_in_rounds


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
        whole = program.replace(products=LocalBounds().products(layout))
        return whole, *proved_offsets(whole, solver)
    given = jax.device_get(fixed)
    rounds = solved_in_rounds(given, layout, solver, cuts, witness, offered)
    whole = program.replace(products=jax.device_put(rounds.products))
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
    products = products_around(given, layout, solver, cuts, shape)
    return program.replace(products=jax.device_put(products))
