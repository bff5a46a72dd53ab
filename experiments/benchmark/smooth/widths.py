"""Figures of boxes: certified widths over attained ones."""

import jax
import numpy as np
from jaxtyping import Float
from numpy import ndarray

import reachjax as rj
from experiments.competition.study import corners
from experiments.task import STILL

DENSE = 16
"""So many states of a period are simulated to compare spans with."""


def widths_of(region: rj.AbstractSet) -> Float[ndarray, " n"]:
    """Of the box around a set."""
    return np.asarray(region.bounding_box().widths)


def drawn(X0: rj.Box, count: int, seed: int = 0) -> Float[ndarray, "c n"]:
    """Corners of a box, and states in it."""
    states = np.asarray(X0.sample(jax.random.key(seed), count))
    every = np.concatenate([corners(X0), states])
    return np.clip(every, np.asarray(X0.lower), np.asarray(X0.upper))


def ratio(certified: Float[ndarray, " n"], attained: Float[ndarray, " n"]) -> float:
    """The worst of certified widths over attained ones, of coordinates that are not still."""
    moves = attained > STILL * max(attained.max(), 1e-300)
    return float((certified[moves] / attained[moves]).max())


def at_the_end(tube: rj.ReachTube, runs: Float[ndarray, "c T n"]) -> float:
    """The worst width of a tube's last set over that of simulated states."""
    return ratio(widths_of(tube.sets[-1]), np.ptp(runs[:, -1], axis=0))


def span_volumes(tube: rj.ReachTube, runs: Float[ndarray, "c T n"], parts: int) -> float:
    """The mean over a tube of a span's volume over that of the box of simulated states.

    Args:
        tube: of boxes, of a differential equation.
        runs: trajectories with so many parts a period.
        parts: the number.
    """
    found = []
    for k, span in enumerate(tube.spans):
        seen = np.ptp(runs[:, k * parts : (k + 1) * parts + 1], axis=(0, 1))
        moves = seen > STILL * seen.max()
        found.append(np.prod(widths_of(span)[moves] / seen[moves]))
    return float(np.mean(found))
