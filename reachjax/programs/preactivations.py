"""Pre-activation bounds that know how neurons depend on each other, and the shape of an ellipsoid.

Interval arithmetic forgets that the neurons of a layer come from one state, and a box around an
ellipsoid of six dimensions has corners at 2.4 times its radius: neurons would count as switching
that do not. Here each input is written as a row over the state and the units before it that are not
affine. These are replaced by their lines, the last first (CROWN: Zhang, Weng, Chen, Hsieh, Daniel,
Efficient Neural Network Robustness Certification, NeurIPS 2018), and what is left over the state is
the support function of the set. Layers are settled one after the other, and no bound is looser than
that by intervals.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.loops import ClosedLoop
from reachjax.loops.closed_loop import UnitLayer
from reachjax.loops.tracing.functions import Compiled
from reachjax.loops.units import AbstractUnit, Line
from reachjax.numerics.rounding import Ball, gamma, settled
from reachjax.programs.basis import Rows, columns, loop_rows
from reachjax.programs.bounds import LoopBounds, loop_bounds
from reachjax.sets import AbstractSet, Box


@partial(jax.jit, static_argnames="inputs")
def known_inputs(inputs: int, known: Ball | None) -> Ball:
    """Bounds of every unit's input, of infinite radius but for those known, the first ones.

    Args:
        inputs: how many there are.
        known: bounds of the first ones, if there are any.
    """
    mid, rad = jnp.zeros(inputs), jnp.full(inputs, jnp.inf)
    if known is None:
        return Ball(mid, rad)
    here = slice(0, len(known.mid))
    return Ball(mid.at[here].set(known.mid), rad.at[here].set(known.rad))


def bounds_over(
    loop: ClosedLoop,
    X: AbstractSet,
    box: Box,
    t: int | jax.Array,
    known: Ball,
) -> LoopBounds:
    """Bounds of one step of the loop from a set of states.

    Args:
        loop: the closed loop.
        X: the set of states at time `t`, in closed form: a polytope needs linear programs.
        box: a box around it.
        t: the time.
        known: other bounds of the units' inputs, from `known_inputs`.
    """
    if loop.units == 0:
        return loop_bounds(loop, box, t)
    n, size = loop.states, loop.states + loop.units + 1
    places, layers = n + jnp.arange(loop.units), loop.unit_layers

    def once(_, found: tuple[Ball, LoopBounds]) -> tuple[Ball, LoopBounds]:
        known, _ = found
        bounds = loop_bounds(loop, box, t, known)
        rows = loop_rows(loop, columns(0, n, size), places, t, bounds, prune=True)
        return _meet(_ranges(rows.preactivation, X, bounds, layers), known), bounds

    # a layer is settled when those before it are: one pass each, of which the last one's ranges go
    # unused, so that one pass is all that is compiled
    shapes = jax.eval_shape(loop_bounds, loop, box, t, known)
    blank = jax.tree.map(lambda part: jnp.zeros(part.shape, part.dtype), shapes)
    return jax.lax.fori_loop(0, len(layers) + 1, once, (known, blank))[1]


def _meet(one: Ball, other: Ball) -> Ball:
    """What both hold, entry by entry."""
    lower = jnp.maximum(one.lower, other.lower)
    upper = jnp.maximum(lower, jnp.minimum(one.upper, other.upper))
    return Ball.between(*settled((lower, upper)))


def _ranges(rows: Rows, X: AbstractSet, bounds: LoopBounds, layers: tuple[UnitLayer, ...]) -> Ball:
    """Intervals of rows over the basis `[x, z, 1]`, by intervals and by the lines of `z`."""
    both = jax.tree.map(lambda *part: jnp.concatenate(part), rows, -rows)
    relaxed = _relaxed(both, rows, bounds, layers)
    upper, below = jnp.minimum(_upper(both, X, bounds), _upper(relaxed, X, bounds)).reshape(2, -1)
    return Ball.between(-below, jnp.maximum(-below, upper))


def _relaxed(rows: Rows, inputs: Rows, bounds: LoopBounds, layers: tuple[UnitLayer, ...]) -> Rows:
    """Rows that are nowhere smaller, over the state alone but for rounding.

    Where a coefficient is positive the line above takes the place of `z`, else the line below: the
    units of a layer at once, the last layer first.

    Args:
        rows: over the basis `[x, z, 1]`.
        inputs: those of the units `z`.
        bounds: of the units.
        layers: of units.
    """
    below, above = (_lines(line, inputs, layers) for line in bounds.lines)
    sizes = np.array([layer.size for layer in layers])
    ends, width = jnp.asarray(np.cumsum(sizes)), int(sizes.max())
    n = inputs.mid.shape[1] - 1 - int(sizes.sum())

    def replaced(i, rows: Rows) -> Rows:
        end, size = ends[len(layers) - 1 - i], jnp.asarray(sizes)[len(layers) - 1 - i]
        first = jnp.maximum(end - width, 0)
        unit = first + jnp.arange(width)
        known = bounds.affine[unit] | (unit < end - size) | (unit >= end)
        place = (0, n + first)
        weights = jax.lax.dynamic_slice(rows.mid, place, (len(rows.mid), width))
        left = jax.lax.dynamic_update_slice(rows.mid, jnp.where(known, weights, 0.0), place)
        weights = jnp.where(known, 0.0, weights)
        over, under = jnp.maximum(weights, 0.0), jnp.minimum(weights, 0.0)
        return Rows(left, rows.rad) + over @ above[unit] + under @ below[unit]

    return jax.lax.fori_loop(0, len(layers), replaced, rows)


def _lines(line: Line, inputs: Rows, layers: tuple[UnitLayer, ...]) -> Rows:
    """Lines of all units as rows, of the rows of their inputs."""
    found, first = [], 0
    for unit, _, count in layers:
        here, first = slice(first, first + count), first + count
        found.append(unit.combined(line.slope[here] * inputs[here]))
    return Rows.joined(found) + line.offset


def _upper(rows: Rows, X: AbstractSet, bounds: LoopBounds) -> Float[Array, " k"]:
    """Upper bounds of rows over the basis `[x, z, 1]`: supports of `x`, intervals of `z`."""
    n = X.dimension
    A, B, c = rows.mid[:, :n], rows.mid[:, n:-1], rows.mid[:, -1]
    z, size = bounds.output, abs(bounds.output.mid) + bounds.output.rad
    values = jnp.concatenate([abs(bounds.state.mid) + bounds.state.rad, size, jnp.ones(1)])
    # errors of the coefficients, and of the sums formed here
    error = rows.rad @ values + gamma(len(values)) * (abs(rows.mid) @ values)
    spread = (abs(B) @ z.rad + error) * (1 + gamma(len(values)))
    return B @ z.mid + c + X.support(A) + spread


@Compiled
def first_rows(loop: ClosedLoop) -> Rows | None:
    """Rows over `[x, 1]` of the inputs of the controller's first layer.

    None if it has no units, or if it measures the state with noise: what it is given is no function
    of the state then, nor are its units the first ones of a step.
    """
    n, found = loop.states, []
    if loop.noise is not None:
        return None

    def stop(unit: AbstractUnit, *y: Rows) -> Rows:
        found.append(Rows.joined(y))
        return unit.combined(found[-1])

    loop.controller.propagate(columns(0, n, n + 1), stop)
    return found[0] if found else None


@jax.jit  # so that the interval arithmetic is compiled as one
def first_inputs(
    rows: Rows, lower: Float[Array, " k"], upper: Float[Array, " k"], box: Box
) -> Ball:
    """Bounds of the inputs of the controller's first layer.

    Args:
        rows: of these inputs over `[x, 1]`.
        lower: `(k,)`, of the rows without their constants over the set of states.
        upper: `(k,)`, the same.
        box: around these states.
    """
    around = Ball.between(box.lower, box.upper)
    size = jnp.append(abs(around.mid) + around.rad, 1.0)
    error = (rows.rad @ size) * (1 + gamma(len(size)))
    return Ball.between(lower, upper) + Ball(rows.mid[:, -1], error)
