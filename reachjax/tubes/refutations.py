"""Counterexamples: trajectories that surely break a requirement, rounding accounted for."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import jax
import numpy as np

from reachjax.loops import ClosedLoop
from reachjax.numerics.rounding import TINY, gamma
from reachjax.programs.bounds import successor_box
from reachjax.sets import AbstractSet, Box
from reachjax.sets.balance import balanced
from reachjax.tubes.requirements import Requirement
from reachjax.tubes.verdicts import Counterexample

SUSPECTS = 5
"""So many of the worst trajectories of each requirement are examined with their rounding."""


class Suspect(NamedTuple):
    """A simulated trajectory that seems to break a requirement.

    Attributes:
        room: how far it is on the right side: not at all.
        item: the requirement.
        states: `(h + 1, n_x)`.
    """

    room: float
    item: Requirement
    states: np.ndarray


def suspects(item: Requirement, rooms: np.ndarray, trajectories: np.ndarray) -> list[Suspect]:
    """The worst of trajectories `(c, h + 1, n_x)`, of which these are the rooms `(c,)`."""
    worst = np.argsort(rooms)[:SUSPECTS]
    return [Suspect(float(rooms[k]), item, trajectories[k]) for k in worst if rooms[k] <= 0]


def counterexample(
    loop: ClosedLoop, X0: AbstractSet, found: Iterable[Suspect], start: int
) -> Counterexample | None:
    """The worst suspect that surely begins in the set and breaks its requirement; None if none."""
    for room, item, states in sorted(found, key=lambda suspect: suspect.room):
        if X0.surely_contains(states[0]) and surely_broken(loop, item, states[0], start):
            on_host = jax.device_get(loop)
            inputs = [on_host.input(x, start + t) for t, x in enumerate(states[:-1])]
            return Counterexample(item.name, item.time, -room, states, np.stack(inputs))
    return None


def surely_broken(loop: ClosedLoop, item: Requirement, x0: np.ndarray, start: int) -> bool:
    """Whether the exact trajectory from `x0` breaks a requirement, rounding accounted for."""
    reached = Box(x0, x0)
    for t in range(item.time):
        reached = successor_box(loop, reached, start + t)
    lower, upper = np.asarray(reached.lower), np.asarray(reached.upper)
    C, d = balanced(*(np.asarray(part) for part in item.region.facets), inner=not item.inside)
    ends = np.where(C > 0, lower, upper), np.where(C > 0, upper, lower)
    with np.errstate(over="ignore", invalid="ignore"):
        least, most = (np.sum(C * end, axis=1) for end in ends)
        size = np.sum(abs(C) * np.maximum(abs(lower), abs(upper)), axis=1)
        underflow = TINY * ((C != 0) @ ((lower != 0) | (upper != 0)))
        error = gamma(len(lower)) * size + underflow
        if item.inside:
            return bool(np.any(least - error > d))
        return bool(np.all(most + error <= d))
