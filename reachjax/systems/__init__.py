"""What is verified: activations, networks, plants and the loop they close."""

from reachjax.systems.activations import AbstractActivation, ReLU
from reachjax.systems.closed_loop import ClosedLoop
from reachjax.systems.discretisation import runge_kutta, zero_order_hold
from reachjax.systems.networks import MLP
from reachjax.systems.plants import AffinePlant

__all__ = [
    "MLP",
    "AbstractActivation",
    "AffinePlant",
    "ClosedLoop",
    "ReLU",
    "runge_kutta",
    "zero_order_hold",
]
