"""What is verified: units, networks, plants and the loop they close."""

from reachjax.loops.closed_loop import ClosedLoop
from reachjax.loops.discretisation import runge_kutta, zero_order_hold
from reachjax.loops.networks import MLP, AbstractNetwork, Network
from reachjax.loops.plants import AbstractPlant, AffinePlant, NonlinearPlant
from reachjax.loops.residual import Residual
from reachjax.loops.units import AbstractActivation, AbstractUnit, HardTanh, LeakyReLU, ReLU

__all__ = [
    "MLP",
    "AbstractActivation",
    "AbstractNetwork",
    "AbstractPlant",
    "AbstractUnit",
    "AffinePlant",
    "ClosedLoop",
    "HardTanh",
    "LeakyReLU",
    "Network",
    "NonlinearPlant",
    "ReLU",
    "Residual",
    "runge_kutta",
    "zero_order_hold",
]
