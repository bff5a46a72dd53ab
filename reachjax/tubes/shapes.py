"""Boxes and ellipsoids as points of a vector space, to be enlarged, moved and differentiated."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from reachjax.sets import Box, Ellipsoid

Kind = Box | Ellipsoid


class Shape(NamedTuple):
    """A box or an ellipsoid as `center + axes s`, over a box or a ball of `s`.

    Attributes:
        center: `(n,)`.
        axes: `(n,)`, half-widths of a box, of which some may be zero: such sides are flat, and
            stay where they are; `(n, n)`, a factor of an ellipsoid's shape.
    """

    center: Float[Array, " n"]
    axes: Float[Array, ...]

    @classmethod
    def of(cls, X: Kind) -> Shape:
        """That of a set."""
        if isinstance(X, Box):
            return cls(jnp.asarray(X.center), jnp.asarray(X.widths) / 2)
        return cls(jnp.asarray(X.center), jnp.linalg.cholesky(jnp.asarray(X.shape)))

    @property
    def sides(self) -> list[int]:
        """Those to be extended, which are not flat: of an ellipsoid, ends of axes."""
        return [side for side in range(2 * len(self.center)) if self.lengths[side // 2] > 0]

    @property
    def lengths(self) -> Float[Array, " n"]:
        """How far it reaches from its center along each coordinate."""
        return self.axes if self.axes.ndim == 1 else jnp.linalg.norm(self.axes, axis=1)

    def set(self) -> Kind:
        """The set.

        Raises:
            ValueError: an entry is not finite, or there is no inside.
        """
        if self.axes.ndim == 1:
            return Box(self.center - self.axes, self.center + self.axes)
        return Ellipsoid(self.center, self.axes @ self.axes.T)

    def support(self, directions: Float[Array, "m n"]) -> Float[Array, " m"]:
        """Upper bounds of directions."""
        if self.axes.ndim == 1:
            return directions @ self.center + abs(directions) @ self.axes
        size = jnp.sqrt(jnp.sum((directions @ self.axes) ** 2, axis=1))
        return directions @ self.center + size

    def log_volume(self) -> Float[Array, ""]:
        """The logarithm of the volume, but for a constant; flat sides do not count."""
        if self.axes.ndim == 1:
            return jnp.sum(jnp.log(jnp.where(self.axes > 0, self.axes, 1.0)))
        return jnp.linalg.slogdet(self.axes)[1]

    def volume(self) -> float:
        """Its volume, flat sides aside; of an ellipsoid, that of the box of its axes."""
        return float(2.0 ** (len(self.sides) // 2) * jnp.exp(self.log_volume()))

    def preconditioned(self, shape: Shape) -> Shape:
        """A gradient at some shape as a direction, in units of its axes."""
        if shape.axes.ndim == 1:
            center, axes = shape.axes**2 * self.center, shape.axes**2 * self.axes
            units = jnp.where(shape.axes > 0, shape.axes, 1.0)
            size = jnp.max(jnp.stack([abs(center), abs(axes)]) / units)
        else:
            Q = shape.axes @ shape.axes.T
            center, axes = Q @ self.center, Q @ self.axes
            both = jnp.column_stack([center, axes])
            size = jnp.max(abs(jnp.linalg.solve(shape.axes, both)))
        return Shape(center / size, axes / size)

    def moved(self, along: Shape, length: float) -> Shape:
        """The shape some way along a direction."""
        return Shape(self.center + length * along.center, self.axes + length * along.axes)

    def enlarged(self, by: float) -> Shape:
        """The same about its center, larger by this part."""
        return Shape(self.center, (1 + by) * self.axes)

    def extended(self, side: int, by: float) -> Shape:
        """The same with one end further out by this part of its axis, the other end as it is."""
        i, sign = side // 2, 1.0 if side % 2 else -1.0
        if self.axes.ndim == 1:
            half = by * self.axes[i] / 2
            return Shape(self.center.at[i].add(sign * half), self.axes.at[i].add(half))
        left, sizes, _ = jnp.linalg.svd(self.axes)
        half = by * sizes[i] / 2
        center = self.center + sign * half * left[:, i]
        return Shape(center, left * sizes.at[i].add(half))
