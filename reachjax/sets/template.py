"""Templates: the facet normals of the polytopes that reachability computes."""

from __future__ import annotations

import itertools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.checks import Numbers, is_concrete, whole_number
from reachjax.pytrees import Replaceable, converted, pytree
from reachjax.sets.polytope import Polytope


@pytree
class Template(Replaceable):
    """Facet directions: the matrix `A` of the paper's problem (sdp::poly), whose `b` is sought.

    Args:
        directions: `(m, n)`, one facet normal a row; together they must bound a polytope.

    Raises:
        ValueError: a row is zero or not finite, or the directions leave the polytope unbounded.

    Example:
        >>> Template.octagonal(2).directions.shape
        (8, 2)
    """

    directions: Float[Array, "m n"] = converted(converter=Numbers("(m, n)"))

    def __post_init__(self):
        if is_concrete(self.directions):
            try:
                self.polytope(jnp.ones(len(self))).bounding_box()
            except ValueError as error:
                raise ValueError(f"Template.directions do not bound a set: {error}") from None

    @property
    def dimension(self) -> int:
        """The number of coordinates."""
        return self.directions.shape[1]

    def __len__(self) -> int:
        """The number of facets."""
        return self.directions.shape[0]

    def polytope(self, offsets: Float[Array, " m"]) -> Polytope:
        """The polytope `directions x <= offsets`."""
        return Polytope(self.directions, offsets)

    @classmethod
    def box(cls, dimension: int) -> Template:
        """`+-x_i`: axis-aligned boxes, `2 n` facets."""
        whole_number("dimension", dimension, 1)
        return cls(_signed(np.eye(dimension)))

    @classmethod
    def octagonal(cls, dimension: int) -> Template:
        """`+-x_i` and `+-x_i +- x_j`: `2 n^2` facets; in two dimensions the paper's eight."""
        whole_number("dimension", dimension, 1)
        eye = np.eye(dimension)
        pairs = [
            row
            for i, j in itertools.combinations(range(dimension), 2)
            for row in (eye[i] - eye[j], eye[i] + eye[j])
        ]
        return cls(_signed(np.array([*eye, *pairs])))

    @classmethod
    def regular(cls, facets: int) -> Template:
        """Normals at equal angles in the plane, the first along `x_1`.

        Raises:
            ValueError: fewer than three facets, which bound no set.
        """
        whole_number("facets", facets, 3)
        angles = 2 * np.pi * np.arange(facets) / facets
        return cls(np.stack([np.cos(angles), np.sin(angles)], axis=1))


def _signed(rows: np.ndarray) -> np.ndarray:
    """Each row followed by its negative."""
    return np.stack([rows, 0.0 - rows], axis=1).reshape(-1, rows.shape[1])  # 0, not -0
