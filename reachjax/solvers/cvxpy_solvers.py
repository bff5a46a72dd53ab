"""Conic solvers by name: SCS, and any other that cvxpy knows."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from reachjax.numerics.budget import clock
from reachjax.solvers.base import require_positive
from reachjax.solvers.conic import AbstractConicSolver

LEAST = 1e-3
"""Seconds: to SCS zero is no limit."""


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
