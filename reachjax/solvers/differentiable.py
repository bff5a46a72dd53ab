"""The offsets of a semidefinite program and their derivative.

An offset is an optimal value, so the envelope theorem gives its derivative: hold multipliers and
moments fixed and differentiate the Lagrangian,

    d b = <X / 2, d(F' Gamma F + p e' + e p')>,

with `X` the dual moment matrix; ordinary automatic differentiation carries it on through rows,
bounds and earlier steps. What the recheck adds to an offset is not differentiated. Where the solver
gave no optimal value that its multipliers bear out, the derivative is NaN, so that no number of a
failed solve reaches an optimiser.

**Accuracy.** The derivative is as good as the solver. Where facets are `SOLVED` at tolerance 1e-9
it differs from fourth-order differences by 2e-5 in the median and 6e-4 at most, over one step and
over five; at 1e-6 it is off by 2e-4 to 3e-3, at 1e-4 by 5e-3 to 7e-2 (of its norm). Facets left
`INACCURATE` were seen to be wrong by up to 1e-1.

**Kinks.** Where a facet only touches, a neuron becomes stable, or an optimal point is not unique,
an offset has a kink: the derivative is then one of its generalised gradients, and central
differences see another. Second derivatives and forward mode do not exist; JAX raises an error.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.lmi import Program, lagrangian
from reachjax.solvers.accepted import accepted_offsets
from reachjax.solvers.base import AbstractSolver, Solution
from reachjax.solvers.host import on_host


def proved_offsets(program: Program, solver: AbstractSolver) -> tuple[Float[Array, " f"], Solution]:
    """Solve for every facet and prove the offsets; differentiable in the program's rows.

    Returns:
        The proved offsets `(f,)`, and what the solver proposed (which has no derivative).
    """
    result: Any = _proved_offsets(solver, program.facts.mid, program.objective.mid, program)
    offsets, _, solution = result
    return offsets, solution


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _proved_offsets(solver, facts, objective, program) -> tuple[Array, Array, Solution]:
    facets, size = objective.shape
    shapes = Solution.shapes(facets, program.products.free.shape[0], size)
    offsets = jax.ShapeDtypeStruct((facets,), float)
    optimal = jax.ShapeDtypeStruct((facets,), bool)
    return on_host(partial(_solve, solver), (offsets, optimal, shapes), program)


def _forward(solver, facts, objective, program):
    result: Any = _proved_offsets(solver, facts, objective, program)
    _, optimal, solution = result
    moments = jnp.where(optimal[:, None, None], solution.moments, jnp.nan)
    return result, (program, solution.multipliers, moments)


def _backward(solver, residual, cotangents):
    program, multipliers, moments = residual

    def value(facts, objective):
        held = program.replace(
            facts=type(program.facts)(facts, program.facts.rad),
            objective=type(program.objective)(objective, program.objective.rad),
        )
        return lagrangian(held, multipliers, moments)

    pull: Any = jax.vjp(value, program.facts.mid, program.objective.mid)[1]
    return *pull(cotangents[0]), None


_proved_offsets.defvjp(_forward, _backward)


def _solve(solver: AbstractSolver, program: Program) -> tuple[np.ndarray, np.ndarray, Solution]:
    solution = solver.solve(program)
    return *accepted_offsets(program, solution), solution
