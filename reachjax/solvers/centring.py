"""Minimum-volume ellipsoids on the central path, and how they move with their program.

The optimum of a semidefinite program need not be differentiable, and its optimality conditions are
singular there. The minimiser of its barrier function is near it, unique and smooth, and moves as
the implicit function theorem says, with the Hessian of this function. A few Newton steps lead there
from a solver's point, also from one that stalled: so that point is what is reported, and its
derivative is exact.
"""

from __future__ import annotations

import time
from functools import partial
from typing import NamedTuple

import numpy as np

from reachjax.numerics.host import all_finite
from reachjax.programs.lmi import Program, with_successor
from reachjax.programs.presolve import presolved
from reachjax.proofs.proposal import Enclosure, SolverStatus
from reachjax.sets import NormalForm
from reachjax.solvers.barrier import EllipsoidBarrier
from reachjax.solvers.central_path import FROM_AFAR, MOST_MULTIPLIERS, Centre, path_end, solved

WEIGHTS = (1e-6, 1e-7, 1e-8)
"""Barrier weights `mu`, followed downwards. At the last one the logarithm of the volume is off by
that times the number of multipliers and rows, and by the damping of large multipliers (2e-6 where
they were 1400). Derivatives lose digits below it, as the matrices become singular: ten times
smaller, one of a thin ellipsoid was off by 7e-4, not by 1e-5."""

USEFUL = 1e-3
"""A path that is lost at a smaller weight still gives an ellipsoid, looser by that as above."""


class Sensitivity(NamedTuple):
    """A derivative of `A` and `b` as that of two Lagrangians, `lmi.schur_slopes`.

    The derivative in the rows of `<cotangent, (A, b)>` is that of the Lagrangian at the first three
    less that at the last three.

    Attributes:
        multipliers: `(K,)`, at the centre.
        form: `A` and `b` at the centre.
        moments: `(n + q, n + q)`, how the moments at the centre answer the cotangent.
        multipliers_slope: `(K,)`, how the multipliers answer it.
        form_slope: how `A` and `b` do.
        moments_slope: `(n + q, n + q)`, the moments at the centre.
    """

    multipliers: np.ndarray
    form: NormalForm
    moments: np.ndarray
    multipliers_slope: np.ndarray
    form_slope: NormalForm
    moments_slope: np.ndarray

    @classmethod
    def unknown(cls, program: Program) -> Sensitivity:
        """NaN throughout, of the right shapes."""
        q, n = program.objective.mid.shape
        K = program.products.free.shape[0]
        half = (
            np.full(K, np.nan),
            NormalForm(np.full((q, q), np.nan), np.full(q, np.nan)),
            np.full((n + q, n + q), np.nan),
        )
        return cls(*half, *half)


def enclosed(program: Program, given: NormalForm | None = None) -> Enclosure:
    """The ellipsoid at the end of the central path, followed from afar.

    Args:
        program: whose objective rows are the successor's.
        given: the ellipsoid up to a factor on `A` and `b`; free if it is None.
    """
    began, proposal = time.perf_counter(), Enclosure.blank(program)
    if not all_finite((program, given)) or (given is not None and not given.A.any()):
        return proposal
    reduced = presolved(program)
    if len(reduced.kept) > MOST_MULTIPLIERS or not len(reduced.columns):
        return proposal
    barrier = EllipsoidBarrier(reduced, given)
    found = path_end(barrier, barrier.inside, FROM_AFAR + WEIGHTS)
    seconds = np.array(time.perf_counter() - began)
    if found is None or found.weight > USEFUL:
        return proposal._replace(seconds=seconds)
    multipliers, form = barrier.unscaled(found.y, len(proposal.multipliers))
    if given is not None and reduced.is_thinnest(form):
        unbounded = np.array(int(SolverStatus.UNBOUNDED))
        return proposal._replace(status=unbounded, seconds=seconds)
    moments = barrier.whole(found.weight * barrier.inverse(found.y), len(program.transform))
    ended = SolverStatus.SOLVED if found.weight == WEIGHTS[-1] else SolverStatus.INACCURATE
    return Enclosure(form, multipliers, moments, np.array(int(ended)), seconds)


def centred(
    program: Program, multipliers: np.ndarray, form: NormalForm
) -> tuple[np.ndarray, NormalForm] | None:
    """Multipliers `(K,)` and ellipsoid on the central path near a solution.

    None where the path is not reached, or the program is so large that it would take long.
    """
    reduced = presolved(program)
    if len(reduced.kept) > MOST_MULTIPLIERS or not all_finite((multipliers, form)):
        return None
    barrier = EllipsoidBarrier(reduced)
    found = _centre(barrier, multipliers, form)
    return None if found is None else barrier.unscaled(found.y, len(multipliers))


def sensitivity(
    program: Program,
    multipliers: np.ndarray,
    form: NormalForm,
    cotangent: NormalForm,
    frame: NormalForm,
) -> Sensitivity:
    """The derivative of `<cotangent, (A, b)>`, NaN where the centre is not found.

    Args:
        program: whose objective rows are the successor's.
        multipliers: `(K,)`, of the solution.
        form: the solution.
        cotangent: weights of `A` and `b`.
        frame: of the successor, in which the solution was centred.
    """
    if not all_finite((program, multipliers, form, cotangent, frame)):
        return Sensitivity.unknown(program)
    barrier = EllipsoidBarrier(presolved(with_successor(program, frame)))
    found = None
    if barrier.count <= MOST_MULTIPLIERS:
        found = _centre(barrier, multipliers, form.of(frame.inverse))
    if found is None:
        return Sensitivity.unknown(program)
    y, hessian, weight = found
    # the transpose of `.of(frame)`
    framed = NormalForm(cotangent.A @ frame.A.T + np.outer(cotangent.b, frame.b), cotangent.b)
    w = solved(hessian, barrier.vector(framed))
    inverse = barrier.inverse(y)
    moving = barrier.weighted(w)
    halves = []
    for vector, moments in ((y, -weight * inverse @ moving @ inverse), (w, -weight * inverse)):
        weights, part = barrier.unscaled(vector, len(multipliers))
        halves += [weights, part.of(frame), barrier.whole(moments, len(program.transform))]
    return Sensitivity(*halves)


def _centre(barrier: EllipsoidBarrier, multipliers: np.ndarray, form: NormalForm) -> Centre | None:
    """The centre at the last weight, from a point near it or not; None where it is not reached."""
    near = partial(barrier.near, multipliers, form, WEIGHTS[0])
    for start, weights in ((near, WEIGHTS), (barrier.inside, FROM_AFAR + WEIGHTS)):
        found = path_end(barrier, start, weights)
        if found is not None and found.weight == WEIGHTS[-1]:
            return found
    return None
