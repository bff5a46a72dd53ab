"""Proofs by products of facts: of facets, of ellipsoids, and of intersections of both."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.numerics.pytrees import pytree
from reachjax.programs.lmi import Program
from reachjax.proofs.certificates import AbstractCertificate
from reachjax.proofs.recheck import proved_offsets, sound_level
from reachjax.sets import NormalForm


@pytree
class Certificate(AbstractCertificate):
    """Proof of the offsets of one step, `directions x[t] <= bounds`: one program a facet.

    Attributes:
        solver_offsets: `(f,)`, what the solver itself claimed; not bounds.
    """

    solver_offsets: Float[Array | np.ndarray, " f"]

    def __repr__(self) -> str:
        return f"Certificate(facets={len(self.bounds)}, products={self.multipliers.shape[-1]})"

    def recheck(
        self, multipliers: Float[np.ndarray, "f K"] | None = None
    ) -> Float[np.ndarray, " f"]:
        """Prove the offsets anew, from the program and these or other multipliers.

        Sound for any multipliers: negative ones are clipped where the sign matters, and what
        the matrix inequality misses is paid for. The certificate's own prove its bounds, or a
        little less than a bound that stays at the relaxation's optimum.

        Raises:
            ValueError: the multipliers contain NaN or infinity, or have another shape.

        Example:
            >>> from reachjax import MLP, AffinePlant, Box, ClosedLoop, Template, reach_step
            >>> loop = ClosedLoop(AffinePlant([[0.5]], [[1.0]]), MLP.from_layers([([[0]], [0])]))
            >>> _, certificate = reach_step(loop, Box([1.0], [2.0]), Template.box(1))
            >>> certificate.recheck().round(6).tolist()
            [1.0, -0.5]
            >>> garbage = -certificate.multipliers
            >>> bool((certificate.recheck(garbage) >= [1.0, -0.5]).all())
            True
        """
        proposed = self._proposed(multipliers)
        return proved_offsets(jax.device_get(self.program), proposed)


@pytree
class EllipsoidCertificate(AbstractCertificate):
    """Proof of the ellipsoid of one step, `|A x[t] + b| <= s`: one program, so `f = 1`.

    The set holds that ellipsoid; what is bounded, by 1, is `|A x[t] + b| / s`. `A` and `b` are
    those of the proof: from centre and shape of the set others would follow, in which the same
    numbers round otherwise.

    Attributes:
        form: `A` and `b`.
        level: `s`.
    """

    form: NormalForm
    level: Float[Array | np.ndarray, ""]

    def __repr__(self) -> str:
        return f"EllipsoidCertificate(products={self.multipliers.shape[-1]})"

    def recheck(
        self, multipliers: Float[np.ndarray, "1 K"] | None = None
    ) -> Float[np.ndarray, " 1"]:
        """What `|A x + b| / s` surely does not exceed, by these or other multipliers.

        Sound for any multipliers; for the certificate's own it is 1 at most. Infinite unless `s` is
        positive and finite.

        Raises:
            ValueError: the multipliers contain NaN or infinity, or have another shape.

        Example:
            >>> from reachjax import AffinePlant, ClosedLoop, Ellipsoid, EllipsoidTemplate, MLP
            >>> from reachjax import reach_step
            >>> loop = ClosedLoop(AffinePlant([[0.5]], [[1.0]]), MLP.from_layers([([[0]], [0])]))
            >>> X0 = Ellipsoid([1.0], [[1.0]])
            >>> following, certificate = reach_step(loop, X0, EllipsoidTemplate())
            >>> following.shape.round(6).tolist(), certificate.recheck().round(6).tolist()
            ([[0.25]], [1.0])
        """
        proposed = self._proposed(multipliers)
        program, form, level = jax.device_get((self.program, self.form, self.level))
        if not 0 < level < np.inf:
            return np.array([np.inf])
        return np.array([sound_level(program, proposed, form) / level])


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
