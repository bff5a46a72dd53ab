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
from reachjax.sets import AbstractSet, Box, Ellipsoid, Intersection, PolyhedralSet

STEPS = 80
"""Gradient steps of an ascent. After 60, one on a polytope of six dimensions lacked 1e-4."""

SWEEPS = 20
"""Rounds of projections onto the facets of a polytope, one after the other."""

LONGEST = 4.0
"""The longest step, in half-widths of the set: from further away projections are worse."""

INSIDE = 1 - 1e-9
"""What is projected onto a set that is no box ends this close to its edge, seen from inside."""


@partial(jax.jit, static_argnames=("horizon", "start"))
def ascended(
    loop: ClosedLoop,
    X0: AbstractSet,
    box: Box,
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
        box: around it.
        middle: a point in its interior, if it has any.
        states: where to begin.
        region: a set whose bounded values are sought.
        which: of these values, one for each state.
        k: after how many steps.
        horizon: how many steps are simulated.
        start: the time of the initial set.
    """
    scale = X0.from_ball() if isinstance(X0, Ellipsoid) else jnp.diag((box.upper - box.lower) / 2)

    def climb(state: Float[Array, " n_x"], number: Int[Array, ""]) -> Float[Array, " n_x"]:
        def value(state):
            after = loop.simulate(state, horizon, start)[k]
            return region.bounded_values(after)[number]

        def improve(carry, _):
            best, slope, state, length = carry
            uphill = scale.T @ slope
            size = jnp.linalg.norm(uphill)
            unit = uphill / jnp.where(size > 0, size, 1.0)
            moved = _projected(X0, box, middle, scale, state + length * scale @ unit)
            reached, other = jax.value_and_grad(value)(moved)
            better = reached > best
            following = reached, other, moved, jnp.minimum(2 * length, LONGEST)
            return jax.tree.map(
                lambda new, old: jnp.where(better, new, old),
                following,
                (best, slope, state, length / 2),
            ), None

        first = _projected(X0, box, middle, scale, state)
        begun = (*jax.value_and_grad(value)(first), first, jnp.array(0.5))
        return jax.lax.scan(improve, begun, length=STEPS)[0][2]

    return jax.vmap(climb)(states, which)


def _projected(
    X0: AbstractSet,
    box: Box,
    middle: Float[Array, " n_x"],
    scale: Float[Array, "n_x n_x"],
    state: Float[Array, " n_x"],
) -> Float[Array, " n_x"]:
    """A point of the set, about the closest one to a state where `scale` is the unit."""
    if isinstance(X0, Box):
        return jnp.clip(state, box.lower, box.upper)
    limits = []
    if isinstance(X0, Ellipsoid | Intersection):
        ball = X0 if isinstance(X0, Ellipsoid) else X0.ellipsoid
        state = ball.center + (state - ball.center) / jnp.maximum(ball.bounded_values(state), 1.0)
        limits = [jnp.ones(1)]
    polytope = X0.polytope if isinstance(X0, Intersection) else X0
    if isinstance(polytope, PolyhedralSet):
        A, b = polytope.facets
        state, limits = _onto_facets(A, b, scale, state), [b, *limits]
    # what a set bounds is convex: on the way from the middle it grows at most linearly
    limit = jnp.concatenate(limits)
    here, there = X0.bounded_values(middle), X0.bounded_values(state)
    grown = jnp.where(there > here, there - here, 1.0)  # not where the middle is outside as well
    share = jnp.where(there > limit, jnp.maximum(limit - here, 0.0) / grown, 1.0)
    return middle + INSIDE * jnp.min(share) * (state - middle)


def _onto_facets(
    A: Float[Array, "m n_x"],
    b: Float[Array, " m"],
    scale: Float[Array, "n_x n_x"],
    state: Float[Array, " n_x"],
) -> Float[Array, " n_x"]:
    """The closest point of `A x <= b`, by ascent in the multiplier of one facet at a time.

    Source: Hildreth, A quadratic programming procedure (1957).
    """
    along = A @ scale @ scale.T
    squares = jnp.sum(A * along, axis=1)

    def onto(carry, facet):
        state, weights = carry
        over = (A[facet] @ state - b[facet]) / jnp.where(squares[facet] > 0, squares[facet], 1.0)
        weight = jnp.maximum(weights[facet] + over, 0.0)
        moved = state - (weight - weights[facet]) * along[facet]
        return (moved, weights.at[facet].set(weight)), None

    order = jnp.tile(jnp.arange(len(b)), SWEEPS)
    return jax.lax.scan(onto, (state, jnp.zeros(len(b))), order)[0][0]
