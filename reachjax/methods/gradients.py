"""Derivatives of what forms prove, over an initial set or over cells of it, held as they are.

A bound is that of a form over the cell that decides it. Ends of cells move with the box around the
initial set; where facets of the set itself decide, they have the multipliers of a linear program.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.loops import ClosedLoop
from reachjax.methods.cell_tree import Node
from reachjax.methods.problem import Problem
from reachjax.programs.held import Facets, held_bounds, sources
from reachjax.programs.horizon import Horizon
from reachjax.programs.moving import HeldBounds, Moving, moving
from reachjax.sets import AbstractSet, Box, Polytope

LOOSE = 1e-6
"""By which part of its longest side a cell is larger for the programs of its multipliers."""


def moving_cell(problem: Problem, node: Node) -> tuple[AbstractSet, Box]:
    """A cell that moves with the box around the initial set, and the box that it lies in."""
    X0, box = problem.X0, problem.box
    lower, upper = (np.asarray(jax.lax.stop_gradient(end)) for end in (box.lower, box.upper))
    sides = np.where(upper > lower, upper - lower, 1.0)
    shares = ((end - lower) / sides for end in node.ends)
    around = Box(*(box.lower + share * (box.upper - box.lower) for share in shares))
    return X0.cut(around) if isinstance(X0, Polytope) else around, around


def moving_offsets(
    problem: Problem, deciding: Mapping[int, Node], k: int
) -> dict[int, Float[Array, ""]]:
    """Numbers with the derivatives of what forms over the deciding cells prove.

    Args:
        problem: the problem, of a box or a polytope.
        deciding: for some facets after `k + 1` steps, the cell in which the bound is largest.
        k: the number of the step.
    """
    offsets, known, directions = dict[int, Array](), dict[int, Array](), problem.directions
    fixed = jax.lax.stop_gradient((problem.loop, problem.X0, directions))
    loop, region, rows = jax.device_get(fixed)
    everywhere = jnp.zeros((len(rows), 2, rows.shape[2]))
    for facet, node in deciding.items():
        if id(node) not in known:
            held = _held(loop, region, rows, node, k, problem.start)
            part, around = moving_cell(problem, node)
            parts = Moving(problem.loop, part, around, directions[k], everywhere)
            known[id(node)] = moving(parts, held, k + 1, problem.start)
        offsets[facet] = known[id(node)][facet]
    return offsets


def moving_forms(
    loop: ClosedLoop, X0: AbstractSet, box: Box, directions: Float[Array, "N f n_x"], start: int
) -> Iterator[Float[Array, " f"]]:
    """Numbers with the derivatives of what forms over a set prove, one step after the other.

    Args:
        loop: the closed loop.
        X0: the initial set, cut by a polytope.
        box: around it.
        directions: of the facets of all steps.
        start: the time of the initial set.
    """
    fixed = jax.lax.stop_gradient((loop, X0, box, directions))
    on_host, begun, around, rows = jax.device_get(fixed)
    horizon = Horizon(on_host, begun, around, start)
    everywhere = jnp.zeros((len(rows), 2, loop.states))
    facets = None if horizon.start.cut is None else horizon.start.cut.facets
    for k in range(len(rows)):
        horizon.advance()
        held = _held_forms(horizon, rows, facets)
        yield moving(Moving(loop, X0, box, directions[k], everywhere), held, k + 1, start)


def _held(
    loop: ClosedLoop,
    X0: AbstractSet,
    directions: Float[np.ndarray, "N f n_x"],
    cell: Node,
    k: int,
    start: int,
) -> HeldBounds:
    """What bounds over a cell rest on: forms, and what the initial set and its box are cut by.

    What a box is cut by decides where programs bound a form better than its norms do. The box is a
    little larger for them, so that where the initial set has a corner, its own facets decide.
    """
    loop, part, box = jax.device_get((loop, cell.part, cell.box))
    horizon, facets = Horizon(loop, part, box, start), None
    for _ in range(k + 1):
        horizon.advance()
    if isinstance(X0, Polytope):
        room = LOOSE * np.max(box.upper - box.lower)
        facets = X0.cut(Box(box.lower - room, box.upper + room)).facets
    return _held_forms(horizon, directions, facets)


def _held_forms(
    horizon: Horizon, directions: Float[np.ndarray, "N f n_x"], facets: Facets | None
) -> HeldBounds:
    """What bounds of the last states of a horizon rest on.

    Args:
        horizon: over some of the steps.
        directions: of all steps.
        facets: of the polytope that the initial set is cut by, if it is.
    """
    forms = directions[len(horizon.steps) - 1] @ horizon.state
    _, upper = forms.ends(horizon.start, cut=facets is not None)
    bounds = sources(horizon.start, forms, upper, facets)
    return held_bounds(horizon, bounds, len(directions), facets)
