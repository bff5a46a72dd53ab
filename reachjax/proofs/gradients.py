"""Derivatives of bounds as they are proved, what a solver or branches proposed being held.

The offset that multipliers prove is the largest value of a quadratic function on a ball (strong
duality of trust regions; `eta` as in `recheck`, with `n` entries of which one is constant):

    2 b  =  max { [eta, 1] M [eta, 1]' : |eta|^2 <= n - 1 },    M = F' Gamma F + p e' + e p'.

With `X` the moments of a maximiser, `db = <X / 2, dM>`: the derivative of a bound that holds,
however far the multipliers are from the best ones. Where they are the best, `b` has a kink in most
programs, and the moments of the dual, which are those of several maximisers, tell more than one of
them does: where a solver has them they are used instead (`reported`). A bound by intervals is
`p [s, 1]` with `s` the signs of `p`, which is the same with no multipliers.

**By branches.** A leaf bounds `(c + sum_i lambda_i p_i) . eta` over the columns `eta`. Where that
is largest, at `eta*`, the row's derivative is the bound's, multipliers and `eta*` being held (the
envelope theorem). A row's value at `eta*` needs no row: it is a run of the loop from the initial
state that `eta*` holds, each unit's value being `slope y + offset` as `eta*` says, with what the
facts are along the way.

Where units are as they should be at `eta*`, the bound is the value of a trajectory. A unit is then
its own line there, but where it is bent; so this is the derivative of the worst trajectory, which
the multipliers of facts keep on the bends that it rests on. Elsewhere the lines that hold the unit
count as given, though they depend on ranges, and these on the loop: the derivative lacks that part.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from reachjax.loops import ClosedLoop
from reachjax.loops.tracing.functions import Compiled
from reachjax.loops.units import AbstractUnit, Mark
from reachjax.numerics.pytrees import Replaceable, pytree
from reachjax.numerics.rounding import Ball
from reachjax.programs.affine_steps import UnitForms
from reachjax.programs.horizon import Horizon
from reachjax.programs.initial import InitialColumns
from reachjax.programs.lmi import Program, form_rows
from reachjax.proofs.recheck import (
    best_offset,
    bordered,
    clipped,
    half_square_by_intervals,
    matrix,
    sound_level,
    squared,
)
from reachjax.sets import AbstractSet, Box, NormalForm


class Held(NamedTuple):
    """What the derivative of bounds rests on: that of `<X, Z>` (`lmi`), these being held.

    Attributes:
        multipliers: `(f, K)`.
        moments: `(f, N, N)`.
    """

    multipliers: Float[Array | np.ndarray, "f K"]
    moments: Float[Array | np.ndarray, "f N N"]


def held_offsets(
    program: Program,
    multipliers: Float[np.ndarray, "f K"],
    by_multipliers: Bool[np.ndarray, " f"],
) -> Held:
    """Multipliers and moments of the bound of each offset.

    Args:
        program: of finite numbers.
        multipliers: of each facet.
        by_multipliers: where these prove the offset; elsewhere it is that of intervals.
    """
    rows = program.objective
    moments = np.zeros((*rows.mid.shape, rows.mid.shape[1]))
    for i, (mid, rad) in enumerate(zip(rows.mid, rows.rad, strict=True)):
        if by_multipliers[i]:
            moments[i] = _moments(program, multipliers[i], bordered(mid, rad))
        else:
            corner = np.append(np.sign(mid[:-1]), 1.0)
            moments[i] = np.outer(corner, corner)
    return Held(np.where(by_multipliers[:, None], clipped(program, multipliers), 0.0), moments)


def held_level(program: Program, multipliers: Float[np.ndarray, "1 K"], form: NormalForm) -> Held:
    """Multipliers and moments of the bound of a level, by multipliers or by intervals.

    The level `s` is `sound_level`'s; with `V = A x+ + b`, `s ds = <X / 2, d(F' Gamma F + V' V)>`.
    Zero where the level is.
    """
    V = form_rows(program, form)
    q, n = V.mid.shape
    moments, held = np.zeros((1, n + q, n + q)), np.zeros_like(multipliers)
    level = sound_level(program, multipliers, form)
    if not 0 < level < np.inf:
        return Held(held, moments)
    if level**2 / 2 < half_square_by_intervals(V):
        X = _moments(program, multipliers[0], squared(V))
        held, rows = clipped(program, multipliers) / level, V.mid @ X / level
        moments[0, :n, :n] = -X / 2
    else:
        signs = np.sign(V.mid)
        rows = signs * abs(V.mid).sum(axis=1, keepdims=True) / level
    moments[0, n:, :n] = rows / 2
    return Held(held, moments)


def _moments(program: Program, multipliers: np.ndarray, goal: Ball) -> Float[np.ndarray, "n n"]:
    """Moments of a maximiser; of two, with their mean, where the ball alone bounds a direction."""
    mid, _ = matrix(program, multipliers, goal)
    shift = best_offset(mid)[1]
    values, vectors = np.linalg.eigh(mid[:-1, :-1])
    inner = (vectors.T @ mid[-1, :-1]) / np.where(shift > values, shift - values, np.inf)
    point = np.append(vectors @ inner, 1.0)
    X = np.outer(point, point)
    room = len(inner) - float(np.sum(inner**2))
    if shift > 0 and room > 0:
        X[:-1, :-1] += room * np.outer(vectors[:, -1], vectors[:, -1])
    whole, used = np.zeros((len(program.used),) * 2), np.flatnonzero(program.used)
    whole[np.ix_(used, used)] = X
    return whole


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
    if unit.curved and unit.inputs > 1:
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
    loop.require_units(inputs=replay.slopes.shape[-1])
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
