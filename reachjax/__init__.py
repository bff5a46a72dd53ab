"""Certified, differentiable reachability of neural-network control loops (Reach-SDP) in JAX.

Turn on 64-bit floats before building networks and sets::

    import jax
    jax.config.update("jax_enable_x64", True)

    import reachjax as rj
"""

from reachjax.loops import (
    ISRU,
    MLP,
    AbstractActivation,
    AbstractNetwork,
    AbstractPlant,
    AbstractUnit,
    AffinePlant,
    Asin,
    Asinh,
    Atan,
    ClosedLoop,
    Cos,
    Erf,
    Exp,
    HardTanh,
    LeakyReLU,
    Log,
    Network,
    NonlinearPlant,
    Reciprocal,
    ReLU,
    Residual,
    SampledPlant,
    Sigmoid,
    Sin,
    Sinc,
    Softplus,
    Sqrt,
    Square,
    Step,
    Switched,
    Tanh,
    XLogX,
    delayed,
    one_of,
    runge_kutta,
    with_inputs,
    zero_order_hold,
)
from reachjax.methods.affine_forms import AffineForms
from reachjax.methods.branch_and_cut import Branching
from reachjax.methods.cells import Cells
from reachjax.methods.problem import AbstractMethod, Problem, ReachSet
from reachjax.methods.recursion import Recursion
from reachjax.numerics.archives import UnreadableError
from reachjax.numerics.budget import Interrupted
from reachjax.numerics.compilations import compiler_options, keep_compilations
from reachjax.programs.basis import ChangeOfBasis, change_of_basis
from reachjax.programs.relaxations import (
    AbstractRelaxation,
    AllProducts,
    BranchAndCut,
    CuttingPlanes,
    LinearBounds,
    LocalBounds,
    PaperQC,
)
from reachjax.proofs.branches import BranchCertificate, Rung
from reachjax.proofs.by_forms import CellCertificate, LinearCertificate
from reachjax.proofs.by_products import Certificate, EllipsoidCertificate, MixedCertificate
from reachjax.proofs.certificates import AbstractCertificate, AbstractProof
from reachjax.proofs.proposal import SolverStatus
from reachjax.sets import (
    AbstractSet,
    AbstractTemplate,
    Box,
    Ellipsoid,
    EllipsoidTemplate,
    Intersection,
    MixedTemplate,
    PolyhedralSet,
    Polytope,
    Template,
    VnnLib,
    read_vnnlib,
)
from reachjax.sets.pictures import plot_set
from reachjax.solvers import (
    SCS,
    AbstractSolver,
    Auto,
    Clarabel,
    CvxpySolver,
    InteriorPoint,
)
from reachjax.training import (
    Certified,
    Epoch,
    PenaltySchedule,
    Simulated,
    Stage,
    Trained,
    TrainingBatch,
    TrainingHistory,
    failures,
    skip_failures,
    specification_penalty,
    train,
    unsolved,
    volume_penalty,
)
from reachjax.tubes.partitions import PartitionedTube, plot_tube, reach_partitioned
from reachjax.tubes.reach import ReachTube, reach, reach_step
from reachjax.tubes.repeats import DisagreementError
from reachjax.tubes.sizes import log_volume, log_widths, volume
from reachjax.verdicts.decide import decide
from reachjax.verdicts.largest import LargestSet, largest_set
from reachjax.verdicts.loading import load
from reachjax.verdicts.soundness import UnsoundError
from reachjax.verdicts.specification import shortfall
from reachjax.verdicts.verdict import (
    Counterexample,
    DecidedCell,
    Recurrence,
    Verdict,
    VerdictStatus,
    WinningSet,
    plot_cells,
)
from reachjax.verdicts.verify import verify
from reachjax.verdicts.winning import winning_set

__version__ = "0.1.0"


def __dir__() -> list[str]:
    """The public names, and no others."""
    return [*__all__]


__all__ = [
    "ISRU",
    "MLP",
    "SCS",
    "AbstractActivation",
    "AbstractCertificate",
    "AbstractMethod",
    "AbstractNetwork",
    "AbstractPlant",
    "AbstractProof",
    "AbstractRelaxation",
    "AbstractSet",
    "AbstractSolver",
    "AbstractTemplate",
    "AbstractUnit",
    "AffineForms",
    "AffinePlant",
    "AllProducts",
    "Asin",
    "Asinh",
    "Atan",
    "Auto",
    "Box",
    "BranchAndCut",
    "BranchCertificate",
    "Branching",
    "CellCertificate",
    "Cells",
    "Certificate",
    "Certified",
    "ChangeOfBasis",
    "Clarabel",
    "ClosedLoop",
    "Cos",
    "Counterexample",
    "CuttingPlanes",
    "CvxpySolver",
    "DecidedCell",
    "DisagreementError",
    "Ellipsoid",
    "EllipsoidCertificate",
    "EllipsoidTemplate",
    "Epoch",
    "Erf",
    "Exp",
    "HardTanh",
    "InteriorPoint",
    "Interrupted",
    "Intersection",
    "LargestSet",
    "LeakyReLU",
    "LinearBounds",
    "LinearCertificate",
    "LocalBounds",
    "Log",
    "MixedCertificate",
    "MixedTemplate",
    "Network",
    "NonlinearPlant",
    "PaperQC",
    "PartitionedTube",
    "PenaltySchedule",
    "PolyhedralSet",
    "Polytope",
    "Problem",
    "ReLU",
    "ReachSet",
    "ReachTube",
    "Reciprocal",
    "Recurrence",
    "Recursion",
    "Residual",
    "Rung",
    "SampledPlant",
    "Sigmoid",
    "Simulated",
    "Sin",
    "Sinc",
    "Softplus",
    "SolverStatus",
    "Sqrt",
    "Square",
    "Stage",
    "Step",
    "Switched",
    "Tanh",
    "Template",
    "Trained",
    "TrainingBatch",
    "TrainingHistory",
    "UnreadableError",
    "UnsoundError",
    "Verdict",
    "VerdictStatus",
    "VnnLib",
    "WinningSet",
    "XLogX",
    "change_of_basis",
    "compiler_options",
    "decide",
    "delayed",
    "failures",
    "keep_compilations",
    "largest_set",
    "load",
    "log_volume",
    "log_widths",
    "one_of",
    "plot_cells",
    "plot_set",
    "plot_tube",
    "reach",
    "reach_partitioned",
    "reach_step",
    "read_vnnlib",
    "runge_kutta",
    "shortfall",
    "skip_failures",
    "specification_penalty",
    "train",
    "unsolved",
    "verify",
    "volume",
    "volume_penalty",
    "winning_set",
    "with_inputs",
    "zero_order_hold",
]
