"""Solvers of semidefinite programs: they propose, and nothing more."""

from reachjax.solvers.auto import Auto
from reachjax.solvers.base import AbstractSolver
from reachjax.solvers.cutting_planes import proved_with_cuts, with_cuts_around
from reachjax.solvers.differentiable import proved_offsets
from reachjax.solvers.enclosures import proved_ellipsoid, proved_size
from reachjax.solvers.interior_point import InteriorPoint
from reachjax.solvers.named import SCS, Clarabel, CvxpySolver

__all__ = [
    "SCS",
    "AbstractSolver",
    "Auto",
    "Clarabel",
    "CvxpySolver",
    "InteriorPoint",
    "proved_ellipsoid",
    "proved_offsets",
    "proved_size",
    "proved_with_cuts",
    "with_cuts_around",
]
