"""Solvers of semidefinite programs: they propose, and nothing more."""

from reachjax.solvers.auto import Auto
from reachjax.solvers.base import AbstractSolver
from reachjax.solvers.clarabel import Clarabel
from reachjax.solvers.conic import SCS, CvxpySolver
from reachjax.solvers.cutting_planes import Rounds
from reachjax.solvers.ellipsoids import GivenShape, LeastVolume
from reachjax.solvers.facets import Facets
from reachjax.solvers.goals import AbstractGoal, proved
from reachjax.solvers.interior_point import InteriorPoint

__all__ = [
    "SCS",
    "AbstractGoal",
    "AbstractSolver",
    "Auto",
    "Clarabel",
    "CvxpySolver",
    "Facets",
    "GivenShape",
    "InteriorPoint",
    "LeastVolume",
    "Rounds",
    "proved",
]
