"""The whole horizon in affine forms: bounds of directions of every later state, over `X_0` alone.

On the host step by step in numpy, where nothing is compiled; for traced numbers as one `scan`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from reachjax.loops import ClosedLoop
from reachjax.loops.functions import Compiled
from reachjax.loops.units import AbstractUnit, Mark
from reachjax.numerics.host import in_numpy
from reachjax.programs.affine import AffineForms
from reachjax.programs.affine_steps import UnitForms, states_facts, step_columns, step_forms
from reachjax.programs.initial import Ends, InitialColumns, constant
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
        ranges: `(N, 2, units)`, lower and upper bounds of the units' inputs, as they were known.
        of_ranges: `(N, 2, units)`, which of the bounds they are, or `INTERVAL`.
        states: `(N, 2, n_x)`, those of states.
        of_states: `(N, 2, n_x)`, which of the bounds they are, or `INTERVAL`, or `KNOWN`.
    """

    columns: Float[Array | np.ndarray, "B n"]
    of_units: Float[Array | np.ndarray, "P N b units"]
    of_set: Float[Array | np.ndarray, "P r"]
    by_interval: Bool[Array | np.ndarray, " f"]
    ranges: Float[Array | np.ndarray, "N 2 units"]
    of_ranges: Int[Array | np.ndarray, "N 2 units"]
    states: Float[Array | np.ndarray, "N 2 n_x"]
    of_states: Int[Array | np.ndarray, "N 2 n_x"]


class ByForms(NamedTuple):
    """What affine forms say of the states of one step; or of `N` steps, with a leading axis.

    Attributes:
        offsets: `(m,)`, upper bounds of the directions.
        slopes: `(units,)`, of the lines that stand for the units of the step before.
        corners: `(m, n_x)`, initial states at which the forms are largest, but for their columns of
            units and what cuts the initial set.
        drawn: for each step so far the values `(m, d)` of disturbances there; nothing of compiled
            code.
    """

    offsets: Float[Array | np.ndarray, "*N m"]
    slopes: Float[Array | np.ndarray, "*N units"]
    corners: Float[Array | np.ndarray, "*N m n_x"]
    drawn: tuple[Float[np.ndarray, "m d"], ...] = ()


def unrolled(
    loop: ClosedLoop,
    X0: AbstractSet,
    box: Box,
    directions: Float[np.ndarray, "N m n_x"],
    t: int = 0,
    slopes: Float[np.ndarray, "N units"] | None = None,
    known: Sequence[Box] | None = None,
) -> Iterator[ByForms]:
    """Bounds of directions of the states after 1, ..., N steps, one step after the other in numpy.

    Args:
        loop: of concrete numbers.
        X0: the initial set.
        box: around it.
        directions: one row a facet, for each step.
        t: the time of the initial set.
        slopes: of lines for the units of each step, of which any are sound; None for good ones.
        known: boxes that surely hold the states after each step, where they are known.

    Example:
        >>> from reachjax import MLP, AffinePlant
        >>> net = MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
        >>> loop, X0 = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net), Box([1.0], [2.0])
        >>> [step.offsets.round(6).tolist() for step in unrolled(loop, X0, X0, np.ones((2, 1, 1)))]
        [[1.2], [0.72]]
    """
    loop, X0, box, known = map(in_numpy, (loop, X0, box, known))
    with np.errstate(all="ignore"):  # what overflows ends as infinity or NaN, which is no bound
        start = InitialColumns.of(X0, box, loop.curved)
        state = AffineForms.beginning(start)
    free: list[np.ndarray] = []
    for k, rows in enumerate(np.asarray(directions)):
        with np.errstate(all="ignore"):
            given = None if slopes is None else np.asarray(slopes[k])
            held = None if known is None else known[k]
            state, units, _ = step_forms(loop, state, t + k, start, slopes=given, known=held)
            forms = rows @ state
            found = _bounds(forms, units, start)
        here = [layer.places for layer in units if layer.unit.free]
        free.append(np.concatenate([np.zeros(0, int), *here]))
        yield found._replace(drawn=tuple(np.sign(forms.columns[:, each]) for each in free))


@partial(Compiled, static_argnames="t")
def unrolled_at_once(
    loop: ClosedLoop,
    X0: AbstractSet,
    box: Box,
    directions: Float[Array, "N m n_x"],
    t: int = 0,
) -> ByForms:
    """The same for all steps at once, compiled and differentiable, without a call to the host.

    A polytope counts as the box around it.
    """
    start = InitialColumns.of(X0, box, loop.curved)
    (more, between), steps = step_columns(loop), len(directions)
    first, end = start.count, start.count + steps * more

    # a derivative computes a step again: storing what it needs of it is most of what is compiled
    @partial(jax.checkpoint, prevent_cse=False)
    def advance(state: AffineForms, step: tuple[Array, Array]) -> tuple[AffineForms, ByForms]:
        k, rows = step
        place = first + k * more
        state, units, _ = step_forms(loop, state, t + k, start, place=place, scratch=end)
        return state, _bounds(rows @ state, units, start)

    state = AffineForms.beginning(start, end + between)
    return jax.lax.scan(advance, state, (jnp.arange(steps), directions))[1]


@partial(Compiled, static_argnames="t")
def unrolled_from_boxes(
    loop: ClosedLoop,
    lower: Float[Array, "c n_x"],
    upper: Float[Array, "c n_x"],
    directions: Float[Array, "N m n_x"],
    t: int = 0,
) -> Float[Array, "c N m"]:
    """Upper bounds of directions after 1, ..., N steps from each of many boxes, in one call."""

    def one(lower: Float[Array, " n_x"], upper: Float[Array, " n_x"]) -> Float[Array, "N m"]:
        box = Box(lower, upper)
        return unrolled_at_once(loop, box, box, directions, t).offsets

    return jax.vmap(one)(lower, upper)


@partial(Compiled, static_argnames="t")
def held_at_once(
    loop: ClosedLoop,
    X0: AbstractSet,
    box: Box,
    directions: Float[Array, "f n_x"],
    held: HeldBounds,
    known: Float[Array, "N 2 n_x"],
    t: int = 0,
) -> Float[Array, "N f"]:
    """Numbers with the derivatives of bounds of directions after 1, ..., N steps, compiled.

    Args:
        loop: the closed loop.
        X0: the initial set.
        box: around it.
        directions: one row a bound.
        held: where the bounds are attained, and those of ranges that they rest on.
        known: bounds of the states that narrow their intervals, with derivatives of their own.
        t: the time of the initial set.
    """
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

        def attained(rows: AffineForms, which: Any) -> Float[Array, " k"]:
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
            here = slice(done, done + len(y.rows))
            values, which, besides = of_state if unit is None else (ranges_known, of_ranges, None)
            moved = []
            sides = zip((-y, y), (-1, 1), values, which, y.ends_by_interval(), strict=True)
            for side, (form, sign, value, bound, end) in enumerate(sides):
                if unit is not None:
                    value, bound = value[here], bound[here]
                by_form = sign * attained(form, jnp.maximum(bound, 0))
                moving = jnp.where(bound == INTERVAL, end, by_form)
                if besides is not None:
                    moving = jnp.where(bound == KNOWN, besides[side], moving)
                moved.append(value + (moving - jax.lax.stop_gradient(moving)))
            return moved[0], moved[1]

        place = first + k * more
        following, *_ = step_forms(
            loop, state, t + k, start, place=place, scratch=end, ranges=ranges
        )
        forms = directions @ following
        by_form = attained(forms, np.arange(len(directions)))
        found = jnp.where(held.by_interval, forms.ends_by_interval()[1], by_form)
        return (following, total), found

    parts = held.ranges, held.of_ranges, held.states, held.of_states
    given = jnp.arange(steps), weights, *map(jnp.asarray, parts), known
    return jax.lax.scan(advance, (state, total), given)[1]


def _bounds(rows: AffineForms, units: tuple[UnitForms, ...], start: InitialColumns) -> ByForms:
    xp = jnp if isinstance(rows.rows, jax.Array) else np
    slopes = xp.concatenate([layer.slope for layer in units] or [xp.zeros(0)])
    corners = start.farthest(constant(rows.columns[:, : len(start.spread)]))
    return ByForms(rows.ends(start, cut=True)[1], slopes, corners)
