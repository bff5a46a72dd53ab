"""Semidefinite programs by cvxpy, with a solver that it calls by name: SCS, and any other."""

from __future__ import annotations

import abc
import dataclasses
import threading
import warnings
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from reachjax.numerics.budget import clock
from reachjax.programs.lmi import Program
from reachjax.programs.presolve import THINNEST, AbstractInequality, Pencil
from reachjax.proofs.proposal import Proposal, SolverStatus
from reachjax.solvers.base import (
    RESCALINGS,
    AbstractSolver,
    Found,
    UnknownOptionError,
    UnknownSolverError,
    proposed_by,
    require_positive,
)

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

LEAST = 1e-3
"""Seconds that a solver is given at least: zero is no limit to some, and an error to others."""

ONE_AT_A_TIME = threading.RLock()
"""Threads share cvxpy's count of variables, and the filters of warnings that are set around it."""


class AbstractConicSolver(AbstractSolver, abc.ABC):
    """A solver that cvxpy calls by name."""

    @abc.abstractmethod
    def settings(self) -> tuple[str, dict[str, Any]]:
        """The name cvxpy has for the solver, and the keyword arguments for `Problem.solve`."""

    def solve(self, program: Program, goal: AbstractInequality) -> Proposal:
        """Propose multipliers, and what is sought, for every program of a goal.

        Raises:
            ValueError: cvxpy does not find the solver, or it takes no semidefinite programs.
            TypeError: the solver does not know one of the options.
        """
        with ONE_AT_A_TIME:
            name, options = self.settings()
            if name not in _installed():
                raise UnknownSolverError(
                    f"the solver {name!r} is not among those that cvxpy finds here: "
                    f"{', '.join(_installed())}"
                )
            pencil = goal.pencil(program)
            model = Model(pencil)

            def attempt(i: int, scale: float) -> tuple[SolverStatus, Found | None]:
                return model.solved(scale * pencil.constant(i), name, options)

            # an ellipsoid has its own scale
            scales = RESCALINGS[: None if model.is_linear else 1]
            return proposed_by(attempt, program, goal, pencil, scales=scales)


@dataclasses.dataclass(frozen=True)
class SCS(AbstractConicSolver):
    """The splitting conic solver: many cheap iterations, few digits.

    Args:
        tolerance: of feasibility and of the gap, relative and absolute.
        max_iterations: a facet that needs more is reported with status `LIMIT` or `INACCURATE`.
    """

    tolerance: float = 1e-7
    max_iterations: int = 50_000

    def __post_init__(self):
        require_positive(self)

    def settings(self) -> tuple[str, dict[str, Any]]:
        """SCS's own names."""
        return "SCS", {
            "eps_abs": self.tolerance,
            "eps_rel": self.tolerance,
            "max_iters": self.max_iterations,
        } | ({"time_limit_secs": max(clock().left, LEAST)} if clock().timed else {})


@dataclasses.dataclass(frozen=True)
class CvxpySolver(AbstractConicSolver):
    """Any other solver that cvxpy knows, by cvxpy's name for it.

    Args:
        name: such as `cvxpy.MOSEK`.
        options: keyword arguments of `cvxpy.Problem.solve` for this solver.

    Example:
        >>> CvxpySolver("SCS", {"eps_abs": 1e-6}).settings()
        ('SCS', {'eps_abs': 1e-06})
    """

    name: str
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict, hash=False)

    def settings(self) -> tuple[str, dict[str, Any]]:
        """The settings as given; the names cvxpy has are in capitals."""
        return self.name.upper(), dict(self.options)


def unit_columns(pencil: Pencil) -> tuple[sp.csc_array, sp.csc_array, Float[np.ndarray, " k"]]:
    """The flattened `-H_j`, `(N * N, u)`, and the `G_k` at unit size and the sizes they had."""
    columns = sp.csc_array(-pencil.terms.columns())
    unknowns, generators = columns[:, pencil.multipliers :], columns[:, : pencil.multipliers]
    sizes = np.sqrt(np.asarray(generators.multiply(generators).sum(axis=0)).ravel())
    sizes = np.where(sizes > 0, sizes, 1.0)
    return unknowns, sp.csc_array(generators @ sp.diags_array(1 / sizes)), sizes


class Model:
    """A pencil as cvxpy states it.

    It is built once for all programs of a goal. Only a parameter, the constant, changes from one to
    the next, so cvxpy's canonicalisation is done once as well (disciplined parametrised
    programming).
    """

    def __init__(self, pencil: Pencil):
        import cvxpy as cp

        unknowns, generators, self._sizes = unit_columns(pencil)
        self._free: Any = pencil.normal.free
        free, signed = generators[:, self._free], generators[:, ~self._free]
        size = pencil.size
        self._y_free = cp.Variable(free.shape[1]) if free.shape[1] else None
        self._y_signed = cp.Variable(signed.shape[1], nonneg=True)
        self._constant = cp.Parameter(size * size)
        self._sought = cp.Variable(len(pencil.sizes))
        weighted = signed @ self._y_signed
        if self._y_free is not None:
            weighted = weighted + free @ self._y_free
        matrix = weighted + unknowns @ self._sought - self._constant
        self._lmi = cp.reshape(matrix, (size, size), order="F") << 0
        self.is_linear, s = len(pencil.sizes) == 1, pencil.sizes.shape[1]
        flat = pencil.sizes.reshape(len(pencil.sizes), s * s)
        constraints: list[Any] = [self._lmi]
        if self.is_linear:
            enlarged = flat[:, 0] @ self._sought
        else:
            matrix = cp.reshape(flat.T @ self._sought, (s, s), order="F")
            enlarged = cp.log_det(matrix)
            constraints.append(matrix << np.eye(s) / THINNEST)
        self._problem = cp.Problem(cp.Maximize(enlarged), constraints)

    def solved(
        self, constant: Float[np.ndarray, "N N"], name: str, options: dict[str, Any]
    ) -> tuple[SolverStatus, Found | None]:
        """How the program with this constant ends, and what is found if anything is."""
        self._constant.value = constant.ravel()
        status = _run(self._problem, name, options)
        unknowns, signed = self._sought.value, self._y_signed.value
        if unknowns is None or signed is None:
            return status, None
        y = np.zeros(len(self._free))
        y[~self._free] = signed
        if self._y_free is not None:
            y[self._free] = self._y_free.value
        if not (np.isfinite(y).all() and np.isfinite(unknowns).all()):
            return status, None
        moments = np.asarray(self._lmi.dual_value, dtype=float)
        if moments.ndim != 2:
            moments = np.full(constant.shape, np.nan)
        return status, Found(np.asarray(unknowns), y / self._sizes, moments)


@cache
def _installed() -> list[str]:
    import cvxpy as cp

    return cp.installed_solvers()


def _run(problem: Any, name: str, options: dict) -> SolverStatus:
    """Solve; values that an earlier program left behind are cleared first."""
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
            require_panic(error)
            return SolverStatus.FAILED
    return STATUSES.get(problem.status, SolverStatus.FAILED)


def require_panic(error: BaseException) -> None:
    """Raise an error again that is no panic of compiled code, but an interrupt."""
    if isinstance(error, KeyboardInterrupt | SystemExit | GeneratorExit):
        raise error
