"""Simulated trajectories as lower bounds of what is reachable.

A witness is an initial state whose trajectory attains a value of a direction: no sound offset can
be smaller. Candidates are the corners of the initial set, points drawn from it, and whatever states
the dual of a semidefinite program proposes.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.sets import AbstractSet, Box, Ellipsoid, Intersection, PolyhedralSet
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


CLIMBS = 60
"""Gradient steps from a proposed state."""

SWEEPS = 20
"""Rounds of projections onto the facets of a polytope, one after the other."""


class Simulations:
    """Trajectories from an initial set, and the largest values that they attain.

    Args:
        loop: the closed loop.
        X0: the set of initial states.
        horizon: how many steps are simulated.
        start: the time of the initial set.
        samples: how many trajectories, besides those from corners.
        seed: of the samples.
    """

    def __init__(
        self, loop: ClosedLoop, X0: AbstractSet, horizon: int, start: int, samples: int, seed: int
    ):
        self._loop, self._X0, self._start = loop, X0, start
        self._box = X0.bounding_box()
        self.states = initial_states(X0, samples, seed)
        self.trajectories = loop.simulate(self.states, horizon, start)
        self._added: list[Array] = []

    def attained(self, k: int, direction: Float[Array, " n_x"]) -> tuple[float, Array]:
        """The largest value after `k` steps of the trajectories sampled, and its initial state."""
        values = self.trajectories[:, k] @ direction
        best = int(jnp.argmax(values))
        return float(values[best]), self.states[best]

    def climbed(
        self, k: int, direction: Float[Array, " n_x"], state: Float[Array, " n_x"]
    ) -> float:
        """The value after `k` steps that gradient ascent from a state finds; the state is kept."""
        best = _climb(
            self._loop,
            self._X0,
            self._box,
            state,
            direction,
            k,
            self.trajectories.shape[1] - 1,
            self._start,
        )
        if not bool(self._X0.contains(best)):
            return -np.inf
        self._added.append(best)
        reached = self._loop.simulate(best, self.trajectories.shape[1] - 1, self._start)
        return float(reached[k] @ direction)

    @property
    def all_states(self) -> Float[Array, "c n_x"]:
        """The initial states of all trajectories."""
        return jnp.concatenate([self.states, *(state[None] for state in self._added)])


@partial(jax.jit, static_argnames=("horizon", "start"))
def _climb(loop, X0, box, state, direction, k, horizon, start) -> Float[Array, " n_x"]:
    """Projected gradient ascent on a value after `k` steps, in the coordinates of the box."""
    widths = (box.upper - box.lower) / 2

    def value(state):
        return loop.simulate(state, horizon, start)[k] @ direction

    def improve(carry, _):
        state, best, slope, length = carry
        uphill = widths * slope
        size = jnp.linalg.norm(uphill)
        step = length * widths * uphill / jnp.where(size > 0, size, 1.0)
        moved = _nearest(X0, box, state + step)
        new, other = jax.value_and_grad(value)(moved)
        better = new > best
        chosen = [
            jnp.where(better, a, b)
            for a, b in ((moved, state), (new, best), (other, slope), (2 * length, length / 2))
        ]
        return tuple(chosen), None

    first = _nearest(X0, box, state)
    begun = (first, *jax.value_and_grad(value)(first), jnp.array(0.5))
    return jax.lax.scan(improve, begun, length=CLIMBS)[0][0]


def _nearest(X0: AbstractSet, box: Box, state: Float[Array, " n_x"]) -> Float[Array, " n_x"]:
    """A point of the set close to a state: the closest one of a box, about that of others."""
    state = jnp.clip(state, box.lower, box.upper)
    if isinstance(X0, Box):
        return state
    if isinstance(X0, Ellipsoid | Intersection):
        ball = X0 if isinstance(X0, Ellipsoid) else X0.ellipsoid
        reached = jnp.linalg.norm(ball.normal_form.A @ state + ball.normal_form.b)
        state = ball.center + (state - ball.center) * PULL / jnp.maximum(reached, PULL)
    polytope = X0.polytope if isinstance(X0, Intersection) else X0
    if isinstance(polytope, PolyhedralSet):
        A, b = polytope.facets
        squares = jnp.sum(A**2, axis=1)

        def onto(state, facet):
            over = jnp.maximum(A[facet] @ state - b[facet], 0.0)
            return state - over / squares[facet] * A[facet], None

        state = jax.lax.scan(onto, state, jnp.tile(jnp.arange(len(b)), SWEEPS))[0]
    return state
