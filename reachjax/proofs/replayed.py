"""The derivative of a bound by branches, as that of a number that is simulated.

A leaf bounds `(c + sum_i lambda_i p_i) . eta` over the columns `eta`. Where that is largest, at
`eta*`, the row's derivative is the bound's, multipliers and `eta*` being held (the envelope
theorem). A row's value at `eta*` needs no row: it is a run of the loop from the initial state that
`eta*` holds, each unit's value being `slope y + offset` as `eta*` says, with what the facts are
along the way.

Where units are as they should be at `eta*`, the bound is the value of a trajectory. A unit is then
its own line there, but where it is bent; so this is the derivative of the worst trajectory, which
the multipliers of facts keep on the bends that it rests on. Elsewhere the lines that hold the unit
count as given, though they depend on ranges, and these on the loop: the derivative lacks that part.
"""

from __future__ import annotations

from functools import partial
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.loops import ClosedLoop
from reachjax.loops.tracing.functions import Compiled
from reachjax.loops.units import AbstractUnit, Bilinear, Mark
from reachjax.numerics.pytrees import Replaceable, pytree
from reachjax.programs.affine_steps import UnitForms
from reachjax.programs.horizon import Horizon
from reachjax.programs.initial import InitialColumns
from reachjax.sets import AbstractSet, Box

NEAR = 1e-6
"""Values that differ by less, in parts of the range of a unit's input, are the same."""


@pytree
class Replay(Replaceable):
    """What is held of the leaves of some facets, over `N` steps.

    Attributes:
        initial: `(f, n_w)`, the columns of the initial state.
        slopes: `(f, N, inputs)`, of each input of a unit.
        offsets: `(f, N, units)`.
        multipliers: `(f, N, b, units)`, of the facts of each unit, of which there are `b`.
        of_set: `(f, r)`, those of the facets of the initial set.
    """

    initial: Float[Array | np.ndarray, "f n_w"]
    slopes: Float[Array | np.ndarray, "f N inputs"]
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
        """The replay of one leaf for each facet.

        Args:
            horizon: whose facts they are, over some of the steps.
            columns: where each leaf attains its bound.
            multipliers: of the facts.
            steps: `N`, those of the horizon and more.
        """
        first, shape = horizon.steps[0], (len(columns), steps)
        slopes = np.zeros((*shape, sum(len(layer.lower) for layer in first)))
        offsets = np.zeros((*shape, sum(len(layer.gap) for layer in first)))
        for step, layers in enumerate(horizon.steps):
            parts = [_lines(layer, columns) for layer in layers]
            if parts:
                slopes[:, step], offsets[:, step] = (
                    np.concatenate(each, axis=1) for each in zip(*parts, strict=True)
                )
        of_units, of_set = (
            horizon.of_units(multipliers, steps),
            horizon.of_set(multipliers),
        )
        initial = columns[:, : horizon.start.spread.shape[1]]
        return cls(initial, slopes, offsets, of_units, of_set)


def _lines(
    layer: UnitForms, columns: Float[np.ndarray, "f n"]
) -> tuple[Float[np.ndarray, "f inputs"], Float[np.ndarray, "f k"]]:
    """Slopes and offsets of units at these columns."""
    width, unit = layer.inputs.columns.shape[1], cast(Any, layer.unit)
    y = columns[:, :width] @ layer.inputs.columns.T + layer.inputs.rows[:, 0]
    switching = layer.places >= 0
    own = np.where(switching, columns[:, np.maximum(layer.places, 0)], 0.0)
    if isinstance(unit, Bilinear):
        width = layer.outputs.columns.shape[1]
        z = columns[:, :width] @ layer.outputs.columns.T + layer.outputs.rows[:, 0]
        slope = unit.derivative(y)
        return slope, np.asarray(z - unit.combined(slope * y))
    z = layer.slope * y + layer.offset + layer.gap * own
    near = NEAR * (layer.upper - layer.lower)
    lines = unit.lines(y - near, y + near)
    its_own = switching & lines.affine & (abs(unit(y) - z) <= near)
    slope = np.where(its_own, lines.above.slope, layer.slope)
    return slope, np.asarray(z - slope * y)


@partial(Compiled, static_argnames="start")
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
    initial, (_, ball) = InitialColumns.of(X0, box), X0.parts
    cornered = ball is None and replay.of_set.shape[1] > 0
    steps = replay.slopes.shape[1]

    def of_facet(direction, columns, slopes, offsets, multipliers, of_set):
        x = initial.center + initial.spread @ columns
        if cornered:  # by facets alone
            x = jax.lax.stop_gradient(x)
        total = jnp.zeros(())
        if len(of_set):
            A, b = X0.facets
            total += of_set @ (b - A @ x)

        def advance(carry, given):
            x, total = carry
            t, slope, offset, weights = given
            done, seen, facts = 0, 0, jnp.zeros(())

            def unit(unit: AbstractUnit, *given: Array) -> Array:
                nonlocal done, seen, facts
                y = jnp.concatenate(given)
                slopes, seen = slope[seen : seen + len(y)], seen + len(y)
                sums = unit.combined(slopes * y)
                here, done = slice(done, done + len(sums)), done + len(sums)
                z = sums + offset[here]
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

    parts = replay.initial, replay.slopes, replay.offsets, replay.multipliers, replay.of_set
    return jax.vmap(of_facet)(directions, *jax.lax.stop_gradient(parts))
