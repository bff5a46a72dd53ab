"""Clarabel, called directly: no modelling language between the program and its conic form."""

from __future__ import annotations

import dataclasses
import importlib
import os
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from reachjax.numerics.budget import MOST_BYTES, clock, require_memory
from reachjax.programs.lmi import Program
from reachjax.programs.presolve import NormalProgram, presolved
from reachjax.proofs.proposal import Enclosure, Solution, SolverStatus
from reachjax.sets import NormalForm
from reachjax.solvers.base import require_positive
from reachjax.solvers.conic import RESCALINGS, STALLED, AbstractConicSolver
from reachjax.solvers.models import unit_generators

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

LEAST = 1e-3
"""Seconds: Clarabel takes no limit of zero."""

ANSWERS = SolverStatus.SOLVED, SolverStatus.INACCURATE, SolverStatus.LIMIT


@dataclasses.dataclass(frozen=True)
class Clarabel(AbstractConicSolver):
    """The interior-point code Clarabel, which `Auto` takes for small programs.

    Facets go to it directly, ellipsoids by cvxpy.

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

    def solve(self, program: Program) -> Solution:
        """Propose multipliers for every facet, on as many threads as there are cores and memory.

        Raises:
            MemoryError: one facet would take too much of it.
            TimeOverError: the time in force would be over before the first iterate.
        """
        reduced, solution = presolved(program), Solution.blank_for(program)
        taken = _require_memory(reduced.objective.shape[1])
        budget = clock()  # of this thread; others have none
        cone = FacetCone(reduced, self._options)

        def solve(i: int) -> None:
            began, factor, found = time.perf_counter(), 1.0, None
            solution.statuses[i] = SolverStatus.LIMIT
            for factor in RESCALINGS:
                if budget.late:
                    break
                solution.statuses[i], found = cone.solved(factor * reduced.objective[i])
                if solution.statuses[i] not in STALLED:
                    break
            solution.seconds[i] = time.perf_counter() - began
            if found is None:
                return
            offset, multipliers, moment = found
            unit = reduced.units[i] / factor
            solution.offsets[i] = reduced.centers[i] + unit * offset
            solution.multipliers[i, reduced.kept] = unit * multipliers / reduced.norms
            if moment[-1, -1] > 0:
                solution.moments[i] = 0.0
                used = np.ix_(reduced.columns, reduced.columns)
                solution.moments[i][used] = moment / moment[-1, -1]

        facets, threads = range(len(reduced.objective)), int(MOST_BYTES // max(8 * taken, 1))
        if len(facets) > 1:
            pool = ThreadPoolExecutor(min(os.cpu_count() or 1, threads))
            try:
                list(pool.map(solve, facets))
            finally:  # nobody waits for them after Ctrl-C
                pool.shutdown(wait=False, cancel_futures=True)
        else:
            for i in facets:
                solve(i)
        return solution

    def enclose(self, program: Program, form: NormalForm | None = None) -> Enclosure:
        """Propose the smallest ellipsoid around the successors, and its multipliers.

        Raises:
            MemoryError: it would take too much memory.
            TimeOverError: the time in force would be over before the first iterate.
        """
        _require_memory(int(program.used.sum()) + len(program.objective.mid))
        return super().enclose(program, form)


def _require_memory(size: int) -> float:
    """The numbers that a semidefinite cone takes: its matrix is dense, and so is the factor.

    Raises:
        MemoryError: they are too many.
        TimeOverError: the time in force would be over before the matrix is factorised.
    """
    entries = size * (size + 1) / 2
    require_memory(f"a semidefinite cone of {size} columns", 2 * entries**2, entries**3 / 3)
    return 2 * entries**2


class FacetCone:
    """`sum_k y_k G_k + p e' + e p' - 2 b e e' <= 0` with the smallest `b`, as Clarabel takes it.

    The unknowns are `b` and the `y_k`; those that are signed are in the nonnegative orthant, minus
    the matrix in the semidefinite cone. Only the vector of constants depends on `p`.

    Args:
        program: the normal program.
        options: by Clarabel's names.
    """

    def __init__(self, program: NormalProgram, options: Mapping[str, Any]):
        self._clarabel: Any = importlib.import_module("clarabel")  # only where it is needed
        generators, self._sizes = unit_generators(program)
        n, count = program.objective.shape[1], len(program.kept)
        # Clarabel has upper triangles column by column, their inner products those of matrices
        self._column, self._row = np.tril_indices(n)
        self._weight = np.where(self._row == self._column, 1.0, np.sqrt(2.0))
        triangle = sp.diags_array(self._weight) @ generators[self._row * n + self._column]
        corner = sp.csc_array(-2.0 * np.eye(1, len(self._row), len(self._row) - 1).T)
        signed = np.flatnonzero(~program.free)
        below = sp.csc_array(
            (-np.ones(len(signed)), (np.arange(len(signed)), 1 + signed)),
            shape=(len(signed), 1 + count),
        )
        self._matrix = sp.csc_array(sp.vstack([below, sp.hstack([corner, triangle])]))
        self._signed, self._size = len(signed), n
        self._cones = [self._clarabel.PSDTriangleConeT(n)]
        if len(signed):
            self._cones.insert(0, self._clarabel.NonnegativeConeT(len(signed)))
        self._settings = self._clarabel.DefaultSettings()
        self._settings.verbose = False
        for name, value in options.items():
            setattr(self._settings, name, value)

    def solved(
        self, row: Float[np.ndarray, " n"]
    ) -> tuple[SolverStatus, tuple[float, np.ndarray, np.ndarray] | None]:
        """How the program with this `p` ended; its offset, multipliers and moments if it has any.

        Args:
            row: without a constant.
        """
        unknowns = 1 + len(self._sizes)
        constants = np.zeros(self._signed + len(self._row))
        there = self._column == self._size - 1
        constants[self._signed :][there] = -(self._weight * row[self._row])[there]
        solver = self._clarabel.DefaultSolver(
            sp.csc_array((unknowns, unknowns)),
            np.eye(1, unknowns)[0],
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
            if isinstance(error, KeyboardInterrupt | SystemExit | GeneratorExit):
                raise
            return SolverStatus.FAILED, None
        status = STATUSES.get(str(found.status), SolverStatus.FAILED)
        values = np.array(found.x)
        if status not in ANSWERS or not np.isfinite(values).all():
            return status, None
        moment = np.zeros((self._size, self._size))
        moment[self._row, self._column] = np.array(found.z)[self._signed :] / self._weight
        moment[self._column, self._row] = moment[self._row, self._column]
        return status, (float(values[0]), values[1:] / self._sizes, moment)
