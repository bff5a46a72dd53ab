"""What a solver is: from a program and a goal to a proposal."""

from __future__ import annotations

import abc
import dataclasses
import numbers
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

from jaxtyping import Float
from numpy import ndarray

from reachjax.numerics.budget import clock
from reachjax.programs.lmi import Program
from reachjax.programs.pencils import AbstractInequality, Pencil
from reachjax.proofs.proposal import Proposal, SolverStatus

RESCALINGS = (1.0, 8.0, 0.125, 64.0, 1.0)
"""Factors on a pencil's constant, tried while a solver stalls: another scale often helps it."""

STALLED = (SolverStatus.INACCURATE, SolverStatus.FAILED)


def require_positive(solver: Any) -> None:
    """Check that every option of a solver is a positive number.

    Raises:
        TypeError: one is no number.
        ValueError: one is not positive.
    """
    for field in dataclasses.fields(solver):
        value: Any = getattr(solver, field.name)
        name = f"{type(solver).__name__}.{field.name}"
        if isinstance(value, bool) or not isinstance(value, numbers.Real):
            raise TypeError(f"{name} must be a number, but {value!r} arrived")
        if not float(value) > 0:
            raise ValueError(f"{name} must be positive, but {value!r} arrived")


class AbstractSolver(abc.ABC):
    """Solves the programs of one step. Hashable and immutable: its options are its fields.

    `solve` is all that one needs; nothing that it does breaks a bound. An exception, or an answer
    that is no `Proposal` of the right shapes, is a failed proposal and gives a warning; a
    `NotImplementedError` is raised: the solver does not know goals of this kind.
    """

    @abc.abstractmethod
    def solve(self, program: Program, goal: AbstractInequality) -> Proposal:
        """Propose multipliers, and what is sought, for every program of a goal.

        Args:
            program: whose leaves are numpy arrays.
            goal: what is sought of it; `goal.pencil(program)` has it as matrices.
        """


class Found(NamedTuple):
    """What was found for one program, in the units of its pencil.

    Attributes:
        unknowns: `(u,)`.
        multipliers: `(k,)`.
        moments: `(N, N)`, of any scale.
    """

    unknowns: Float[ndarray, " u"]
    multipliers: Float[ndarray, " k"]
    moments: Float[ndarray, "N N"]


Attempt = Callable[[int, float], tuple[SolverStatus, Found | None]]
"""How a program ends whose constant is multiplied by a factor, and what is found if anything is."""


def proposed_by(
    attempt: Attempt,
    program: Program,
    goal: AbstractInequality,
    pencil: Pencil,
    *,
    scales: tuple[float, ...] = (1.0,),
    threads: int = 1,
) -> Proposal:
    """The proposal that attempts at the programs of a goal make, one after the other.

    Args:
        attempt: at one of them.
        program: whose leaves are numpy arrays.
        goal: what is sought of it.
        pencil: the goal's.
        scales: factors on constants, tried in turn while attempts stall.
        threads: at most so many attempts at once.
    """
    proposal, budget = Proposal.blank(program, goal), clock()  # other threads have no clock

    def solve(i: int) -> None:
        began, scale, found = time.perf_counter(), 1.0, None
        proposal.statuses[i] = SolverStatus.LIMIT
        for scale in scales:
            if budget.late:
                break
            proposal.statuses[i], found = attempt(i, scale)
            if proposal.statuses[i] not in STALLED:
                break
        proposal.seconds[i] = time.perf_counter() - began
        if found is None:
            return
        unit = pencil.units[i] / scale
        proposal.unknowns[i] = goal.absolute(pencil.normal, i, unit * found.unknowns)
        proposal.multipliers[i], proposal.moments[i] = pencil.normal.invert(
            unit * found.multipliers, found.moments
        )

    programs = range(len(pencil.units))
    if len(programs) > 1 and threads > 1:
        pool = ThreadPoolExecutor(min(os.cpu_count() or 1, threads))
        try:
            list(pool.map(solve, programs))
        finally:  # nobody waits for them after Ctrl-C
            pool.shutdown(wait=False, cancel_futures=True)
    else:
        for i in programs:
            solve(i)
    return proposal
