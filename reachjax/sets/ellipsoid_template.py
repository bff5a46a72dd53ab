"""Templates whose sets are ellipsoids."""

from __future__ import annotations

from typing import Self

import jax.numpy as jnp
from jaxtyping import Array, Float

from reachjax.numerics.checks import Numbers, is_concrete
from reachjax.numerics.pytrees import converted, pytree
from reachjax.sets.ellipsoid import Ellipsoid
from reachjax.sets.template import AbstractTemplate


@pytree
class EllipsoidTemplate(AbstractTemplate):
    """Ellipsoids: of minimum volume, the paper's problem (sdp::ellips), or of a given shape.

    Args:
        shape: `(n, n)`, symmetric and positive definite, up to a factor. Only the size is then
            sought, around the successor of the centre; the sets are larger, and their derivatives
            exact. None for the ellipsoid of minimum volume, whose derivative is that of a point
            close to it (see `reachjax.solvers.least_volume`), and whose thinnest half-axis is at
            least some 1e-8 of the others: around a flat set there is no least one.

    Raises:
        ValueError: `shape` is not square, symmetric and positive definite.

    Example:
        >>> EllipsoidTemplate(shape=[[4.0, 0.0], [0.0, 1.0]]).dimension
        2
    """

    shape: Float[Array, "n n"] | None = converted(converter=Numbers("(n, n)"), default=None)

    def __post_init__(self):
        if self.shape is not None and is_concrete(self.shape):
            try:
                Ellipsoid(jnp.zeros(len(self.shape)), self.shape)
            except ValueError as error:
                message = str(error).replace("Ellipsoid.", "EllipsoidTemplate.")
                raise ValueError(message) from None

    @property
    def dimension(self) -> int | None:
        """The number of coordinates; None if any shape will do."""
        return None if self.shape is None else len(self.shape)

    @property
    def parts(self) -> tuple[None, Self]:
        """No facets, and the template itself."""
        return None, self

    @property
    def summary(self) -> str:
        """What they are."""
        return "ellipsoids"
