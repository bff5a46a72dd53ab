"""Bounds of everything nonlinear in one step of the loop, from a box of states.

The loop's own forward pass is run over midpoint-radius intervals, so rounding is included: a
neuron that these bounds call stable is stable.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from reachjax.pytrees import pytree
from reachjax.rounding import Ball, gamma
from reachjax.sets import Box
from reachjax.systems import AbstractActivation, ClosedLoop


@pytree
class LoopBounds:
    """Intervals over one step, units in the order of the loop (hidden layers, then projection).

    Attributes:
        state: `(n_x,)`, the box of states it started from.
        preactivation: `(k,)`, inputs `y` of the units.
        output: `(k,)`, outputs `z` of the units.
        passing: `(k,)`, units that are surely the identity.
        blocking: `(k,)`, units that are surely zero.
        successor: `(n_x,)`, states one step later.
    """

    state: Ball
    preactivation: Ball
    output: Ball
    passing: Array
    blocking: Array
    successor: Ball


def loop_bounds(loop: ClosedLoop, box: Box, t: int | jax.Array) -> LoopBounds:
    """Propagate a box of states through one step by interval arithmetic."""
    units: list[tuple[Ball, Ball, Array, Array]] = []

    def unit(activation: AbstractActivation, y: Ball) -> Ball:
        z = Ball.between(*activation.interval(y.lower, y.upper))
        # the ends of `y` may be rounded differently where the midpoint and the radius are formed
        z = Ball(z.mid, z.rad + gamma(8) * (abs(y.mid) + y.rad))
        units.append((y, z, *activation.phases(y.lower, y.upper)))
        return z

    state = Ball.between(box.lower, box.upper)
    successor = loop.step(state, t, unit)
    empty = jnp.zeros(0)
    units.insert(0, (Ball.exact(empty), Ball.exact(empty), empty > 0, empty > 0))
    y, z, passing, blocking = jax.tree.map(_concatenate, *units)
    return LoopBounds(state, y, z, passing, blocking, successor)


@jax.jit
def successor_box(loop: ClosedLoop, box: Box, t: int) -> Box:
    """A box that surely holds the successors of a box of states, rounding included."""
    successor = loop_bounds(loop, box, t).successor
    return Box(successor.lower, successor.upper)


def _concatenate(*arrays: Any) -> Array:
    return jnp.concatenate(arrays)
