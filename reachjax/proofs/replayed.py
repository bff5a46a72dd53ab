"""The derivative of a bound by branches, as that of a number that is simulated.

A leaf bounds `(c + sum_i lambda_i p_i) . eta` over the columns `eta`. Where that is largest, at
`eta*`, the row's derivative is the bound's, multipliers and `eta*` being held (the envelope
theorem). A row's value at `eta*` needs no row: it is a run of the loop from the initial state that
`eta*` holds, each unit's value being `slope y + offset` as `eta*` says, with what the facts are
along the way. Slopes and gaps of units are held too; where a facet is proved exact, they do not
matter, and this is the derivative of the worst trajectory.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.loops import ClosedLoop
from reachjax.loops.units import AbstractUnit, Mark
from reachjax.numerics.pytrees import Replaceable, pytree
from reachjax.programs.horizon import Horizon
from reachjax.programs.initial import InitialColumns
from reachjax.sets import AbstractSet, Box


@pytree
class Replay(Replaceable):
    """What is held of the leaves of some facets, over `N` steps.

    Attributes:
        initial: `(f, n_w)`, the columns of the initial state.
        slopes: `(N, units)`.
        offsets: `(f, N, units)`.
        multipliers: `(f, N, b, units)`, of the facts of each unit, of which there are `b`.
        of_set: `(f, r)`, those of the facets of the initial set.
    """

    initial: Float[Array | np.ndarray, "f n_w"]
    slopes: Float[Array | np.ndarray, "N units"]
    offsets: Float[Array | np.ndarray, "f N units"]
    multipliers: Float[Array | np.ndarray, "f N b units"]
    of_set: Float[Array | np.ndarray, "f r"]

    @classmethod
    def of(
        cls,
        horizon: Horizon,
        columns: Float[np.ndarray, "f n"],
        multipliers: Float[np.ndarray, "f m"],
        steps: int,
    ) -> Replay:
        """That of one leaf for each facet.

        Args:
            horizon: whose facts they are, over some of the steps.
            columns: where each leaf attains its bound.
            multipliers: of the facts.
            steps: `N`, those of the horizon and more.
        """
        facets, units = len(columns), sum(len(layer.places) for layer in horizon.steps[0])
        slopes, offsets = np.zeros((steps, units)), np.zeros((facets, steps, units))
        for step, layers in enumerate(horizon.steps):
            places, slope, offset, gap = (
                np.concatenate([getattr(layer, name) for layer in layers] or [np.zeros(0)])
                for name in ("places", "slope", "offset", "gap")
            )
            own = columns[:, places.astype(int)] * (places >= 0)
            slopes[step], offsets[:, step] = slope, offset + gap * own
        step, unit, kind = horizon.origins.T
        of_units, of_set = step >= 0, step < 0
        found = np.zeros((facets, steps, kind.max(initial=0) + 1, units))
        found[:, step[of_units], kind[of_units], unit[of_units]] = multipliers[:, of_units]
        initial = columns[:, : horizon.start.spread.shape[1]]
        return cls(initial, slopes, offsets, found, multipliers[:, of_set])


@partial(jax.jit, static_argnames="start")
def replayed(
    loop: ClosedLoop,
    X0: AbstractSet,
    box: Box,
    directions: Float[Array, "f n_x"],
    replay: Replay,
    k: Array | int,
    start: int = 0,
) -> Float[Array, " f"]:
    """Numbers `(f,)` whose derivatives in loop, set and directions are those of the bounds."""
    initial, (cut, ball) = InitialColumns.of(X0, box), X0.parts
    cornered = ball is None and replay.of_set.shape[1] > 0
    slopes = jax.lax.stop_gradient(replay.slopes)
    steps = len(slopes)

    def of_facet(direction, columns, offsets, multipliers, of_set):
        x = initial.center + initial.spread @ columns
        if cornered:  # by facets alone
            x = jax.lax.stop_gradient(x)
        total = jnp.zeros(())
        if len(of_set):
            A, b = cut.facets
            total += of_set @ (b - A @ x)

        def advance(carry, given):
            x, total = carry
            t, slope, offset, weights = given
            done, facts = 0, jnp.zeros(())

            def unit(unit: AbstractUnit, y: Array) -> Array:
                nonlocal done, facts
                here, done = slice(done, done + len(y)), done + len(y)
                z = slope[here] * y + offset[here]
                blocks = unit.facts(y, z, y, y).blocks
                sectors = (block.rows for block in blocks if block.mark is Mark.SECTOR)
                for rows, weight in zip(sectors, weights, strict=False):
                    facts += weight[here] @ rows
                return z

            following = loop.step(x, start + t, unit)
            return (following, total + facts), (following, total + facts)

        given = jnp.arange(steps), slopes, offsets, multipliers
        _, (states, totals) = jax.lax.scan(advance, (x, total), given)
        return direction @ states[k - 1] + totals[k - 1]

    parts = replay.initial, replay.offsets, replay.multipliers, replay.of_set
    return jax.vmap(of_facet)(directions, *jax.lax.stop_gradient(parts))
