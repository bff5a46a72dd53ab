"""Projected gradient ascent: scenarios whose trajectories go far.

The loop is piecewise affine, so an ascent ends at a corner of a piece or on the edge of the set. A
solver's proposal is often the best state already, up to its tolerance, and a few steps remove that.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from reachjax.loops import ClosedLoop
from reachjax.loops.scenarios import Scenarios
from reachjax.loops.tracing.functions import Compiled
from reachjax.sets import AbstractSet

ASCENT_STEPS = 80
"""Gradient steps of an ascent. After 60, one on a polytope of six dimensions lacked 1e-4."""

LONGEST = 4.0
"""The longest step, in half-widths of the set: from further away projections are worse."""


@partial(Compiled, static_argnames=("horizon", "start"))
def ascended(
    loop: ClosedLoop,
    scenarios: Scenarios,
    scale: Float[Array, "n_x n_x"],
    middle: Float[Array, " s"],
    begin: Float[Array, "m s"],
    region: AbstractSet,
    which: Int[Array, " m"],
    k: int,
    horizon: int,
    start: int,
) -> Float[Array, "m s"]:
    """Scenarios of larger values after `k` steps: initial states in their set, and what is drawn.

    Steps and projections are measured in the box around a set, or where an ellipsoid is a ball;
    where the loop is affine, an ascent ends at the largest value, but for polytopes with corners so
    sharp that projections onto them do not converge. Steps double where they gain, and are halved
    where they do not.

    Args:
        loop: the closed loop.
        scenarios: all of them.
        scale: in which steps and projections of initial states are measured.
        middle: a scenario in their interior, if they have any.
        begin: where to begin.
        region: a set whose bounded values are sought.
        which: of these values, one for each scenario.
        k: after how many steps.
        horizon: how many steps are simulated.
        start: the time of the initial set.
    """

    def climb(begin: Float[Array, " s"], number: Int[Array, ""]) -> Float[Array, " s"]:
        def value(scenario):
            states, disturbances, noises = scenarios.split(scenario)
            drawn = {"disturbances": disturbances, "noises": noises}
            after = loop.simulate(states, horizon, start, **drawn)[k]
            return region.bounded_values(after)[number]

        def improve(carry, _):
            best, slope, scenario, length = carry
            ahead = scenario + length * scenarios.uphill(slope, scale)
            moved = scenarios.brought_inside(ahead, middle, scale)
            reached, other = jax.value_and_grad(value)(moved)
            better = reached > best
            following = reached, other, moved, jnp.minimum(2 * length, LONGEST)
            return jax.tree.map(
                lambda new, old: jnp.where(better, new, old),
                following,
                (best, slope, scenario, length / 2),
            ), None

        first = scenarios.brought_inside(begin, middle, scale)
        begun = (*jax.value_and_grad(value)(first), first, jnp.array(0.5))
        return jax.lax.scan(improve, begun, length=ASCENT_STEPS)[0][2]

    return jax.vmap(climb)(begin, which)
