"""Projected gradient ascent: initial states whose trajectories go far.

The loop is piecewise affine, so an ascent ends at a corner of a piece or on the edge of the set. A
solver's proposal is often the best state already, up to its tolerance, and a few steps remove that.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from reachjax.loops import ClosedLoop
from reachjax.sets import AbstractSet

ASCENT_STEPS = 80
"""Gradient steps of an ascent. After 60, one on a polytope of six dimensions lacked 1e-4."""

LONGEST = 4.0
"""The longest step, in half-widths of the set: from further away projections are worse."""


@partial(jax.jit, static_argnames=("horizon", "start"))
def ascended(
    loop: ClosedLoop,
    X0: AbstractSet,
    scale: Float[Array, "n_x n_x"],
    middle: Float[Array, " n_x"],
    states: Float[Array, "m n_x"],
    region: AbstractSet,
    which: Int[Array, " m"],
    k: int,
    horizon: int,
    start: int,
) -> Float[Array, "m n_x"]:
    """Initial states of larger values after `k` steps, in the set of initial states.

    Steps and projections are measured in the box around that set, or where an ellipsoid is a ball;
    where the loop is affine, an ascent ends at the largest value, but for polytopes with corners so
    sharp that projections onto them do not converge. Steps double where they gain, and are halved
    where they do not.

    Args:
        loop: the closed loop.
        X0: the set of initial states.
        scale: in which steps and projections are measured.
        middle: a point in its interior, if it has any.
        states: where to begin.
        region: a set whose bounded values are sought.
        which: of these values, one for each state.
        k: after how many steps.
        horizon: how many steps are simulated.
        start: the time of the initial set.
    """

    def climb(state: Float[Array, " n_x"], number: Int[Array, ""]) -> Float[Array, " n_x"]:
        def value(state):
            after = loop.simulate(state, horizon, start)[k]
            return region.bounded_values(after)[number]

        def improve(carry, _):
            best, slope, state, length = carry
            uphill = scale.T @ slope
            size = jnp.linalg.norm(uphill)
            unit = uphill / jnp.where(size > 0, size, 1.0)
            moved = X0.brought_inside(state + length * scale @ unit, middle, scale)
            reached, other = jax.value_and_grad(value)(moved)
            better = reached > best
            following = reached, other, moved, jnp.minimum(2 * length, LONGEST)
            return jax.tree.map(
                lambda new, old: jnp.where(better, new, old),
                following,
                (best, slope, state, length / 2),
            ), None

        first = X0.brought_inside(state, middle, scale)
        begun = (*jax.value_and_grad(value)(first), first, jnp.array(0.5))
        return jax.lax.scan(improve, begun, length=ASCENT_STEPS)[0][2]

    return jax.vmap(climb)(states, which)
