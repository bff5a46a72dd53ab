"""The quadrotor's learned controller: which states its samples are drawn at, and how it is trained.

Half of the candidate states lie around what the loop will visit: closed-loop trajectories of the
MPC over two seconds, from an enlarged copy of the initial set, each state perturbed. Perturbed,
because the learned controller leaves the MPC's trajectories, and two seconds, because then it has
also seen what comes after the goal. The other half is uniform over the position limits and over
speeds as they occur on the way to the origin, so that the controller is one of the whole task.

The samples and the trained network are kept in the folder `data` beside this file, as `python -m
experiments.quadrotor --resample` made them.
"""

import shutil
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from experiments import stored
from experiments.imitation import evaluate
from experiments.quadrotor.model import (
    INITIAL_CENTER,
    INITIAL_RADII,
    INPUT_LIMITS,
    POSITION_LIMITS,
    VELOCITY_LIMITS,
    plant,
)
from experiments.quadrotor.mpc import QuadrotorMPC
from experiments.sampling import Samples, sample_draws

DATA = Path(__file__).parent / "data"
VELOCITY_MARGIN = 0.1
"""By how much velocity limits are tightened where they are kept, metres per second."""


@dataclass(frozen=True)
class Draws:
    """Candidate states in equal parts around the tube and over the whole box; see the module."""

    starts: int = 5
    """Trajectories in a block of candidates."""
    steps: int = 20
    """States of each."""
    enlarged: float = 4.0
    """By how much the initial set is scaled about its centre."""
    position_noise: float = 0.1
    """Standard deviation of what is added to positions of trajectories, metres."""
    velocity_noise: float = 0.15
    """The same for velocities, metres per second."""
    speed: float = 3.0
    """Largest speed of the broad share, along each axis."""

    def __call__(
        self, mpc: QuadrotorMPC, rng: np.random.Generator
    ) -> Float[ndarray, "candidates 6"]:
        """A block in random order; trajectories end early where the MPC has no plan."""
        tube = self._trajectories(mpc, rng)
        noise = np.repeat([self.position_noise, self.velocity_noise], 3)
        tube += noise * rng.standard_normal(tube.shape)
        highest = np.concatenate([POSITION_LIMITS[1], np.full(3, self.speed)])
        broad = rng.uniform(-highest, highest, (self.starts * self.steps, 6))
        return rng.permutation(np.vstack([tube, broad]))

    def _trajectories(self, mpc, rng):
        directions = rng.standard_normal((self.starts, 6))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        ball = directions * rng.uniform(size=(self.starts, 1)) ** (1 / 6)
        sampled = plant()
        A, B, c = (np.asarray(matrix, float) for matrix in (sampled.A, sampled.B, sampled.c))
        states = [INITIAL_CENTER + self.enlarged * INITIAL_RADII * ball]
        while len(states) < self.steps:
            inputs = mpc.batch(states[-1])
            steered = ~np.isnan(inputs[:, 0])
            states.append((states[-1] @ A.T + inputs @ B.T + c)[steered])
        return np.vstack(states)


def teacher(velocity_limits: bool) -> QuadrotorMPC:
    """The paper's MPC without its velocity limits, or one with them that has a plan.

    With them the paper's horizon is too short: 4.7 m in 3 s at 1 m/s. They are tightened, as the
    optimum rides on them and a learned copy undershoots.
    """
    if not velocity_limits:
        return QuadrotorMPC()
    return QuadrotorMPC(horizon=70, velocity_limit=VELOCITY_LIMITS[1, 0] - VELOCITY_MARGIN)


def use_committed(folder: Path, replacing: bool = False) -> None:
    """Copy the committed samples and weights into `folder`, where it has none of its own.

    With `replacing`, also where other settings made what is there; that is kept by another name.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("samples.npz", "weights.npz"):
        ours, theirs = folder / name, DATA / name
        if ours.exists():
            if not replacing or stored.settings_of(ours) == stored.settings_of(theirs):
                continue
            ours.replace(ours.with_stem(f"{ours.stem}_of_other_settings"))
        shutil.copy(theirs, ours)


def sample(
    mpc: QuadrotorMPC,
    count: int,
    seed: int,
    folder: Path,
    *,
    draws: Draws = Draws(),
    progress: bool = True,
) -> Samples:
    """What the MPC decides at `count` states, kept in `folder` and continued from there."""
    return sample_draws(
        mpc,
        count,
        seed,
        draw=partial(draws, mpc),
        settings=asdict(draws),
        path=folder / "samples.npz",
        progress=progress,
    )


def imitation_errors(
    layers, states: Float[ndarray, "count 6"], inputs: Float[ndarray, "count 3"]
) -> Float[ndarray, "2 3"]:
    """Root mean square and largest error of each projected input."""
    applied = np.clip(evaluate(layers, states), *INPUT_LIMITS)
    errors = abs(applied - inputs)
    return np.array([np.sqrt(np.mean(errors**2, axis=0)), errors.max(axis=0)])
