"""The seam to semidefinite-programming codes: arrays in, arrays out."""

from reachjax.proofs.accepted import accepted_enclosure, accepted_offsets
from reachjax.proofs.proposal import Enclosure, Solution, SolverStatus
from reachjax.sets.geometry import (
    bounding_box,
    facets_in_units,
    polytope_volume,
    row_ranges,
    separation,
    support,
)
from reachjax.solvers.auto import Auto
from reachjax.solvers.base import AbstractSolver
from reachjax.solvers.cutting_planes import proved_with_cuts, with_cuts_around
from reachjax.solvers.differentiable import proved_offsets
from reachjax.solvers.enclosures import proved_ellipsoid, proved_size
from reachjax.solvers.interior_point import InteriorPoint
from reachjax.solvers.named import SCS, Clarabel, CvxpySolver
from reachjax.solvers.smoothing import CentralPath

__all__ = [
    "SCS",
    "AbstractSolver",
    "Auto",
    "CentralPath",
    "Clarabel",
    "CvxpySolver",
    "Enclosure",
    "InteriorPoint",
    "Solution",
    "SolverStatus",
    "accepted_enclosure",
    "accepted_offsets",
    "bounding_box",
    "facets_in_units",
    "polytope_volume",
    "proved_ellipsoid",
    "proved_offsets",
    "proved_size",
    "proved_with_cuts",
    "row_ranges",
    "separation",
    "support",
    "with_cuts_around",
]
