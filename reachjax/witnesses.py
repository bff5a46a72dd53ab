"""Simulated trajectories as lower bounds of what is reachable.

A witness is an initial state whose trajectory attains a value of a direction: no sound offset can
be smaller. Candidates are the corners of the initial set, points drawn from it, and whatever states
the dual of a semidefinite program proposes.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.sets import AbstractSet, Ellipsoid, Intersection, PolyhedralSet
from reachjax.systems import ClosedLoop

MOST_DIMENSIONS = 12
"""Corners are listed up to this dimension (a box has 4096 of them there)."""

PULL = 1 - 1e-12
"""How far a rounded point is brought towards the middle of the set."""

SOLVER_PULL = 1 - 1e-7
"""The same for a point that a solver proposes."""


def initial_states(X0: AbstractSet, count: int, seed: int) -> Float[Array, "c n_x"]:
    """Corners of the set, in few dimensions, and `count` points drawn from it.

    Where the set has a round part, half of the points are on the surface, just inside.
    """
    key = jax.random.key(seed)
    states = X0.sample(key, count)
    if isinstance(X0, Ellipsoid | Intersection):
        middle = X0.center if isinstance(X0, Ellipsoid) else states.mean(axis=0)
        surface = middle + PULL * (X0.sample_boundary(key, count) - middle)
        states = states.at[::2].set(surface[::2])
    states = jnp.concatenate([_corners(X0), states])
    # corners and points of triangulations are rounded: bring them inside, or a witness could lie
    center = states.mean(axis=0)
    inside = jnp.where(X0.contains(states)[:, None], states, center + PULL * (states - center))
    kept = np.asarray(X0.contains(inside))
    return inside[kept] if kept.any() else states  # a set without interior contains none exactly


def _corners(X0: AbstractSet) -> Float[Array, "v n_x"]:
    """Corners of the set's facets; none of an ellipsoid, or where there are too many to list."""
    none = jnp.zeros((0, X0.dimension))
    polytope = X0.polytope if isinstance(X0, Intersection) else X0
    if not isinstance(polytope, PolyhedralSet) or X0.dimension > MOST_DIMENSIONS:
        return none
    try:
        corners = polytope.vertices()
    except RuntimeError:  # too thin to have corners: do without
        return none
    return corners[X0.ellipsoid.contains(corners)] if isinstance(X0, Intersection) else corners


def proposed_states(X0: AbstractSet, moments: np.ndarray) -> Float[Array, "f n_x"]:
    """The state columns of dual moment matrices, those that lie in the set."""
    center = X0.bounding_box().center
    states = center + SOLVER_PULL * (jnp.asarray(moments[:, : X0.dimension, -1]) - center)
    return states[np.asarray(X0.contains(states))]


def witnesses(
    loop: ClosedLoop,
    states: Float[Array, "c n_x"],
    sets: Sequence[AbstractSet],
    start: int = 0,
) -> list[tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m n_x"]]]:
    """The largest value of everything that sets bound at times `1, 2, ...`.

    Returns:
        For each set the values `(m,)` and the initial states `(m, n_x)` that attain them.
    """
    trajectories = loop.simulate(states, len(sets), start)
    found = []
    for t, region in enumerate(sets, start=1):
        values = np.asarray(region.bounded_values(trajectories[:, t]))
        found.append((values.max(axis=0), np.asarray(states)[values.argmax(axis=0)]))
    return found
