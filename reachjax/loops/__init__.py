"""What is verified: activations, networks, plants and the loop they close."""

from reachjax.loops.activations import AbstractActivation, ReLU
from reachjax.loops.closed_loop import ClosedLoop
from reachjax.loops.discretisation import runge_kutta, zero_order_hold
from reachjax.loops.networks import MLP
from reachjax.loops.plants import AffinePlant

__all__ = [
    "MLP",
    "AbstractActivation",
    "AffinePlant",
    "ClosedLoop",
    "ReLU",
    "runge_kutta",
    "zero_order_hold",
]
