"""Ellipsoids around the successors: the smallest of a given shape, and that of least volume.

**Of least volume** is the one on the central path. The optimum of a semidefinite program need not
be differentiable, and its optimality conditions are singular there. The minimiser of its barrier
function is near it, unique and smooth, and moves as the implicit function theorem says, with the
Hessian of this function. A few Newton steps lead there from a solver's point, also from one that
stalled: so that point is what is reported, and its derivative is exact.
"""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from reachjax.numerics.budget import clock
from reachjax.numerics.host import all_finite
from reachjax.numerics.pytrees import pytree
from reachjax.programs.lmi import Program, Slopes, form_rows, inequality_slopes, with_successor
from reachjax.programs.presolve import Generators, NormalProgram, Pencil, Shape, presolved
from reachjax.proofs.by_products import EllipsoidCertificate
from reachjax.proofs.gradients import held_level
from reachjax.proofs.proposal import ANSWERS, Proposal, SolverStatus
from reachjax.proofs.recheck import clipped
from reachjax.proofs.reported import Judged, Sized, judged_least, judged_shape
from reachjax.sets import Ellipsoid, NormalForm
from reachjax.solvers.barrier import FROM_AFAR, WEIGHTS, Barrier, Centre, solved
from reachjax.solvers.base import AbstractSolver, proposed
from reachjax.solvers.goals import AbstractGoal


class AbstractEllipsoid(AbstractGoal):
    """What ellipsoids of all kinds have in common."""

    named: ClassVar[str] = "the ellipsoid"
    logarithmic: ClassVar[bool] = True

    def rows(self, states: int) -> Float[Array, "n_x n_x"]:
        """The successor itself."""
        return jnp.eye(states)

    def region(self, value: Sized) -> Ellipsoid:
        """The ellipsoid that is proved."""
        return Ellipsoid.enclosing(*_with_level_held(value))

    def certificate(
        self, program: Program, value: Sized, proposal: Proposal
    ) -> EllipsoidCertificate:
        """The proof of the ellipsoid."""
        form, level = _with_level_held(value)
        own = {"bounds": np.ones(1), "form": form, "level": level}
        return EllipsoidCertificate.of(program, proposal, **own)


def _with_level_held(value: Sized) -> tuple[NormalForm, Any]:
    """`A` and `b`, which alone have a derivative and take on that of the level, and the level."""
    form, level, factor = value
    held = jax.lax.stop_gradient(level)
    moving = held / level * factor  # the factor
    return NormalForm(moving * form.A, moving * form.b), held


def ellipsoid_pencil(
    normal: NormalProgram, forms: NormalForm, sizes: Float[Array | np.ndarray, "u s s"]
) -> Pencil:
    """`Z = [e e' - F' Gamma F, V'; V, I]`, with `V = R W + r e'` and `W` the successor's rows.

    Args:
        normal: in whose units the successor varies by one.
        forms: `R (u, q, q)` and `r (u, q)` of each unknown.
        sizes: what the logarithm of the determinant is taken of.
    """
    W = normal.objective
    (q, n), e = W.shape, np.eye(W.shape[1])[-1:]
    # [0, V'; V, 0] = 2 sum_i sym(u_i' V_i) with unit rows u_i
    rows = np.zeros((q + 1 + q, n + q))
    rows[: q + 1, :n], rows[q + 1 :, n:] = np.vstack([W, e]), np.eye(q)
    weights = 2 * np.concatenate([forms.A, forms.b[:, :, None]], axis=2)
    k, i, j = np.nonzero(weights)
    shares = weights[k, i, j], (k, np.arange(len(k)))
    sharing = sp.csr_array(shares, shape=(len(weights), len(k)))
    return Pencil(
        normal=normal,
        terms=normal.generators.below(Generators(rows, q + 1 + i, j, sharing)),
        constant=lambda _: np.diag(np.r_[np.zeros(n - 1), 1.0, np.ones(q)]),
        sizes=np.asarray(sizes),
        units=np.ones(1),
    )


def level_slopes(program: Program, value: Sized, proposal: Proposal) -> tuple[Slopes, NormalForm]:
    """The derivative of the level that is proved, in rows and in `A` and `b`."""
    form = value.scaled
    multipliers, moments = held_level(program, np.asarray(proposal.multipliers), form)
    return form_slopes(program, multipliers[0], moments[0], form)


def form_slopes(
    program: Program,
    multipliers: Float[Array | np.ndarray, " K"],
    moments: Float[Array | np.ndarray, "N N"],
    form: NormalForm,
) -> tuple[Slopes, NormalForm]:
    """The derivative of `<X, Z>` in rows and in `A` and `b`, where `V = A x+ + b`."""
    extra, P = slice(len(program.transform), None), program.objective.mid
    facts, V = inequality_slopes(program, multipliers, moments, extra)
    return Slopes(facts, form.A.T @ V), NormalForm(V @ P.T, V[:, -1])


@pytree
class GivenShape(AbstractEllipsoid):
    """The smallest ellipsoid of a given centre and shape.

    Attributes:
        form: the ellipsoid up to a factor on `A` and `b`, which is the unknown.
    """

    form: NormalForm

    def shape(self, program: Program) -> Shape:
        """One program of one unknown."""
        q, n = program.objective.mid.shape
        return Shape(1, 1, n + q)

    def pencil(self, program: Program) -> Pencil:
        """The pencil of ellipsoids whose only unknown is the factor, of unit size."""
        normal = presolved(program)
        normal = normal.with_units(normal.widths)
        form, unit = normal.to_unit_box(self.form), self._unit(normal)
        forms = NormalForm(form.A[None] / unit, form.b[None] / unit)
        return ellipsoid_pencil(normal, forms, np.full((1, 1, 1), np.linalg.norm(form.A, 2) / unit))

    def _unit(self, normal: NormalProgram) -> float:
        """The size of the form in the normal program's units."""
        A, b = normal.to_unit_box(self.form)
        size = max(float(np.linalg.norm(A, 2)), float(np.linalg.norm(b)))
        return size if size > 0 else 1.0

    def absolute(
        self, normal: NormalProgram, i: int, unknowns: Float[np.ndarray, " 1"]
    ) -> Float[np.ndarray, " 1"]:
        """The factor on the form itself."""
        return unknowns / self._unit(normal)

    def unknown(self, program: Program) -> Judged:
        """No size: NaN."""
        nan, no = np.array(np.nan), np.array(False)
        return Judged(Sized(self.form, nan, nan), no, (), Proposal.blank(program, self))

    def judged(self, program: Program, solver: AbstractSolver) -> Judged:
        """The size that is proved with what the solver proposes."""
        proposal = proposed(solver, program, self)
        value, optimal = judged_shape(program, proposal, self.form)
        return Judged(value, np.array(optimal), (), proposal)

    def slopes(
        self, program: Program, judged: Judged, cotangent: Sized
    ) -> tuple[Slopes, GivenShape]:
        """Slopes of the factor, an optimal value; or of the level, the factor being held."""
        n, value, factor = len(program.transform), judged.value, judged.value.factor
        if judged.optimal:
            # stationarity in the factor gives the dual its scale, whatever the objective was
            multipliers = clipped(program, judged.proposal.multipliers[0])
            moments = judged.proposal.moments[0]
            unit = -2 * np.sum(moments[n:, :n] * form_rows(program, self.form).mid)
            weight = cotangent.factor / unit
            rows, sought = form_slopes(program, multipliers, moments, value.scaled)
        else:
            weight = cotangent.level
            rows, sought = level_slopes(program, value, judged.proposal)
        slopes = Slopes(weight * rows.facts, weight * rows.objective)
        weight, own = weight * factor, cotangent.form
        form = NormalForm(own.A + weight * sought.A, own.b + weight * sought.b)
        return slopes, GivenShape(form)


ATTEMPTS = 3
"""How often a program is solved, each time in better coordinates."""


@pytree
class LeastVolume(AbstractEllipsoid):
    """The ellipsoid of least volume: problem (sdp::ellips). Its unknowns are `A` and `b`, flat."""

    def shape(self, program: Program) -> Shape:
        """The shape of its programs, of which there is one."""
        q, n = program.objective.mid.shape
        return Shape(1, q * q + q, n + q)

    def pencil(self, program: Program) -> Pencil:
        """The pencil of ellipsoids, in units in which the successor varies by one.

        The unknowns are the entries of a symmetric `R` on and above the diagonal, and `r`.
        """
        return _pencil(presolved(program))

    def absolute(
        self, normal: NormalProgram, i: int, unknowns: Float[np.ndarray, " u"]
    ) -> Float[np.ndarray, " U"]:
        """`A` and `b` of the successor itself; linear."""
        forms = _free_forms(len(normal.objective))
        R, r = (np.tensordot(unknowns, part, 1) for part in forms)
        return flat(normal.from_unit_box(NormalForm(R, r)))

    def unknown(self, program: Program) -> Judged:
        """No size: NaN."""
        blank, q = Proposal.blank(program, self), len(program.objective.mid)
        value = Sized(form_of(blank.unknowns[0]), np.array(np.nan))
        return Judged(value, np.array(False), _identity(q), blank)

    def judged(self, program: Program, solver: AbstractSolver) -> Judged:
        """The ellipsoid that is proved with what the solver proposes, in up to three attempts.

        While the solver stalls, or the ellipsoid is as thin as it may be in these coordinates, the
        next attempt is in those in which the ellipsoid proved so far is the unit ball.
        """
        frame, attempts = _identity(len(program.objective.mid)), []
        for attempt in range(ATTEMPTS):
            framed = with_successor(program, frame) if attempt else program
            normal = presolved(framed)
            if attempt and (normal.is_flat or clock().late):
                break
            proposal, on_path = self._centred(proposed(solver, framed, self), normal)
            form = form_of(proposal.unknowns[0])
            value, optimal = judged_least(program, proposal, form.of(frame), on_path)
            optimal &= int(proposal.statuses[0]) == SolverStatus.SOLVED
            attempts.append(Judged(value, np.array(optimal), frame, proposal))
            if optimal and not normal.is_thinnest(form):
                return attempts[-1]
            frame = NormalForm(value.form.A / value.level, value.form.b / value.level)
            if not all_finite(frame):  # a single point
                break
        return min(attempts, key=lambda judged: judged.value.log_volume)

    def _centred(self, proposal: Proposal, normal: NormalProgram) -> tuple[Proposal, bool]:
        """The solver's ellipsoid, moved to the central path, and whether that was reached."""
        if int(proposal.statuses[0]) not in ANSWERS or not np.isfinite(proposal.unknowns).all():
            return proposal, False
        pencil = _pencil(normal)
        barrier = Barrier(pencil)
        found = _centre(barrier, pencil, proposal.multipliers[0], form_of(proposal.unknowns[0]))
        if found is None:
            return proposal, False
        multipliers, unknowns = self._unscaled(pencil, found.y)
        return proposal._replace(
            unknowns=unknowns[None],
            multipliers=multipliers[None],
            statuses=np.array([int(SolverStatus.SOLVED)]),
        ), True

    def _unscaled(self, pencil: Pencil, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Multipliers of the whole program, and `A` and `b`, from a barrier's variables; linear."""
        unknowns = self.absolute(pencil.normal, 0, y[pencil.multipliers + 1 :])
        return pencil.normal.multipliers_of(y[: pencil.multipliers]), unknowns

    def slopes(
        self, program: Program, judged: Judged, cotangent: Sized
    ) -> tuple[Slopes, LeastVolume]:
        """Slopes of the point on the central path, or of the level that is proved."""
        slopes = None
        if judged.optimal:
            slopes = self._along_path(program, judged, cotangent.form)
        if slopes is None or not all_finite(slopes):
            slopes = _of_level(program, judged, cotangent)
        return slopes, self

    def _along_path(self, program: Program, judged: Judged, cotangent: NormalForm) -> Slopes | None:
        """Slopes of `<cotangent, (A, b)>`, a difference of two Lagrangians' derivatives.

        One is at the centre, with how its moments answer the cotangent; the other is at how
        multipliers and form answer it, with the moments of the centre.
        """
        frame, form = judged.held, judged.value.form
        pencil = self.pencil(with_successor(program, frame))
        barrier, multipliers = Barrier(pencil), judged.proposal.multipliers[0]
        found = _centre(barrier, pencil, multipliers, form.of(frame.inverse))
        if found is None:
            return None
        y, hessian, weight = found
        # the transpose of `.of(frame)`, and of `absolute`
        framed = NormalForm(cotangent.A @ frame.A.T + np.outer(cotangent.b, frame.b), cotangent.b)
        own = _paired(pencil.normal.cotangent_to_unit_box(framed))
        w = solved(hessian, np.r_[np.zeros(barrier.count + 1), own])
        inverse = barrier.inverse(y)
        answering = -weight * inverse @ barrier.weighted(w) @ inverse
        halves = []
        for vector, X in ((y, answering), (w, -weight * inverse)):
            multipliers, unknowns = self._unscaled(pencil, vector)
            part, moments = form_of(unknowns).of(frame), pencil.normal.moments_of(X)
            halves.append(form_slopes(program, multipliers, moments, part)[0])
        (facts, objective), other = halves
        return Slopes(facts - other.facts, objective - other.objective)


def _pencil(normal: NormalProgram) -> Pencil:
    """The pencil of a normal program, in units in which the successor varies by one."""
    forms = _free_forms(len(normal.objective))
    return ellipsoid_pencil(normal.with_units(normal.widths), forms, forms.A)


def flat(form: NormalForm) -> Float[np.ndarray, " u"]:
    """`A` and `b` as unknowns."""
    return np.r_[form.A.ravel(), form.b]


def form_of(unknowns: Float[np.ndarray, " u"]) -> NormalForm:
    """`A` and `b` from unknowns."""
    q = int(np.sqrt(len(unknowns)))  # of q^2 + q
    return NormalForm(np.asarray(unknowns[: q * q]).reshape(q, q), np.asarray(unknowns[q * q :]))


def _identity(q: int) -> NormalForm:
    return NormalForm(np.eye(q), np.zeros(q))


def _free_forms(q: int) -> NormalForm:
    """`R` and `r` of each unknown of a pencil, `R` symmetric."""
    pairs = np.transpose(np.triu_indices(q))
    A, b = np.zeros((len(pairs) + q, q, q)), np.zeros((len(pairs) + q, q))
    for k, (i, j) in enumerate(pairs):
        A[k, i, j] = A[k, j, i] = 1.0
    b[len(pairs) :] = np.eye(q)
    return NormalForm(A, b)


def _paired(form: NormalForm) -> Float[np.ndarray, " u"]:
    """The inner products of a form with those of each unknown of a pencil."""
    A, b = _free_forms(len(form.b))
    return np.tensordot(A, form.A, 2) + b @ form.b


def _centre(
    barrier: Barrier, pencil: Pencil, multipliers: np.ndarray, form: NormalForm
) -> Centre | None:
    """The centre at the last weight, from a point near it or not; None where it is not reached.

    Args:
        barrier: of the pencil.
        pencil: of the ellipsoid.
        multipliers: `(K,)`, of the whole program, of a solution.
        form: `A` and `b` of the solution.
    """
    normal, squares = pencil.normal, (pencil.sizes**2).sum(axis=(1, 2))
    squares[-len(form.b) :] = 1.0
    unknowns = _paired(normal.to_unit_box(form)) / squares
    near = partial(barrier.near, normal.norms * multipliers[normal.kept], unknowns, WEIGHTS[0])
    for start, weights in ((near, WEIGHTS), (barrier.inside, FROM_AFAR + WEIGHTS)):
        found = barrier.path_end(start, weights)
        if found is not None and found.weight == WEIGHTS[-1]:
            return found
    return None


def _of_level(program: Program, judged: Judged, cotangent: Sized) -> Slopes:
    """Slopes of the level, the ellipsoid moving with the centre and widths of the successors' box.

    Column `j` of `A` stays the same multiple of one over the width in `j`, and `A x + b` at the
    centre of the box is held.
    """
    form, objective = judged.value.form, program.objective.mid
    rows, moved = level_slopes(program, judged.value, judged.proposal)
    A, b = (own + cotangent.level * part for own, part in zip(cotangent.form, moved, strict=True))
    slope = cotangent.level * rows.objective
    width, centre = abs(objective[:, :-1]).sum(axis=1), objective[:, -1]
    varies = width > 0
    wider = ((A - np.outer(b, centre)) * form.A).sum(axis=0) / np.where(varies, width, 1.0)
    slope[:, :-1] -= np.where(varies, wider, 0.0)[:, None] * np.sign(objective[:, :-1])
    slope[:, -1] -= form.A.T @ b
    return Slopes(cotangent.level * rows.facts, slope)
