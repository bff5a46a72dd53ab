"""Proofs of ellipsoids."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Float

from reachjax.numerics.pytrees import pytree
from reachjax.programs.lmi import Program
from reachjax.proofs.certificates import AbstractCertificate
from reachjax.proofs.proposal import Enclosure
from reachjax.proofs.recheck import sound_level
from reachjax.sets import Ellipsoid, NormalForm


@pytree
class EllipsoidCertificate(AbstractCertificate):
    """Proof of the ellipsoid of one step, `|A x[t] + b| <= 1`: one program, so `f = 1`.

    What is bounded, by 1, is `|A x[t] + b|`.

    Attributes:
        form: `A` and `b` of the set.
    """

    form: NormalForm

    @classmethod
    def from_enclosure(
        cls, program: Program, region: Ellipsoid, enclosure: Enclosure
    ) -> EllipsoidCertificate:
        """What was proved with what a solver proposed; witnesses are not known yet (NaN)."""
        T, n = program.transform, len(program.transform)
        moments = enclosure.moments[:n, :n] / enclosure.moments[n - 1, n - 1]
        return cls(
            program=program,
            form=region.normal_form,
            multipliers=enclosure.multipliers[None],
            moments=(T @ moments @ T.T)[None],
            codes=enclosure.status[None],
            bounds=np.ones(1),
            witnesses=np.full(1, np.nan),
            witness_states=np.full((1, 0), np.nan),
            seconds=enclosure.seconds[None],
        )

    def __repr__(self) -> str:
        return f"EllipsoidCertificate(products={self.multipliers.shape[-1]})"

    def recheck(
        self, multipliers: Float[np.ndarray, "1 K"] | None = None
    ) -> Float[np.ndarray, " 1"]:
        """What `|A x + b|` surely does not exceed, by these or other multipliers.

        Sound for any multipliers; for the certificate's own it is 1 at most, but for rounding.

        Raises:
            ValueError: the multipliers contain NaN or infinity, or have another shape.

        Example:
            >>> from reachjax import AffinePlant, ClosedLoop, EllipsoidTemplate, MLP, reach_step
            >>> loop = ClosedLoop(AffinePlant([[0.5]], [[1.0]]), MLP.from_layers([([[0]], [0])]))
            >>> X0 = Ellipsoid([1.0], [[1.0]])
            >>> following, certificate = reach_step(loop, X0, EllipsoidTemplate())
            >>> following.shape.round(6).tolist(), certificate.recheck().round(6).tolist()
            ([[0.25]], [1.0])
        """
        proposed = self._proposed(multipliers)
        form = jax.device_get(self.form)
        return np.array([sound_level(jax.device_get(self.program), proposed[0], form)])
