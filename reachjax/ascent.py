"""Projected gradient ascent: initial states whose trajectories go far.

The loop is piecewise affine, so an ascent ends at a corner of a piece or on the edge of the set. A
solver's proposal is often the best state already, up to its tolerance, and a few steps remove that.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from reachjax.sets import AbstractSet, Box, Ellipsoid, Intersection, PolyhedralSet
from reachjax.systems import ClosedLoop

STEPS = 60
"""Gradient steps of an ascent."""

SWEEPS = 20
"""Rounds of projections onto the facets of a polytope, one after the other."""

INSIDE = 1 - 1e-9
"""What is projected is brought towards the middle of a set that is no box by this factor."""


@partial(jax.jit, static_argnames=("horizon", "start"))
def ascended(
    loop: ClosedLoop,
    X0: AbstractSet,
    box: Box,
    states: Float[Array, "m n_x"],
    region: AbstractSet,
    which: Int[Array, " m"],
    k: int,
    horizon: int,
    start: int,
) -> Float[Array, "m n_x"]:
    """Initial states of larger values after `k` steps, close to the set of initial states.

    Steps are measured in the box around that set; they double where they gain, and are halved where
    they do not.

    Args:
        loop: the closed loop.
        X0: the set of initial states.
        box: around it.
        states: where to begin.
        region: a set whose bounded values are sought.
        which: of these values, one for each state.
        k: after how many steps.
        horizon: how many steps are simulated.
        start: the time of the initial set.
    """
    widths = (box.upper - box.lower) / 2
    center = (box.upper + box.lower) / 2

    def climb(state: Float[Array, " n_x"], number: Int[Array, ""]) -> Float[Array, " n_x"]:
        def value(state):
            after = loop.simulate(state, horizon, start)[k]
            return region.bounded_values(after)[number]

        def improve(carry, _):
            best, slope, state, length = carry
            uphill = widths * slope
            size = jnp.linalg.norm(uphill)
            unit = uphill / jnp.where(size > 0, size, 1.0)
            moved = _projected(X0, box, center, state + length * widths * unit)
            reached, other = jax.value_and_grad(value)(moved)
            better = reached > best
            following = reached, other, moved, 2 * length
            return jax.tree.map(
                lambda new, old: jnp.where(better, new, old),
                following,
                (best, slope, state, length / 2),
            ), None

        first = _projected(X0, box, center, state)
        begun = (*jax.value_and_grad(value)(first), first, jnp.array(0.5))
        return jax.lax.scan(improve, begun, length=STEPS)[0][2]

    return jax.vmap(climb)(states, which)


def _projected(
    X0: AbstractSet, box: Box, center: Float[Array, " n_x"], state: Float[Array, " n_x"]
) -> Float[Array, " n_x"]:
    """A point of the set close to a state: the closest one of a box, about that of others."""
    state = jnp.clip(state, box.lower, box.upper)
    if isinstance(X0, Box):
        return state
    if isinstance(X0, Ellipsoid | Intersection):
        ball = X0 if isinstance(X0, Ellipsoid) else X0.ellipsoid
        reached = jnp.linalg.norm(ball.normal_form.A @ state + ball.normal_form.b)
        state = ball.center + (state - ball.center) / jnp.maximum(reached, 1.0)
    polytope = X0.polytope if isinstance(X0, Intersection) else X0
    if isinstance(polytope, PolyhedralSet):
        A, b = polytope.facets
        squares = jnp.sum(A**2, axis=1)

        def onto(state, facet):
            over = jnp.maximum(A[facet] @ state - b[facet], 0.0)
            return state - over / squares[facet] * A[facet], None

        state = jax.lax.scan(onto, state, jnp.tile(jnp.arange(len(b)), SWEEPS))[0]
    return center + INSIDE * (state - center)
