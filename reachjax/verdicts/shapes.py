"""Boxes and ellipsoids as points of a vector space, to be enlarged, moved and differentiated.

All of it is numpy: values that cost thousands of evaluations are had without a compilation.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from reachjax.sets import Box, Ellipsoid

Kind = Box | Ellipsoid

STEP = 1e-7
"""The step of difference quotients, in parts of the axes: rounding leaves half of the digits."""


class Shape(NamedTuple):
    """A box or an ellipsoid as `center + axes s`, over a box or a ball of `s`.

    Attributes:
        center: `(n,)`.
        axes: `(n,)`, half-widths of a box, of which some may be zero: such sides are flat, and
            stay where they are; `(n, n)`, a factor of an ellipsoid's shape.
    """

    center: Float[np.ndarray, " n"]
    axes: Float[np.ndarray, ...]

    @classmethod
    def of(cls, X: Kind) -> Shape:
        """The shape of a set."""
        if isinstance(X, Box):
            return cls(np.asarray(X.center), np.asarray(X.widths) / 2)
        return cls(np.asarray(X.center), np.linalg.cholesky(np.asarray(X.shape)))

    @property
    def sides(self) -> list[int]:
        """The sides to be extended, which are not flat: of an ellipsoid, ends of axes."""
        return [side for side in range(2 * len(self.center)) if self.lengths[side // 2] > 0]

    @property
    def lengths(self) -> Float[np.ndarray, " n"]:
        """How far it reaches from its center along each coordinate."""
        return self.axes if self.axes.ndim == 1 else np.linalg.norm(self.axes, axis=1)

    def set(self) -> Kind:
        """The set.

        Raises:
            ValueError: an entry is not finite, or there is no inside.
        """
        if self.axes.ndim == 1:
            return Box(self.center - self.axes, self.center + self.axes)
        return Ellipsoid(self.center, self.axes @ self.axes.T)

    def support(self, directions: Float[np.ndarray, "m n"]) -> Float[np.ndarray, " m"]:
        """Upper bounds of directions."""
        if self.axes.ndim == 1:
            return directions @ self.center + abs(directions) @ self.axes
        size = np.sqrt(np.sum((directions @ self.axes) ** 2, axis=1))
        return directions @ self.center + size

    def log_volume(self) -> float:
        """The logarithm of the volume, but for a constant; flat sides do not count."""
        if self.axes.ndim == 1:
            return float(np.sum(np.log(np.where(self.axes > 0, self.axes, 1.0))))
        return float(np.linalg.slogdet(self.axes)[1])

    def volume(self) -> float:
        """The volume, flat sides aside; of an ellipsoid, that of the box of its axes."""
        return float(2.0 ** (len(self.sides) // 2) * np.exp(self.log_volume()))

    def uphill(self, value: Callable[[Shape], float], here: float) -> Shape:
        """A direction in which a value grows, of length one in units of the axes.

        It is the gradient in these units, by difference quotients; of an ellipsoid along its center
        and the symmetric factors of its axes, since turning them changes nothing. Where the value
        is not finite there is no slope.

        Args:
            value: of shapes.
            here: its value at this one.
        """

        def slope(center: np.ndarray, axes: np.ndarray) -> float:
            moved = Shape(self.center + STEP * center, self.axes + STEP * axes)
            found = (value(moved) - here) / STEP
            return found if np.isfinite(found) else 0.0

        n, still = len(self.center), np.zeros_like(self.axes)
        if self.axes.ndim == 1:
            along = np.diag(self.axes)[self.axes > 0]
            center, axes = np.zeros(n), np.zeros(n)
            for each in along:
                center = center + slope(each, still) * each
                axes = axes + slope(np.zeros(n), each) * each
            units = np.where(self.axes > 0, self.axes, 1.0)
            size = np.max(abs(np.stack([center, axes])) / units, initial=0.0)
        else:
            moves, factors = np.zeros(n), np.zeros((n, n))
            for i in range(n):
                moves[i] = slope(self.axes[:, i], still)
            for i, j in itertools.combinations_with_replacement(range(n), 2):
                factor = np.zeros((n, n))
                factor[i, j] = factor[j, i] = 1.0
                share = 1.0 if i == j else 0.5
                factors[i, j] = factors[j, i] = share * slope(np.zeros(n), self.axes @ factor)
            center, axes = self.axes @ moves, self.axes @ factors
            size = np.max(abs(np.column_stack([moves, factors])))
        size = size or 1.0
        return Shape(center / size, axes / size)

    def moved(self, along: Shape, length: float) -> Shape:
        """The shape some way along a direction."""
        return Shape(self.center + length * along.center, self.axes + length * along.axes)

    def enlarged(self, by: float) -> Shape:
        """The shape about its center, larger by this part."""
        return Shape(self.center, (1 + by) * self.axes)

    def extended(self, side: int, by: float) -> Shape:
        """The shape with one end further out by this part of its axis, the other end as it is."""
        i, sign = side // 2, 1.0 if side % 2 else -1.0
        if self.axes.ndim == 1:
            own, half = np.eye(len(self.axes))[i], by * self.axes[i] / 2
            return Shape(self.center + sign * half * own, self.axes + half * own)
        left, sizes, _ = np.linalg.svd(self.axes)
        half = by * sizes[i] / 2
        center = self.center + sign * half * left[:, i]
        return Shape(center, left * (sizes + half * np.eye(len(sizes))[i]))
