"""Bounds of everything nonlinear in one step of the loop, from a box of states.

The loop's own forward pass is run over midpoint-radius intervals, so rounding is included: a
unit that these bounds call affine is affine.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from reachjax.loops import ClosedLoop
from reachjax.loops.units import AbstractUnit, Line, Lines
from reachjax.numerics.host import in_numpy
from reachjax.numerics.pytrees import pytree, unchecked
from reachjax.numerics.rounding import TINY, Ball, gamma, settled
from reachjax.sets import Box

MARGINAL = 1e-9
"""Inputs that leave a range on which a unit is affine by no more than this part of their size
leave it affine."""


@pytree
class LoopBounds:
    """Intervals over one step, units in the order in which the loop meets them.

    Attributes:
        state: `(n_x,)`, the box of states it started from.
        preactivation: inputs `y` of the units, one or two of each.
        output: `(k,)`, outputs `z` of the units.
        lines: `(k,)`, below and above outputs, up to `excess`; a slope for each input.
        affine: `(k,)`, units of which both lines are the same.
        excess: `(k,)`, by how much those may be off at most; zero where they surely are affine.
        successor: `(n_x,)`, states one step later.
    """

    state: Ball
    preactivation: Ball
    output: Ball
    lines: Lines
    affine: Array
    excess: Array
    successor: Ball


def loop_bounds(
    loop: ClosedLoop,
    box: Box,
    t: int | jax.Array,
    known: Ball | None = None,
    w: Array | None = None,
    v: Array | None = None,
) -> LoopBounds:
    """Propagate a box of states through one step by interval arithmetic.

    Args:
        loop: the closed loop.
        box: of states.
        t: the time.
        known: other bounds of the units' inputs, if there are any.
        w: `(n_w,)`, the disturbances, where they are known.
        v: `(n_x,)`, the noise, where it is known.
    """
    drawn = (None if part is None else Ball.exact(part) for part in (w, v))
    units: list[tuple[Ball, Ball, Lines, Array, Array]] = []

    def unit(unit: AbstractUnit, *given: Ball) -> Ball:
        y = Ball.joined(given)
        if known is not None:
            done = sum(len(each[0].mid) for each in units)
            also = known[done : done + len(y.mid)]
            lower = jnp.maximum(y.lower, also.lower)
            y = Ball.between(lower, jnp.maximum(lower, jnp.minimum(y.upper, also.upper)))
        y, ends, z = _image(unit, y)
        lines = settled(unit.lines(*ends))
        constant = lines.affine & (unit.combined(abs(lines.above.slope)) == 0)
        mid = jnp.where(constant, lines.above.offset, z.mid)
        z = Ball(mid, jnp.where(constant, 0.0, z.rad))
        units.append((y, z, *_affine_units(unit, y, ends, z, lines)))
        return z

    state = Ball.between(box.lower, box.upper)
    successor = loop.step(state, t, unit, *drawn)
    empty = jnp.zeros(0)
    none, line = Ball.exact(empty), Line(empty, empty)
    units.insert(0, (none, none, Lines(line, line), empty > 0, empty))
    y, z, lines, affine, excess = jax.tree.map(_concatenate, *units)
    return LoopBounds(state, y, z, lines, affine, excess, successor)


def _image(unit: AbstractUnit, y: Ball) -> tuple[Ball, Sequence[Array], Ball]:
    """What inputs may be, their ends, and what a unit makes of them.

    What inputs were made of may be rounded differently where each of their parts was formed.
    """
    rounding = gamma(8) * (abs(y.mid) + y.rad)
    if not unit.nonexpansive:
        y = Ball(y.mid, y.rad + 2 * rounding)
    y = settled(y)
    ends = settled((y.lower, y.upper))
    z = Ball.between(*settled(unit.interval(*ends)))
    return y, ends, Ball(z.mid, z.rad + rounding) if unit.nonexpansive else z


def _value(doubt: float, unit: AbstractUnit, *given: Ball) -> Ball:
    """What a unit makes of inputs, in numpy; of one that jumps they are in doubt."""
    y = Ball.joined(given)
    if doubt and unit.jumps:
        y = Ball(y.mid, y.rad + doubt * (y.rad + gamma(1) * abs(y.mid)) + TINY)
    return _image(unit, y)[2]


def _affine_units(
    unit: AbstractUnit, y: Ball, ends: Sequence[Array], z: Ball, lines: Lines
) -> tuple[Lines, Array, Array]:
    """Lines, which units are affine, and by how much the lines of these may be off.

    Affine is also a unit that would be if its inputs ended next to nothing sooner, below or above.
    Kept, it would need multipliers of the size of `1 / MARGINAL`, and derivatives lose as many
    digits. A unit is nonexpansive, and so is such a line, so its output is off by twice the
    distance of an input from where it is affine, and by no more than its distance from the line.
    That is said of one input alone, and of no layer that is not separable, nor of units that jump.
    """
    if not (unit.separable and unit.nonexpansive):
        return lines, lines.affine, jnp.zeros_like(z.mid)
    spare, surely, (lower, upper) = MARGINAL * (abs(y.mid) + y.rad), lines.affine, ends
    least, most = settled((lower + spare, upper - spare))
    from_above = settled(unit.lines(least, jnp.maximum(upper, least)))
    from_below = settled(unit.lines(jnp.minimum(lower, most), most))
    affine, line = surely, lines.above
    for near in (from_above, from_below):
        line = _chosen(affine, line, near.above)
        affine = affine | near.affine
    off = z - (line.slope * y + line.offset)
    excess = jnp.minimum(2 * spare, abs(off.mid) + off.rad)
    lines = Lines(_chosen(affine, line, lines.below), _chosen(affine, line, lines.above))
    return lines, affine, jnp.where(affine & ~surely, excess, 0.0)


def _chosen(mask: Array, one: Line, other: Line) -> Line:
    """The first line where the mask is true, and the second elsewhere."""
    return Line(*(jnp.where(mask, *pair) for pair in zip(one, other, strict=True)))


def successor_box(
    loop: ClosedLoop, box: Box, t: int, w: Any = None, v: Any = None, *, doubt: float = 0.0
) -> Box:
    """A box that surely holds the successors of a box of states, rounding included.

    In numpy, where nothing is compiled: it is asked for one trajectory at a time.

    Args:
        loop: of known numbers; of one with numpy arrays the functions are recorded once.
        box: of states.
        t: the time.
        w: the disturbances, where they are known.
        v: the noise, where it is known.
        doubt: by how many times what rounding may be worth numbers are wider that are compared
            where the loop jumps: compiled code may take another winner of what is nearly a tie.

    Returns:
        A box of numpy arrays, infinite or no numbers where numbers overflow.
    """
    loop, lower, upper = map(in_numpy, (loop, box.lower, box.upper))
    drawn = (None if part is None else Ball.exact(np.asarray(part)) for part in (w, v))
    with np.errstate(all="ignore"):
        state = Ball.between(lower, upper)
        successor = loop.step(state, t, partial(_value, doubt), *drawn)
        return unchecked(Box, lower=successor.lower, upper=successor.upper)


def _concatenate(*arrays: Any) -> Array:
    return jnp.concatenate(arrays)
