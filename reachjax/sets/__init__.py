"""Geometry: sets of states, their facts, support functions, samples and volumes."""

from reachjax.sets.base import AbstractSet
from reachjax.sets.box import Box
from reachjax.sets.ellipsoid import Ellipsoid
from reachjax.sets.ellipsoid_template import EllipsoidTemplate
from reachjax.sets.intersection import Intersection
from reachjax.sets.mixed_template import MixedTemplate
from reachjax.sets.normal_form import NormalForm
from reachjax.sets.polyhedral_set import PolyhedralSet
from reachjax.sets.polytope import Polytope
from reachjax.sets.template import AbstractTemplate, Template

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
