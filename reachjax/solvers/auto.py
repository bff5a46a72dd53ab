"""The solver that fits the size of a program."""

from __future__ import annotations

import dataclasses

from reachjax.checks import whole_number
from reachjax.lmi import Program
from reachjax.sets import NormalForm
from reachjax.solvers.base import AbstractSolver, Enclosure, Solution, SolverStatus
from reachjax.solvers.interior_point import InteriorPoint
from reachjax.solvers.named import Clarabel


@dataclasses.dataclass(frozen=True)
class Auto(AbstractSolver):
    """Clarabel for the facets of small programs, the interior-point method for all else.

    The choice depends on the size of the basis alone, so that it is the same inside `jax.jit`, and
    `choice(certificate.program)` tells which solver a certificate's multipliers came from.

    Args:
        small: what solves programs up to the limit.
        large: what solves larger ones.
        limit: the largest basis, with its constant, that counts as small. Measured: per facet both
            take as long at some 25 entries, and a compilation is worth some facets more.

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
        return self.large if len(program.transform) > self.limit else self.small

    def solve(self, program: Program) -> Solution:
        """Propose multipliers for every facet."""
        return self.choice(program).solve(program)

    def propose(self, program: Program) -> Solution:
        """Propose multipliers for every facet; traced where the program is."""
        return self.choice(program).propose(program)

    def enclose(self, program: Program, form: NormalForm | None = None) -> Enclosure:
        """Propose the smallest ellipsoid around the successors, and its multipliers.

        The `small` solver is asked where the `large` one ends without.
        """
        found = self.large.enclose(program, form)
        return found if found.status == SolverStatus.SOLVED else self.small.enclose(program, form)
