"""Proofs of intersections of facets and an ellipsoid."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.numerics.pytrees import pytree
from reachjax.programs.lmi import Program
from reachjax.proofs.certificates import AbstractCertificate
from reachjax.proofs.ellipsoids import EllipsoidCertificate
from reachjax.proofs.facets import Certificate
from reachjax.sets import NormalForm


@pytree
class MixedCertificate(AbstractCertificate):
    """Proof of the intersection of one step, the `m` facets first: `f = m + 1` programs.

    The rows of the program's objective are the facets', and then those of the successor.

    Attributes:
        solver_offsets: `(m,)`, what the solver itself claimed for the facets; not bounds.
        form: `A` and `b` of the ellipsoid `|A x[t] + b| <= s`.
        level: `s`.
    """

    solver_offsets: Float[Array | np.ndarray, " m"]
    form: NormalForm
    level: Float[Array | np.ndarray, ""]

    @classmethod
    def joining(
        cls, program: Program, facets: Certificate, ellipsoid: EllipsoidCertificate
    ) -> MixedCertificate:
        """The proofs of both parts as one.

        Args:
            program: that of all objective rows; where the parts have other products than its own,
                it gets theirs, the facets' first.
            facets: the proof of the facets.
            ellipsoid: that of the ellipsoid.
        """
        if facets.program.products is not ellipsoid.program.products:
            program, facets, ellipsoid = _with_all_products(program, facets, ellipsoid)
        each = facets.of_programs(), ellipsoid.of_programs()
        return cls(
            program=program,
            **jax.tree.map(lambda *both: jnp.concatenate(both), *each),
            solver_offsets=facets.solver_offsets,
            form=ellipsoid.form,
            level=ellipsoid.level,
        )

    @property
    def parts(self) -> tuple[Certificate, EllipsoidCertificate]:
        """The proof of the facets, and that of the ellipsoid."""
        m = len(self.solver_offsets)
        first, second = slice(m), slice(m, None)
        facets = Certificate(
            program=self.program.with_objective(first),
            **self.of_programs(first),
            solver_offsets=self.solver_offsets,
        )
        ellipsoid = EllipsoidCertificate(
            program=self.program.with_objective(second),
            **self.of_programs(second),
            form=self.form,
            level=self.level,
        )
        return facets, ellipsoid

    def __repr__(self) -> str:
        facets, products = len(self.solver_offsets), self.multipliers.shape[-1]
        return f"MixedCertificate(facets={facets}, products={products})"

    def recheck(
        self, multipliers: Float[np.ndarray, "m+1 K"] | None = None
    ) -> Float[np.ndarray, " m+1"]:
        """Prove the offsets, and what `|A x + b| / s` does not exceed, as the parts' proofs do.

        Sound for any multipliers.

        Raises:
            ValueError: the multipliers contain NaN or infinity, or have another shape.

        Example:
            >>> from reachjax import MLP, AffinePlant, Box, ClosedLoop, MixedTemplate, Template
            >>> from reachjax import reach_step
            >>> loop = ClosedLoop(AffinePlant([[0.5]], [[1.0]]), MLP.from_layers([([[0]], [0])]))
            >>> template = MixedTemplate(Template.box(1))
            >>> _, certificate = reach_step(loop, Box([1.0], [2.0]), template)
            >>> certificate.recheck().round(6).tolist()
            [1.0, -0.5, 1.0]
        """
        proposed, m = self._proposed(multipliers), len(self.solver_offsets)
        facets, ellipsoid = self.parts
        return np.concatenate([facets.recheck(proposed[:m]), ellipsoid.recheck(proposed[m:])])


def _with_all_products(
    program: Program, facets: Certificate, ellipsoid: EllipsoidCertificate
) -> tuple[Program, Certificate, EllipsoidCertificate]:
    """The program with the products of both parts, and the parts with multipliers for all."""
    first, second = facets.program.products, ellipsoid.program.products
    counts = len(first.free), len(second.free)
    moved = second.replace(multiplier=counts[0] + second.multiplier)
    products = jax.tree.map(lambda *part: jnp.concatenate(part), first, moved)
    return (
        program.replace(facts=facets.program.facts, products=products),
        facets.replace(multipliers=jnp.pad(facets.multipliers, ((0, 0), (0, counts[1])))),
        ellipsoid.replace(multipliers=jnp.pad(ellipsoid.multipliers, ((0, 0), (counts[0], 0)))),
    )
