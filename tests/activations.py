"""The list of activations, and of the controllers that claims about units are checked with.

Beside each of them stands its value in plain numpy, for floats and fractions alike.
"""

from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np

import reachjax as rj
from tests.networks import LoopData, he_network, input_box, plant

LEAK = 0.1


def leaky(y):
    """`max(y, a y)`."""
    return np.maximum(y, y * (Fraction(LEAK) if y.dtype == object else LEAK))


ACTIVATIONS = {
    rj.ReLU(): lambda y: np.maximum(y, 0),
    rj.LeakyReLU(LEAK): leaky,
    rj.HardTanh(): lambda y: np.clip(y, -1, 1),
}
UNITS = {one: value for one, value in ACTIVATIONS.items() if isinstance(one, rj.AbstractUnit)}


@dataclass(frozen=True)
class Controlled:
    """A loop as arrays, its activation, and what skips its network, `u = proj(net(x) + skip x)`."""

    data: LoopData
    activation: rj.AbstractActivation = field(default_factory=rj.ReLU)
    skip: np.ndarray | None = None

    @property
    def loop(self):
        """The library's loop."""
        net = rj.MLP.from_layers(self.data.layers, activation=self.activation)
        data, net = self.data, net if self.skip is None else rj.Residual(net, self.skip)
        box = None if data.u_lower is None else rj.Box(data.u_lower, data.u_upper)
        return rj.ClosedLoop(rj.AffinePlant(data.A, data.B, data.c), net, box)

    def controller(self, x):
        """What the controller gives for points x (k, n_x), in plain numpy."""
        *hidden, (W, b) = self.data.layers
        z = x
        for V, a in hidden:
            z = ACTIVATIONS[self.activation](z @ V.T + a)
        return z @ W.T + b + (0 if self.skip is None else x @ self.skip.T)

    def successors(self, x, t=0):
        """The states (k, n_x) after the states x."""
        A, B, c, lower, upper = self.data.at(t)
        u = self.controller(x)
        return x @ A.T + (u if lower is None else np.clip(u, lower, upper)) @ B.T + c


def controlled(activation, n_x=2, hidden=(4, 3), seed=0, skip=False, boxed=True):
    """A random loop of this activation."""
    n_u = min(n_x, 2)
    layers = he_network((n_x, *hidden, n_u), seed)
    box = input_box(n_u, seed) if boxed else (None, None)
    data = LoopData(layers, *plant(n_x, n_u, seed), *box)
    gain = 0.3 * np.random.default_rng(seed).normal(size=(n_u, n_x)) if skip else None
    return Controlled(data, activation, gain)


CONTROLLERS = [{"activation": activation} for activation in ACTIVATIONS]
CONTROLLERS.append({"activation": rj.ReLU(), "skip": True})
"""Options of `controlled`: every activation, and a residual connection."""
NAMES = [f"{c['activation']}{', residual' if 'skip' in c else ''}" for c in CONTROLLERS]
