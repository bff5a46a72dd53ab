"""Templates: what the sets that reachability computes look like: polytopes, ellipsoids, or both."""

from __future__ import annotations

import abc
import itertools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.checks import Numbers, is_concrete, require_kind, same_size, whole_number
from reachjax.pytrees import Replaceable, converted, pytree
from reachjax.sets.ellipsoid import Ellipsoid
from reachjax.sets.polytope import Polytope


class AbstractTemplate(Replaceable, abc.ABC):
    """A family of sets, of which reachability finds the smallest that surely hold the states."""

    @property
    @abc.abstractmethod
    def dimension(self) -> int | None:
        """The number of coordinates; None if it is that of the loop."""

    @property
    @abc.abstractmethod
    def summary(self) -> str:
        """A few words for what the sets look like."""


@pytree
class Template(AbstractTemplate):
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

    @property
    def summary(self) -> str:
        """The number of facets."""
        return f"facets={len(self)}"

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


@pytree
class EllipsoidTemplate(AbstractTemplate):
    """Ellipsoids: of minimum volume, the paper's problem (sdp::ellips), or of a given shape.

    Args:
        shape: `(n, n)`, symmetric and positive definite, up to a factor. Only the size is then
            sought, around the successor of the centre; the sets are larger, and their derivatives
            exact. None for the ellipsoid of minimum volume, whose derivative is that of a point
            close to it (see `reachjax.solvers.enclosures`), and whose thinnest half-axis is at
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
    def summary(self) -> str:
        """What they are."""
        return "ellipsoids"


@pytree
class MixedTemplate(AbstractTemplate):
    """Polytopes cut by ellipsoids: both are sought at each step, and their intersection is kept.

    A step solves the programs of both templates, each over the facts of both parts of the set
    before, so that each part is the smaller for the other.

    Args:
        facets: the directions of the polytope.
        ellipsoid: of minimum volume by default.

    Raises:
        TypeError: a part is of another kind.
        ValueError: the dimensions differ.

    Example:
        >>> MixedTemplate(Template.box(2)).summary
        'facets=4, ellipsoids'
    """

    facets: Template
    ellipsoid: EllipsoidTemplate = EllipsoidTemplate()

    def __post_init__(self):
        facets = "a template such as Template.box(n)"
        require_kind("MixedTemplate.facets", self.facets, Template, facets)
        ellipsoid = "a template such as EllipsoidTemplate()"
        require_kind("MixedTemplate.ellipsoid", self.ellipsoid, EllipsoidTemplate, ellipsoid)
        same_size(
            "MixedTemplate.facets has dimension",
            "MixedTemplate.ellipsoid has dimension",
            (self.dimension, self.ellipsoid.dimension or self.dimension),
        )

    @property
    def dimension(self) -> int:
        """The number of coordinates."""
        return self.facets.dimension

    @property
    def summary(self) -> str:
        """What both parts say."""
        return f"{self.facets.summary}, {self.ellipsoid.summary}"


def _signed(rows: np.ndarray) -> np.ndarray:
    """Each row followed by its negative."""
    return np.stack([rows, 0.0 - rows], axis=1).reshape(-1, rows.shape[1])  # 0, not -0
