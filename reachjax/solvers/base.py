"""What a solver is: from a program and a goal to a proposal.

Solvers are written by users too. Whatever one does (an exception, `None`, arrays of another shape
or kind, a status that there is none, multipliers that are no numbers) is a failed proposal: the
bound is then the one that needs no solver, the status is `FAILED`, and a warning says why. What is
fit passes as it is; numbers of another precision become float64.

Only `SetupError` is raised, which says that the solver was chosen or set up wrongly, and
`NotImplementedError`: it does not know what is sought.
"""

from __future__ import annotations

import abc
import dataclasses
import numbers
import os
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from reachjax.numerics.budget import TimeOverError, clock
from reachjax.numerics.checks import described
from reachjax.programs.lmi import Program
from reachjax.programs.presolve import AbstractInequality, Pencil
from reachjax.proofs.proposal import CLAIMING, OF_SOLVERS, Proposal, SolverStatus

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


class SetupError(Exception):
    """The solver cannot be used, whatever the program: raised, and no failed proposal."""


class UnknownSolverError(SetupError, ValueError):
    """There is no such solver here, or it takes no such programs."""


class UnknownOptionError(SetupError, TypeError):
    """The solver does not know one of its options."""


class _FaultError(Exception):
    """What is wrong with an answer."""


def proposed(solver: AbstractSolver, program: Program, goal: AbstractInequality) -> Proposal:
    """What a solver proposes for the programs of a goal, of numpy arrays.

    Raises:
        NotImplementedError: the solver does not know such goals.
        SetupError: the solver was chosen or set up wrongly.
    """
    blank = Proposal.blank(program, goal)
    try:
        clock().require()
        found = _asked(solver, lambda: _of_kind(solver.solve(program, goal), blank))
    except TimeOverError:
        return blank._replace(statuses=np.full_like(blank.statuses, int(SolverStatus.LIMIT)))
    return blank if found is None else _repaired(found, type(solver).__name__, goal)


def _repaired(proposal: Proposal, name: str, goal: AbstractInequality) -> Proposal:
    """The proposal without what is no number: such programs have failed.

    Args:
        proposal: arrays of the right shapes.
        name: what warnings call the solver.
        goal: what was sought.
    """
    unknowns, multipliers, moments, statuses, seconds = proposal
    known = np.isin(statuses, OF_SOLVERS)
    finite = np.isfinite(multipliers).all(axis=1)
    broken = ~known | (np.isin(statuses, CLAIMING) & ~finite)
    for i in np.flatnonzero(broken)[:1]:
        _warn(name, _why(bool(known[i]), statuses[i], f" of {goal.named.format(i)}"))
    usable = finite & known
    whole = usable & np.isfinite(moments).all(axis=(1, 2))
    there = usable & np.isfinite(unknowns).all(axis=1)
    return Proposal(
        unknowns=np.where(there[:, None], unknowns, np.nan),
        multipliers=np.where(usable[:, None], multipliers, 0.0),
        moments=np.where(whole[:, None, None], moments, np.nan),
        statuses=np.where(broken, int(SolverStatus.FAILED), statuses),
        seconds=seconds,
    )


def _asked(solver: AbstractSolver, answer: Callable[[], Proposal]) -> Proposal | None:
    """What the solver answers, of the right shapes; None where it answers nothing fit for use."""
    name = type(solver).__name__
    try:
        return answer()
    except (SetupError, TimeOverError, NotImplementedError):
        raise
    except _FaultError as fault:
        _warn(name, str(fault))
    except BaseException as error:
        # a panic of compiled code is no Exception; what else is none (an interrupt) has to pass
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        _warn(name, f"{type(error).__name__} was raised: {error}")
    return None


def _warn(name: str, why: str) -> None:
    warnings.warn(
        f"the solver {name} counts as FAILED on a program, and bounds that need no solver are "
        f"used: {why}",
        RuntimeWarning,
        stacklevel=2,
    )


def _why(known: bool, status: Any, where: str) -> str:
    if not known:
        return f"the status{where} is {int(status)}, which no solver's SolverStatus is"
    called = SolverStatus(int(status)).name
    return f"the status{where} is {called}, but its multipliers contain NaN or infinity"


def _of_kind(found: Any, blank: Proposal) -> Proposal:
    """The answer as arrays of the right shapes and kinds."""
    if not isinstance(found, Proposal):
        raise _FaultError(f"a Proposal was expected, but {described(found)} arrived")
    named = zip(Proposal._fields, found, blank, strict=True)
    return Proposal(*(_array(f"proposal.{name}", part, like) for name, part, like in named))


def _array(name: str, value: Any, like: np.ndarray) -> np.ndarray:
    """An array of its own, with the shape and kind of another."""
    whole = like.dtype.kind == "i"
    wanted = f"{name} must be {'whole ' if whole else ''}numbers of shape {like.shape}"
    try:
        array = np.array(value)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise _FaultError(f"{wanted}, but {described(value)} arrived: {error}") from None
    if array.dtype.kind not in ("iu" if whole else "iuf"):
        kind = described(value) if array.dtype.kind == "O" else f"an array of {array.dtype}"
        raise _FaultError(f"{wanted}, but {kind} arrived")
    if array.shape != like.shape:
        raise _FaultError(f"{wanted}, but an array of shape {array.shape} arrived")
    with np.errstate(over="ignore"):  # what is too large is no number, which is looked at later
        return array.astype(like.dtype)
