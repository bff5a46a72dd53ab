"""Scenarios: an initial state, and the disturbances and noises of every step behind it, as one row.

They are points of the product `X_0 x (W x V) x (W x V) x ...`, which is convex if its factors are,
and a trajectory is a function of one of them. Of a loop without disturbances and noise a scenario
is an initial state. Of others there may be too many corners to look at, so some are drawn: one
extreme disturbance at all times, another one at each time, or any.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from reachjax.loops.batches import trajectories
from reachjax.loops.closed_loop import ClosedLoop, Scenario, split
from reachjax.loops.draws import Frame, framed
from reachjax.numerics.pytrees import Replaceable, pytree, static
from reachjax.sets import AbstractSet

POOL = 500
"""So many points of a set of disturbances, and as many extreme ones, scenarios are made of."""

PULL = 1 - 1e-12
"""How far a rounded point is brought towards the middle of its set."""

NEXT = 1e-9
"""A state is next to a set that is no further beside it than this; of flat sets none is in it."""

Rows = Float[Array | np.ndarray, "*batch s"]


class Runs(NamedTuple):
    """Scenarios and what follows from them.

    Attributes:
        scenarios: `(c, s)`.
        states: `(c, h + 1, n_x)`, trajectories.
    """

    scenarios: Float[np.ndarray, "c s"]
    states: Float[np.ndarray, "c h+1 n_x"]

    def some(self, which: Any) -> Runs:
        """The runs of these numbers."""
        return Runs(self.scenarios[which], self.states[which])


@pytree
class Draws(Replaceable):
    """The sets that something is drawn from at each of `h` steps, and what ascents need of them.

    Attributes:
        sets: one, the numbers of which have a leading axis `h`.
        scales: `(h, n, n)`, matrices of half-widths.
        middles: `(h, n)`, points in the interior, if there is any.
        at_start: the set as it was given.
        start: the time of the first step.
    """

    sets: AbstractSet
    scales: Float[Array | np.ndarray, "h n n"]
    middles: Float[Array | np.ndarray, "h n"]
    at_start: AbstractSet
    start: int = static()

    @classmethod
    def of(cls, W: AbstractSet, steps: int, start: int) -> Draws:
        """The draws from a set, of numbers, from a time on."""
        if W.steps is None:
            scales, middles = np.asarray(W.scale()), _middle(W)
            sets = jax.tree.map(np.asarray, W)
            each = (np.broadcast_to(part, (steps, *part.shape)) for part in (scales, middles))
            sets = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (steps, *leaf.shape)), sets)
            return cls(sets, *each, at_start=W, start=start)
        sets = jax.tree.map(lambda leaf: np.asarray(leaf)[start : start + steps], W)
        half = (sets.upper - sets.lower) / 2
        scales = half[:, :, None] * np.eye(half.shape[1])
        return cls(sets, scales, sets.lower + half, at_start=W, start=start)

    def contain(self, points: Float[Array, "*batch h n"]) -> Bool[Array, "*batch"]:
        """Whether the points of all steps are in their sets."""
        inside = jax.vmap(lambda W, w: W.contains(w), in_axes=(0, -2), out_axes=-1)
        return inside(self.sets, points).all(axis=-1)

    def clipped(self, points: Float[np.ndarray, "c h n"]) -> Float[np.ndarray, "c h n"]:
        """Points of boxes brought inside; others on the way from the middle, into the ellipsoid."""
        if self.sets.intervals is not None:
            return np.clip(points, *map(np.asarray, self.sets.intervals))
        _, ball = self.at_start.parts
        if ball is None:
            return points
        A, b = (np.asarray(part) for part in ball.normal_form)
        middles = np.asarray(self.middles)
        here, there = (A @ each[..., None] + b[:, None] for each in (middles, points))
        # |p + s d| = 1 at the largest share s
        p, d = here[..., 0], (there - here)[..., 0]
        a, half, rest = (d * d).sum(-1), (p * d).sum(-1), 1.0 - (p * p).sum(-1)
        root = np.sqrt(np.maximum(half**2 + a * rest, 0.0))
        share = np.where(a > 0, (root - half) / np.where(a > 0, a, 1.0), 1.0)
        share = np.where(share < 1, PULL * np.maximum(share, 0.0), 1.0)[..., None]
        return middles + share * (points - middles)

    def sample(self, count: int, seed: int) -> Float[np.ndarray, "c h n"]:
        """One of three kinds in turn: an extreme one for all times, one at each time, or any.

        What is drawn for a time does not depend on how many times there are.
        """
        steps, n = self.middles.shape
        extreme, inner = self._pools(seed)
        kind, rng = np.arange(count) % 3, np.random.default_rng([seed, 0])
        held = rng.integers(len(extreme), size=count)
        found = np.empty((count, steps, n))
        for k in range(steps):
            rng = np.random.default_rng([seed, 1, k])
            other = rng.integers(len(extreme), size=count)
            drawn = extreme[np.where(kind == 0, held, other)]
            any_one = inner[rng.integers(len(inner), size=count)]
            found[:, k] = self._placed(np.where((kind == 2)[:, None], any_one, drawn), k)
        return found

    def _pools(self, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Extreme points and any points of the set; of boxes, as parts of their sides."""
        if self.sets.intervals is not None:
            rng, n = np.random.default_rng([seed, 2]), self.middles.shape[1]
            return rng.integers(2, size=(POOL, n)).astype(float), rng.uniform(size=(POOL, n))
        W, key, middle = self.at_start, jax.random.key(seed), np.asarray(self.middles)[0]
        inner = np.asarray(W.sample(key, POOL))
        surface = W.sample_boundary(key, POOL)
        extreme = np.asarray(W.corners() if surface is None else surface)
        extreme = middle + PULL * (extreme - middle)
        inner, extreme = (each[np.asarray(W.contains(each))] for each in (inner, extreme))
        inner = inner if len(inner) else middle[None]
        return (extreme if len(extreme) else inner), inner

    def _placed(self, points: np.ndarray, k: int) -> np.ndarray:
        if self.sets.intervals is None:
            return points
        lower, upper = (ends[k] for ends in self.sets.intervals)
        return np.clip(lower + points * (upper - lower), lower, upper)


def _middle(W: AbstractSet) -> Float[np.ndarray, " n"]:
    """A point in the interior, if there is any."""
    flat, ball = W.parts
    if flat is None:
        return np.asarray(ball.center) if ball is not None else np.zeros(W.dimension)
    if W.intervals is not None:
        lower, upper = W.intervals
        return np.asarray(lower + (upper - lower) / 2)
    points = W.sample(jax.random.key(0), POOL) if ball is not None else flat.vertices()
    return np.asarray(points).mean(axis=0)


@pytree
class Scenarios(Replaceable):
    """All scenarios of a loop from an initial set over some steps.

    Attributes:
        X0: the initial set.
        disturbances: what they are drawn from; None of loops without.
        noises: the same.
        steps: how many.
    """

    X0: AbstractSet
    disturbances: Draws | None
    noises: Draws | None
    steps: int = static()

    @classmethod
    def of(cls, loop: ClosedLoop, X0: AbstractSet, steps: int, start: int = 0) -> Scenarios:
        """The scenarios of a loop of numbers."""
        given = (loop.disturbance, loop.noise)
        draws = (None if W is None else Draws.of(W, steps, start) for W in given)
        return cls(X0, *draws, steps=steps)

    @property
    def _draws(self) -> list[Draws]:
        return [part for part in (self.disturbances, self.noises) if part is not None]

    @property
    def _sizes(self) -> list[int]:
        parts = self.disturbances, self.noises
        return [0 if part is None else part.middles.shape[1] for part in parts]

    def split(self, scenarios: Rows) -> Scenario:
        """The parts of scenarios, of as many steps as they have."""
        if not self._draws:  # all of them is the initial state
            return Scenario(scenarios, None, None)
        return split(scenarios, self.X0.dimension, *self._sizes)

    def joined(self, states: Any, *drawn: Any) -> Any:
        """Scenarios of initial states and of what is drawn, disturbances first."""
        xp = jnp if any(isinstance(part, jax.Array) for part in (states, *drawn)) else np
        present = [part for part in drawn if part is not None]
        if not present:
            return states
        rest = xp.concatenate(present, axis=-1)
        flat = rest.reshape(*rest.shape[:-2], rest.shape[-2] * rest.shape[-1])
        return xp.concatenate([states, flat], axis=-1)

    def middle(self, state: Float[np.ndarray, " n_x"]) -> Float[np.ndarray, " s"]:
        """The scenario from a state in which everything drawn is in the middle of its set."""
        return self.joined(state, *(part.middles for part in self._draws))

    def completed(
        self, scenarios: Float[np.ndarray, "c p"], by: Float[np.ndarray, "#c s"]
    ) -> Float[np.ndarray, "c s"]:
        """Scenarios that end early, with the ends of others."""
        known, size = scenarios.shape[1], by.shape[-1]
        ends = np.broadcast_to(by[..., min(known, size) :], (len(scenarios), max(size - known, 0)))
        return np.concatenate([scenarios[:, :size], ends], axis=1)

    def drawn(self, states: Float[np.ndarray, "c n_x"], seed: int) -> Float[np.ndarray, "c s"]:
        """A scenario from each of these initial states."""
        parts = enumerate(self._draws)
        return self.joined(states, *(part.sample(len(states), seed + i) for i, part in parts))

    def runs(
        self, loop: ClosedLoop, scenarios: Float[np.ndarray, "c s"], steps: int, start: int
    ) -> Float[np.ndarray, "c steps+1 n_x"]:
        """The trajectories of scenarios.

        Args:
            loop: of numpy arrays.
            scenarios: of at least so many steps.
            steps: how many are simulated.
            start: the time of the initial states.
        """
        return trajectories(loop, *self.split(scenarios), horizon=steps, start=start)

    def contains(self, scenarios: Rows) -> Any:
        """Which scenarios have every part in its set."""
        states, *drawn = self.split(scenarios)
        inside = self.X0.contains(states)
        for draws, points in zip((self.disturbances, self.noises), drawn, strict=True):
            if draws is not None:
                inside = inside & _contain(draws, points)
        return inside

    def nearly_contains(self, scenarios: Float[np.ndarray, "c s"]) -> Bool[np.ndarray, " c"]:
        """Which scenarios begin in the initial set or next to it, the rest being in its sets."""
        states, *drawn = self.split(scenarios)
        inside = np.asarray(self.X0.contains(states, NEXT))
        for draws, points in zip((self.disturbances, self.noises), drawn, strict=True):
            if draws is not None:
                inside = inside & np.asarray(_contain(draws, points))
        return inside

    def surely_contains(self, scenario: Float[np.ndarray, " s"]) -> bool:
        """Whether every part is in its set in exact arithmetic."""
        states, *drawn = self.split(scenario)
        if not self.X0.surely_contains(states):
            return False
        for draws, points in zip((self.disturbances, self.noises), drawn, strict=True):
            if draws is None:
                continue
            if draws.sets.intervals is not None:  # comparisons are exact
                lower, upper = map(np.asarray, draws.sets.intervals)
                if not np.all((lower <= points) & (points <= upper)):
                    return False
            elif not all(map(draws.at_start.surely_contains, points)):
                return False
        return True

    def clipped(self, scenarios: Float[np.ndarray, "c s"]) -> Float[np.ndarray, "c s"]:
        """Scenarios with what is drawn in its sets, but for rounding and facets of polytopes."""
        states, *drawn = self.split(scenarios)
        parts = zip((self.disturbances, self.noises), drawn, strict=True)
        inside = [None if draws is None else draws.clipped(points) for draws, points in parts]
        return self.joined(states, *inside)

    def brought_inside(
        self, scenario: Array, middle: Array, scale: Float[Array, "n_x n_x"]
    ) -> Array:
        """A scenario part by part near this one, with every part in its set.

        Args:
            scenario: any one.
            middle: with its parts in the interiors of their sets.
            scale: in which the initial state is measured.
        """
        (state, *drawn), (center, *_) = self.split(scenario), self.split(middle)
        inside = [self.X0.brought_inside(state, center, scale)]
        for draws, points in zip((self.disturbances, self.noises), drawn, strict=True):
            if draws is not None:
                given: Any = draws.sets, points, draws.middles, draws.scales
                inside.append(jax.vmap(type(draws.sets).brought_inside)(*given))
        return self.joined(*inside)

    def uphill(self, slope: Array, scale: Float[Array, "n_x n_x"]) -> Array:
        """The direction in which a value grows, of length 1 part by part, in the parts' scales."""
        state, *drawn = self.split(slope)
        along = [scale @ _unit(scale.T @ state)]
        for draws, slopes in zip((self.disturbances, self.noises), drawn, strict=True):
            if draws is not None:
                by = jax.vmap(lambda scale, slope: scale @ _unit(scale.T @ slope))
                along.append(by(draws.scales, slopes))
        return self.joined(*along)

    def of_units(
        self, states: Float[np.ndarray, "c n_x"], drawn: Sequence[Float[np.ndarray, "c m"]]
    ) -> Float[np.ndarray, "c s"]:
        """Scenarios of as many steps as values of units are given, in `[-1, 1]`.

        Args:
            states: initial states.
            drawn: for each step what is drawn of the units, noise first.
        """
        if not self._draws or not drawn:
            return states
        found: list[list[np.ndarray]] = [[] for _ in self._draws]
        frames = [_frames(draws, len(drawn)) for draws in self._draws]
        for k, values in enumerate(drawn):
            done = 0
            for which, draws in reversed(list(enumerate(self._draws))):
                n = draws.middles.shape[1]
                found[which].append(frames[which][k].values(values[:, done : done + n]))
                done += n
        return self.joined(states, *(np.stack(each, axis=1) for each in found))

    def units_at(self, scenario: Float[np.ndarray, " s"]) -> list[Float[np.ndarray, " m"]]:
        """The values of the units of each step in a scenario, noise first."""
        _, *drawn = self.split(scenario)
        given = [
            (_frames(draws, self.steps), points)
            for draws, points in zip((self.disturbances, self.noises), drawn, strict=True)
            if draws is not None
        ]
        return [
            np.concatenate([frames[k].inverse(points[k]) for frames, points in reversed(given)])
            for k in range(self.steps)
            if given
        ]


def _frames(draws: Draws, steps: int) -> list[Frame]:
    """What is drawn from at each step; a set that stays the same is framed once."""
    if draws.at_start.steps is None:
        return [framed(draws.at_start)] * steps
    return [framed(draws.at_start, draws.start + k) for k in range(steps)]


@jax.jit
def _contain(draws: Draws, points: Float[Array, "*batch h n"]) -> Bool[Array, "*batch"]:
    return draws.contain(points)


def _unit(vector: Array) -> Array:
    size = jnp.linalg.norm(vector)
    return vector / jnp.where(size > 0, size, 1.0)
