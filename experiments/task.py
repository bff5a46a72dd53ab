"""What a loop is asked: where it starts, what its sets look like, what it has to do."""

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Float
from numpy import ndarray

import reachjax as rj

STILL = 1e-9
"""Directions whose simulated range is below this part of the largest one do not move."""


@dataclass(frozen=True, eq=False)
class Task:
    """A loop, a box of initial states, a number of steps, facets, and what is required.

    Attributes:
        loop: of ReLUs.
        X0: where it starts.
        horizon: the number of steps.
        template: what its sets look like.
        goal: where every state must be at the end, if anywhere.
        safe: where every state must be at all times, if anywhere.
        avoid: sets in which no state may be at any time.
    """

    loop: rj.ClosedLoop
    X0: rj.Box
    horizon: int
    template: rj.Template
    goal: rj.PolyhedralSet | None = None
    safe: rj.PolyhedralSet | None = None
    avoid: tuple[rj.PolyhedralSet, ...] = ()

    @property
    def directions(self) -> Float[ndarray, "m n_x"]:
        """Of the facets."""
        return np.asarray(self.template.directions)

    @property
    def layers(self) -> list[tuple[Float[ndarray, "out in"], Float[ndarray, " out"]]]:
        """Weights and biases of the network."""
        assert isinstance(self.loop.controller, rj.MLP)
        return [(np.asarray(W), np.asarray(b)) for W, b in self.loop.controller.layers]

    @property
    def required(self) -> dict[str, Any]:
        """What `rj.verify` and `rj.decide` take of it."""
        return {"goal": self.goal, "safe": self.safe, "avoid": self.avoid}

    def simulated(self, count: int, seed: int) -> Float[ndarray, "c horizon+1 n_x"]:
        """Trajectories from `count` states of the box and from its corners."""
        states = np.vstack([self.X0.vertices(), self.X0.sample(jax.random.key(seed), count)])
        states = np.clip(states, self.X0.lower, self.X0.upper)  # corners and samples are rounded
        return np.asarray(self.loop.simulate(states, self.horizon))

    def support(self, states: Float[ndarray, "c horizon+1 n_x"]) -> Float[ndarray, "horizon m"]:
        """The largest simulated values of the facets' directions."""
        return (states[:, 1:] @ self.directions.T).max(axis=0)

    def margin(self, states: Float[ndarray, "c horizon+1 n_x"]) -> float:
        """The least room that trajectories leave to what is required, infinite if nothing is."""
        rooms = [np.inf]
        for region, seen in ((self.goal, states[:, -1]), (self.safe, states)):
            if region is not None:
                rooms.append(_rooms(region, seen).min())
        rooms += [(-_rooms(region, states)).max(axis=-1).min() for region in self.avoid]
        return float(min(rooms))

    def widths(self, offsets: Float[ndarray, "horizon m"]) -> Float[ndarray, "horizon m"]:
        """By facets, the width between a facet and the opposite one."""
        norms = self.directions / np.linalg.norm(self.directions, axis=1, keepdims=True)
        opposite = np.argmin(norms @ norms.T, axis=1)
        return offsets + offsets[:, opposite]

    def moving(self, known: Float[ndarray, "horizon m"]) -> ndarray:
        """`(horizon, m)`, which of these widths are no rounding errors."""
        widths = self.widths(known)
        return widths > STILL * widths.max(axis=1, keepdims=True)


def _rooms(region: rj.PolyhedralSet, states: Float[ndarray, "*c n_x"]) -> Float[ndarray, "*c m"]:
    """How far states are within each facet."""
    A, b = map(np.asarray, region.facets)
    return b - states @ A.T
