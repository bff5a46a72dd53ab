"""The offsets of a semidefinite program and their derivative.

An offset is an optimal value, so the envelope theorem gives its derivative: hold multipliers and
moments fixed and differentiate the Lagrangian,

    d b = <X / 2, d(F' Gamma F + p e' + e p')>,

with `X` the dual moment matrix; ordinary automatic differentiation carries it on through rows,
bounds and earlier steps. What the recheck adds to an optimal value is not differentiated.

**Without an optimum.** The derivative is that of the bound that is reported, whatever the status:
where multipliers and moments do not bear out an optimal value, of what the multipliers prove, these
being held, and where they prove nothing of use, of the interval bound (`slopes`). It is NaN where
there is no bound at all. What a solver proposes (multipliers, moments, its own offsets) has no
derivative: asking for one gives NaN.

**Accuracy.** The derivative is as good as the solver: with the default solvers, which go on to
1e-9, the tests hold it to 1e-3 of fourth-order differences, over one step and over five. At 1e-6
it was off by up to 3e-3, at 1e-4 by up to 7e-2 (of its norm). Flat sets and points keep these
digits; of sets, and input ranges, of a width below some 1e-8 of their size the derivative in the
width loses them.

**Kinks.** Where a facet only touches, a neuron becomes stable, or an optimal point is not unique,
an offset has a kink: the derivative is then one of its generalised gradients, and central
differences see another.  Second derivatives and
forward mode do not exist; JAX raises an error.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.numerics.host import all_finite, on_host, shapes_of
from reachjax.programs.lmi import Program, lagrangian
from reachjax.proofs.proposal import Solution
from reachjax.proofs.reported import Judged, judged
from reachjax.solvers.base import AbstractSolver
from reachjax.solvers.cotangents import asked_for
from reachjax.solvers.faults import proposed


def proved_offsets(program: Program, solver: AbstractSolver) -> tuple[Float[Array, " f"], Solution]:
    """Solve for every facet and prove the offsets; differentiable in the program's rows.

    Returns:
        The proved offsets `(f,)`, and what the solver proposed (which has no derivative).
    """
    fixed = jax.lax.stop_gradient(program)
    shapes = shapes_of(_unknown(Solution.blank_for(fixed)))
    return enveloped(program, on_host(partial(_solved, solver), shapes, fixed))


def enveloped(program: Program, judged: Judged) -> tuple[Float[Array, " f"], Solution]:
    """Offsets that were proved, with the derivative that the envelope theorem gives them.

    Args:
        program: whose rows the offsets are differentiated in.
        judged: what was proposed and proved for it.
    """
    return _enveloped(program.facts.mid, program.objective.mid, program, judged)


@jax.custom_vjp
def _enveloped(facts, objective, program, judged) -> tuple[Array, Solution]:
    return judged.offsets, judged.solution


def _forward(facts, objective, program, judged):
    # not `judged` itself: multipliers change with the program, so a second derivative has to fail
    result: Any = _enveloped(facts, objective, program, judged)
    return result, (program, judged.multipliers, judged.moments)


def _backward(residual, cotangents):
    program, multipliers, moments = residual

    def value(facts, objective):
        return lagrangian(program.with_midpoints(facts, objective), multipliers, moments)

    pull: Any = jax.vjp(value, program.facts.mid, program.objective.mid)[1]
    offsets, proposal = cotangents
    return *pull(jnp.where(asked_for(proposal), jnp.nan, offsets)), None, None


_enveloped.defvjp(_forward, _backward)


def _solved(solver: AbstractSolver, program: Program) -> Judged:
    """What is proposed and proved on the host; of a program without numbers nothing."""
    if not all_finite(program):
        return _unknown(Solution.blank_for(program))
    return judged(program, proposed(solver, program))


def _unknown(solution: Solution) -> Judged:
    """Nothing is proved: NaN."""
    unknown = np.full(len(solution.offsets), np.nan)
    return Judged(
        offsets=unknown,
        optimal=np.zeros(len(unknown), dtype=bool),
        multipliers=np.full(solution.multipliers.shape, np.nan),
        moments=np.full(solution.moments.shape, np.nan),
        solution=solution,
    )
