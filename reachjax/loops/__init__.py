"""What is verified: units, networks, plants and the loop they close."""

from reachjax.loops.closed_loop import ClosedLoop
from reachjax.loops.discretisation import runge_kutta, zero_order_hold
from reachjax.loops.networks import MLP, AbstractNetwork, Network
from reachjax.loops.plants import AbstractPlant, AffinePlant, NonlinearPlant
from reachjax.loops.residual import Residual
from reachjax.loops.sampled import SampledPlant
from reachjax.loops.switching import Switched, one_of
from reachjax.loops.units import (
    ISRU,
    AbstractActivation,
    AbstractUnit,
    Asin,
    Asinh,
    Atan,
    Cos,
    Erf,
    Exp,
    HardTanh,
    LeakyReLU,
    Log,
    Reciprocal,
    ReLU,
    Sigmoid,
    Sin,
    Sinc,
    Softplus,
    Sqrt,
    Square,
    Step,
    Tanh,
    XLogX,
)

__all__ = [
    "ISRU",
    "MLP",
    "AbstractActivation",
    "AbstractNetwork",
    "AbstractPlant",
    "AbstractUnit",
    "AffinePlant",
    "Asin",
    "Asinh",
    "Atan",
    "ClosedLoop",
    "Cos",
    "Erf",
    "Exp",
    "HardTanh",
    "LeakyReLU",
    "Log",
    "Network",
    "NonlinearPlant",
    "ReLU",
    "Reciprocal",
    "Residual",
    "SampledPlant",
    "Sigmoid",
    "Sin",
    "Sinc",
    "Softplus",
    "Sqrt",
    "Square",
    "Step",
    "Switched",
    "Tanh",
    "XLogX",
    "one_of",
    "runge_kutta",
    "zero_order_hold",
]
