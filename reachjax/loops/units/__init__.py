"""Nonlinear units and the activations made of them: one file each, which is all that knows them."""

from reachjax.loops.units.base import (
    AbstractActivation,
    AbstractUnit,
    AtUnit,
    Block,
    Facts,
    Line,
    Lines,
    Mark,
    Product,
    evaluate,
)
from reachjax.loops.units.clip import clipped
from reachjax.loops.units.hard_tanh import HardTanh
from reachjax.loops.units.leaky_relu import LeakyReLU
from reachjax.loops.units.projection import ProjectionSlack, projected
from reachjax.loops.units.relu import ReLU

__all__ = [
    "AbstractActivation",
    "AbstractUnit",
    "AtUnit",
    "Block",
    "Facts",
    "HardTanh",
    "LeakyReLU",
    "Line",
    "Lines",
    "Mark",
    "Product",
    "ProjectionSlack",
    "ReLU",
    "clipped",
    "evaluate",
    "projected",
]
