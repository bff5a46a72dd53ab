"""Polytopes in facet form."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from reachjax.numerics.checks import (
    Numbers,
    is_concrete,
    require_double_precision,
    require_exact,
    same_size,
)
from reachjax.numerics.pytrees import converted, pytree
from reachjax.sets import hulls, supports
from reachjax.sets.base import Box, PolyhedralSet

EXACT_DIMENSIONS = 4
"""Beyond so many, corners multiply too fast for a volume that is computed at every step."""


@pytree
class Polytope(PolyhedralSet):
    """The polytope `A x <= b` (the paper's proposition 1).

    It may be unbounded, such as a half-space to be avoided; what needs corners, a volume or a
    support function then says so. Supports and bounding boxes come from linear programs on the
    host, also inside `jax.jit`, where they are NaN of a set that has none; corners, samples and the
    volume are not for use there.

    Args:
        A: `(m, n)`, one facet normal a row, none of them zero.
        b: `(m,)`, the offsets.

    Raises:
        ValueError: sizes differ, an entry is not finite, or a row of `A` is zero.

    Example:
        >>> diamond = Polytope([[1, 1], [1, -1], [-1, 1], [-1, -1]], [1, 1, 1, 1])
        >>> round(diamond.volume(), 6)
        2.0
    """

    A: Float[Array, "m n"] = converted(converter=Numbers("(m, n)"))
    b: Float[Array, " m"] = converted(converter=Numbers("(m,)"))
    needs_programs = True

    def __post_init__(self):
        A, b = self.A, self.b
        same_size("Polytope.A has a number of rows of", "Polytope.b has length", (len(A), len(b)))
        if is_concrete(A) and not np.all(np.any(np.asarray(A) != 0, axis=1)):
            row = int(np.argmin(np.any(np.asarray(A) != 0, axis=1)))
            raise ValueError(f"row {row} of Polytope.A is zero: it is no facet")

    @classmethod
    def between(cls, lower: ArrayLike, upper: ArrayLike) -> Polytope:
        """A box some of whose sides may be infinite, such as one for a specification.

        Args:
            lower: `(n,)`; minus infinity where there is no side.
            upper: `(n,)`; infinity where there is none.

        Raises:
            TypeError: an entry is no real number.
            ValueError: float64 does not hold an entry, sizes differ, an entry is NaN,
                `lower > upper` in a coordinate, an infinite side leaves no point, or no side is
                finite.

        Example:
            >>> Polytope.between([0.0, -np.inf], [1.0, np.inf]).contains([0.5, 1e9]).item()
            True
        """
        for name, end in (("lower", lower), ("upper", upper)):
            try:
                require_exact(end, name)
            except TypeError as error:
                raise TypeError(f"{name} must be real numbers, but {error}") from None
        ends = [np.asarray(each, float) for each in (lower, upper)]
        if ends[0].ndim != 1 or ends[0].shape != ends[1].shape:
            raise ValueError(
                "lower and upper must be vectors of one length, but of shapes "
                f"{ends[0].shape} and {ends[1].shape} they arrived"
            )
        if not np.all(ends[0] <= ends[1]):
            raise ValueError(f"lower must not be above upper, but {lower} and {upper} arrived")
        if np.any(ends[0] == np.inf) or np.any(ends[1] == -np.inf):
            raise ValueError(
                "lower must be below infinity, and upper above minus infinity, but "
                f"{lower} and {upper} arrived"
            )
        eye = np.eye(len(ends[0]))
        A, b = np.vstack([eye, -eye]), np.hstack([ends[1], -ends[0]])
        finite = np.isfinite(b)
        if not finite.any():
            raise ValueError(
                "lower and upper must have a finite entry, but all of them are infinite"
            )
        return cls(A[finite], b[finite])

    @property
    def dimension(self) -> int:
        """The number of coordinates."""
        return self.A.shape[1]

    @property
    def facets(self) -> tuple[Float[Array, "m n"], Float[Array, " m"]]:
        """The pair `(A, b)`."""
        return self.A, self.b

    def _host(self) -> tuple[np.ndarray, np.ndarray]:
        return np.asarray(self.A, dtype=float), np.asarray(self.b, dtype=float)

    def support(self, directions: Float[ArrayLike, "m n"]) -> Float[Array, " m"]:
        """Upper bounds of `max a . x`, exact to rounding (rebuilt from dual multipliers).

        Raises:
            ValueError: the polytope is empty or unbounded.
        """
        return supports.support(self.A, self.b, self._directions(directions))

    def bounding_box(self) -> Box:
        """The smallest box around the polytope.

        Raises:
            ValueError: the polytope is empty or unbounded.
        """
        require_double_precision(set=self)
        return Box(*supports.bounding_box(self.A, self.b))

    def cut(self, box: Box) -> Polytope:
        """The points that lie in a box as well."""
        (A, b), (C, d) = self.facets, box.facets
        return Polytope(jnp.concatenate([A, C]), jnp.concatenate([b, d]))

    def vertices(self) -> Float[Array, "v n"]:
        """The corners, in any dimension, flat polytopes included (Qhull).

        Raises:
            ValueError: the polytope is empty or unbounded.
        """
        return jnp.asarray(hulls.vertices(*self._host()))

    def sample(self, key: PRNGKeyArray, count: int) -> Float[Array, "count n"]:
        """Points drawn uniformly, by a triangulation of the corners."""
        seed = np.asarray(jax.random.bits(key, (4,), dtype=jnp.uint32))
        rng = np.random.default_rng(seed.tolist())
        return jnp.asarray(hulls.uniform(*self._host(), rng, count))

    def volume(self) -> float:
        """The `n`-dimensional volume; zero for a flat polytope (Qhull)."""
        return hulls.volume(*self._host())

    def size(self) -> Float[Array, ""]:
        """The volume; beyond four dimensions, that of the bounding box. Differentiable."""
        if self.dimension <= EXACT_DIMENSIONS:
            return supports.volume(self.A, self.b)
        return jnp.prod(self.bounding_box().widths)
