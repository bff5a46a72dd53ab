"""Geometry: sets of states, their facts, support functions, samples and volumes."""

from reachjax.sets.base import AbstractSet, Box, NormalForm, PolyhedralSet
from reachjax.sets.ellipsoid import Ellipsoid
from reachjax.sets.intersection import Intersection
from reachjax.sets.polytope import Polytope
from reachjax.sets.templates import AbstractTemplate, EllipsoidTemplate, MixedTemplate, Template
from reachjax.sets.vnnlib import VnnLib, read_vnnlib

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
    "VnnLib",
    "read_vnnlib",
]
