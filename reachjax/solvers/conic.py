"""Semidefinite programs by cvxpy, with a solver that it calls by name."""

from __future__ import annotations

import abc
import threading
import time
import warnings
from collections.abc import Callable
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np

from reachjax.numerics.budget import clock
from reachjax.programs.lmi import Program
from reachjax.programs.presolve import presolved
from reachjax.proofs.proposal import Enclosure, Solution, SolverStatus
from reachjax.sets import NormalForm
from reachjax.solvers.base import AbstractSolver
from reachjax.solvers.faults import UnknownOptionError, UnknownSolverError
from reachjax.solvers.models import EllipsoidModel, FacetModel

RESCALINGS = (1.0, 8.0, 0.125, 64.0, 1.0)
"""Factors on the objective, tried in turn while a solver stalls: another scale often helps it."""

STALLED = (SolverStatus.INACCURATE, SolverStatus.FAILED)

STATUSES = {
    "optimal": SolverStatus.SOLVED,
    "optimal_inaccurate": SolverStatus.INACCURATE,
    "infeasible": SolverStatus.INFEASIBLE,
    "infeasible_inaccurate": SolverStatus.INFEASIBLE,
    "infeasible_or_unbounded": SolverStatus.INFEASIBLE,
    "unbounded": SolverStatus.UNBOUNDED,
    "unbounded_inaccurate": SolverStatus.UNBOUNDED,
    "user_limit": SolverStatus.LIMIT,
    "solver_error": SolverStatus.FAILED,
}
"""cvxpy's words for how a solver ended."""

ONE_AT_A_TIME = threading.RLock()
"""Threads share cvxpy's count of variables, and the filters of warnings that are set around it."""


P = ParamSpec("P")
T = TypeVar("T")


def _one_at_a_time(method: Callable[P, T]) -> Callable[P, T]:
    @wraps(method)
    def alone(*args: P.args, **kwargs: P.kwargs) -> T:
        with ONE_AT_A_TIME:
            return method(*args, **kwargs)

    return alone


class AbstractConicSolver(AbstractSolver, abc.ABC):
    """A solver that cvxpy calls by name."""

    @abc.abstractmethod
    def settings(self) -> tuple[str, dict[str, Any]]:
        """The name cvxpy has for the solver, and the keyword arguments for `Problem.solve`."""

    @_one_at_a_time
    def solve(self, program: Program) -> Solution:
        """Propose multipliers for every facet.

        Raises:
            ValueError: cvxpy does not find the solver, or it takes no semidefinite programs.
            TypeError: the solver does not know one of the options.
        """
        name, options = self.settings()
        _require_installed(name)
        reduced = presolved(program)
        model = FacetModel(reduced)
        solution = Solution.blank_for(program)
        for i, (row, center, unit) in enumerate(
            zip(reduced.objective, reduced.centers, reduced.units, strict=True)
        ):
            if clock().late:
                solution.statuses[i:] = SolverStatus.LIMIT
                break
            began = time.perf_counter()
            factor = 1.0
            for factor in RESCALINGS:
                model.objective.value = factor * row
                solution.statuses[i] = _run(model.problem, name, options)
                if solution.statuses[i] not in STALLED:
                    break
            solution.seconds[i] = time.perf_counter() - began
            multipliers = model.multipliers.value
            if model.offset.value is None or multipliers is None:
                continue
            solution.offsets[i] = center + unit / factor * float(model.offset.value)
            solution.multipliers[i, reduced.kept] = unit / factor * multipliers / reduced.norms
            moment = np.asarray(model.lmi.dual_value, dtype=float)
            if moment.ndim == 2 and moment[-1, -1] > 0:
                solution.moments[i] = 0.0
                used = np.ix_(reduced.columns, reduced.columns)
                solution.moments[i][used] = moment / moment[-1, -1]
        return solution

    @_one_at_a_time
    def enclose(self, program: Program, form: NormalForm | None = None) -> Enclosure:
        """Propose the smallest ellipsoid around the successors, and its multipliers.

        Raises:
            ValueError: cvxpy does not find the solver, or it takes no such programs.
            TypeError: the solver does not know one of the options.
        """
        name, options = self.settings()
        _require_installed(name)
        reduced, proposal = presolved(program), Enclosure.blank(program)
        began, status = time.perf_counter(), SolverStatus.FAILED
        scaled = model = None
        for factor in RESCALINGS[: 1 if form is None else None]:
            scaled = reduced.with_units(reduced.widths / factor)
            model = EllipsoidModel(scaled, None if form is None else scaled.to_unit_box(form))
            status = _run(model.problem, name, options)
            if status not in STALLED or clock().late:
                break
        seconds = time.perf_counter() - began
        assert model is not None
        assert scaled is not None
        found, multipliers = model.form, model.multipliers.value
        proposal = proposal._replace(status=np.array(int(status)), seconds=np.array(seconds))
        if found is None or multipliers is None:
            return proposal
        proposal.multipliers[reduced.kept] = multipliers / reduced.norms
        moments = np.asarray(model.lmi.dual_value, dtype=float)
        if moments.ndim == 2:
            size, extra = len(program.transform), len(found.b)
            used = np.r_[reduced.columns, size + np.arange(extra)]
            proposal.moments[:] = 0.0
            proposal.moments[np.ix_(used, used)] = moments
        return proposal._replace(form=scaled.from_unit_box(found))


@cache
def _installed() -> list[str]:
    import cvxpy as cp

    return cp.installed_solvers()


def _require_installed(name: str) -> None:
    if name not in _installed():
        raise UnknownSolverError(
            f"the solver {name!r} is not among those that cvxpy finds here: "
            f"{', '.join(_installed())}"
        )


def _run(problem: Any, name: str, options: dict) -> SolverStatus:
    """Solve; values that an earlier facet left behind are cleared first."""
    import cvxpy as cp

    for variable in problem.variables():
        variable.value = None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # cvxpy warns of inaccuracy, which the status says
        try:
            problem.solve(solver=name, **options)
        except cp.SolverError as error:
            if "cannot solve" in str(error):  # not "failed": it takes no such cones
                raise UnknownSolverError(
                    f"the solver {name!r} cannot solve semidefinite programs"
                ) from None
            return SolverStatus.FAILED
        except TypeError as error:
            raise UnknownOptionError(str(error)) from error
        except Exception:
            raise
        except BaseException as error:  # a panic of compiled code is no Exception
            if isinstance(error, KeyboardInterrupt | SystemExit | GeneratorExit):
                raise
            return SolverStatus.FAILED
    return STATUSES.get(problem.status, SolverStatus.FAILED)
