"""What a solver gives back: how it ended, and a proposal.

Bounds that no semidefinite program is solved for end in other ways, and say so too.

Whatever the status, it is only a proposal: bounds come from `recheck`. A solver that fails
proposes zero multipliers, which prove the interval bound and no more.
"""

from __future__ import annotations

import enum
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from reachjax.programs.lmi import Program
from reachjax.programs.presolve import AbstractInequality


class SolverStatus(enum.IntEnum):
    """How the search for a bound ended. "Almost solved" is not solved, and "solved" is not proof.

    The first six are ends of solvers of programs, the others of searches by forms, linear programs,
    splits and cells: there `SOLVED` means that no more is left open than was asked for. What is
    proved anew from a file is `RECHECKED`: how a search ended cannot be proved.
    """

    SOLVED = 0
    INACCURATE = 1
    INFEASIBLE = 2
    UNBOUNDED = 3
    LIMIT = 4
    FAILED = 5
    TIME = 6
    BUDGET = 7
    AFFINE_FORM = 8
    STALLED = 9
    INTERRUPTED = 10
    UNKNOWN_GAP = 11
    RECHECKED = 12

    @property
    def advice(self) -> str:
        """One sentence on what this means and what to do."""
        return _ADVICE[self]


OF_SOLVERS = tuple(SolverStatus)[: SolverStatus.FAILED + 1]
"""The ends that a solver of programs may report."""

AS_ASKED = (SolverStatus.SOLVED, SolverStatus.AFFINE_FORM, SolverStatus.RECHECKED)
"""The ends after which a bound is as tight as the method that was asked for makes it."""

ANSWERS = (SolverStatus.SOLVED, SolverStatus.INACCURATE, SolverStatus.RECHECKED)
"""The ends after which there is a proposal."""

CLAIMING = (*ANSWERS, SolverStatus.LIMIT)
"""The ends after which there should be multipliers."""

_ADVICE = {
    SolverStatus.SOLVED: "solved to the tolerance asked for",
    SolverStatus.INACCURATE: "the tolerance was not reached: the bound is sound, perhaps loose; "
    "ask for a looser tolerance or try another solver",
    SolverStatus.INFEASIBLE: "reported infeasible, which a bounded set rules out: the data are "
    "badly scaled for this solver; the interval bound was used",
    SolverStatus.UNBOUNDED: "reported unbounded: the set of states is empty, or a shape was given "
    "and all successors are one point; the interval bound was used",
    SolverStatus.LIMIT: "stopped at the limit of iterations or time: the bound is sound, perhaps "
    "loose; raise the limit",
    SolverStatus.FAILED: "broke down without an answer: the interval bound was used; "
    "try another solver or relaxation",
    SolverStatus.TIME: "the time was over before the gap was closed: the bound is sound, perhaps "
    "loose; raise time_limit",
    SolverStatus.BUDGET: "the budget of linear programs or cells was used up before the gap was "
    "closed: the bound is sound, perhaps loose; give a time_limit, or raise BranchAndCut(nodes=) "
    "or BranchAndCut(cells=)",
    SolverStatus.AFFINE_FORM: "bounded by its affine form, as the relaxation asks for, without a "
    "program: the bound is sound, perhaps loose; BranchAndCut() closes the gap",
    SolverStatus.STALLED: "neither splits nor smaller cells close the gap any further: the bound "
    "is sound, and what is open may be left by disturbances, by rounding, or by a relaxation; cut "
    "X0 into cells, or allow BranchAndCut(cells=)",
    SolverStatus.INTERRUPTED: "interrupted before the gap was closed: the bound is sound, perhaps "
    "loose; call again to go on",
    SolverStatus.UNKNOWN_GAP: "no trajectory could be simulated, so that what is left open is not "
    "known: the bound is sound; give a set X0 that states can be drawn from",
    SolverStatus.RECHECKED: "proved anew from a file: the bound is sound, and its gap is what the "
    "witness leaves; how the search for it ended is not known, and was not believed",
}


class Proposal(NamedTuple):
    """What a solver proposes for the programs of a goal; arrays only, numpy's on the host.

    Attributes:
        unknowns: `(f, u)`, what is sought as the solver has it (the offset of each facet; the form
            of an ellipsoid, or the factor on a given one), NaN where it has none. Not bounds.
        multipliers: `(f, K)`, zero where it has none.
        moments: `(f, N, N)`, dual matrices of the goal's matrix over the scaled basis with corner
            1, NaN where it has none.
        statuses: `(f,)`, values of `SolverStatus`.
        seconds: `(f,)`, wall time of each program.
    """

    unknowns: Float[np.ndarray, "f u"]
    multipliers: Float[np.ndarray, "f K"]
    moments: Float[np.ndarray, "f N N"]
    statuses: Int[np.ndarray, " f"]
    seconds: Float[np.ndarray, " f"]

    @classmethod
    def blank(cls, program: Program, goal: AbstractInequality) -> Proposal:
        """No proposal yet for a goal: zero multipliers, everything else missing."""
        programs, unknowns, size = goal.shape(program)
        return cls(
            unknowns=np.full((programs, unknowns), np.nan),
            multipliers=np.zeros((programs, len(program.products.free))),
            moments=np.full((programs, size, size), np.nan),
            statuses=np.full(programs, int(SolverStatus.FAILED)),
            seconds=np.zeros(programs),
        )
