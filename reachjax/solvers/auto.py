"""The solver that fits the size of a program."""

from __future__ import annotations

import dataclasses

import numpy as np

from reachjax.numerics.budget import clock
from reachjax.numerics.checks import whole_number
from reachjax.programs.lmi import Program
from reachjax.programs.presolve import AbstractInequality
from reachjax.proofs.proposal import ANSWERS, Proposal, SolverStatus
from reachjax.solvers.base import AbstractSolver, proposed
from reachjax.solvers.clarabel import Clarabel
from reachjax.solvers.interior_point import InteriorPoint


@dataclasses.dataclass(frozen=True)
class Auto(AbstractSolver):
    """Clarabel for small programs and very many products, the interior-point method for others.

    Clarabel's time grows with the entries of the matrix, `n (n + 1) / 2`, the interior-point
    method's with the number of multipliers, so the latter is chosen where these are fewer. For
    facets the choice depends on shapes alone: a program that is solved at once has the same inside
    `jax.jit`, and `choice(certificate.program)` tells which solver its multipliers came from. Under
    `CuttingPlanes` each round has its own.

    Args:
        small: what solves facets of programs up to the limit, and programs of more multipliers
            than entries.
        large: what solves the others.
        limit: the largest basis, with its constant, that counts as small for facets. Measured: per
            facet both take as long at some 25 entries, and a compilation is worth some facets more.

    Raises:
        TypeError: an option is of another kind.
        ValueError: the limit is negative.

    Example:
        >>> from reachjax import MLP, AffinePlant, Box, ClosedLoop, Template, reach_step
        >>> loop = ClosedLoop(AffinePlant([[0.5]], [[1.0]]), MLP.from_layers([([[0]], [0])]))
        >>> _, proof = reach_step(loop, Box([1.0], [2.0]), Template.box(1), solver=Auto())
        >>> type(Auto().choice(proof.program)).__name__
        'Clarabel'
    """

    small: AbstractSolver = Clarabel()  # noqa: RUF009  (immutable)
    large: AbstractSolver = InteriorPoint()  # noqa: RUF009
    limit: int = 32

    def __post_init__(self):
        for name in ("small", "large"):
            if not isinstance(getattr(self, name), AbstractSolver):
                raise TypeError(
                    f"Auto.{name} must be a solver, but {getattr(self, name)!r} arrived"
                )
        whole_number("Auto.limit", self.limit, 0)

    def choice(self, program: Program) -> AbstractSolver:
        """What solves the facets of this program."""
        size, count = len(program.transform), len(program.products.free)
        return self.large if size > self.limit and _is_lean(count, size) else self.small

    def solve(self, program: Program, goal: AbstractInequality) -> Proposal:
        """Propose multipliers, and what is sought, for every program of a goal.

        For ellipsoids the program counts without what is unused, and where the one that is chosen
        fails, the other is asked.
        """
        if not goal.logarithmic:
            return self.choice(program).solve(program, goal)
        pencil = goal.pencil(program)
        if _is_lean(pencil.multipliers, pencil.size):
            first, second, enough = self.large, self.small, (SolverStatus.SOLVED,)
        else:  # an inaccurate ellipsoid is centred anyhow
            first, second, enough = self.small, self.large, ANSWERS
        found = proposed(first, program, goal)
        if np.isin(found.statuses, enough).all() or clock().late:
            return found
        other = proposed(second, program, goal)
        return other if np.isin(other.statuses, ANSWERS).all() else found


def _is_lean(multipliers: int, size: int) -> bool:
    """Whether there are fewer multipliers than entries of a symmetric matrix."""
    return multipliers < size * (size + 1) / 2
