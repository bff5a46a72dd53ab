"""The program of a window: the loop unrolled over its last steps, from a known set of states.

The basis is `[x[t], z[t], ..., z[t + w - 1], 1]`: a state and the outputs of the units of `w`
steps. States after `x[t]` are rows over it, and the sets that are known to hold them add facts. A
window of one step is the paper's recursion; one that begins at the initial set forgets nothing.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from reachjax.basis import Rows, columns, loop_rows
from reachjax.bounds import LoopBounds, loop_bounds
from reachjax.lmi import Program
from reachjax.preactivations import bounds_over, rounded
from reachjax.relaxation import AbstractRelaxation, FactLayout
from reachjax.sets import AbstractSet, Box, Ellipsoid, Intersection
from reachjax.systems import ClosedLoop

CONSTANT = 1e-9
"""An output whose radius is a smaller part than this of its input's size has a single value."""


def step_program(
    loop: ClosedLoop,
    X: AbstractSet,
    box: Box,
    directions: Float[Array, "f n_x"],
    t: int,
    relaxation: AbstractRelaxation,
) -> Program:
    """Theorem 1 for every facet of the successors of `X` at time `t`: a window of one step."""
    return window_program(loop, (X,), (box,), directions, t, relaxation)


def window_program(
    loop: ClosedLoop,
    sets: tuple[AbstractSet, ...],
    boxes: tuple[Box, ...],
    directions: Float[Array, "f n_x"],
    t: int,
    relaxation: AbstractRelaxation,
) -> Program:
    """Theorem 1 for every facet of the states at time `t + w`, over the scaled basis.

    Compiled once for a loop's shape, numbers of steps and facets, and a relaxation. With the
    identity for directions, the objective rows are the state: the program of an ellipsoid.

    Args:
        loop: the closed loop.
        sets: `w` sets that hold the states at times `t, ..., t + w - 1`. Of a round one after the
            first, only the facets add facts.
        boxes: a box around each.
        directions: one row for each facet.
        t: the time of the first set.
        relaxation: which products of facts are used.
    """
    around = rounded(sets[0], boxes[0])
    facts = tuple(X.facts() for X in sets)
    return _window_program(
        loop, facts, sets[0].cone_facts(), around, boxes, directions, t, relaxation
    )


@partial(jax.jit, static_argnames="relaxation")
def _window_program(
    loop: ClosedLoop,
    set_facts: tuple[Float[Array, "m n_x+1"], ...],
    cone_facts: Float[Array, "r n_x+1"],
    around: Ellipsoid | Intersection | None,
    boxes: tuple[Box, ...],
    directions: Float[Array, "f n_x"],
    t: int,
    relaxation: AbstractRelaxation,
) -> Program:
    n, k, prune = loop.states, loop.units, relaxation.remove_stable
    size = n + k * len(boxes) + 1
    first = state = columns(0, n, size)
    bounds, units, known = [], [], []
    for i, (box, given) in enumerate(zip(boxes, set_facts, strict=True)):
        of_step = loop_bounds(loop, box, t + i)
        if i == 0 and around is not None and prune:
            of_step = bounds_over(loop, around, box, t)
        rows = loop_rows(loop, state, n + i * k, t + i, of_step, prune)
        known.append(_holding(given, state))
        bounds.append(of_step)
        units.append(rows.facts)
        state = rows.successor
    kinds = jax.tree.map(_stacked, *units)
    one, cone = columns(size - 1, 1, size), _holding(cone_facts, first)
    facts = jax.tree.map(_stacked, one, *known, *kinds, cone)
    # The optimal value does not depend on the scaling, but its derivative at inexact multipliers
    # does: with the scaling's share, facts of thin sets keep their size and errors cancel.
    ball = around.ellipsoid if isinstance(around, Intersection) else around
    T = scaling(bounds, prune, ball)
    # one rounding of it for all rows, whatever the compiler fuses
    T = jax.lax.optimization_barrier(T)
    layout = FactLayout(sum(len(given) for given in set_facts), k * len(boxes), len(cone_facts))
    return Program(
        facts=facts @ T,
        objective=(directions @ state) @ T,
        products=relaxation.products(layout),
        transform=T,
    )


def _holding(facts: Float[Array, "m n_x+1"], state: Rows) -> Rows:
    """Facts of states as rows over the basis."""
    return facts[:, :-1] @ state + facts[:, -1]


def _stacked(*parts: Array) -> Array:
    return jnp.concatenate(parts)


def scaling(bounds: list[LoopBounds], prune: bool, X: Ellipsoid | None) -> Float[Array, "n n"]:
    """`T` with `xi = T eta`, the entries of `eta` being in `[-1, 1]`, the last one 1."""
    mid, rad = basis_box(bounds, prune)
    T = jnp.diag(rad).at[:-1, -1].set(mid[:-1])
    if X is None:
        return T
    n = X.dimension
    return T.at[:n, :n].set(X.from_ball()).at[:n, -1].set(X.center)


def basis_box(
    bounds: list[LoopBounds], prune: bool
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Midpoint and radius of each entry of the basis `[x, z, ..., 1]`.

    A unit that has left the basis gets radius zero. One that stays although its output has a single
    value (a dead neuron that the paper keeps) is scaled by its input, so that it does stay: a
    radius at rounding level would tell the solver what the paper's constraints do not.
    """
    parts = [(bounds[0].state.mid, bounds[0].state.rad)]
    for of_step in bounds:
        y, z = of_step.preactivation, of_step.output
        if prune:
            gone = of_step.passing | of_step.blocking
            parts.append((jnp.where(gone, 0.0, z.mid), jnp.where(gone, 0.0, z.rad)))
        else:
            size = abs(y.mid) + y.rad
            constant = z.rad <= CONSTANT * size
            # a tenth of the input's size: measured, solvers lose digits at the whole and at a
            # hundredth
            kept = jnp.where(constant, jnp.where(size > 0, size / 10, 1.0), z.rad)
            parts.append((z.mid, kept))
    parts.append((jnp.zeros(1), jnp.ones(1)))
    mid, rad = (_stacked(*part) for part in zip(*parts, strict=True))
    return mid, rad
