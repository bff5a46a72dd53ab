"""The derivatives of bounds over a horizon, by forms where the bounds are attained.

Compiled forms of the whole horizon have the derivatives of its rows. They are compiled for these
alone, once for all steps of a tube: nobody asks for their values.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from reachjax.loops import ClosedLoop
from reachjax.loops.tracing.functions import with_constants
from reachjax.loops.units import AbstractUnit, Mark
from reachjax.numerics.checks import is_concrete
from reachjax.numerics.compilations import ONCE
from reachjax.numerics.derivatives import moved_by
from reachjax.programs.affine import AffineForms
from reachjax.programs.affine_steps import UnitForms, states_facts, step_columns, step_forms
from reachjax.programs.initial import Ends, InitialColumns
from reachjax.sets import AbstractSet, Box

INTERVAL, KNOWN = -1, -2
"""In the place of a bound's number: that of an interval, and what is known of a state besides."""

Carry = tuple[AffineForms, Array]


class HeldBounds(NamedTuple):
    """Where bounds of rows over a horizon are attained, of which derivatives are taken.

    A bound is the largest value of its row and of weighed facts over the columns; those where it is
    attained are held, and multipliers (the envelope theorem). Directions of states come first.

    Attributes:
        columns: `(B, n)`, where each is attained, in the places of compiled forms.
        of_units: `(P, N, b, units)`, multipliers of the facts of each unit, of which there are `b`,
            of the first bounds; all others have none.
        of_set: `(P, r)`, of the facets of the initial set.
        by_interval: `(f,)`, whether directions are bounded by intervals instead.
        ranges: `(N, 2, inputs)`, lower and upper bounds of the units' inputs, as they were known.
        of_ranges: `(N, 2, inputs)`, which of the bounds they are, or `INTERVAL`.
        states: `(N, 2, n_x)`, those of states.
        of_states: `(N, 2, n_x)`, which of the bounds they are, or `INTERVAL`, or `KNOWN`.
    """

    columns: Float[Array | np.ndarray, "B n"]
    of_units: Float[Array | np.ndarray, "P N b units"]
    of_set: Float[Array | np.ndarray, "P r"]
    by_interval: Bool[Array | np.ndarray, " f"]
    ranges: Float[Array | np.ndarray, "N 2 inputs"]
    of_ranges: Int[Array | np.ndarray, "N 2 inputs"]
    states: Float[Array | np.ndarray, "N 2 n_x"]
    of_states: Int[Array | np.ndarray, "N 2 n_x"]

    @property
    def intervals(self) -> bool:
        """Whether any bound is that of an interval."""
        parts = self.by_interval, self.of_ranges == INTERVAL, self.of_states == INTERVAL
        return any(np.any(part) for part in parts)


class Moving(NamedTuple):
    """What bounds have derivatives in.

    Attributes:
        loop: the closed loop.
        X0: the initial set.
        box: around it.
        directions: one row a bound.
        known: bounds of the states that narrow their intervals.
    """

    loop: ClosedLoop
    X0: AbstractSet
    box: Box
    directions: Float[Array, "f n_x"]
    known: Float[Array, "N 2 n_x"]


def moving(parts: Moving, held: HeldBounds, k: int, t: int) -> Float[Array, " f"]:
    """Zeros with the derivatives of bounds of directions after `k` steps.

    Args:
        parts: what the bounds have derivatives in.
        held: where they are attained, and those of ranges that they rest on.
        k: the number of steps.
        t: the time of the initial set.
    """
    return _zeros(parts._replace(loop=with_constants(parts.loop)), held, k, t)


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def _zeros(parts: Moving, held: HeldBounds, k: int, t: int) -> Float[Array, " f"]:
    return jnp.zeros(len(parts.directions))


def _forward(parts: Moving, held: HeldBounds, k: int, t: int) -> Any:
    return _zeros(parts, held, k, t), (parts, held, k)


def _backward(t: int, given: Any, slopes: Float[Array, " f"]) -> tuple[Moving, None, None]:
    parts, held, k = given
    options = ONCE if is_concrete(slopes, parts) else {}  # code within other code takes none
    pulled = jax.jit(_pulled, static_argnames=("t", "intervals"), compiler_options=options)
    return pulled(parts, held, k, slopes, t=t, intervals=held.intervals), None, None


_zeros.defvjp(_forward, _backward)


def _pulled(
    parts: Moving, held: HeldBounds, k: Array, slopes: Float[Array, " f"], t: int, intervals: bool
) -> Moving:
    """Derivatives of the bounds after `k` steps, weighed."""
    leaves, tree = jax.tree.flatten(parts)
    moves = [jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves]
    some = [leaf for leaf, it_moves in zip(leaves, moves, strict=True) if it_moves]

    def weighed(some: list[Array]) -> Array:
        given = iter(some)
        whole = [
            next(given) if it_moves else leaf for leaf, it_moves in zip(leaves, moves, strict=True)
        ]
        loop, X0, box, directions, known = jax.tree.unflatten(tree, whole)
        return slopes @ _values(loop, X0, box, directions, held, known, t, intervals)[k - 1]

    found = iter(jax.grad(weighed)(some))
    return jax.tree.unflatten(tree, [next(found) if it_moves else None for it_moves in moves])


def _values(
    loop: ClosedLoop,
    X0: AbstractSet,
    box: Box,
    directions: Float[Array, "f n_x"],
    held: HeldBounds,
    known: Float[Array, "N 2 n_x"],
    t: int,
    intervals: bool,
) -> Float[Array, "N f"]:
    """Values after 1, ..., N steps where bounds are attained."""
    loop.require_units(inputs=held.ranges.shape[-1])
    start, steps = InitialColumns.of(X0, box, loop.curved), len(held.ranges)
    (more, between), first = step_columns(loop), start.count
    end, weights = first + steps * more, jnp.moveaxis(jnp.asarray(held.of_units), 1, 0)
    columns, count = jnp.asarray(held.columns), len(held.of_units)
    state, total = AffineForms.beginning(start, end + between), jnp.zeros(count)

    def weighed(facts: AffineForms, weights: Float[Array, "P k"]) -> Float[Array, " P"]:
        values = facts.rows[:, 0] + columns[:count] @ facts.columns.T
        return (weights * values).sum(axis=1)

    if held.of_set.shape[1]:
        A, b = X0.facets
        total = weighed(b - A @ state, jnp.asarray(held.of_set))

    def advance(carry: Carry, step: Any) -> tuple[Carry, Array]:
        (state, total), (k, given, ranges_known, of_ranges, *of_state) = carry, step
        told = done = 0

        def attained(rows: AffineForms, which: Any) -> Any:
            weighed = jnp.where(which < count, total[jnp.minimum(which, count - 1)], 0.0)
            return rows.rows[:, 0] + (rows.columns * columns[which]).sum(axis=1) + weighed

        def tell(units: Sequence[UnitForms]) -> None:
            """Add what bounds make of the facts of layers that are new."""
            nonlocal total, told, done
            for layer in units[told:]:
                here, done = slice(done, done + len(layer.gap)), done + len(layer.gap)
                if not states_facts(layer.unit):
                    continue
                ends: Any = layer.lower, layer.upper
                said = layer.unit.facts(layer.inputs, layer.outputs, *ends)
                sectors = (block.rows for block in said.blocks if block.mark is Mark.SECTOR)
                for rows, of_unit in zip(sectors, jnp.moveaxis(given, 1, 0), strict=False):
                    total = total + weighed(rows, of_unit[:, here])
            told = len(units)

        def ranges(
            unit: AbstractUnit | None, y: AffineForms, ends: Ends, found: Sequence[UnitForms]
        ) -> Ends:
            tell(found)
            first = sum(len(layer.lower) for layer in found)
            here = slice(first, first + len(y))
            values, which, besides = of_state if unit is None else (ranges_known, of_ranges, None)
            moved = []
            sides = zip((-y, y), (-1, 1), values, which, y.ends_by_interval(), strict=True)
            for side, (form, sign, value, bound, end) in enumerate(sides):
                if unit is not None:
                    value, bound = value[here], bound[here]
                by_form = sign * attained(form, jnp.maximum(bound, 0))
                moving = jnp.where(bound == INTERVAL, end, by_form) if intervals else by_form
                if besides is not None:
                    moving = jnp.where(bound == KNOWN, besides[side], moving)
                moved.append(moved_by(value, moving))
            return moved[0], moved[1]

        place = first + k * more
        following, *_ = step_forms(
            loop, state, t + k, start, place=place, scratch=end, ranges=ranges
        )
        forms = directions @ following
        by_form = attained(forms, np.arange(len(directions)))
        found = jnp.where(held.by_interval, forms.ends_by_interval()[1], by_form)
        if not intervals:
            found, radii = by_form, jax.lax.stop_gradient(following.radii)
            following = AffineForms(following.rows, radii)
        return (following, total), found

    parts = held.ranges, held.of_ranges, held.states, held.of_states
    given = jnp.arange(steps), weights, *map(jnp.asarray, parts), known
    return jax.lax.scan(advance, (state, total), given)[1]
