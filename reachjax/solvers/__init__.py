"""The seam to semidefinite-programming codes: arrays in, arrays out."""

from reachjax.solvers.accepted import accepted_offsets
from reachjax.solvers.base import AbstractSolver, Solution, SolverStatus
from reachjax.solvers.conic import SCS, Clarabel, CvxpySolver
from reachjax.solvers.differentiable import proved_offsets
from reachjax.solvers.geometry import bounding_box, polytope_volume, separation, support

__all__ = [
    "SCS",
    "AbstractSolver",
    "Clarabel",
    "CvxpySolver",
    "Solution",
    "SolverStatus",
    "accepted_offsets",
    "bounding_box",
    "polytope_volume",
    "proved_offsets",
    "separation",
    "support",
]
