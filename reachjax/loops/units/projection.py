"""The projection onto a polytope `C u <= d` by its Karush-Kuhn-Tucker conditions.

The point of it that is nearest to `y` is `u = y - C' m` with

    m >= 0,    s = d - C u >= 0,    m_i s_i = 0,

exactly those. With excesses `y' = C y - d` the slacks are `s = C C' m - y'`: multipliers are a
function of excesses alone, the solution of a linear complementarity problem.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from reachjax.loops.units.active_sets import ActiveSets, Cases, Normals, active_sets
from reachjax.loops.units.base import AbstractUnit, AtUnit, Block, Facts, Line, Lines, Mark
from reachjax.loops.units.piecewise import PRODUCTS, ZERO
from reachjax.numerics.rounding import namespace, settled, smaller

ROUNDED = 1e-14
"""Multipliers and slacks that are no more negative than this, in parts of excesses, are not."""


@dataclasses.dataclass(frozen=True)
class ProjectionSlack(AbstractUnit):
    """Multipliers `m` of the facets, given their excesses `y' = C y - d`: `r` numbers each.

    Where more facets meet than there are inputs, multipliers are not unique; these are those of
    linearly independent facets.

    Args:
        normals: `C`, one row a facet.
        offsets: `d` `(r,)`, if they are known. They tell which facets meet, and change no value:
            two units are the same if their normals are.

    Example:
        >>> import jax.numpy as jnp
        >>> triangle = ProjectionSlack(((1.0, 1.0), (-1.0, 0.0), (0.0, -1.0)))
        >>> triangle(jnp.array([1.0, -2.0, -3.0])).tolist()
        [0.5, 0.0, 0.0]
    """

    normals: Normals
    offsets: Any = dataclasses.field(default=None, compare=False, repr=False)

    separable = False

    @classmethod
    def scaled(cls, normals: Any, offsets: Any) -> ProjectionSlack:
        """The unit of facets brought to a size about 1 by powers of two: nothing is rounded."""
        C = np.asarray(normals, float)
        scale = np.ldexp(1.0, -np.frexp(abs(C).max(axis=1))[1])
        return cls(tuple(map(tuple, (scale[:, None] * C).tolist())), scale * offsets)

    @property
    def kind(self) -> ProjectionSlack:
        """The unit without what it knows of offsets."""
        return ProjectionSlack(self.normals)

    @property
    def _sets(self) -> ActiveSets:
        return active_sets(self.normals)

    def __call__(self, y: Float[Array, "*c r"]) -> Float[Array, "*c r"]:
        """The multipliers of the first active set whose multipliers and slacks are not negative."""
        xp, sets, (N, r) = namespace(y), self._sets, self._sets.members.shape
        faces = sets.faces(self.offsets)
        m, s = (
            (y @ matrices.reshape(N * r, r).T).reshape((*y.shape[:-1], N, r))
            for matrices in (sets.multipliers, sets.slacks)
        )
        least = xp.where(sets.members, m, s).min(axis=-1)
        size = abs(y).max(axis=-1, keepdims=True)
        if self.offsets is not None:
            size = size + abs(self.offsets).max()
        least = xp.where(least >= -ROUNDED * size, 0.0, least)
        chosen = xp.where(faces, least, -np.inf).argmax(axis=-1)
        values = (xp.asarray(sets.multipliers)[chosen] @ y[..., None])[..., 0]
        return xp.where(faces.any(), values, np.nan)

    def interval(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """The least and the largest of what active sets allow."""
        return self._cases(lower, upper).interval

    def lines(self, lower: Array, upper: Array) -> Lines:
        """Zero of a facet that surely is inactive; else the better of a chord and a constant."""
        xp, cases = namespace(lower, upper), self._cases(lower, upper)
        (least, most), none = settled(cases.interval), settled(cases.never)
        width, steepest = upper - lower, 1 / self._sets.gram.diagonal()
        chord = settled(smaller(most / xp.where(width > 0, width, 1.0), steepest))
        low, high = cases.rest(chord)
        better = settled(high - low < most - least)
        under, _ = cases.rest(steepest + 0 * chord)
        rising = settled(steepest * (lower + upper) / 2 + under > least)
        above = Line(xp.where(better, chord, 0.0), xp.where(better, high, most))
        below = Line(xp.where(rising, steepest, 0.0), xp.where(rising, under, least))
        return Lines(
            *(Line(*(xp.where(none, 0.0, part) for part in line)) for line in (below, above))
        )

    def remainder(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
        """The least and the largest of what active sets allow."""
        return self._cases(lower, upper).rest(slope)

    def facts(self, y: Any, z: Any, lower: Array, upper: Array) -> Facts:
        """`m >= 0`, `s >= 0`, and what bounds say of both.

        A facet that surely is active has no slack, whatever the others do.
        """
        C, cases = np.array(self.normals), self._cases(lower, upper)
        slack = C @ (C.T @ z) - y
        blocks = (
            Block(z, "output", Mark.SECTOR),
            Block(slack, "slack", Mark.SECTOR),
            Block((-1.0 * settled(cases.always)) * slack, "active", Mark.SECTOR),
            Block(cases.interval[1] - z, "output cap", Mark.BOUND),
            Block(cases.largest_slack - slack, "slack cap", Mark.BOUND),
        )
        return Facts(blocks, ZERO, PRODUCTS)

    def _cases(self, lower: Array, upper: Array) -> Cases:
        return Cases.of(self._sets, self._sets.faces(self.offsets), lower, upper)


def projected(y: Any, normals: Any, offsets: Any, unit: AtUnit) -> Any:
    """The point of `C u <= d` that is nearest to `y`, for any kind of number.

    Args:
        y: `(n,)`.
        normals: `C` `(r, n)`, of numbers.
        offsets: `d` `(r,)`.
        unit: what is done at a unit.

    Example:
        >>> import jax.numpy as jnp
        >>> from reachjax.loops.units import evaluate
        >>> half_plane = [[1.0, 1.0]], jnp.array([1.0])
        >>> projected(jnp.array([2.0, 1.0]), *half_plane, evaluate).tolist()
        [1.0, 0.0]
    """
    facets = ProjectionSlack.scaled(normals, offsets)
    C = np.array(facets.normals)
    m = unit(facets, C @ y - facets.offsets)
    return y - C.T @ m
