"""Linear programs over the columns of a horizon, by the simplex method of HiGHS.

The largest value of a row over `|eta_i| <= 1` and the facts `F eta + f >= 0`, some of which are
held at zero. One model grows with the horizon, and each program begins at the basis where the one
before ended, so most of them take a few pivots. Rows and objectives are of unit size: HiGHS's
tolerances are absolute. What comes back is a proposal: multipliers prove what `programs.horizon`
makes of them.

Where the initial state is in an ellipsoid, its columns are in the unit ball: one second-order cone,
and Clarabel solves the programs.
"""

from __future__ import annotations

import abc
import importlib
from collections.abc import Iterable
from typing import Any, NamedTuple

import highspy
import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from reachjax.numerics.budget import ENDLESS, Budget
from reachjax.programs.affine import AffineForms

TOLERANCE = 1e-9
"""The tolerance of feasibility, primal and dual, in rows of unit size."""

DANTZIG, OFF = 0, 0
"""Few pivots lead from a node to its branches: weights of edges and scales take longer."""

BREATH = 0.4
"""Seconds after which a program lets Ctrl-C through, before it goes on from its basis."""

OPTIMAL, INFEASIBLE = highspy.HighsModelStatus.kOptimal, highspy.HighsModelStatus.kInfeasible
OUT_OF_TIME = highspy.HighsModelStatus.kTimeLimit


class Vertex(NamedTuple):
    """Where a linear program ended.

    Attributes:
        value: the largest value; minus infinity if no columns satisfy the facts.
        columns: `(n,)`, where it is attained, zero of those left out; empty if nowhere.
        multipliers: `(m,)` of the facts that bound it, or that show that there is nothing.
        weights: `(r,)` of the rows of which the least is largest, of sum 1.
        reduced: `(n,)`, by how much the bound rises with the range of each column.
        basis: from which a program with a few facts more is solved soon.
    """

    value: float
    columns: Float[np.ndarray, " n"]
    multipliers: Float[np.ndarray, " m"]
    weights: Float[np.ndarray, " r"]
    reduced: Float[np.ndarray, " n"]
    basis: Any = None


class AbstractPrograms(abc.ABC):
    """Programs over the columns and facts of a horizon, which grow.

    Args:
        states: how many columns are of the initial state.
    """

    def __init__(self, states: int):
        self._states = states
        self._columns, self._width = np.arange(states), states

    @abc.abstractmethod
    def grow(self, facts: AffineForms, columns: Int[np.ndarray, " v"]) -> None:
        """Add the columns and the facts that are new.

        Args:
            facts: all of them, the first ones as before.
            columns: the numbers of those that matter, the first ones as before; remainders that
                are left out are so small that they change no program.
        """

    @abc.abstractmethod
    def largest(
        self,
        rows: Float[np.ndarray, "r n"],
        constants: Float[np.ndarray, " r"],
        zero: Iterable[int],
        budget: Budget = ENDLESS,
        reach: float | Float[np.ndarray, " n"] = 1.0,
        basis: Any = None,
    ) -> Vertex | None:
        """The largest value of a row, or of the least of several; None where there is no answer.

        Args:
            rows: over the columns.
            constants: of the rows.
            zero: facts that are held at zero.
            budget: whose time ends it, without an answer.
            reach: what bounds the columns of units, of all or of each column.
            basis: where the search begins; None where the last one ended.
        """

    @abc.abstractmethod
    def forget(self) -> None:
        """Let what is solved next depend on nothing that was solved before."""

    def _own(self, rows: Float[np.ndarray, "r n"]) -> tuple[Float[np.ndarray, "r v"], float]:
        """Rows over the columns that matter, and how large their coefficients are."""
        given = np.zeros((len(rows), self._width))
        given[:, : rows.shape[1]] = rows
        rows = given[:, self._columns]
        return rows, abs(rows).max(initial=0.0) or 1.0

    def _placed(self, values: Float[np.ndarray, " v"]) -> Float[np.ndarray, " n"]:
        """Values of the columns that matter among those of all."""
        found = np.zeros(self._width)
        found[self._columns] = values
        return found


def _of_unit_size(
    facts: AffineForms, columns: Int[np.ndarray, " v"]
) -> tuple[Float[np.ndarray, "m v"], Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Rows and constants of facts over some columns, divided by their sizes, and these.

    Facts that are no numbers are none: their rows are zero.
    """
    constants, rows = facts.rows[:, 0], facts.columns[:, columns]
    size = np.maximum(abs(rows).max(axis=1, initial=0.0), abs(constants))
    known = np.isfinite(size)
    rows, constants = np.where(known[:, None], rows, 0.0), np.where(known, constants, 0.0)
    size = np.where((size > 0) & known, size, 1.0)
    return rows / size[:, None], constants / size, size


class LinearPrograms(AbstractPrograms):
    """Linear programs as one model.

    Args:
        states: how many columns are of the initial state.
        bounded: whether these are bounded by 1 each, or by the facts alone.
    """

    def __init__(self, states: int, bounded: bool):
        super().__init__(states)
        self._model: Any = highspy.Highs()
        for name, value in {
            "output_flag": False,
            "presolve": "off",
            "threads": 1,
            "simplex_dual_edge_weight_strategy": DANTZIG,
            "simplex_scale_strategy": OFF,
            "primal_feasibility_tolerance": TOLERANCE,
            "dual_feasibility_tolerance": TOLERANCE,
        }.items():
            self._model.setOptionValue(name, value)
        self._model.changeObjectiveSense(highspy.ObjSense.kMaximize)
        self._model.addVar(0.0, 0.0)  # the least of several rows, where that is maximised
        self._add_columns(states, 1.0 if bounded else highspy.kHighsInf)
        self._held: set[int] = set()
        self._rows = np.zeros(0, dtype=int)  # numbers of the facts among the model's rows
        self._size, self._constant = np.zeros(0), np.zeros(0)
        self._count = 0

    def grow(self, facts: AffineForms, columns: Int[np.ndarray, " v"]) -> None:
        """Add the columns and the facts that are new."""
        self._add_columns(len(columns) - len(self._columns), 1.0)
        self._columns, self._width, old = columns, facts.columns.shape[1], len(self._rows)
        rows, constants, size = _of_unit_size(facts[old:], columns)
        self._rows = np.append(self._rows, self._count + np.arange(len(rows)))
        self._size = np.append(self._size, size)
        self._constant = np.append(self._constant, constants)
        self._add_rows(-constants, rows, 0.0)

    def largest(
        self,
        rows: Float[np.ndarray, "r n"],
        constants: Float[np.ndarray, " r"],
        zero: Iterable[int],
        budget: Budget = ENDLESS,
        reach: float | Float[np.ndarray, " n"] = 1.0,
        basis: Any = None,
    ) -> Vertex | None:
        """The largest value of a row, or of the least of several; None where there is no answer."""
        if not (np.isfinite(rows).all() and np.isfinite(constants).all()):
            return None
        self._hold({int(fact) for fact in zero})
        rows, size = self._own(rows)
        width = len(self._columns) + 1
        objective = np.zeros(width)
        extra = 0
        if len(rows) == 1:
            objective[1:] = rows[0] / size
        else:
            objective[0], extra = 1.0, len(rows)
            self._model.changeColBounds(0, -highspy.kHighsInf, highspy.kHighsInf)
            self._add_rows(-constants / size, rows / size, -1.0)
        self._model.changeColsCost(width, np.arange(width, dtype=np.int32), objective)
        if np.any(reach != 1.0):
            self._bound_units(reach)
        if basis is not None:
            self._model.setBasis(basis)
        found = self._solved(rows, constants, size, extra, budget)
        if np.any(reach != 1.0):
            self._bound_units(1.0)
        if extra:
            last = np.arange(self._count - extra, self._count, dtype=np.int32)
            self._model.deleteRows(extra, last)
            self._count -= extra
            self._model.changeColBounds(0, 0.0, 0.0)
        return found

    def forget(self) -> None:
        """Let what is solved next depend on nothing that was solved before."""
        self._hold(set())
        self._model.clearSolver()

    def _solved(
        self, rows: np.ndarray, constants: np.ndarray, size: float, extra: int, budget: Budget
    ) -> Vertex | None:
        status = self._run(budget)
        count = len(rows)
        if status == INFEASIBLE:
            _, there, ray = self._model.getDualRay()
            multipliers = np.array(ray)[self._rows] / self._size if there else None
            if multipliers is None:
                return None
            none = np.zeros(0)
            return Vertex(-np.inf, none, -multipliers, none, none)
        if status != OPTIMAL:
            return None
        solution = self._model.getSolution()
        columns, duals = np.array(solution.col_value)[1:], np.array(solution.row_dual)
        weights = np.ones(1)
        if extra:
            weights = np.maximum(-duals[self._count - count :], 0.0)
            total = weights.sum()
            weights = weights / total if total > 0 else np.full(count, 1 / count)
        value = (constants + rows @ columns).min()
        return Vertex(
            float(value),
            self._placed(columns),
            -size * duals[self._rows] / self._size,
            weights,
            self._placed(size * np.array(solution.col_dual)[1:]),
            self._model.getBasis(),
        )

    def _run(self, budget: Budget) -> Any:
        """How it ended; nothing reaches it while it runs, so it comes up for air to be stopped."""
        while True:
            # the limit is of all runs of a model together
            ends = self._model.getRunTime() + min(budget.left, BREATH)
            self._model.setOptionValue("time_limit", ends)
            self._model.run()
            status = self._model.getModelStatus()
            if status != OUT_OF_TIME or budget.late:
                return status

    def _hold(self, zero: set[int]) -> None:
        """Hold these facts at zero, and no others."""
        for fact in self._held - zero:
            self._bound(fact, highspy.kHighsInf)
        for fact in zero - self._held:
            self._bound(fact, -self._constant[fact])
        self._held = zero

    def _bound(self, fact: int, upper: float) -> None:
        self._model.changeRowBounds(int(self._rows[fact]), -self._constant[fact], upper)

    def _bound_units(self, reach: float | Float[np.ndarray, " n"]) -> None:
        ends = np.broadcast_to(reach, self._width)[self._columns]
        for column in range(self._states, len(self._columns)):
            self._model.changeColBounds(1 + column, -ends[column], ends[column])

    def _add_columns(self, count: int, bound: float) -> None:
        if count > 0:
            self._model.addVars(count, np.full(count, -bound), np.full(count, bound))

    def _add_rows(self, lowers: np.ndarray, rows: np.ndarray, least: float) -> None:
        """Add rows that are at least so much, in all of which the least of several counts so much.

        All at once: each time, the model orders all its entries anew.
        """
        given = sp.csr_array(np.c_[np.full(len(rows), least), rows])
        count, starts = len(rows), given.indptr[:-1].astype(np.int32)
        entries = given.nnz, starts, given.indices.astype(np.int32), given.data
        if count:
            self._model.addRows(count, lowers, np.full(count, highspy.kHighsInf), *entries)
        self._count += count


ANSWERS = "Solved", "AlmostSolved"
EMPTY = "PrimalInfeasible", "AlmostPrimalInfeasible"


class ConicPrograms(AbstractPrograms):
    """Second-order cone programs, each stated anew.

    Args:
        states: how many columns are of the initial state.
    """

    def __init__(self, states: int):
        self._clarabel: Any = importlib.import_module("clarabel")  # only where it is needed
        super().__init__(states)
        self._settings = self._clarabel.DefaultSettings()
        self._settings.verbose = False
        self._settings.presolve_enable = False
        self._facts, self._constants = np.zeros((0, states)), np.zeros(0)
        self._size = np.zeros(0)

    def grow(self, facts: AffineForms, columns: Int[np.ndarray, " v"]) -> None:
        """Add the columns and the facts that are new."""
        self._columns, self._width = columns, facts.columns.shape[1]
        self._facts, self._constants, self._size = _of_unit_size(facts, columns)

    def largest(
        self,
        rows: Float[np.ndarray, "r n"],
        constants: Float[np.ndarray, " r"],
        zero: Iterable[int],
        budget: Budget = ENDLESS,
        reach: float | Float[np.ndarray, " n"] = 1.0,
        basis: Any = None,
    ) -> Vertex | None:
        """The largest value of a row, or of the least of several; None where there is no answer."""
        (rows, size), n = self._own(rows), len(self._columns)
        held = np.array(sorted({int(fact) for fact in zero}), dtype=int)
        others = np.setdiff1d(np.arange(len(self._facts)), held)
        # the last variable is the least of the rows
        fixed, signed = (
            np.c_[self._facts[which], np.zeros(len(which))] for which in (held, others)
        )
        compared = np.c_[rows / size, -np.ones(len(rows))]
        units = np.eye(n, n + 1)[self._states :]
        ball = np.vstack([np.zeros(n + 1), np.eye(self._states, n + 1)])
        ends_of_units = np.broadcast_to(reach, self._width)[self._columns[self._states :]]
        parts = fixed, compared, signed, units, -units, ball
        ends = (
            self._constants[held],
            constants / size,
            self._constants[others],
            ends_of_units,
            ends_of_units,
            np.eye(1, self._states + 1)[0],
        )
        if not all(np.isfinite(part).all() for part in (*parts, *ends)):
            return None
        cones = [
            self._clarabel.ZeroConeT(len(fixed)),
            self._clarabel.NonnegativeConeT(sum(map(len, parts[1:-1]))),
            self._clarabel.SecondOrderConeT(len(ball)),
        ]
        self._settings.time_limit = budget.left
        solver = self._clarabel.DefaultSolver(
            sp.csc_array((n + 1, n + 1)),
            -np.eye(1, n + 1, n)[0],
            sp.csc_array(-np.vstack(parts)),
            np.concatenate(ends),
            cones,
            self._settings,
        )
        found = solver.solve()
        duals = np.split(np.array(found.z), np.cumsum([*map(len, parts)])[:-1])
        of_fixed, weights, of_signed, of_upper, of_lower, _ = duals
        multipliers = np.zeros(len(self._facts))
        multipliers[held], multipliers[others] = of_fixed, of_signed
        if str(found.status) in EMPTY:
            return Vertex(-np.inf, np.zeros(0), multipliers / self._size, np.zeros(0), np.zeros(0))
        if str(found.status) not in ANSWERS:
            return None
        columns = np.array(found.x)[:-1]
        reduced = np.zeros(n)
        reduced[self._states :] = of_upper - of_lower
        return Vertex(
            float((constants + rows @ columns).min()),
            self._placed(columns),
            size * multipliers / self._size,
            np.maximum(weights, 0.0) / np.maximum(weights, 0.0).sum(),
            self._placed(size * reduced),
        )

    def forget(self) -> None:
        """Nothing is kept anyhow."""
