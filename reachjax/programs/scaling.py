"""The scaling of a basis: `xi = T eta`, the entries of `eta` being in `[-1, 1]`.

The optimal value of a program does not depend on it, but its derivative at inexact multipliers
does: with the scaling's share, facts of thin sets keep their size and errors cancel.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from reachjax.numerics.rounding import Ball
from reachjax.programs.basis import picking
from reachjax.programs.bounds import LoopBounds
from reachjax.sets import Box, Ellipsoid

CONSTANT = 1e-9
"""An output whose radius is a smaller part than this of its input's size has a single value."""


def scaled_states(box: Box, ball: Ellipsoid | None) -> Float[Array, "n_x+1 n_x+1"]:
    """The scaling of `[x, 1]`.

    Args:
        box: a box around the states.
        ball: an ellipsoid around them, if one fits better.
    """
    n, around = box.dimension, Ball.between(box.lower, box.upper)
    T = jnp.diag(jnp.append(around.rad, 1.0)).at[:-1, -1].set(around.mid)
    if ball is not None:
        T = T.at[:n, :n].set(ball.from_ball()).at[:n, -1].set(ball.center)
    return jax.lax.optimization_barrier(T)


def scaled_units(
    T: Float[Array, "n n"], places: Int[Array | np.ndarray, " k"], bounds: LoopBounds, prune: bool
) -> Float[Array, "n n"]:
    """The scaling with the outputs of units in it.

    Args:
        T: without them.
        places: the column of each unit; negative for those without one.
        bounds: of the units.
        prune: whether units that the bounds prove to be affine have left the basis.
    """
    here = picking(places, len(T)).mid
    mid, rad = _ranges(bounds, prune)
    T = T.at[:, -1].add(mid @ here) + jnp.diag(rad @ here)
    # one rounding of it for all rows, whatever the compiler fuses
    return jax.lax.optimization_barrier(T)


def _ranges(bounds: LoopBounds, prune: bool) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """Midpoint and radius of the output of each unit.

    A unit that has left the basis gets radius zero. One that stays although its output has a single
    value (a dead neuron that the paper keeps) is scaled by its input, so that it does stay: a
    radius at rounding level would tell the solver what the paper's constraints do not.
    """
    y, z = bounds.preactivation, bounds.output
    if prune:
        return jnp.where(bounds.affine, 0.0, z.mid), jnp.where(bounds.affine, 0.0, z.rad)
    size = abs(y.mid) + y.rad
    constant = z.rad <= CONSTANT * size
    # a tenth of the input's size: measured, solvers lose digits at the whole and at a hundredth
    return z.mid, jnp.where(constant, jnp.where(size > 0, size / 10, 1.0), z.rad)
