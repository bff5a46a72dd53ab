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
from reachjax.loops.units.disturbance import Constraint, Disturbance
from reachjax.loops.units.exponential import Exp, Log
from reachjax.loops.units.hard_tanh import HardTanh
from reachjax.loops.units.hyperbolic import Sigmoid, Tanh
from reachjax.loops.units.leaky_relu import LeakyReLU
from reachjax.loops.units.powers import Reciprocal, Sqrt, Square
from reachjax.loops.units.projection import ProjectionSlack, projected
from reachjax.loops.units.relu import ReLU
from reachjax.loops.units.smooth import Quadratic, SmoothUnit, UnboundedError
from reachjax.loops.units.trigonometric import Atan, Cos, Sin

__all__ = [
    "AbstractActivation",
    "AbstractUnit",
    "AtUnit",
    "Atan",
    "Block",
    "Constraint",
    "Cos",
    "Disturbance",
    "Exp",
    "Facts",
    "HardTanh",
    "LeakyReLU",
    "Line",
    "Lines",
    "Log",
    "Mark",
    "Product",
    "ProjectionSlack",
    "Quadratic",
    "ReLU",
    "Reciprocal",
    "Sigmoid",
    "Sin",
    "SmoothUnit",
    "Sqrt",
    "Square",
    "Tanh",
    "UnboundedError",
    "clipped",
    "evaluate",
    "projected",
]
