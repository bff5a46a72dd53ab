"""The seam to semidefinite-programming codes: arrays in, arrays out."""

from reachjax.solvers.base import AbstractSolver, Solution, SolverStatus
from reachjax.solvers.conic import SCS, Clarabel, CvxpySolver

__all__ = ["SCS", "AbstractSolver", "Clarabel", "CvxpySolver", "Solution", "SolverStatus"]
