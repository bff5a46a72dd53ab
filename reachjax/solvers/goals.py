"""Goals: what is sought of a program, from what a solver proposes to a proof with a derivative.

A goal is the offset of each facet, the ellipsoid of least volume, or the least size of a given
shape. What it proves is a number or a shape of the program's rows, and its derivative in them is
found on the host: ordinary automatic differentiation carries it on through rows, bounds and earlier
steps.

**With an optimum.** Offsets and sizes are optimal values, so the envelope theorem gives their
derivative: hold multipliers and moments fixed and differentiate the Lagrangian (`programs.lmi`).
The ellipsoid of least volume is an optimal *point*: what is reported is the point on the central
path nearby, which moves as the implicit function theorem says (`ellipsoids`). What the recheck
adds to an optimum is not differentiated.

**Without an optimum.** The derivative is that of the bound that is reported, whatever the status:
where multipliers and moments do not bear out an optimum, of what the multipliers prove, these being
held, and where they prove nothing of use, of the interval bound (`proofs.gradients`). It is NaN
where there is no bound at all. What a solver proposes (multipliers, moments, its own offsets) has
no derivative: asking for one gives NaN.

**Accuracy.** The derivative is as good as the solver: with the default solvers, which go on to
1e-9, the tests hold it to 1e-3 of fourth-order differences, over one step and over five. At 1e-6
it was off by up to 3e-3, at 1e-4 by up to 7e-2 (of its norm). Flat sets and points keep these
digits; of sets, and input ranges, of a width below some 1e-8 of their size the derivative in the
width loses them.

**Kinks.** Where a facet only touches, a neuron becomes stable, or an optimal point is not unique,
an offset has a kink: the derivative is then one of its generalised gradients, and central
differences see another. Second derivatives and forward mode do not exist; JAX raises an error.
"""

from __future__ import annotations

import abc
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from reachjax.numerics.checks import is_concrete
from reachjax.numerics.flags import lenient
from reachjax.numerics.host import all_finite, on_host, shapes_of
from reachjax.programs.lmi import Program, Slopes
from reachjax.programs.presolve import AbstractInequality
from reachjax.programs.relaxations import LocalBounds, Products
from reachjax.proofs.certificates import AbstractCertificate
from reachjax.proofs.proposal import Proposal
from reachjax.proofs.reported import Judged
from reachjax.sets import AbstractSet
from reachjax.solvers.base import AbstractSolver, proposed
from reachjax.solvers.cutting_planes import NONE, CutPool, Rounds, Shown, idle, in_rounds, joint


class AbstractGoal(AbstractInequality):
    """What is sought of a program. A pytree; what gets a program gets numpy arrays, on the host.

    It says what solvers see (`programs.presolve`), what is proved with what they propose, and how
    that moves with the program's rows.
    """

    @abc.abstractmethod
    def rows(self, states: int) -> Float[Array, "f n_x"]:
        """The rows of the successor that the program is to have for an objective."""

    @abc.abstractmethod
    def unknown(self, program: Program) -> Judged:
        """Nothing is proved: NaN."""

    @abc.abstractmethod
    def judged(self, program: Program, solver: AbstractSolver) -> Judged:
        """What the solver proposes for a program of finite numbers, and what that proves."""

    def in_rounds(
        self, program: Program, solver: AbstractSolver, rounds: Rounds
    ) -> tuple[Products, Judged]:
        """The products that were added round by round, and what is proved with them.

        As they are here, for goals of one program: those that its own moments violate.
        """
        pool, n = CutPool(program, rounds.layout), len(program.transform)

        def solve(pairs: np.ndarray) -> Shown:
            given = program.replace(products=joint(pool.core, pairs))
            found = proposed(solver, given, self)
            return Shown(found.moments[0, :n, :n], idle(found.multipliers[0], len(pairs)))

        products = joint(pool.core, in_rounds(pool, rounds, NONE, solve))
        return products, judged(self, program.replace(products=products), solver)

    @abc.abstractmethod
    def slopes(
        self, program: Program, judged: Judged, cotangent: Any
    ) -> tuple[Slopes, AbstractGoal]:
        """The derivative of `<cotangent, value>` in the program's rows, and in the goal.

        Args:
            program: the program.
            judged: what was proved of it: finite numbers.
            cotangent: weights of the value.
        """

    @abc.abstractmethod
    def region(self, value: Any) -> AbstractSet:
        """The set that is proved."""

    @abc.abstractmethod
    def certificate(self, program: Program, value: Any, proposal: Proposal) -> AbstractCertificate:
        """The proof of the set."""


def judged(goal: AbstractGoal, program: Program, solver: AbstractSolver) -> Judged:
    """What is proved of a goal with what a solver proposes, of numpy arrays."""
    if not all_finite((goal, program)):
        return goal.unknown(program)
    return goal.judged(program, solver)


def proved(
    goal: AbstractGoal, program: Program, solver: AbstractSolver, rounds: Rounds | None = None
) -> tuple[Program, Any, Proposal]:
    """What is proved of a goal, differentiable in the program's rows and in the goal.

    Args:
        goal: what is sought.
        program: with the goal's rows for an objective, and the products to begin with.
        solver: what proposes multipliers.
        rounds: by which products are added; traced numbers have those of `LocalBounds` instead.

    Returns:
        The program with all its products, the value that is proved, and what was proposed.
    """
    fixed = jax.lax.stop_gradient((goal, program))
    if rounds is not None and is_concrete(fixed):
        sought, given = jax.device_get(fixed)
        products, found = jax.device_put(sought.in_rounds(given, solver, rounds))
        program = program.replace(products=products)
    else:
        if rounds is not None:
            program = program.replace(products=LocalBounds().products(rounds.layout))
            fixed = jax.lax.stop_gradient((goal, program))
        shapes = shapes_of(goal.unknown(program))
        found: Any = on_host(partial(_judged, solver), shapes, fixed)
    rows = program.facts.mid, program.objective.mid
    return program, *_enveloped(goal, *rows, program, found)


def _judged(solver: AbstractSolver, fixed: tuple[AbstractGoal, Program]) -> Judged:
    return judged(*fixed, solver)


@jax.custom_vjp
def _enveloped(goal, facts, objective, program, judged):
    """What was proved, with its derivative in the goal and in midpoints of rows."""
    return judged.value, judged.proposal


def _forward(goal, facts, objective, program, judged):
    return _enveloped(goal, facts, objective, program, judged), (goal, program, judged)


@lenient
def _backward(residual, cotangents):
    goal, program, _ = residual
    value, proposal = cotangents
    rows = Slopes(program.facts.mid, program.objective.mid)
    found: Any = on_host(_slopes, shapes_of((rows, goal)), (*residual, value))
    asked = _asked_for(proposal)
    (facts, objective), sought = jax.tree.map(lambda x: jnp.where(asked, jnp.nan, x), found)
    return sought, facts, objective, None, None


def _slopes(argument: tuple[AbstractGoal, Program, Judged, Any]) -> tuple[Slopes, AbstractGoal]:
    goal, program, judged, cotangent = argument
    if not all_finite((goal, program, judged.value)):
        rows = Slopes(program.facts.mid, program.objective.mid)
        return jax.tree.map(lambda leaf: np.full_like(leaf, np.nan), (rows, goal))
    return goal.slopes(program, judged, cotangent)


def _asked_for(proposal: Proposal) -> Bool[Array, ""]:
    """Whether a derivative of what a solver proposes is asked for; there is none."""
    parts = [part for part in jax.tree.leaves(proposal) if part.dtype == float]
    return jnp.array([jnp.any(part != 0) for part in parts]).any()


_enveloped.defvjp(_forward, _backward)
