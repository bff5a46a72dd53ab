"""Pre-activation bounds that know the shape of a round set, not only its box.

The box around an ellipsoid of six dimensions has corners at 2.4 times its radius: neurons would
count as switching that do not. Here each input is written as a row over the state and the neurons
before it that do switch; its range is the support function of the set on the first part, and an
interval on the second. Layers are settled one after the other.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from reachjax.basis import Rows, columns, loop_rows
from reachjax.bounds import LoopBounds, loop_bounds
from reachjax.rounding import Ball, gamma
from reachjax.sets import AbstractSet, Box, Ellipsoid, Intersection
from reachjax.systems import ClosedLoop


def rounded(X: AbstractSet, box: Box) -> Ellipsoid | Intersection | None:
    """A set around `X` with a round part, whose supports can be compiled; None without such a part.

    Supports of polytopes are linear programs on the host: here a box around it stands for one.
    """
    if isinstance(X, Intersection):
        return X.replace(polytope=box)
    return X if isinstance(X, Ellipsoid) else None


def bounds_over(loop: ClosedLoop, X: AbstractSet, box: Box, t: int | jax.Array) -> LoopBounds:
    """Bounds of one step of the loop from a set of states with a round part.

    Args:
        loop: the closed loop.
        X: the set of states at time `t`, as `rounded` gives it.
        box: a box around it.
        t: the time.
    """
    if loop.units == 0:
        return loop_bounds(loop, box, t)
    n, size = loop.states, loop.states + loop.units + 1
    places = n + jnp.arange(loop.units)

    def once(_, bounds: LoopBounds) -> LoopBounds:
        rows = loop_rows(loop, columns(0, n, size), places, t, bounds, prune=True)
        return loop_bounds(loop, box, t, _ranges(rows.preactivation, X, bounds))

    layers = len(loop.controller.layers) - 1 + 2 * (loop.input_box is not None)
    return jax.lax.fori_loop(0, layers, once, loop_bounds(loop, box, t))


def _ranges(rows: Rows, X: AbstractSet, bounds: LoopBounds) -> Ball:
    """Intervals of rows over the basis `[x, z, 1]`."""
    n = X.dimension
    A, B, c = rows.mid[:, :n], rows.mid[:, n:-1], rows.mid[:, -1]
    z, size = bounds.output, abs(bounds.output.mid) + bounds.output.rad
    values = jnp.concatenate([abs(bounds.state.mid) + bounds.state.rad, size, jnp.ones(1)])
    middle = B @ z.mid + c
    # errors of the coefficients, and of the sums formed here
    error = rows.rad @ values + gamma(len(values)) * (abs(rows.mid) @ values)
    spread = (abs(B) @ z.rad + error) * (1 + gamma(len(values)))
    lower, upper = middle - X.support(-A) - spread, middle + X.support(A) + spread
    return Ball.between(lower, jnp.maximum(lower, upper))
