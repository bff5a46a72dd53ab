"""Which offsets are reported: what the recheck proves, in the light of what the solver claims."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from reachjax.lmi import Program
from reachjax.recheck import interval_offsets, sound_offsets
from reachjax.solvers.base import Solution, SolverStatus

SHORTFALL = 1e-3
"""A claim that its multipliers miss by more than this, relatively, is not the optimal value."""


def accepted_offsets(program: Program, solution: Solution) -> Float[np.ndarray, " f"]:
    """The rechecked offsets, never below what the relaxation itself gives.

    The recheck knows that the basis is bounded, so it may prove less than the program's optimal
    value. Where the solver has that value, the offset stays there: it means what the relaxation's
    name says, and its derivative is the program's. Where the solver has none, or its multipliers
    fall short of it, interval arithmetic is taken if it is better.
    """
    offsets = sound_offsets(program, solution.multipliers)
    claims = np.asarray(solution.offsets)
    answered = np.isin(solution.statuses, (SolverStatus.SOLVED, SolverStatus.INACCURATE))
    borne_out = offsets <= claims + SHORTFALL * (1 + abs(claims))  # False where the claim is NaN
    relaxed, fallback = np.fmax(offsets, claims), np.fmin(offsets, interval_offsets(program))
    return np.where(answered & borne_out, relaxed, fallback)
