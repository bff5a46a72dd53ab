"""Clarabel, called directly: no modelling language between the program and its conic form."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from reachjax.numerics.budget import MOST_BYTES, clock, require_memory
from reachjax.programs.lmi import Program
from reachjax.programs.presolve import AbstractInequality, Pencil
from reachjax.proofs.proposal import CLAIMING, Proposal, SolverStatus
from reachjax.solvers.base import RESCALINGS, Found, proposed_by, require_positive
from reachjax.solvers.conic import LEAST, AbstractConicSolver, require_panic, unit_columns

STATUSES = {
    "Solved": SolverStatus.SOLVED,
    "AlmostSolved": SolverStatus.INACCURATE,
    "InsufficientProgress": SolverStatus.INACCURATE,
    "PrimalInfeasible": SolverStatus.INFEASIBLE,
    "AlmostPrimalInfeasible": SolverStatus.INFEASIBLE,
    "DualInfeasible": SolverStatus.UNBOUNDED,
    "AlmostDualInfeasible": SolverStatus.UNBOUNDED,
    "MaxIterations": SolverStatus.LIMIT,
    "MaxTime": SolverStatus.LIMIT,
}
"""Clarabel's words for how it ended; any other is a failure."""


@dataclasses.dataclass(frozen=True)
class Clarabel(AbstractConicSolver):
    """The interior-point code Clarabel, which `Auto` takes for small programs.

    Offsets and sizes go to it directly, ellipsoids of least volume by cvxpy.

    Args:
        tolerance: of feasibility and of the gap, relative and absolute.
        max_iterations: a facet that needs more is reported with status `LIMIT`.
        time_limit: seconds for each facet.
    """

    tolerance: float = 1e-9
    max_iterations: int = 200
    time_limit: float = float("inf")

    def __post_init__(self):
        require_positive(self)

    def settings(self) -> tuple[str, dict[str, Any]]:
        """Clarabel's own names; a stalled run still returns its last iterate, as inaccurate.

        Chordal decomposition stays off: with it, programs whose dual has no interior (dead neurons,
        the paper's constraints without `lambda_ij`) stalled at two digits; without it, at nine.
        """
        return "CLARABEL", self._options | {"accept_unknown": True}

    @property
    def _options(self) -> dict[str, Any]:
        tight = ("tol_gap_abs", "tol_gap_rel", "tol_feas")
        loose = ("reduced_tol_gap_abs", "reduced_tol_gap_rel", "reduced_tol_feas")
        return {
            **dict.fromkeys(tight, self.tolerance),
            **dict.fromkeys(loose, max(1e-3, self.tolerance)),
            "max_iter": self.max_iterations,
            "time_limit": min(self.time_limit, max(clock().left, LEAST)),
            "chordal_decomposition_enable": False,
        }

    def solve(self, program: Program, goal: AbstractInequality) -> Proposal:
        """Propose multipliers and offsets or factors, on as many threads as there are cores and
        memory; ellipsoids of least volume by cvxpy.

        Raises:
            MemoryError: one program would take too much of it.
            TimeOverError: the time in force would be over before the first iterate.
        """
        pencil = goal.pencil(program)
        taken = _require_memory(pencil.size)
        if len(pencil.sizes) > 1:
            return super().solve(program, goal)
        cone = Cone(pencil, self._options)

        def attempt(i: int, scale: float) -> tuple[SolverStatus, Found | None]:
            return cone.solved(scale * pencil.constant(i))

        threads = int(MOST_BYTES // max(8 * taken, 1))
        given = attempt, program, goal, pencil
        return proposed_by(*given, scales=RESCALINGS, threads=threads)


def _require_memory(size: int) -> float:
    """The numbers that a semidefinite cone takes: its matrix is dense, and so is the factor.

    Raises:
        MemoryError: they are too many.
        TimeOverError: the time in force would be over before the matrix is factorised.
    """
    entries = size * (size + 1) / 2
    require_memory(f"a semidefinite cone of {size} columns", 2 * entries**2, entries**3 / 3)
    return 2 * entries**2


class Cone:
    """A pencil of one unknown, as Clarabel takes it.

    The multipliers that are signed are in the nonnegative orthant, the matrix in the semidefinite
    cone. Only the vector of constants differs from program to program.

    Args:
        pencil: of a goal.
        options: by Clarabel's names.
    """

    def __init__(self, pencil: Pencil, options: Mapping[str, Any]):
        self._clarabel: Any = importlib.import_module("clarabel")  # only where it is needed
        unknowns, generators, self._sizes = unit_columns(pencil)
        n, count = pencil.size, pencil.multipliers
        # Clarabel has upper triangles column by column, their inner products those of matrices
        self._column, self._row = np.tril_indices(n)
        self._weight = np.where(self._row == self._column, 1.0, np.sqrt(2.0))
        flat, weight = self._row * n + self._column, sp.diags_array(self._weight)
        signed = np.flatnonzero(~pencil.normal.free)
        below = sp.csc_array(
            (-np.ones(len(signed)), (np.arange(len(signed)), 1 + signed)),
            shape=(len(signed), 1 + count),
        )
        beside = sp.hstack([weight @ sp.csc_array(part)[flat] for part in (unknowns, generators)])
        self._matrix = sp.csc_array(sp.vstack([below, beside]))
        self._costs = np.r_[-pencil.sizes[:, 0, 0], np.zeros(count)]
        self._signed, self._size = len(signed), n
        self._cones = [self._clarabel.PSDTriangleConeT(n)]
        if len(signed):
            self._cones.insert(0, self._clarabel.NonnegativeConeT(len(signed)))
        self._settings = self._clarabel.DefaultSettings()
        self._settings.verbose = False
        for name, value in options.items():
            setattr(self._settings, name, value)

    def solved(self, constant: Float[np.ndarray, "N N"]) -> tuple[SolverStatus, Found | None]:
        """How the program with this constant ends, and what is found if anything is."""
        unknowns = len(self._costs)
        constants = np.zeros(self._signed + len(self._row))
        constants[self._signed :] = self._weight * constant[self._row, self._column]
        solver = self._clarabel.DefaultSolver(
            sp.csc_array((unknowns, unknowns)),
            self._costs,
            self._matrix,
            constants,
            self._cones,
            self._settings,
        )
        try:
            found = solver.solve()
        except Exception:
            raise
        except BaseException as error:  # a panic of compiled code is no Exception
            require_panic(error)
            return SolverStatus.FAILED, None
        status = STATUSES.get(str(found.status), SolverStatus.FAILED)
        values = np.array(found.x)
        if status not in CLAIMING or not np.isfinite(values).all():
            return status, None
        moments = np.zeros((self._size, self._size))
        moments[self._row, self._column] = np.array(found.z)[self._signed :] / self._weight
        moments[self._column, self._row] = moments[self._row, self._column]
        return status, Found(values[:1], values[1:] / self._sizes, moments)
