"""Templates whose sets are polytopes cut by ellipsoids."""

from __future__ import annotations

from typing import Self

from reachjax.numerics.checks import require_kind, same_size
from reachjax.numerics.pytrees import pytree
from reachjax.sets.ellipsoid_template import EllipsoidTemplate
from reachjax.sets.template import AbstractTemplate, Template


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
