"""Proofs of ellipsoids."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Array, Float

from reachjax.numerics.pytrees import pytree
from reachjax.proofs.certificates import AbstractCertificate
from reachjax.proofs.recheck import sound_level
from reachjax.sets import NormalForm


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

        Sound for any multipliers; for the certificate's own it is 1 at most.

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
        return np.array([sound_level(program, proposed, form) / level])
