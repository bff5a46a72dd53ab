"""Ellipsoids around the successors, proved, and their derivative.

**A given shape.** Only its size is sought. Its factor is an optimal value, so the envelope theorem
gives the derivative, as for offsets.

**Any shape.** The ellipsoid is an optimal *point*. What is reported is the point on the central
path nearby, at a small barrier weight, and its derivative (see `centring`).

In both cases the derivative is NaN where the solver has no optimum that its multipliers bear out,
and what the recheck adds to an ellipsoid is not differentiated.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from reachjax.numerics.host import all_finite, on_host, shapes_of
from reachjax.programs.compact import compact
from reachjax.programs.lmi import Program, form_rows, schur_lagrangian, with_successor
from reachjax.proofs.accepted import accepted_enclosure, log_volume
from reachjax.proofs.proposal import ANSWERS, Enclosure, SolverStatus
from reachjax.sets import Ellipsoid, NormalForm
from reachjax.solvers.base import AbstractSolver
from reachjax.solvers.centring import Sensitivity, centred, sensitivity
from reachjax.solvers.cotangents import asked_for

ATTEMPTS = 3
"""How often a program is solved, each time in better coordinates."""


def proved_ellipsoid(program: Program, solver: AbstractSolver) -> tuple[Ellipsoid, Enclosure]:
    """The minimum-volume ellipsoid of a program, differentiable in the program's rows.

    Args:
        program: whose objective rows are the successor's.
        solver: what solves it.

    Returns:
        The ellipsoid, and what the solver proposed (which has no derivative).
    """
    result: Any = _ellipsoid(solver, program.facts.mid, program.objective.mid, program)
    form, level, _, enclosure, _ = result
    return _reported(form, level, enclosure)


def _reported(form: NormalForm, level: Array, enclosure: Enclosure) -> tuple[Ellipsoid, Enclosure]:
    """The ellipsoid that was proved, and multipliers that prove it (the proof is homogeneous)."""
    level = jax.lax.stop_gradient(level)
    proof = enclosure._replace(multipliers=enclosure.multipliers / level**2)
    return Ellipsoid.enclosing(form, level), proof


def _enclose(
    solver: AbstractSolver, program: Program
) -> tuple[NormalForm, np.ndarray, np.ndarray, Enclosure, NormalForm]:
    """The ellipsoid, its level, whether it is optimal, the proposal, and its coordinates.

    While the solver stalls, or the ellipsoid is as thin as it may be in these coordinates, the next
    attempt is in those in which the ellipsoid proved so far is the unit ball.
    """
    q = len(program.objective.mid)
    frame, attempts = NormalForm(np.eye(q), np.zeros(q)), []
    if not all_finite(program):
        blank = Enclosure.blank(program)
        return blank.form, np.array(np.nan), np.array(False), blank, frame
    for attempt in range(ATTEMPTS):
        framed = with_successor(program, frame) if attempt else program
        reduced = compact(framed)
        if attempt and reduced.is_flat:
            break
        proposed, on_path = _proposed(solver, framed)
        enclosure = proposed._replace(form=proposed.form.of(frame))
        form, level, optimal = accepted_enclosure(program, enclosure, centred=on_path)
        optimal &= enclosure.status == SolverStatus.SOLVED
        attempts.append((form, level, optimal, enclosure, frame))
        if optimal and not reduced.is_thinnest(proposed.form):
            return attempts[-1]
        frame = NormalForm(form.A / level, form.b / level)
        if not all_finite(frame):  # a single point
            break
    return min(attempts, key=lambda attempt: log_volume(*attempt[:2]))


def _proposed(solver: AbstractSolver, program: Program) -> tuple[Enclosure, bool]:
    """The solver's ellipsoid, moved to the central path, and whether that was reached."""
    enclosure = solver.enclose(program)
    if int(enclosure.status) not in ANSWERS:
        return enclosure, False
    found = centred(program, np.asarray(enclosure.multipliers), enclosure.form)
    if found is None:
        return enclosure, False
    solved = np.array(int(SolverStatus.SOLVED))
    return enclosure._replace(multipliers=found[0], form=found[1], status=solved), True


def _fit(
    solver: AbstractSolver, argument: tuple[Program, NormalForm]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Enclosure]:
    """The factor on a given form, the level, whether they are optimal, and the proposal."""
    program, given = argument
    if not all_finite(argument):
        unknown = np.array(np.nan)
        return unknown, unknown, np.array(False), Enclosure.blank(program)
    enclosure = solver.enclose(program, given)
    factor = np.sum(enclosure.form.A * given.A) / np.sum(given.A**2)
    proposed = NormalForm(factor * given.A, factor * given.b)
    enclosure = enclosure._replace(form=proposed)
    form, level, optimal = accepted_enclosure(program, enclosure, given)
    optimal &= enclosure.status == SolverStatus.SOLVED
    return np.where(form is proposed, factor, 1.0), level, optimal, enclosure


def _shapes(program: Program) -> tuple[Any, Any, Enclosure]:
    """Of a level, whether it is optimal, and the proposal."""
    number, truth = jax.ShapeDtypeStruct((), float), jax.ShapeDtypeStruct((), bool)
    return number, truth, shapes_of(Enclosure.blank(program))


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _ellipsoid(solver, facts, objective, program):
    shapes = _shapes(program)
    form = shapes[-1].form
    return on_host(partial(_enclose, solver), (form, *shapes, form), program)


def _ellipsoid_forward(solver, facts, objective, program):
    result: Any = _ellipsoid(solver, facts, objective, program)
    form, _, optimal, enclosure, frame = result
    return result, (program, form, optimal, enclosure.multipliers, frame)


def _ellipsoid_backward(solver, residual, cotangents):
    program, form, optimal, multipliers, frame = residual
    trusted = optimal & ~asked_for(cotangents[3])
    multipliers = jnp.where(trusted, multipliers, jnp.nan)  # nothing is sought for these
    shapes = shapes_of(Sensitivity.unknown(program))
    arguments = (program, multipliers, form, cotangents[0], frame)
    held: Any = on_host(lambda given: sensitivity(*given), shapes, arguments)

    def value(facts, objective):
        rows = program.with_midpoints(facts, objective)
        at_centre = schur_lagrangian(rows, held.multipliers, held.form, held.moments)
        return at_centre - schur_lagrangian(
            rows, held.multipliers_slope, held.form_slope, held.moments_slope
        )

    slopes = jax.grad(value, (0, 1))(program.facts.mid, program.objective.mid)
    return *(jnp.where(trusted, slope, jnp.nan) for slope in slopes), None


_ellipsoid.defvjp(_ellipsoid_forward, _ellipsoid_backward)


def proved_size(
    program: Program, given: NormalForm, solver: AbstractSolver
) -> tuple[Ellipsoid, Enclosure]:
    """The smallest ellipsoid of a given centre and shape, differentiable in rows and shape.

    Args:
        program: whose objective rows are the successor's.
        given: the ellipsoid up to a factor on `A` and `b`.
        solver: what solves it.

    Returns:
        The ellipsoid, and what the solver proposed (which has no derivative).
    """
    result: Any = _size(solver, program.facts.mid, program.objective.mid, given, program)
    factor, level, _, enclosure = result
    scaled = NormalForm(factor * given.A, factor * given.b)
    return _reported(scaled, level, enclosure)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _size(solver, facts, objective, given, program):
    shapes = _shapes(program)
    return on_host(partial(_fit, solver), (shapes[0], *shapes), (program, given))


def _size_forward(solver, facts, objective, given, program):
    result: Any = _size(solver, facts, objective, given, program)
    factor, _, optimal, enclosure = result
    return result, (program, given, factor, optimal, enclosure)


def _size_backward(solver, residual, cotangents):
    program, given, factor, optimal, enclosure = residual
    trusted = optimal & ~asked_for(cotangents[3])
    n = len(program.transform)
    moments = enclosure.moments
    # stationarity in the factor gives the dual its scale, whatever the solver's objective was
    unit = -2 * jnp.sum(moments[n:, :n] * form_rows(program, given).mid)

    def value(facts, objective, given):
        scaled = NormalForm(factor * given.A, factor * given.b)
        rows = program.with_midpoints(facts, objective)
        return schur_lagrangian(rows, enclosure.multipliers, scaled, moments) / unit

    slopes = jax.grad(value, (0, 1, 2))(program.facts.mid, program.objective.mid, given)
    weight = jnp.where(trusted, cotangents[0], jnp.nan)
    return *jax.tree.map(lambda slope: weight * slope, slopes), None


_size.defvjp(_size_forward, _size_backward)
