"""Proofs of facets."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Array, Float

from reachjax.numerics.pytrees import pytree
from reachjax.proofs.certificates import AbstractCertificate
from reachjax.proofs.proposal import Proposal
from reachjax.proofs.reported import judged_offsets


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
        the matrix inequality misses is paid for.

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
        program = jax.device_get(self.program)
        back = _left_inverse(np.asarray(program.transform))
        moments = back @ np.asarray(self.moments) @ back.T
        claims, codes = np.asarray(self.solver_offsets)[:, None], np.asarray(self.codes)
        proposal = Proposal(claims, proposed, moments, codes, np.asarray(self.seconds))
        return judged_offsets(program, proposal).value


def _left_inverse(T: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "m n"]:
    """A pseudo-inverse of a matrix whose rows and columns may be of very different sizes."""
    rows = _sizes(T, axis=1)
    columns = _sizes(T / rows[:, None], axis=0)
    return np.linalg.pinv(T / rows[:, None] / columns) / rows / columns[:, None]


def _sizes(T: np.ndarray, axis: int) -> np.ndarray:
    size = abs(T).max(axis=axis, initial=0.0)
    return np.where(size > 0, size, 1.0)
