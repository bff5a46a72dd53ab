"""Which offsets are reported: what the recheck proves, in the light of what the solver claims."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from reachjax.lmi import Program
from reachjax.recheck import interval_offsets, sound_offsets
from reachjax.solvers.base import Solution, SolverStatus

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
    answers = (SolverStatus.SOLVED, SolverStatus.INACCURATE)
    answered = np.isin(solution.statuses, answers) & np.isfinite(claims)
    size = by_intervals - np.asarray(program.objective.mid)[:, -1]
    borne_out = offsets <= claims + SHORTFALL * size  # False where the claim is NaN
    optimal = answered & borne_out
    return np.where(optimal, np.fmax(offsets, claims), offsets), optimal
