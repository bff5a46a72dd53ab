"""Ellipsoids around the successors, proved, and their derivative.

**A given shape.** Only its size is sought. Its factor is an optimal value, so the envelope theorem
gives the derivative, as for offsets.

**Any shape.** The ellipsoid is an optimal *point*. What is reported is the point on the central
path nearby, at a small barrier weight, and its derivative (see `centring`).

What the recheck adds to an optimum is not differentiated.

**Without an optimum.** Where there is none that the numbers bear out, or the path is not found, the
derivative is that of what is reported all the same: the level that the multipliers, or intervals,
prove for the form, which itself moves with the box around the successors (`slopes`). It is NaN
where there is no bound at all.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from reachjax.numerics.host import all_finite, on_host, shapes_of
from reachjax.programs.lmi import Program, form_rows, schur_lagrangian, with_successor
from reachjax.programs.presolve import presolved
from reachjax.proofs.proposal import ANSWERS, Enclosure, SolverStatus
from reachjax.proofs.reported import SHORTFALL, accepted_enclosure, largest_factor, log_volume
from reachjax.proofs.slopes import held_level
from reachjax.sets import NormalForm
from reachjax.solvers.base import AbstractSolver
from reachjax.solvers.centring import Sensitivity, centred, sensitivity
from reachjax.solvers.cotangents import asked_for
from reachjax.solvers.faults import proposed_enclosure

ATTEMPTS = 3
"""How often a program is solved, each time in better coordinates."""


Proved = tuple[NormalForm, Array, Enclosure]
"""`A` and `b`, the level `s` of what is proved, `|A x + b| <= s`, and what the solver proposed,
which has no derivative and whose multipliers prove the level."""


def proved_ellipsoid(program: Program, solver: AbstractSolver) -> Proved:
    """The minimum-volume ellipsoid of a program, differentiable in the program's rows.

    Args:
        program: whose objective rows are the successor's.
        solver: what solves it.
    """
    result: Any = _ellipsoid(solver, program.facts.mid, program.objective.mid, program)
    form, level, _, enclosure, _ = result
    return *_sized(form, level), enclosure


def _sized(form: NormalForm, level: Array) -> tuple[NormalForm, Array]:
    """The same, of which the form alone has a derivative: it takes on that of the level."""
    held = jax.lax.stop_gradient(level)
    moving = held / level  # 1
    return NormalForm(moving * form.A, moving * form.b), held


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
        reduced = presolved(framed)
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
    enclosure = proposed_enclosure(solver, program)
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
    enclosure = proposed_enclosure(solver, program, given)
    factor = np.sum(enclosure.form.A * given.A) / np.sum(given.A**2)
    proposed = NormalForm(factor * given.A, factor * given.b)
    enclosure = enclosure._replace(form=proposed)
    form, level, optimal = accepted_enclosure(program, enclosure, given)
    optimal &= largest_factor(program, enclosure) <= 1 + SHORTFALL  # the moments are of use
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
    sought = jnp.where(optimal, multipliers, jnp.nan)  # nothing is sought for these
    shapes = shapes_of(Sensitivity.unknown(program))
    arguments = (program, sought, form, cotangents[0], frame)
    path: Any = on_host(lambda given: sensitivity(*given), shapes, arguments)
    held: Any = _held_level(program, multipliers, form)

    def on_path(facts, objective):
        rows = program.with_midpoints(facts, objective)
        at_centre = schur_lagrangian(rows, path.multipliers, path.form, path.moments)
        return at_centre - schur_lagrangian(
            rows, path.multipliers_slope, path.form_slope, path.moments_slope
        )

    def with_box(facts, objective):
        rows, moved = program.with_midpoints(facts, objective), _with_box(form, program, objective)
        level = cotangents[1] * schur_lagrangian(rows, held[0], moved, held[1])
        return level + jnp.sum(cotangents[0].A * moved.A) + jnp.sum(cotangents[0].b * moved.b)

    first, other = (
        jax.grad(value, (0, 1))(program.facts.mid, program.objective.mid)
        for value in (on_path, with_box)
    )
    found = jnp.array([jnp.isfinite(slope).all() for slope in first]).all()
    asked = asked_for(cotangents[3])
    slopes = (jnp.where(found, *pair) for pair in zip(first, other, strict=True))
    return *(jnp.where(asked, jnp.nan, slope) for slope in slopes), None


def _held_level(program: Program, multipliers: Array, form: NormalForm) -> Any:
    """Multipliers and moments of the Lagrangian whose derivative is the level's, these held."""

    def found(given):
        return held_level(*given) if all_finite(given) else (blank.multipliers, blank.moments)

    blank = Enclosure.blank(program)
    blank = blank._replace(multipliers=blank.multipliers * np.nan)
    shapes = shapes_of((blank.multipliers, blank.moments))
    return on_host(found, shapes, (program, multipliers, form))


def _with_box(form: NormalForm, program: Program, objective: Array) -> NormalForm:
    """The form, moving with the centre and the widths of the box around the successors."""
    width = abs(program.objective.mid[:, :-1]).sum(axis=1)
    varies = width > 0
    size = jnp.where(varies, width, 1.0)
    now = jnp.sum(jnp.where(varies[:, None], abs(objective[:, :-1]), 0.0), axis=1)
    A = form.A * (size / jnp.where(varies, now, 1.0))
    center = program.objective.mid[:, -1]
    return NormalForm(A, form.b + form.A @ center - A @ objective[:, -1])


_ellipsoid.defvjp(_ellipsoid_forward, _ellipsoid_backward)


def proved_size(program: Program, given: NormalForm, solver: AbstractSolver) -> Proved:
    """The smallest ellipsoid of a given centre and shape, differentiable in rows and shape.

    Args:
        program: whose objective rows are the successor's.
        given: the ellipsoid up to a factor on `A` and `b`.
        solver: what solves it.
    """
    result: Any = _size(solver, program.facts.mid, program.objective.mid, given, program)
    factor, level, _, enclosure = result
    scaled = NormalForm(factor * given.A, factor * given.b)
    return *_sized(scaled, level), enclosure


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
    n, moments = len(program.transform), enclosure.moments
    scaled = NormalForm(factor * given.A, factor * given.b)
    held: Any = _held_level(program, enclosure.multipliers, scaled)
    # stationarity in the factor gives the dual its scale, whatever the solver's objective was
    unit = -2 * jnp.sum(moments[n:, :n] * form_rows(program, given).mid)
    free, weights = program.products.free, enclosure.multipliers
    proving = jnp.where(free, weights, jnp.maximum(weights, 0.0))  # negative ones prove nothing
    factors = (proving, jnp.where(optimal, moments, 0.0))

    def value(facts, objective, given, multipliers, moments):
        scaled = NormalForm(factor * given.A, factor * given.b)
        rows = program.with_midpoints(facts, objective)
        return schur_lagrangian(rows, multipliers, scaled, moments)

    slopes = jax.grad(value, (0, 1, 2))
    place = program.facts.mid, program.objective.mid, given
    optima, others = slopes(*place, *factors), slopes(*place, *held)
    asked = asked_for(cotangents[3])

    def weighed(optimum, other):
        slope = jnp.where(optimal, cotangents[0] / unit * optimum, cotangents[1] * other)
        return jnp.where(asked, jnp.nan, slope)

    return *jax.tree.map(weighed, optima, others), None


_size.defvjp(_size_forward, _size_backward)
