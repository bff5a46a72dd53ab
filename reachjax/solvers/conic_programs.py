"""Programs over the columns of a horizon from a round initial set, by Clarabel.

As `linear_programs`, with the initial state in an ellipsoid: its columns are in the unit ball, one
second-order cone.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from reachjax.numerics.budget import ENDLESS, Budget
from reachjax.programs.affine import AffineForms
from reachjax.solvers.linear_programs import AbstractPrograms, Vertex

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
        rows, constants = facts.columns[:, columns], facts.rows[:, 0]
        size = np.maximum(abs(rows).max(axis=1, initial=0.0), abs(constants))
        known = np.isfinite(size)
        rows, constants = np.where(known[:, None], rows, 0.0), np.where(known, constants, 0.0)
        self._size = np.where((size > 0) & known, size, 1.0)
        self._facts, self._constants = rows / self._size[:, None], constants / self._size

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
        given = np.zeros((len(rows), self._width))
        given[:, : rows.shape[1]] = rows
        rows, n = given[:, self._columns], len(self._columns)
        size = abs(rows).max(initial=0.0) or 1.0
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
