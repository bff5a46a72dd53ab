"""What a solver answers, made fit for use: one door for facets, ellipsoids and rounds of cuts.

Solvers are written by users too. Whatever one does (an exception, `None`, arrays of another shape
or kind, a status that there is none, multipliers that are no numbers) is a failed proposal: the
bound is then the one that needs no solver, the status is `FAILED`, and a warning says why. What is
fit passes as it is; numbers of another precision become float64.

Only `SetupError` is raised: it says that the solver was chosen or set up wrongly.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from reachjax.numerics.budget import TimeOverError, clock
from reachjax.numerics.checks import described
from reachjax.programs.lmi import Program
from reachjax.proofs.proposal import ANSWERS, OF_SOLVERS, Enclosure, Solution, SolverStatus
from reachjax.sets import NormalForm

if TYPE_CHECKING:
    from reachjax.solvers.base import AbstractSolver

CLAIMING = (*ANSWERS, SolverStatus.LIMIT)
"""The ends after which there should be multipliers."""


class SetupError(Exception):
    """The solver cannot be used, whatever the program: raised, and no failed proposal."""


class UnknownSolverError(SetupError, ValueError):
    """There is no such solver here, or it takes no such programs."""


class UnknownOptionError(SetupError, TypeError):
    """The solver does not know one of its options."""


class UnsupportedError(SetupError, NotImplementedError):
    """The solver does not know programs of this kind."""


class _FaultError(Exception):
    """What is wrong with an answer."""


def proposed(solver: AbstractSolver, program: Program) -> Solution:
    """What a solver proposes for the facets of a program whose leaves are numpy arrays.

    Raises:
        SetupError: the solver was chosen or set up wrongly.
    """
    blank = Solution.blank_for(program)
    try:
        clock().require()
        found = _asked(solver, lambda: _solution(solver.solve(program), blank))
    except TimeOverError:
        return blank._replace(statuses=np.full_like(blank.statuses, int(SolverStatus.LIMIT)))
    return blank if found is None else _repaired(found, type(solver).__name__)


def proposed_enclosure(
    solver: AbstractSolver, program: Program, form: NormalForm | None = None
) -> Enclosure:
    """What a solver proposes for an ellipsoid, the program's leaves being numpy arrays.

    Raises:
        SetupError: the solver was chosen or set up wrongly.
    """
    blank = Enclosure.blank(program)
    try:
        clock().require()
        found = _asked(solver, lambda: _enclosure(solver.enclose(program, form), blank))
    except TimeOverError:
        return blank._replace(status=np.array(int(SolverStatus.LIMIT)))
    return blank if found is None else _repaired_enclosure(found, blank, type(solver).__name__)


def _repaired(solution: Solution, name: str) -> Solution:
    """The proposal without what is no number, in numpy: such facets have failed.

    Args:
        solution: arrays of the right shapes.
        name: what warnings call the solver.
    """
    statuses, multipliers = np.asarray(solution.statuses), np.asarray(solution.multipliers)
    known = np.isin(statuses, OF_SOLVERS)
    finite = np.isfinite(multipliers).all(axis=1)
    broken = ~known | (np.isin(statuses, CLAIMING) & ~finite)
    for facet in np.flatnonzero(broken)[:1]:
        _warn(name, _why(bool(known[facet]), statuses[facet], f" of facet {facet}"))
    usable = finite & known
    offsets, moments = np.asarray(solution.offsets), np.asarray(solution.moments)
    whole = usable & np.isfinite(moments).all(axis=(1, 2))
    return Solution(
        offsets=np.where(usable & np.isfinite(offsets), offsets, np.nan),
        multipliers=np.where(usable[:, None], multipliers, 0.0),
        moments=np.where(whole[:, None, None], moments, np.nan),
        statuses=np.where(broken, int(SolverStatus.FAILED), statuses),
        seconds=np.asarray(solution.seconds),
    )


def _repaired_enclosure(found: Enclosure, blank: Enclosure, name: str) -> Enclosure:
    known = int(found.status) in OF_SOLVERS
    finite = bool(np.isfinite(found.multipliers).all())
    if not known or (int(found.status) in CLAIMING and not finite):
        _warn(name, _why(known, found.status))
        return blank._replace(seconds=found.seconds)
    if not finite:
        return blank._replace(status=found.status, seconds=found.seconds)
    moments, n = found.moments, len(found.moments) - len(found.form.b)
    if not (np.isfinite(moments).all() and moments[n - 1, n - 1] > 0):
        found = found._replace(moments=blank.moments)
    a_form = np.isfinite(found.form.A).all() and np.isfinite(found.form.b).all()
    return found if a_form else found._replace(form=blank.form)


def _asked(solver: AbstractSolver, answer: Callable[[], NamedTuple]) -> Any:
    """What the solver answers, of the right shapes; None where it answers nothing fit for use."""
    name = type(solver).__name__
    try:
        return answer()
    except (SetupError, TimeOverError):
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


def _why(known: bool, status: Any, where: str = "") -> str:
    if not known:
        return f"the status{where} is {int(status)}, which no solver's SolverStatus is"
    called = SolverStatus(int(status)).name
    return f"the status{where} is {called}, but its multipliers contain NaN or infinity"


def _solution(found: Any, blank: Solution) -> Solution:
    """The answer as arrays of the right shapes and kinds."""
    if not isinstance(found, Solution):
        raise _FaultError(f"a Solution was expected, but {described(found)} arrived")
    fields = blank._asdict()
    return Solution(
        **{
            name: _array(f"solution.{name}", getattr(found, name), like)
            for name, like in fields.items()
        }
    )


def _enclosure(found: Any, blank: Enclosure) -> Enclosure:
    """The answer as numpy arrays of the right shapes and kinds."""
    if not isinstance(found, Enclosure):
        raise _FaultError(f"an Enclosure was expected, but {described(found)} arrived")
    form = found.form
    if not isinstance(form, tuple) or len(form) != 2:
        raise _FaultError(f"enclosure.form must be a NormalForm, but {described(form)} arrived")
    parts = (
        _array(f"enclosure.form.{name}", part, np.asarray(like))
        for name, part, like in zip("Ab", form, blank.form, strict=True)
    )
    numbers = {
        name: _array(f"enclosure.{name}", getattr(found, name), like)
        for name, like in blank._asdict().items()
        if name != "form"
    }
    return Enclosure(form=NormalForm(*parts), **numbers)


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
