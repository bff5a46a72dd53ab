"""What a file keeps of tubes: all of them, but for a loop whose functions a user wrote.

Of such a loop it keeps the numbers and some trajectories, so that another one is noticed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from reachjax.loops import ClosedLoop
from reachjax.loops.scenarios import Scenarios
from reachjax.numerics.storage import write
from reachjax.proofs.witnesses import initial_states
from reachjax.sets import AbstractSet

SAMPLES = 100
CLOSE = 1e-9
"""Of the largest number at a time: what trajectories of one loop may differ by on two machines."""


class Kept(NamedTuple):
    """What a file holds.

    Attributes:
        tube: or several, of cells.
        leaves: the loop's arrays.
        scenarios: `(c, s)`, from the initial set.
        trajectories: `(c, horizon + 1, n_x)`, of these.
    """

    tube: Any
    leaves: tuple[np.ndarray, ...]
    scenarios: np.ndarray
    trajectories: np.ndarray

    def is_of(self, loop: ClosedLoop, start: int) -> bool:
        """Whether a loop has these numbers and these trajectories."""
        leaves = jax.tree.leaves(loop)
        if len(leaves) != len(self.leaves) or not all(map(np.array_equal, leaves, self.leaves)):
            return False
        found = _trajectories(loop, self.scenarios, self.trajectories.shape[1] - 1, start)
        size = np.max(abs(self.trajectories), axis=(0, 2), initial=0.0)[None, :, None]
        return found.shape == self.trajectories.shape and bool(
            np.all(abs(found - self.trajectories) <= CLOSE * size)
        )


def keep(
    path: Path, tube: Any, loop: ClosedLoop, X0: AbstractSet, horizon: int, start: int
) -> None:
    """Write tubes of one loop to a file."""
    scenarios = Scenarios.of(loop, X0, horizon, start)
    try:
        drawn = scenarios.drawn(initial_states(X0, SAMPLES, seed=0), seed=0)
    except RuntimeError:  # the set is too thin to be sampled
        drawn = scenarios.middle(np.asarray(X0.bounding_box().center))[None]
    leaves = tuple(map(np.asarray, jax.tree.leaves(loop)))
    kept = Kept(tube, leaves, drawn, _trajectories(loop, drawn, horizon, start))
    write(path, kept, outside=ClosedLoop)


def _trajectories(loop: ClosedLoop, scenarios: Any, horizon: int, start: int) -> np.ndarray:
    states, w, v = loop.split(scenarios)
    return np.asarray(loop.simulate(states, horizon, start, disturbances=w, noises=v))
