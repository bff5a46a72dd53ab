"""Ellipsoids around the successors: what all goals of this kind share, and the smallest of a given
shape. That of least volume is in `least_volume`.
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from reachjax.numerics.pytrees import pytree
from reachjax.programs.lmi import Program, Slopes, form_rows, inequality_slopes
from reachjax.programs.pencils import Pencil, Shape
from reachjax.programs.presolve import Generators, NormalProgram, presolved
from reachjax.proofs.by_products import EllipsoidCertificate
from reachjax.proofs.proposal import Proposal
from reachjax.proofs.recheck import clipped
from reachjax.proofs.reported import Judged, Sized, judged_shape
from reachjax.proofs.slopes import held_level
from reachjax.sets import Ellipsoid, NormalForm
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
