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
from jaxtyping import Array, Float

from reachjax.loops import ClosedLoop
from reachjax.loops.functions import Compiled
from reachjax.loops.units import AbstractUnit, Mark
from reachjax.numerics.host import in_numpy
from reachjax.programs.affine import AffineForms
from reachjax.programs.affine_steps import UnitForms, step_columns, step_forms
from reachjax.programs.initial import Ends, InitialColumns, constant, product_facts
from reachjax.sets import AbstractSet, Box

Carry = tuple[AffineForms, AffineForms]


class FactWeights(NamedTuple):
    """Multipliers of the facts of a horizon, for each of some bounds.

    Attributes:
        of_units: `(f, N, b, units)`, of the facts of each unit, of which there are `b`.
        of_set: `(f, r)`, of the facets of the initial set.
        of_products: `(f, p)`, of the facts of products of its columns.
        ranges: `(N, 2, units)`, lower and upper bounds of the units' inputs, as they were known.
        attained: `(f, c)`, the initial columns where each bound is attained, which is that of a
            form there then; NaN for the norms of its form.
    """

    of_units: Float[Array | np.ndarray, "f N b units"]
    of_set: Float[Array | np.ndarray, "f r"]
    of_products: Float[Array | np.ndarray, "f p"]
    ranges: Float[Array | np.ndarray, "N 2 units"]
    attained: Float[Array | np.ndarray, "f c"]


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
            state, units, _ = step_forms(
                loop, state, t + k, start, slopes=given, known=held, before=k
            )
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
def weighed_at_once(
    loop: ClosedLoop,
    X0: AbstractSet,
    box: Box,
    directions: Float[Array, "f n_x"],
    weights: FactWeights,
    t: int = 0,
) -> Float[Array, "N f"]:
    """Upper bounds of directions after 1, ..., N steps by forms and weighed facts, compiled.

    Each is that of its direction's form and the facts so far, as `Horizon.bounds` takes them, so it
    has the derivative of a bound whose weights are held. Ranges of units that were better known
    than by forms have the derivatives of these.

    Args:
        loop: the closed loop.
        X0: the initial set.
        box: around it.
        directions: one row a bound.
        weights: of the facts, for each bound.
        t: the time of the initial set.
    """
    start = InitialColumns.of(X0, box, loop.curved)
    (more, between), steps = step_columns(loop), weights.of_units.shape[1]
    first, end = start.count, start.count + steps * more
    state = AffineForms.beginning(start, end + between)
    facts, radii = map(jnp.asarray, product_facts(start))
    facts = jnp.pad(facts, ((0, 0), (0, end + between - start.count)))
    total = weights.of_products @ AffineForms(facts, radii)
    if weights.of_set.shape[1]:
        A, b = X0.facets
        total = total + weights.of_set @ (b - A @ state)

    def advance(carry: Carry, step: tuple[Array, Array, Array]) -> tuple[Carry, Array]:
        (state, total), (k, given, known), done = carry, step, 0

        def ranges(
            unit: AbstractUnit, y: AffineForms, ends: Ends, found: Sequence[UnitForms]
        ) -> Ends:
            before = sum(len(each.gap) for each in found)
            here = known[:, before : before + len(y.rows)]
            low, high = (end - jax.lax.stop_gradient(end) for end in ends)
            return here[0] + low, here[1] + high

        place = first + k * more
        state, units, _ = step_forms(
            loop, state, t + k, start, place=place, scratch=end, ranges=ranges
        )
        for layer in units:
            here, done = slice(done, done + len(layer.gap)), done + len(layer.gap)
            ends: Any = layer.lower, layer.upper
            said = layer.unit.facts(layer.inputs, layer.outputs, *ends)
            sectors = (block.rows for block in said.blocks if block.mark is Mark.SECTOR)
            for rows, weight in zip(sectors, jnp.moveaxis(given, 1, 0), strict=False):
                total = total + weight[:, here] @ rows
        forms = directions @ state + total
        return (state, total), jnp.where(held, forms.largest(there), forms.ends(start)[1])

    held = jnp.isfinite(weights.attained).all(axis=1)
    there = jnp.where(held[:, None], weights.attained, 0.0)
    of_units = jnp.moveaxis(weights.of_units, 1, 0)
    given = jnp.arange(steps), of_units, jnp.asarray(weights.ranges)
    return jax.lax.scan(advance, (state, total), given)[1]


def _bounds(rows: AffineForms, units: tuple[UnitForms, ...], start: InitialColumns) -> ByForms:
    xp = jnp if isinstance(rows.rows, jax.Array) else np
    slopes = xp.concatenate([layer.slope for layer in units] or [xp.zeros(0)])
    corners = start.farthest(constant(rows.columns[:, : len(start.spread)]))
    return ByForms(rows.ends(start, cut=True)[1], slopes, corners)
