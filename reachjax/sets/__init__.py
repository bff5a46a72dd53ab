"""Geometry: sets of states, their facts, support functions, samples and volumes."""

from reachjax.sets.base import AbstractSet, PolyhedralSet
from reachjax.sets.box import Box
from reachjax.sets.ellipsoid import Ellipsoid, NormalForm
from reachjax.sets.intersection import Intersection
from reachjax.sets.polytope import Polytope
from reachjax.sets.template import AbstractTemplate, EllipsoidTemplate, MixedTemplate, Template

__all__ = [
    "AbstractSet",
    "AbstractTemplate",
    "Box",
    "Ellipsoid",
    "EllipsoidTemplate",
    "Intersection",
    "MixedTemplate",
    "NormalForm",
    "PolyhedralSet",
    "Polytope",
    "Template",
]
