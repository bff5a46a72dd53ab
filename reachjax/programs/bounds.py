"""Bounds of everything nonlinear in one step of the loop, from a box of states.

The loop's own forward pass is run over midpoint-radius intervals, so rounding is included: a
neuron that these bounds call stable is stable.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from reachjax.loops import AbstractActivation, ClosedLoop
from reachjax.numerics.pytrees import pytree
from reachjax.numerics.rounding import Ball, gamma
from reachjax.sets import Box

MARGINAL = 1e-9
"""Inputs that cross zero by no more than this part of their size leave a unit affine."""


@pytree
class LoopBounds:
    """Intervals over one step, units in the order of the loop (hidden layers, then projection).

    Attributes:
        state: `(n_x,)`, the box of states it started from.
        preactivation: `(k,)`, inputs `y` of the units.
        output: `(k,)`, outputs `z` of the units.
        passing: `(k,)`, units that are the identity, up to `excess`.
        blocking: `(k,)`, units that are zero, up to `excess`.
        excess: `(k,)`, by how much at most; zero where `y` surely does not change its sign.
        successor: `(n_x,)`, states one step later.
    """

    state: Ball
    preactivation: Ball
    output: Ball
    passing: Array
    blocking: Array
    excess: Array
    successor: Ball


def loop_bounds(
    loop: ClosedLoop, box: Box, t: int | jax.Array, known: Ball | None = None
) -> LoopBounds:
    """Propagate a box of states through one step by interval arithmetic.

    Args:
        loop: the closed loop.
        box: of states.
        t: the time.
        known: `(k,)`, other bounds of the units' inputs, if there are any.
    """
    units: list[tuple[Ball, Ball, Array, Array, Array]] = []

    def unit(activation: AbstractActivation, y: Ball) -> Ball:
        if known is not None:
            done = sum(len(each[0].mid) for each in units)
            also = known[done : done + len(y.mid)]
            lower = jnp.maximum(y.lower, also.lower)
            y = Ball.between(lower, jnp.maximum(lower, jnp.minimum(y.upper, also.upper)))
        z = Ball.between(*activation.interval(y.lower, y.upper))
        # the ends of `y` may be rounded differently where the midpoint and the radius are formed
        rounding = gamma(8) * (abs(y.mid) + y.rad)
        zero = activation.phases(y.lower, y.upper)[1]
        z = Ball(jnp.where(zero, 0.0, z.mid), jnp.where(zero, 0.0, z.rad + rounding))
        units.append((y, z, *_phases(activation, y, z)))
        return z

    state = Ball.between(box.lower, box.upper)
    successor = loop.step(state, t, unit)
    empty = jnp.zeros(0)
    units.insert(0, (Ball.exact(empty), Ball.exact(empty), empty > 0, empty > 0, empty))
    y, z, passing, blocking, excess = jax.tree.map(_concatenate, *units)
    return LoopBounds(state, y, z, passing, blocking, excess, successor)


def _phases(activation: AbstractActivation, y: Ball, z: Ball) -> tuple[Array, Array, Array]:
    """Units that are affine but for inputs that change their sign by next to nothing.

    Kept, such a unit would need multipliers of the size of `1 / MARGINAL`, and derivatives lose as
    many digits. An activation is nonexpansive, so its output is off by twice the distance of an
    input from where it is the identity; and what is taken for zero by no more than its size.
    """
    spare = MARGINAL * (abs(y.mid) + y.rad)
    surely = activation.phases(y.lower, y.upper)
    passing = activation.phases(y.lower + spare, jnp.maximum(y.upper, y.lower + spare))[0]
    blocking = activation.phases(jnp.minimum(y.lower, y.upper - spare), y.upper - spare)[1]
    blocking &= ~passing
    excess = jnp.where(blocking, jnp.minimum(2 * spare, abs(z.mid) + z.rad), 2 * spare)
    excess = jnp.where(surely[0] | surely[1] | ~(passing | blocking), 0.0, excess)
    return passing, blocking, excess


@jax.jit
def successor_box(loop: ClosedLoop, box: Box, t: int) -> Box:
    """A box that surely holds the successors of a box of states, rounding included."""
    successor = loop_bounds(loop, box, t).successor
    return Box(successor.lower, successor.upper)


def _concatenate(*arrays: Any) -> Array:
    return jnp.concatenate(arrays)
