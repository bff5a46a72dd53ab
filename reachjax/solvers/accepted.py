"""Which bounds are reported: what the recheck proves, in the light of what the solver claims."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from reachjax.lmi import Program
from reachjax.recheck import interval_offsets, sound_level, sound_offsets
from reachjax.rounding import gamma
from reachjax.sets import NormalForm
from reachjax.solvers.base import Enclosure, Solution, SolverStatus

ANSWERS = (SolverStatus.SOLVED, SolverStatus.INACCURATE)

SHORTFALL = 1e-3
"""A claim that its multipliers miss by more than this part of the interval's radius is none."""


def accepted_offsets(
    program: Program, solution: Solution
) -> tuple[Float[np.ndarray, " f"], Bool[np.ndarray, " f"]]:
    """The rechecked offsets, never below what the relaxation itself gives.

    The recheck knows that the basis is bounded, so it may prove less than the program's optimal
    value. Where the solver has that value, the offset stays there: it means what the relaxation's
    name says, and its derivative is the program's. Elsewhere, or where the multipliers fall short
    of the claim, it is what is proved, by multipliers or by intervals.

    Returns:
        The offsets, and for each whether it is the relaxation's optimal value.
    """
    by_intervals = interval_offsets(program)
    offsets = np.fmin(sound_offsets(program, np.asarray(solution.multipliers)), by_intervals)
    claims = np.asarray(solution.offsets)
    answered = np.isin(solution.statuses, ANSWERS) & np.isfinite(claims)
    size = by_intervals - np.asarray(program.objective.mid)[:, -1]
    borne_out = offsets <= claims + SHORTFALL * size  # False where the claim is NaN
    optimal = answered & borne_out
    return np.where(optimal, np.fmax(offsets, claims), offsets), optimal


def accepted_enclosure(
    program: Program, enclosure: Enclosure, given: NormalForm | None = None
) -> tuple[NormalForm, np.ndarray, np.ndarray]:
    """The ellipsoid `|A x+ + b| <= level` to report, its level being what is proved, at least 1.

    Where the solver proposes nothing of use, it is `given`, or the ellipsoid around the box of
    successors.

    Returns:
        The form, the level, and whether it is the relaxation's optimum.
    """
    form, level = _interval_form(program) if given is None else given, np.inf
    for candidate in (form, enclosure.form):
        if not _invertible(candidate):
            continue
        proved = max(1.0, sound_level(program, np.asarray(enclosure.multipliers), candidate))
        if _log_volume(candidate, proved) <= _log_volume(form, level):
            form, level = candidate, proved
    proposed = np.array_equal(form.A, enclosure.form.A)
    optimal = proposed and int(enclosure.status) in ANSWERS and level <= 1 + SHORTFALL
    return form, np.array(level), np.array(optimal)


def _log_volume(form: NormalForm, level: float) -> float:
    return len(form.b) * np.log(level) - np.linalg.slogdet(form.A)[1]


def _interval_form(program: Program) -> NormalForm:
    """The ellipsoid around the interval bounds of the successor, never quite flat."""
    p = program.objective
    center, radius = p.mid[:, -1], abs(p.mid[:, :-1]).sum(axis=1)
    least = np.maximum(1e-9 * (abs(center) + radius.max()), 1e-300)
    A = np.diag(1 / (np.sqrt(len(p.mid)) * np.maximum(radius, least)))
    return NormalForm(A, -A @ center)


def _invertible(form: NormalForm) -> bool:
    """Whether the ellipsoid can be turned into centre and shape with digits to spare."""
    A, b = form
    if not (np.isfinite(A).all() and np.isfinite(b).all()):
        return False
    try:
        inverse = np.linalg.inv(A)
    except np.linalg.LinAlgError:
        return False
    with np.errstate(over="ignore", invalid="ignore"):
        rounding = gamma(len(b)) * (abs(A) @ abs(inverse @ inverse.T) @ abs(A).T).sum(axis=1)
        rounding += gamma(len(b)) * (abs(A) @ abs(inverse @ b))
    return bool(np.all(rounding < 1e-6))
