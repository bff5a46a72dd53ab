"""Templates: what the sets that reachability computes look like: polytopes, ellipsoids, or both."""

from __future__ import annotations

import abc
from typing import Protocol, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from reachjax.numerics.checks import (
    Numbers,
    described,
    is_concrete,
    require_kind,
    same_size,
    whole_number,
)
from reachjax.numerics.pytrees import Replaceable, converted, pytree
from reachjax.sets import fit
from reachjax.sets.base import MOST_DIMENSIONS, AbstractSet, PolyhedralSet
from reachjax.sets.ellipsoid import Ellipsoid
from reachjax.sets.polytope import Polytope


class Simulated(Protocol):
    """What can be simulated, such as a `ClosedLoop`."""

    @property
    def states(self) -> int:
        """The number of states."""
        ...

    def simulate(
        self, x0: Float[Array, "c n"], horizon: int, start: int = 0
    ) -> Float[Array, "c horizon+1 n"]:
        """Trajectories from initial states."""
        ...


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

    @property
    @abc.abstractmethod
    def parts(self) -> tuple[Template | None, EllipsoidTemplate | None]:
        """The templates of the two parts that the sets have; None of what they have not."""

    @property
    def alone(self) -> Template | None:
        """The template, if its sets are bounded by facets and nothing else; None of others."""
        facets, ellipsoid = self.parts
        return facets if ellipsoid is None else None

    @property
    def steps(self) -> int | None:
        """The number of steps it is given for; None if all sets look alike."""
        return None

    def at(self, k: int) -> Self:
        """What the set after `k` steps looks like, `k` being 1 or more."""
        return self


@pytree
class Template(AbstractTemplate):
    """Facet directions: the matrix `A` of the paper's problem (sdp::poly), whose `b` is sought.

    Args:
        directions: `(m, n)`, one facet normal a row; together they must bound a polytope. With a
            leading time axis, `(N, m, n)`, those of the sets after 1, ..., N steps.

    Raises:
        ValueError: a row is zero or not finite, or the directions leave the polytope unbounded.

    Example:
        >>> Template.octagonal(2).directions.shape
        (8, 2)
    """

    directions: Float[Array, "*N m n"] = converted(converter=Numbers("(m, n)", "(N, m, n)"))

    def __post_init__(self):
        if is_concrete(self.directions):
            directions = np.asarray(self.directions)
            for rows in directions.reshape(-1, *directions.shape[-2:]):
                try:
                    Polytope(rows, np.ones(len(rows))).bounding_box()
                except ValueError as error:
                    raise ValueError(f"Template.directions do not bound a set: {error}") from None

    @property
    def dimension(self) -> int:
        """The number of coordinates."""
        return self.directions.shape[-1]

    @property
    def parts(self) -> tuple[Self, None]:
        """The template itself, and no ellipsoid."""
        return self, None

    @property
    def summary(self) -> str:
        """The number of facets."""
        return f"facets={len(self)}"

    @property
    def steps(self) -> int | None:
        """The number of steps it is given for; None if all sets have the same directions."""
        return len(self.directions) if self.directions.ndim == 3 else None

    def at(self, k: int) -> Self:
        """The directions of the set after `k` steps, `k` being 1 or more.

        Raises:
            ValueError: they are given for fewer steps.
        """
        if self.steps is None:
            return self
        if not 1 <= k <= self.steps:
            raise ValueError(f"Template.directions are for k = 1 .. {self.steps}, but {k} arrived")
        return self.replace(directions=self.directions[k - 1])

    def __len__(self) -> int:
        """The number of facets."""
        return self.directions.shape[-2]

    def polytope(self, offsets: Float[ArrayLike, " m"]) -> Polytope:
        """The polytope `directions x <= offsets`.

        Raises:
            ValueError: the directions depend on the step: those of one are `template.at(k)`.
        """
        if self.steps is not None:
            raise ValueError("Template.directions have a time axis: use template.at(k).polytope")
        return Polytope(self.directions, offsets)

    @classmethod
    def box(cls, dimension: int) -> Template:
        """`+-x_i`: axis-aligned boxes, `2 n` facets."""
        whole_number("dimension", dimension, 1)
        return cls(fit.signed(np.eye(dimension)))

    @classmethod
    def octagonal(cls, dimension: int) -> Template:
        """`+-x_i` and `+-x_i +- x_j`: `2 n^2` facets; in two dimensions the paper's eight."""
        whole_number("dimension", dimension, 1)
        return cls(fit.octagonal(dimension))

    @classmethod
    def default(cls, dimension: int) -> Template:
        """Where none is given: octagonal in two dimensions, in others boxes.

        Example:
            >>> [len(Template.default(n)) for n in (1, 2, 3)]
            [2, 8, 6]
        """
        return cls.octagonal(dimension) if dimension == 2 else cls.box(dimension)

    @classmethod
    def regular(cls, facets: int) -> Template:
        """Normals at equal angles in the plane, the first along `x_1`.

        Raises:
            ValueError: fewer than three facets, which bound no set.
        """
        whole_number("facets", facets, 3)
        return cls(fit.plane(facets))

    @classmethod
    def adapted(
        cls,
        loop: Simulated,
        X0: AbstractSet,
        horizon: int,
        facets: int | None = None,
        *,
        start: int = 0,
        samples: int = 10_000,
        seed: int = 0,
    ) -> Template:
        """Directions that fit the simulated states of each step.

        In the plane they are normals of edges of the states' convex hull, those without which a
        polygon around it would be largest. In more dimensions they are the states' principal axes,
        then sums and differences of two of them, axes being scaled to unit spread.

        Args:
            loop: the closed loop.
            X0: the set of initial states.
            horizon: the number `N` of steps.
            facets: how many; but in the plane an even number from `2 n` to `2 n^2`. None for 12, or
                the nearest such number.
            start: the time of `X0`.
            samples: how many trajectories are simulated.
            seed: of the samples.

        Raises:
            RuntimeError: `X0` cannot be sampled.
            TypeError: the loop cannot be simulated, `X0` is no set, or a number no whole one.
            ValueError: dimensions disagree; there are too few facets to bound a set, or more than
                there are directions; `X0` is empty or unbounded; or simulated states overflow.

        Example:
            >>> from reachjax import MLP, AffinePlant, Box, ClosedLoop
            >>> net = MLP.from_layers([([[0.0, 0.0]], [0.0])])
            >>> loop = ClosedLoop(AffinePlant([[1.0, 1.0], [0.0, 1.0]], [[0.0], [1.0]]), net)
            >>> Template.adapted(loop, Box([-1.0, -1.0], [1.0, 1.0]), horizon=3).directions.shape
            (3, 12, 2)
        """
        require_kind("X0", X0, AbstractSet, "a set such as Box(lower, upper)")
        if isinstance(loop, type) or not callable(getattr(loop, "simulate", None)):
            raise TypeError(f"loop must be a ClosedLoop, but {described(loop)} arrived")
        n = X0.dimension
        same_size("the loop's number of states is", "the dimension of X0 is", (loop.states, n))
        if facets is None:
            facets = 12 if n == 2 else min(max(12, 2 * n), 2 * n * n)
        count = whole_number("facets", facets, 3 if n == 2 else 2 * n)
        states = X0.sample(jax.random.key(seed), whole_number("samples", samples, n + 1))
        if isinstance(X0, PolyhedralSet) and n <= MOST_DIMENSIONS:
            states = jnp.concatenate([states, X0.vertices()])
        trajectories = np.asarray(loop.simulate(states, horizon, start))
        if not np.isfinite(trajectories).all():
            raise ValueError(
                "simulated states overflow or are not numbers: check the loop's weights"
            )
        fitting = fit.edges if n == 2 else fit.axes
        return cls(np.stack([fitting(trajectories[:, k], count) for k in range(1, horizon + 1)]))


@pytree
class EllipsoidTemplate(AbstractTemplate):
    """Ellipsoids: of minimum volume, the paper's problem (sdp::ellips), or of a given shape.

    Args:
        shape: `(n, n)`, symmetric and positive definite, up to a factor. Only the size is then
            sought, around the successor of the centre; the sets are larger, and their derivatives
            exact. None for the ellipsoid of minimum volume, whose derivative is that of a point
            close to it (see `reachjax.solvers.ellipsoids`), and whose thinnest half-axis is at
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
    def parts(self) -> tuple[Template, EllipsoidTemplate]:
        """The templates of facets and of ellipsoids."""
        return self.facets, self.ellipsoid

    @property
    def steps(self) -> int | None:
        """The number of steps that the facets are given for."""
        return self.facets.steps

    def at(self, k: int) -> Self:
        """What the set after `k` steps looks like, `k` being 1 or more."""
        return self.replace(facets=self.facets.at(k))

    @property
    def summary(self) -> str:
        """What both parts say."""
        return f"{self.facets.summary}, {self.ellipsoid.summary}"
