"""Ellipsoids around the successors: of least volume, or the smallest of a given shape."""

from __future__ import annotations

from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from reachjax.numerics.budget import clock
from reachjax.numerics.host import all_finite
from reachjax.numerics.pytrees import pytree
from reachjax.programs.lmi import Program, Slopes, form_rows, schur_slopes, with_successor
from reachjax.programs.presolve import presolved
from reachjax.programs.relaxations import Products
from reachjax.proofs.ellipsoids import EllipsoidCertificate
from reachjax.proofs.proposal import ANSWERS, Enclosure, SolverStatus
from reachjax.proofs.reported import SHORTFALL, Judged, judged_form, largest_factor, log_volume
from reachjax.proofs.slopes import held_level
from reachjax.sets import Ellipsoid, NormalForm
from reachjax.solvers.base import AbstractSolver
from reachjax.solvers.centring import centred, sensitivity
from reachjax.solvers.cut_pool import NONE, CutPool, joint
from reachjax.solvers.faults import proposed_enclosure
from reachjax.solvers.goals import AbstractGoal
from reachjax.solvers.rounds import Rounds, Shown, idle, in_rounds

ATTEMPTS = 3
"""How often a program is solved, each time in better coordinates."""


class Sized(NamedTuple):
    """The ellipsoid `|A x + b| <= level`, of which `A` and `b` are the first's times the factor."""

    form: NormalForm
    level: Float[Array | np.ndarray, ""]
    factor: Float[Array | np.ndarray, ""] = np.array(1.0)


class _Held(NamedTuple):
    """What a derivative rests on: the ellipsoid, whether it is the optimum, and its multipliers.

    Attributes:
        value: what is proved.
        optimal: whether it is the relaxation's optimum.
        multipliers: `(K,)`.
        moments: `(n + q, n + q)`, zero where it is not.
        frame: the coordinates of the successor in which it was centred.
    """

    value: Sized
    optimal: Bool[np.ndarray, ""]
    multipliers: Float[np.ndarray, " K"]
    moments: Float[np.ndarray, "n+q n+q"]
    frame: NormalForm


class _AbstractEllipsoid(AbstractGoal):
    """What both have in common."""

    def rows(self, states: int) -> Float[Array, "n_x n_x"]:
        """The successor itself."""
        return jnp.eye(states)

    @property
    def given(self) -> NormalForm | None:
        """The ellipsoid up to a factor; None if any will do."""
        return None

    def in_rounds(
        self, program: Program, solver: AbstractSolver, rounds: Rounds
    ) -> tuple[Products, Judged]:
        """The products that the ellipsoid's own moments violate."""
        pool, n = CutPool(program, rounds.layout), len(program.transform)

        def solve(pairs: np.ndarray) -> Shown:
            given = program.replace(products=joint(pool.core, pairs))
            enclosure = proposed_enclosure(solver, given, self.given)
            moments = np.asarray(enclosure.moments)
            moment = moments[:n, :n] / moments[n - 1, n - 1]
            return Shown(moment, idle(np.asarray(enclosure.multipliers), len(pairs)))

        products = joint(pool.core, in_rounds(pool, rounds, NONE, solve))
        return products, self.judged(program.replace(products=products), solver)

    def region(self, value: Sized) -> Ellipsoid:
        """The ellipsoid that is proved."""
        return Ellipsoid.enclosing(*_with_level_held(value))

    def certificate(
        self, program: Program, value: Sized, proposal: Enclosure
    ) -> EllipsoidCertificate:
        """The proof of the ellipsoid."""
        form, level = _with_level_held(value)
        return EllipsoidCertificate.from_enclosure(program, form, level, proposal)


def _with_level_held(value: Sized) -> tuple[NormalForm, Any]:
    """`A` and `b`, which alone have a derivative and take on that of the level, and the level."""
    form, level, factor = value
    held = jax.lax.stop_gradient(level)
    moving = held / level * factor  # the factor
    return NormalForm(moving * form.A, moving * form.b), held


@pytree
class LeastVolume(_AbstractEllipsoid):
    """The ellipsoid of least volume: problem (sdp::ellips)."""

    def unknown(self, program: Program) -> Judged:
        """No size: NaN."""
        blank, q = Enclosure.blank(program), len(program.objective.mid)
        return _judged(Sized(blank.form, np.array(np.nan)), np.array(False), blank, _identity(q))

    def judged(self, program: Program, solver: AbstractSolver) -> Judged:
        """The ellipsoid that is proved with what the solver proposes, in up to three attempts.

        While the solver stalls, or the ellipsoid is as thin as it may be in these coordinates, the
        next attempt is in those in which the ellipsoid proved so far is the unit ball.
        """
        if not all_finite(program):
            return self.unknown(program)
        frame, attempts = _identity(len(program.objective.mid)), []
        for attempt in range(ATTEMPTS):
            framed = with_successor(program, frame) if attempt else program
            reduced = presolved(framed)
            if attempt and (reduced.is_flat or clock().late):
                break
            proposed, on_path = _on_path(solver, framed)
            enclosure = proposed._replace(form=proposed.form.of(frame))
            form, level, optimal = judged_form(program, enclosure, centred=on_path)
            optimal &= enclosure.status == SolverStatus.SOLVED
            attempts.append(_judged(Sized(form, level), optimal, enclosure, frame))
            if optimal and not reduced.is_thinnest(proposed.form):
                return attempts[-1]
            frame = NormalForm(form.A / level, form.b / level)
            if not all_finite(frame):  # a single point
                break
        return min(attempts, key=lambda judged: log_volume(judged.value.form, judged.value.level))

    def slopes(self, program: Program, held: _Held, cotangent: Sized) -> tuple[Slopes, Self]:
        """Slopes of the point on the central path, or of the level that is proved."""
        slopes = None
        if held.optimal:
            slopes = _along_path(program, held, cotangent.form)
        if slopes is None or not all_finite(slopes):
            slopes = _of_level(program, held, cotangent)
        return slopes, self


@pytree
class GivenShape(_AbstractEllipsoid):
    """The smallest ellipsoid of a given centre and shape.

    Attributes:
        form: the ellipsoid up to a factor on `A` and `b`.
    """

    form: NormalForm

    @property
    def given(self) -> NormalForm:
        """The ellipsoid up to a factor."""
        return self.form

    def unknown(self, program: Program) -> Judged:
        """No size: NaN."""
        nan = np.array(np.nan)
        blank, frame = Enclosure.blank(program), _identity(len(program.objective.mid))
        return _judged(Sized(self.form, nan, nan), np.array(False), blank, frame)

    def judged(self, program: Program, solver: AbstractSolver) -> Judged:
        """The size that is proved with what the solver proposes."""
        if not all_finite((program, self.form)):
            return self.unknown(program)
        given, frame = self.form, _identity(len(program.objective.mid))
        enclosure = proposed_enclosure(solver, program, given)
        factor = np.sum(enclosure.form.A * given.A) / np.sum(given.A**2)
        proposed = NormalForm(factor * given.A, factor * given.b)
        enclosure = enclosure._replace(form=proposed)
        form, level, optimal = judged_form(program, enclosure, given)
        optimal &= largest_factor(program, enclosure) <= 1 + SHORTFALL  # the moments bear it out
        factor = np.where(np.array_equal(form.A, proposed.A), factor, 1.0)
        return _judged(Sized(given, level, factor), optimal, enclosure, frame)

    def slopes(self, program: Program, held: _Held, cotangent: Sized) -> tuple[Slopes, Self]:
        """Slopes of the factor, an optimal value; or of the level, the factor being held."""
        n, factor = len(program.transform), held.value.factor
        scaled = NormalForm(factor * self.form.A, factor * self.form.b)
        if held.optimal:
            # stationarity in the factor gives the dual its scale, whatever the objective was
            unit = -2 * np.sum(held.moments[n:, :n] * form_rows(program, self.form).mid)
            free, weights = program.products.free, held.multipliers
            proving = np.where(free, weights, np.maximum(weights, 0.0))  # negative ones do not
            weight, rests_on = cotangent.factor / unit, (proving, held.moments)
        else:
            weight, rests_on = cotangent.level, held_level(program, held.multipliers, scaled)
        rows, sought = schur_slopes(program, rests_on[0], scaled, rests_on[1])
        slopes = Slopes(weight * rows.facts, weight * rows.objective)
        weight, own = weight * factor, cotangent.form
        form = NormalForm(own.A + weight * sought.A, own.b + weight * sought.b)
        return slopes, self.replace(form=form)


def _identity(q: int) -> NormalForm:
    return NormalForm(np.eye(q), np.zeros(q))


def _judged(value: Sized, optimal: np.ndarray, enclosure: Enclosure, frame: NormalForm) -> Judged:
    moments = np.where(optimal, enclosure.moments, 0.0)
    held = _Held(value, optimal, np.asarray(enclosure.multipliers), moments, frame)
    return Judged(value, optimal, held, enclosure)


def _on_path(solver: AbstractSolver, program: Program) -> tuple[Enclosure, bool]:
    """The solver's ellipsoid, moved to the central path, and whether that was reached."""
    enclosure = proposed_enclosure(solver, program)
    if int(enclosure.status) not in ANSWERS:
        return enclosure, False
    found = centred(program, np.asarray(enclosure.multipliers), enclosure.form)
    if found is None:
        return enclosure, False
    solved = np.array(int(SolverStatus.SOLVED))
    return enclosure._replace(multipliers=found[0], form=found[1], status=solved), True


def _along_path(program: Program, held: _Held, cotangent: NormalForm) -> Slopes:
    """The difference of two Lagrangians' derivatives: see `Sensitivity`."""
    path = sensitivity(program, held.multipliers, held.value.form, cotangent, held.frame)
    first, _ = schur_slopes(program, path.multipliers, path.form, path.moments)
    other, _ = schur_slopes(program, path.multipliers_slope, path.form_slope, path.moments_slope)
    return Slopes(first.facts - other.facts, first.objective - other.objective)


def _of_level(program: Program, held: _Held, cotangent: Sized) -> Slopes:
    """Slopes of the level, the ellipsoid moving with the centre and widths of the successors' box.

    Column `j` of `A` stays the same multiple of one over the width in `j`, and `A x + b` at the
    centre of the box is held.
    """
    form, objective = held.value.form, program.objective.mid
    multipliers, moments = held_level(program, held.multipliers, form)
    rows, moved = schur_slopes(program, multipliers, form, moments)
    A, b = (own + cotangent.level * part for own, part in zip(cotangent.form, moved, strict=True))
    slope = cotangent.level * rows.objective
    width, centre = abs(objective[:, :-1]).sum(axis=1), objective[:, -1]
    varies = width > 0
    wider = ((A - np.outer(b, centre)) * form.A).sum(axis=0) / np.where(varies, width, 1.0)
    slope[:, :-1] -= np.where(varies, wider, 0.0)[:, None] * np.sign(objective[:, :-1])
    slope[:, -1] -= form.A.T @ b
    return Slopes(cotangent.level * rows.facts, slope)
