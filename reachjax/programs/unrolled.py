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
from reachjax.numerics.rounding import Ball
from reachjax.programs.affine import AffineForms
from reachjax.programs.affine_steps import UnitForms, states_facts, step_columns, step_forms
from reachjax.programs.initial import Ends, InitialColumns, constant, met, product_facts
from reachjax.sets import AbstractSet, Box

Carry = tuple[AffineForms, Array]


class HeldBounds(NamedTuple):
    """What `B` bounds of rows over a horizon rest on, of which derivatives are taken.

    A bound is the largest value of its row and weighed facts over the columns. Where that is
    attained, multipliers and columns may be held (the envelope theorem). Bounds of directions of
    states come first, then those of inputs of units that something better than their forms proved.

    Attributes:
        of_units: `(B, N, b, units)`, multipliers of the facts of each unit, of which there are `b`.
        of_set: `(B, r)`, of the facets of the initial set.
        of_products: `(B, p)`, of the facts of products of its columns.
        columns: `(B, n)`, where each is attained, in the places of compiled forms.
        by_norm: `(B,)`, whether it is attained instead where the norm of its initial columns is.
        by_form: `(f,)`, whether directions are bounded by their forms alone, or by intervals.
        ranges: `(N, 2, units)`, lower and upper bounds of the units' inputs, as they were known.
        of_ranges: `(N, 2, units)`, which of the bounds they are; -1 for those of forms.
    """

    of_units: Float[Array | np.ndarray, "B N b units"]
    of_set: Float[Array | np.ndarray, "B r"]
    of_products: Float[Array | np.ndarray, "B p"]
    columns: Float[Array | np.ndarray, "B n"]
    by_norm: Bool[Array | np.ndarray, " B"]
    by_form: Bool[Array | np.ndarray, " f"]
    ranges: Float[Array | np.ndarray, "N 2 units"]
    of_ranges: Int[Array | np.ndarray, "N 2 units"]


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
    known: tuple[Float[Array, "N n_x"], Float[Array, "N n_x"]],
    t: int = 0,
) -> Float[Array, "N f"]:
    """Numbers with the derivatives of bounds of directions after 1, ..., N steps, compiled.

    Each has the value of its direction's form and of the facts so far where the bound is attained.

    Args:
        loop: the closed loop.
        X0: the initial set.
        box: around it.
        directions: one row a bound.
        held: what the bounds rest on.
        known: bounds of the state after each step that narrow its interval, with derivatives of
            their own; infinite where there is none.
        t: the time of the initial set.
    """
    start, steps = InitialColumns.of(X0, box, loop.curved), len(held.ranges)
    more, between = step_columns(loop)
    first, end, count = start.count, start.count + steps * more, start.count
    state, columns = AffineForms.beginning(start, end + between), jnp.asarray(held.columns)

    def values(rows: AffineForms, columns: Float[Array, "k n"]) -> Float[Array, "k c"]:
        """Of one row each: its initial columns, and beside these its value."""
        rest = rows.rows[:, 0] + (rows.columns[:, count:] * columns[:, count:]).sum(axis=1)
        return jnp.concatenate([rows.columns[:, :count], rest[:, None]], axis=1)

    def weighed(facts: AffineForms, weights: Float[Array, "B k"]) -> Float[Array, "B c"]:
        rest = facts.rows[:, 0] + columns[:, count:] @ facts.columns[:, count:].T
        rest = (weights * rest).sum(axis=1)
        return jnp.concatenate([weights @ facts.columns[:, :count], rest[:, None]], axis=1)

    def largest(values: Float[Array, "k c"], which: Any) -> Float[Array, " k"]:
        rows, rest = values[:, :-1], values[:, -1]
        attained = (rows * columns[which, :count]).sum(axis=1)
        return rest + jnp.where(held.by_norm[which], start.bounds(rows)[1], attained)

    facts, radii = map(jnp.asarray, product_facts(start))
    facts = jnp.pad(facts, ((0, 0), (0, end + between - start.count)))
    total = weighed(AffineForms(facts, radii), held.of_products)
    if held.of_set.shape[1]:
        A, b = X0.facets
        total = total + weighed(b - A @ state, held.of_set)

    def advance(carry: Carry, step: Any) -> tuple[Carry, Array]:
        (state, total), (k, given, known_ends, numbers, narrowed) = carry, step
        told = done = 0

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
                for rows, weights in zip(sectors, jnp.moveaxis(given, 1, 0), strict=False):
                    total = total + weighed(rows, weights[:, here])
            told = len(units)

        def ranges(
            unit: AbstractUnit, y: AffineForms, ends: Ends, found: Sequence[UnitForms]
        ) -> Ends:
            tell(found)
            here = slice(done, done + len(y.rows))
            moving = []
            for form, end, sign, which in zip((-y, y), ends, (-1, 1), numbers, strict=True):
                own = which[here]
                proved = largest(values(form, columns[own]) + total[own], own)
                moving.append(jnp.where(own >= 0, sign * proved, end))
            lower, upper = (
                end + (each - jax.lax.stop_gradient(each))
                for end, each in zip(known_ends[:, here], moving, strict=True)
            )
            return lower, upper

        state, units, _ = step_forms(
            loop, state, t + k, start, place=first + k * more, scratch=end, ranges=ranges
        )
        tell(units)
        forms, own = directions @ state, np.arange(len(directions))
        attained = largest(values(forms, columns[own]) + total[own], own)
        found = jnp.where(held.by_form, forms.ends(start)[1], attained)
        state = state.within(Ball.between(*met(state.ends(start), narrowed)))
        return (state, total), found

    of_units = jnp.moveaxis(held.of_units, 1, 0)
    ranges, numbers = jnp.asarray(held.ranges), jnp.asarray(held.of_ranges)
    given = jnp.arange(steps), of_units, ranges, numbers, known
    return jax.lax.scan(advance, (state, total), given)[1]


def _bounds(rows: AffineForms, units: tuple[UnitForms, ...], start: InitialColumns) -> ByForms:
    xp = jnp if isinstance(rows.rows, jax.Array) else np
    slopes = xp.concatenate([layer.slope for layer in units] or [xp.zeros(0)])
    corners = start.farthest(constant(rows.columns[:, : len(start.spread)]))
    return ByForms(rows.ends(start, cut=True)[1], slopes, corners)
