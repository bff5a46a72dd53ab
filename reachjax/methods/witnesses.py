"""Simulated trajectories as lower bounds of what is reachable.

A witness is an initial state whose trajectory attains a value of a direction: no sound offset can
be smaller. Candidates are the corners of the initial set, points drawn from it, and what gradient
ascent finds from these and from the states that the dual of a semidefinite program proposes. Of a
loop with disturbances or noise it is a whole scenario (`loops.scenarios`).

The ascent is a projected one. The loop is piecewise affine, so an ascent ends at a corner of a
piece or on the edge of the set. A solver's proposal is often the best state already, up to its
tolerance, and a few steps remove that.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from reachjax.loops import ClosedLoop
from reachjax.loops.scenarios import PULL, Runs, Scenarios
from reachjax.loops.tracing.functions import Compiled
from reachjax.numerics.host import in_numpy
from reachjax.sets import AbstractSet

ASCENT_STEPS = 80
"""Gradient steps of an ascent. After 60, one on a polytope of six dimensions lacked 1e-4."""

LONGEST = 4.0
"""The longest step, in half-widths of the set: from further away projections are worse."""


@partial(Compiled, static_argnames=("horizon", "start"))
def ascended(
    loop: ClosedLoop,
    scenarios: Scenarios,
    scale: Float[Array, "n_x n_x"],
    middle: Float[Array, " s"],
    begin: Float[Array, "m s"],
    region: AbstractSet,
    which: Int[Array, " m"],
    k: int,
    horizon: int,
    start: int,
) -> Float[Array, "m s"]:
    """Scenarios of larger values after `k` steps: initial states in their set, and what is drawn.

    Steps and projections are measured in the box around a set, or where an ellipsoid is a ball;
    where the loop is affine, an ascent ends at the largest value, but for polytopes with corners so
    sharp that projections onto them do not converge. Steps double where they gain, and are halved
    where they do not.

    Args:
        loop: the closed loop.
        scenarios: all of them.
        scale: in which steps and projections of initial states are measured.
        middle: a scenario in their interior, if they have any.
        begin: where to begin.
        region: a set whose bounded values are sought.
        which: of these values, one for each scenario.
        k: after how many steps.
        horizon: how many steps are simulated.
        start: the time of the initial set.
    """

    def climb(begin: Float[Array, " s"], number: Int[Array, ""]) -> Float[Array, " s"]:
        def value(scenario):
            states, disturbances, noises = scenarios.split(scenario)
            drawn = {"disturbances": disturbances, "noises": noises}
            after = loop.simulate(states, horizon, start, **drawn)[k]
            return region.bounded_values(after)[number]

        def improve(carry, _):
            best, slope, scenario, length = carry
            ahead = scenario + length * scenarios.uphill(slope, scale)
            moved = scenarios.brought_inside(ahead, middle, scale)
            reached, other = jax.value_and_grad(value)(moved)
            better = reached > best
            following = reached, other, moved, jnp.minimum(2 * length, LONGEST)
            return jax.tree.map(
                lambda new, old: jnp.where(better, new, old),
                following,
                (best, slope, scenario, length / 2),
            ), None

        first = scenarios.brought_inside(begin, middle, scale)
        begun = (*jax.value_and_grad(value)(first), first, jnp.array(0.5))
        return jax.lax.scan(improve, begun, length=ASCENT_STEPS)[0][2]

    return jax.vmap(climb)(begin, which)


BLOCK = 1024
"""Points are drawn and evaluated in multiples of so many, for which code is compiled once."""

PULLS = PULL, 1 - 1e-9, 1 - 1e-6
"""How far points are pulled that solvers of cones found, by turns until one is inside."""


def initial_states(X0: AbstractSet, count: int, seed: int) -> Float[np.ndarray, "c n_x"]:
    """Corners of the set, in few dimensions, and `count` points drawn from it.

    Where the set has a curved surface, half of the points are on it, just inside.
    """
    if X0.intervals is not None:  # in numpy, and surely inside
        return np.concatenate([jax.device_get(X0.corners()), X0.drawn(count, seed)])
    drawn = _blocks(count)
    states = X0.drawn(drawn, seed)[:count]
    surface = jax.device_get(X0.sample_boundary(jax.random.key(seed), drawn))
    if surface is not None:
        middle = states.mean(axis=0)
        states = states.copy()
        states[::2] = (middle + PULL * (surface[:count] - middle))[::2]
    states = np.concatenate([jax.device_get(X0.corners()), states])
    moved, inside = jax.device_get(_brought_inside(X0, _padded(states)))
    states, inside = moved[: len(states)], inside[: len(states)]
    return states[inside] if inside.any() else states  # a flat set contains none exactly


def _blocks(count: int) -> int:
    """At least so many, in whole blocks."""
    return -(-count // BLOCK) * BLOCK


def _padded(points: Float[np.ndarray, "c n"]) -> Float[np.ndarray, "b n"]:
    """The same points and some of them again, so that there are few numbers of them."""
    return np.resize(points, (_blocks(len(points)), points.shape[1]))


def in_blocks(function: Callable[[Any], Any], points: Float[np.ndarray, "c n"]) -> np.ndarray:
    """What a function says of each point, of as many at once as it is compiled for."""
    return np.asarray(function(_padded(points)))[: len(points)]


@jax.jit
def _brought_inside(
    X0: AbstractSet, states: Float[Array, "c n_x"]
) -> tuple[Float[Array, "c n_x"], Bool[Array, " c"]]:
    """States inside the set, and whether they are now.

    Corners and points of triangulations are rounded: left as they are, a witness could lie.
    """
    center = states.mean(axis=0)
    states = jnp.where(X0.contains(states)[:, None], states, center + PULL * (states - center))
    return states, X0.contains(states)


class Simulated(NamedTuple):
    """Simulated values of directions.

    Attributes:
        least: `(f,)`, infinite where nothing is simulated.
        most: `(f,)`, the same.
        scenarios: `(f, s)`, those that attain the largest.
    """

    least: Float[np.ndarray, " f"]
    most: Float[np.ndarray, " f"]
    scenarios: Float[np.ndarray, "f s"]

    @classmethod
    def nothing(cls, scenario: Float[np.ndarray, " s"], facets: int) -> Simulated:
        """Nothing known of so many directions, with some scenario."""
        none = np.full(facets, np.inf)
        return cls(none, -none, np.tile(scenario, (facets, 1)))


class Simulations:
    """Trajectories from an initial set, and the largest values that they attain.

    They begin at corners and samples; those that gradient ascent finds are added.

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
        self._loop, self._start, self._horizon = loop, start, horizon
        self._on_host = in_numpy(loop)
        self._scale = X0.scale()
        self._all = Scenarios.of(loop, X0, horizon, start)
        states = initial_states(X0, samples, seed)
        self._middle = self._all.middle(states.mean(axis=0))
        self._scenarios = self._all.drawn(states, seed)
        self._trajectories = self.simulated(self._scenarios)

    @property
    def runs(self) -> Runs:
        """All trajectories so far."""
        return Runs(self._scenarios, self._trajectories)

    def simulated(self, scenarios: Float[np.ndarray, "c s"]) -> Float[np.ndarray, "c h+1 n_x"]:
        """The trajectories of these scenarios."""
        return self._all.runs(self._on_host, scenarios, self._horizon, self._start)

    def values(self, k: int, directions: Float[np.ndarray, "f n_x"]) -> Simulated:
        """What is known of directions after `k` steps."""
        return self.known(self._trajectories[:, k] @ directions.T)

    def known(self, values: Float[np.ndarray, "c f"]) -> Simulated:
        """What is known of numbers that these are the values of, trajectory by trajectory."""
        worst = values.argmax(axis=0)
        return Simulated(values.min(axis=0), values.max(axis=0), self._scenarios[worst])

    def climb(
        self,
        k: int,
        region: AbstractSet,
        which: Int[np.ndarray, " m"],
        begin: Float[np.ndarray, "m p"],
    ) -> None:
        """Seek larger values after `k` steps by gradient ascent.

        Args:
            k: the number of steps.
            region: a set that bounds `m` values.
            which: of these values each ascent seeks.
            begin: scenarios where it begins, or initial states alone, with what is drawn in the
                best scenario so far; those that are no numbers begin at the middle of the samples.
        """
        if begin.shape[1] < len(self._middle):
            best = self._values(k, region).argmax(axis=0)
            begin = self._all.completed(begin, self._scenarios[best[which]])
        known = np.isfinite(begin).all(axis=1, keepdims=True)
        begin = np.where(known, begin, self._middle)
        fixed = self._loop, self._all, self._scale, self._middle
        found = ascended(*fixed, begin, region, which, k, self._horizon, self._start)
        self.include(np.asarray(found))

    def include(self, *given: Float[np.ndarray, "m p"]) -> Runs:
        """Simulate these scenarios too, those that are in their sets or just outside.

        They may end early, or be initial states alone: then everything else that is drawn is in the
        middle of its set.
        """
        if not any(map(len, given)):
            return self.runs.some(slice(0))
        scenarios = np.concatenate([self._all.completed(part, self._middle) for part in given])
        scenarios = np.unique(scenarios, axis=0)  # facets of many steps are often worst at one
        scenarios = self._all.clipped(scenarios)
        inside = self._inside(scenarios)
        for pull in PULLS:
            if inside.all():
                break
            pulled = self._middle + pull * (scenarios - self._middle)
            scenarios = np.where(inside[:, None], scenarios, self._all.clipped(pulled))
            inside = self._inside(scenarios)
        found = self.simulated(scenarios)
        kept = inside & np.isfinite(found).all(axis=(1, 2))
        added = Runs(scenarios[kept], found[kept])
        self._scenarios = np.concatenate([self._scenarios, added.scenarios])
        self._trajectories = np.concatenate([self._trajectories, added.states])
        return added

    def _inside(self, scenarios: Float[np.ndarray, "m s"]) -> Bool[np.ndarray, " m"]:
        """Which scenarios have every part in its set."""
        return in_blocks(self._all.contains, scenarios)

    def _values(self, k: int, region: AbstractSet) -> Float[np.ndarray, "c m"]:
        """What a set bounds, at each trajectory after `k` steps: facets in numpy."""
        points = self._trajectories[:, k]
        flat, curved = region.parts
        values = [] if flat is None else [points @ np.asarray(flat.facets[0]).T]
        if curved is not None:
            values.append(in_blocks(curved.bounded_values, points))
        return np.concatenate(values, axis=1)

    def attained(
        self, k: int, region: AbstractSet
    ) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m s"]]:
        """The largest values `(m,)` of what a set bounds, after `k` steps, and their scenarios."""
        values = self._values(k, region)
        return values.max(axis=0), self._scenarios[values.argmax(axis=0)]

    def best(
        self, k: int, region: AbstractSet, which: int, count: int
    ) -> Float[np.ndarray, "count s"]:
        """The scenarios of the largest values of one of the things that a set bounds."""
        order = np.argsort(-self._values(k, region)[:, which], stable=True)
        return self._scenarios[np.resize(order[:count], count)]
