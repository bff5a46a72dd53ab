"""Nonlinear units and the activations made of them, one file a family."""

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
from reachjax.loops.units.bilinear import Bilinear
from reachjax.loops.units.disturbance import Constraint, Disturbance
from reachjax.loops.units.one_hot import OneHot
from reachjax.loops.units.piecewise import HardTanh, LeakyReLU, ReLU, clipped
from reachjax.loops.units.powers import Exp, Log, Reciprocal, Sqrt, Square, Within, XLogX
from reachjax.loops.units.projection import ProjectionSlack, projected
from reachjax.loops.units.saturating import ISRU, Asin, Asinh, Erf, Sigmoid, Softplus, Tanh
from reachjax.loops.units.smooth import Origin, Quadratic, SmoothUnit, UnboundedError
from reachjax.loops.units.step import Entered, Floor, Gated, Step
from reachjax.loops.units.trigonometric import Atan, Cos, Sin, Sinc

__all__ = [
    "ISRU",
    "AbstractActivation",
    "AbstractUnit",
    "Asin",
    "Asinh",
    "AtUnit",
    "Atan",
    "Bilinear",
    "Block",
    "Constraint",
    "Cos",
    "Disturbance",
    "Entered",
    "Erf",
    "Exp",
    "Facts",
    "Floor",
    "Gated",
    "HardTanh",
    "LeakyReLU",
    "Line",
    "Lines",
    "Log",
    "Mark",
    "OneHot",
    "Origin",
    "Product",
    "ProjectionSlack",
    "Quadratic",
    "ReLU",
    "Reciprocal",
    "Sigmoid",
    "Sin",
    "Sinc",
    "SmoothUnit",
    "Softplus",
    "Sqrt",
    "Square",
    "Step",
    "Tanh",
    "UnboundedError",
    "Within",
    "XLogX",
    "clipped",
    "evaluate",
    "projected",
]
