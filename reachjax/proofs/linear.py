"""Proofs of facets by affine forms."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Float

from reachjax.loops import ClosedLoop
from reachjax.numerics.checks import floats_of, require_double_precision
from reachjax.numerics.pytrees import pytree, static
from reachjax.programs.unrolled import unrolled
from reachjax.proofs.certificates import AbstractProof
from reachjax.sets import AbstractSet


@pytree
class LinearCertificate(AbstractProof):
    """Proof of the offsets of one step, `directions x[t] <= bounds`, by affine forms from `X0`.

    What it rests on are the slopes of the lines that stand for the units: they and the loop are all
    that the forms are made of.

    Attributes:
        loop: the closed loop.
        X0: the initial set.
        directions: `(f, n_x)`, of the facets.
        slopes: `(k, units)`, of the units at each time before.
        corners: `(f, n_x)`, initial states at which the forms are largest.
        k: how many steps after the initial set.
        start: the time of the initial set.
    """

    loop: ClosedLoop
    X0: AbstractSet
    directions: Float[Array | np.ndarray, "f n_x"]
    slopes: Float[Array | np.ndarray, "k units"]
    corners: Float[Array | np.ndarray, "f n_x"]
    k: int = static()
    start: int = static()

    def __repr__(self) -> str:
        return f"LinearCertificate(facets={len(self.bounds)}, steps={self.k})"

    def recheck(
        self, slopes: Float[np.ndarray, "k units"] | None = None
    ) -> Float[np.ndarray, " f"]:
        """Prove the offsets anew, step by step from the initial set, with these or other slopes.

        Sound for any slopes: where two lines of this slope must lie to hold a unit between them is
        found again on the intervals that are proved on the way. Infinite where they overflow.

        Raises:
            ValueError: the slopes contain NaN or infinity, or have another shape.

        Example:
            >>> from reachjax import MLP, AffinePlant, Box, ClosedLoop, Template
            >>> from reachjax import LinearBounds, reach
            >>> net = MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
            >>> loop = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net)
            >>> tube = reach(loop, Box([-1.0], [2.0]), 2, Template.box(1), LinearBounds())
            >>> proof = tube.proof(2)
            >>> bool((proof.recheck() == proof.bounds).all())
            True
            >>> bool((proof.recheck(-3 * proof.slopes) >= [0.72, 0.36]).all())
            True
        """
        require_double_precision(certificate=floats_of(self))
        chosen = np.asarray(self.slopes if slopes is None else slopes)
        if chosen.shape != self.slopes.shape or not np.isfinite(chosen).all():
            raise ValueError(
                f"slopes must be finite and have shape {self.slopes.shape} (steps, units), "
                f"but {chosen.shape} arrived, {np.isfinite(chosen).sum()} of them finite"
            )
        directions = np.broadcast_to(self.directions, (self.k, *self.directions.shape))
        box = self.X0.bounding_box()
        *_, last = unrolled(self.loop, self.X0, box, directions, self.start, chosen)
        return np.where(np.isnan(last.offsets), np.inf, last.offsets)
