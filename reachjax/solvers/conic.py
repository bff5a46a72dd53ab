"""Semidefinite programs by cvxpy: Clarabel by default, any other solver that cvxpy knows alike.

The model is built once for a step. Only a parameter (the objective row) changes from facet to
facet, so cvxpy's canonicalisation is done once as well (disciplined parametrised programming).
"""

from __future__ import annotations

import abc
import dataclasses
import numbers
import time
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import scipy.sparse as sp

from reachjax.lmi import Program
from reachjax.solvers.base import AbstractSolver, Solution, SolverStatus
from reachjax.solvers.compact import CompactProgram, compact

RESCALINGS = (1.0, 8.0, 0.125, 64.0, 1.0)
"""Factors on the objective, tried in turn while a solver stalls: another scale often helps it."""

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


class _Model:
    """The cvxpy problem of one step, with the objective row as its parameter."""

    def __init__(self, program: CompactProgram):
        import cvxpy as cp

        n = program.objective.shape[1]
        free, signed = program.generators[:, program.free], program.generators[:, ~program.free]
        self.free = cp.Variable(free.shape[1]) if free.shape[1] else None
        self.signed = cp.Variable(signed.shape[1], nonneg=True)
        self.offset = cp.Variable()
        self.objective = cp.Parameter(n)
        corner = np.zeros(n * n)
        corner[-1] = 2.0
        matrix = signed @ self.signed + _bordered(n) @ self.objective - corner * self.offset
        if self.free is not None:
            matrix = matrix + free @ self.free
        self.lmi = cp.reshape(matrix, (n, n), order="F") << 0
        self.problem = cp.Problem(cp.Minimize(self.offset), [self.lmi])

    def multipliers(self, program: CompactProgram) -> np.ndarray:
        """The values found, in the order of the program's generators."""
        y = np.zeros(len(program.kept))
        y[~program.free] = self.signed.value
        if self.free is not None:
            y[program.free] = self.free.value
        return y / program.norms


def _bordered(n: int) -> sp.csr_array:
    """The map from a row `p` to the flattened `p e' + e p'`."""
    index = np.arange(n)
    rows = np.r_[index * n + n - 1, (n - 1) * n + index]
    return sp.csr_array((np.ones(2 * n), (rows, np.r_[index, index])), shape=(n * n, n))


class _ConicSolver(AbstractSolver, abc.ABC):
    """A solver that cvxpy calls by name."""

    @abc.abstractmethod
    def settings(self) -> tuple[str, dict[str, Any]]:
        """The name cvxpy has for the solver, and the keyword arguments for `Problem.solve`."""

    def solve(self, program: Program) -> Solution:
        """Propose multipliers for every facet.

        Raises:
            ValueError: cvxpy does not find the solver, or it takes no semidefinite programs.
            TypeError: the solver does not know one of the options.
        """
        name, options = self.settings()
        _require_installed(name)
        reduced = compact(program)
        model = _Model(reduced)
        facets, size = program.objective.mid.shape
        solution = Solution.blank(facets, len(program.products.free), size)
        for i, (row, center, unit) in enumerate(
            zip(reduced.objective, reduced.centers, reduced.units, strict=True)
        ):
            began = time.perf_counter()
            solution.statuses[i], factor = _run_scaled(model, row, name, options)
            solution.seconds[i] = time.perf_counter() - began
            if model.offset.value is None or model.signed.value is None:
                continue
            multipliers = unit / factor * model.multipliers(reduced)
            if not np.isfinite(multipliers).all():
                continue
            solution.offsets[i] = center + unit / factor * float(model.offset.value)
            solution.multipliers[i, reduced.kept] = multipliers
            moment = np.asarray(model.lmi.dual_value, dtype=float)
            if moment.ndim == 2 and moment[-1, -1] > 0:
                solution.moments[i] = 0.0
                used = np.ix_(reduced.columns, reduced.columns)
                solution.moments[i][used] = moment / moment[-1, -1]
        return solution


def _require_installed(name: str) -> None:
    import cvxpy as cp

    if name not in cp.installed_solvers():
        raise ValueError(
            f"the solver {name!r} is not among those that cvxpy finds here: "
            f"{', '.join(cp.installed_solvers())}"
        )


def _run_scaled(
    model: _Model, row: np.ndarray, name: str, options: dict
) -> tuple[SolverStatus, float]:
    """Solve for one objective row, at other scales while the solver stalls; the scale used last."""
    status, factor = SolverStatus.FAILED, 1.0
    for factor in RESCALINGS:
        status = _run(model, factor * row, name, options)
        if status not in (SolverStatus.INACCURATE, SolverStatus.FAILED):
            break
    return status, factor


def _run(model: _Model, objective: np.ndarray, name: str, options: dict) -> SolverStatus:
    """Solve for one objective row; values that an earlier facet left behind are cleared first."""
    import cvxpy as cp

    for variable in model.problem.variables():
        variable.value = None
    model.objective.value = objective
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # cvxpy warns of inaccuracy, which the status says
        try:
            model.problem.solve(solver=name, **options)
        except cp.SolverError as error:
            if "cannot solve" in str(error):  # not "failed": it takes no such cones
                raise ValueError(
                    f"the solver {name!r} cannot solve semidefinite programs"
                ) from None
            return SolverStatus.FAILED
        except Exception:
            raise
        except BaseException as error:  # a panic of compiled code is no Exception
            if isinstance(error, KeyboardInterrupt | SystemExit | GeneratorExit):
                raise
            return SolverStatus.FAILED
    return STATUSES.get(model.problem.status, SolverStatus.FAILED)


def _require_positive(solver: Any) -> None:
    for field in dataclasses.fields(solver):
        value: Any = getattr(solver, field.name)
        name = f"{type(solver).__name__}.{field.name}"
        if isinstance(value, bool) or not isinstance(value, numbers.Real):
            raise TypeError(f"{name} must be a number, but {value!r} arrived")
        if not float(value) > 0:
            raise ValueError(f"{name} must be positive, but {value!r} arrived")


@dataclasses.dataclass(frozen=True)
class Clarabel(_ConicSolver):
    """The interior-point code Clarabel, the default.

    Args:
        tolerance: of feasibility and of the gap, relative and absolute.
        max_iterations: a facet that needs more is reported with status `LIMIT`.
        time_limit: seconds for each facet.
    """

    tolerance: float = 1e-9
    max_iterations: int = 200
    time_limit: float = float("inf")

    def __post_init__(self):
        _require_positive(self)

    def settings(self) -> tuple[str, dict[str, Any]]:
        """Clarabel's own names; a stalled run still returns its last iterate, as inaccurate.

        Chordal decomposition stays off: with it, programs whose dual has no interior (dead neurons,
        the paper's constraints without `lambda_ij`) stalled at two digits; without it, at nine.
        """
        tight = ("tol_gap_abs", "tol_gap_rel", "tol_feas")
        loose = ("reduced_tol_gap_abs", "reduced_tol_gap_rel", "reduced_tol_feas")
        return "CLARABEL", {
            **dict.fromkeys(tight, self.tolerance),
            **dict.fromkeys(loose, max(1e-3, self.tolerance)),
            "max_iter": self.max_iterations,
            "time_limit": self.time_limit,
            "accept_unknown": True,
            "chordal_decomposition_enable": False,
        }


@dataclasses.dataclass(frozen=True)
class SCS(_ConicSolver):
    """The splitting conic solver: many cheap iterations, few digits.

    Args:
        tolerance: of feasibility and of the gap, relative and absolute.
        max_iterations: a facet that needs more is reported with status `LIMIT` or `INACCURATE`.
    """

    tolerance: float = 1e-7
    max_iterations: int = 50_000

    def __post_init__(self):
        _require_positive(self)

    def settings(self) -> tuple[str, dict[str, Any]]:
        """SCS's own names."""
        return "SCS", {
            "eps_abs": self.tolerance,
            "eps_rel": self.tolerance,
            "max_iters": self.max_iterations,
        }


@dataclasses.dataclass(frozen=True)
class CvxpySolver(_ConicSolver):
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
        """As given; the names cvxpy has are in capitals."""
        return self.name.upper(), dict(self.options)
