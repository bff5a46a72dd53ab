"""The library's own interior-point methods: `primal_dual`, and `barrier` for ellipsoids."""

from __future__ import annotations

import dataclasses

import numpy as np

from reachjax.numerics.budget import require_memory
from reachjax.numerics.checks import whole_number
from reachjax.numerics.host import all_finite
from reachjax.programs.lmi import Program
from reachjax.programs.presolve import THINNEST, AbstractInequality, Pencil
from reachjax.proofs.proposal import Proposal, SolverStatus
from reachjax.solvers.barrier import FROM_AFAR, WEIGHTS, Barrier
from reachjax.solvers.base import AbstractSolver, Attempt, Found, proposed_by, require_positive
from reachjax.solvers.primal_dual import Instance, minimised

USEFUL = 1e-3
"""A path that is lost at a smaller weight still gives an ellipsoid, looser by that as above."""


@dataclasses.dataclass(frozen=True)
class InteriorPoint(AbstractSolver):
    """The library's own interior-point method: numpy, and fast where there are many neurons.

    Ellipsoids are sought along their central path, which the options have no part in.

    Args:
        tolerance: of residuals and gap, relative, that counts as solved. Iterations go on to a
            thousandth of it as long as they gain, which most programs reach.
        max_iterations: a facet that needs more is reported with status `LIMIT`.

    Raises:
        TypeError: an option is no number.
        ValueError: an option is not positive.

    Example:
        >>> from reachjax import MLP, AffinePlant, Box, ClosedLoop, Template, reach_step
        >>> loop = ClosedLoop(AffinePlant([[0.5]], [[1.0]]), MLP.from_layers([([[0]], [0])]))
        >>> box, facets = Box([1.0], [2.0]), Template.box(1)
        >>> following, certificate = reach_step(loop, box, facets, solver=InteriorPoint())
        >>> following.b.round(6).tolist(), [status.name for status in certificate.statuses]
        ([1.0, -0.5], ['SOLVED', 'SOLVED'])
    """

    tolerance: float = 1e-6
    max_iterations: int = 200

    def __post_init__(self):
        require_positive(self)
        whole_number("InteriorPoint.max_iterations", self.max_iterations, 1)

    def solve(self, program: Program, goal: AbstractInequality) -> Proposal:
        """Propose multipliers, and what is sought, for every program of a goal.

        Raises:
            MemoryError: an iteration would take too much memory.
            TimeOverError: the time in force would be over before the first iterate.
        """
        if not all_finite((goal, program)):
            return Proposal.blank(program, goal)
        pencil = goal.pencil(program)
        attempt = _along_path(pencil) if goal.logarithmic else self._by_iterates(pencil)
        return proposed_by(attempt, program, goal, pencil)

    def _by_iterates(self, pencil: Pencil) -> Attempt:
        """By the primal-dual method, whose matrices are half of the pencil's."""
        count, pairs = pencil.multipliers, len(pencil.normal.generators.left)
        named = f"a program of {count:,} multipliers and {pairs:,} products"
        require_memory(named, count * (pairs + 2 * count), 8 * pairs**2 + count**3 / 3)
        generators = pencil.terms.scaled(np.r_[np.full(count, -1.0), -0.5])
        free, target = np.append(pencil.normal.free, True), float(pencil.sizes[0, 0, 0])

        def attempt(i: int, scale: float) -> tuple[SolverStatus, Found]:
            given = Instance(generators, free, -scale * pencil.constant(i) / 2, target)
            found = minimised(given, self.tolerance, self.max_iterations)
            sought = np.array([found.offset])
            return found.status, Found(sought, 2 * found.multipliers, found.moment)

        return attempt


def _along_path(pencil: Pencil) -> Attempt:
    """By the central path, followed from afar to its end."""

    def attempt(i: int, scale: float) -> tuple[SolverStatus, Found | None]:
        if not (pencil.sizes.any() and pencil.normal.columns.size):
            return SolverStatus.FAILED, None
        barrier = Barrier(pencil)
        end = barrier.path_end(barrier.inside, FROM_AFAR + WEIGHTS)
        if end is None or end.weight > USEFUL:
            return SolverStatus.FAILED, None
        y = end.y[barrier.unknowns]
        if len(y) == 1 and np.linalg.norm(barrier.enlarged(end.y), 2) > 0.5 / THINNEST:
            return SolverStatus.UNBOUNDED, None
        solved = end.weight == WEIGHTS[-1]
        moments = end.weight * barrier.inverse(end.y)
        return (
            SolverStatus.SOLVED if solved else SolverStatus.INACCURATE,
            Found(y, end.y[: pencil.multipliers], moments),
        )

    return attempt
