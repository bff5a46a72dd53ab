"""A primal-dual interior-point method made for the program of a facet, in JAX.

Cones of general conic solvers hold a dense block of `n (n + 1) / 2` rows for a matrix inequality of
size `n`. Here a multiplier's matrix is a product of two rows, so Gram matrices of rows are enough
(`generators`), and an iteration costs `O(n^3)`. It runs on plain arrays and inside `jax.jit`,
`jax.grad` and `jax.lax.scan` alike; ellipsoids are sought on the host (`centring`).
"""

from __future__ import annotations

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np

from reachjax.numerics.checks import is_concrete, require_double_precision, whole_number
from reachjax.programs.lmi import Program
from reachjax.programs.trimming import trimmed
from reachjax.sets import NormalForm
from reachjax.solvers.arrangement import arranged, cut
from reachjax.solvers.base import AbstractSolver, require_positive
from reachjax.solvers.centring import enclosed
from reachjax.solvers.facets import solve_facets
from reachjax.solvers.proposals import Enclosure, Solution


@dataclasses.dataclass(frozen=True)
class InteriorPoint(AbstractSolver):
    """The library's own interior-point method: JAX, and fast where there are many neurons.

    It compiles once for each of a few padded sizes; on the CPU facets are solved one by one.
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
        """Propose multipliers for every facet, from a program cut to what it uses.

        Raises:
            RuntimeError: JAX's 64-bit floats are off.
        """
        require_double_precision()
        facets, solution = len(program.objective.mid), Solution.blank_for(program)
        given = trimmed(program)
        layout = cut(arranged(given, program.products))
        generators, count = jax.device_put(layout.generators), len(layout.columns)
        used = np.ix_(layout.columns, layout.columns)
        for here in _batches(facets):
            began = time.perf_counter()
            rows = layout.objective[here]
            found = jax.device_get(_run(generators, rows, self.tolerance, self.max_iterations))
            solution.seconds[here] = (time.perf_counter() - began) / len(rows)
            solution.statuses[here] = found.status
            solution.offsets[here] = given.centers[here] + given.units[here] * found.offset
            factors = 2 * given.units[here, None] * layout.scale
            multipliers = factors * found.multipliers[:, : len(layout.scale)]
            solution.multipliers[here, layout.order] = multipliers
            for i, moment in zip(range(facets)[here], found.moment, strict=True):
                if np.isfinite(moment).all():
                    solution.moments[i] = 0.0
                    solution.moments[i][used] = moment[-count:, -count:]
        return solution

    def propose(self, program: Program) -> Solution:
        """Propose multipliers for every facet; traced where the program is, at its full shape.

        Inside `jax.jit` one multiplier at most may weigh more than two products (an ellipsoid's
        does); others are left out there. Seconds are NaN.
        """
        if is_concrete(program):
            return super().propose(program)
        given = trimmed(program)
        extra = len(program.products.left) - len(program.products.free)
        layout = arranged(given, program.products, 1 + (extra > 0), int(extra > 1))
        found = solve_facets(
            layout.generators, layout.objective, self.tolerance, self.max_iterations
        )
        count = len(layout.order)
        factors = 2 * given.units[:, None] * layout.scale
        ordered = jnp.where(jnp.isfinite(factors), factors, 0.0) * found.multipliers[:, :count]
        used = 1 - layout.generators.idle
        return Solution(
            offsets=given.centers + given.units * found.offset,
            multipliers=jnp.zeros_like(ordered).at[:, layout.order].set(ordered),
            moments=found.moment * used[:, None] * used,
            statuses=found.status,
            seconds=jnp.full_like(given.units, jnp.nan),
        )

    def enclose(self, program: Program, form: NormalForm | None = None) -> Enclosure:
        """Propose the smallest ellipsoid around the successors, and its multipliers.

        Its central path is followed to its end, on the host (`barrier`).
        """
        return enclosed(program, form)


_run = jax.jit(solve_facets)


def _batches(facets: int) -> list[slice]:
    """One facet at a time on a CPU, which compiles once for any number of them; else all."""
    if jax.default_backend() == "cpu":
        return [slice(i, i + 1) for i in range(facets)]
    return [slice(0, facets)]
