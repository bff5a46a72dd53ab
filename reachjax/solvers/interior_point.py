"""The library's own interior-point methods: facets (`primal_dual`) and ellipsoids (`centring`)."""

from __future__ import annotations

import dataclasses
import time

import numpy as np

from reachjax.numerics.budget import clock, require_memory
from reachjax.numerics.checks import whole_number
from reachjax.programs.lmi import Program
from reachjax.programs.presolve import presolved
from reachjax.proofs.proposal import Enclosure, Solution, SolverStatus
from reachjax.sets import NormalForm
from reachjax.solvers.base import AbstractSolver, require_positive
from reachjax.solvers.centring import enclosed
from reachjax.solvers.primal_dual import minimised


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

    def solve(self, program: Program) -> Solution:
        """Propose multipliers for every facet.

        Raises:
            MemoryError: an iteration would take too much memory.
            TimeOverError: the time in force would be over before the first iterate.
        """
        facets, size = program.objective.mid.shape
        solution = Solution.blank(facets, len(program.products.free), size)
        reduced = presolved(program)
        count, pairs = reduced.generators.size, len(reduced.generators.left)
        named = f"a program of {count:,} multipliers and {pairs:,} products"
        require_memory(named, count * (pairs + 2 * count), 8 * pairs**2 + count**3 / 3)
        used = np.ix_(reduced.columns, reduced.columns)
        for i, row in enumerate(reduced.objective):
            if clock().late:
                solution.statuses[i:] = SolverStatus.LIMIT
                break
            began = time.perf_counter()
            given = reduced.generators, reduced.free, row
            found = minimised(*given, self.tolerance, self.max_iterations)
            solution.seconds[i] = time.perf_counter() - began
            solution.statuses[i] = found.status
            solution.offsets[i] = reduced.centers[i] + reduced.units[i] * found.offset
            # twice: the method's objective is half of `p e' + e p'`
            multipliers = 2 * reduced.units[i] * found.multipliers / reduced.norms
            solution.multipliers[i, reduced.kept] = multipliers
            if np.isfinite(found.moment).all():
                solution.moments[i] = 0.0
                solution.moments[i][used] = found.moment
        return solution

    def enclose(self, program: Program, form: NormalForm | None = None) -> Enclosure:
        """Propose the smallest ellipsoid around the successors, and its multipliers.

        Its central path is followed to its end, on the host (`barrier`).
        """
        return enclosed(program, form)
