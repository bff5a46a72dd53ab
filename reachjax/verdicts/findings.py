"""What is known of a specification so far: what is proved of it, what is simulated, what breaks it.

Whoever decides notes here what it finds, in any order and from anywhere: `verify` of a tube's sets,
`decide` of bounds and programs, cells of all of these.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from reachjax.loops import ClosedLoop
from reachjax.loops.batches import in_between
from reachjax.loops.scenarios import Runs
from reachjax.numerics.host import in_numpy
from reachjax.numerics.rounding import TINY
from reachjax.sets import AbstractSet
from reachjax.verdicts.counterexamples import counterexample, suspects
from reachjax.verdicts.soundness import Claim, require_broken
from reachjax.verdicts.specification import Requirement
from reachjax.verdicts.verdict import Counterexample, Verdict, VerdictStatus


def rooms_of(
    loop: ClosedLoop, item: Requirement, runs: Runs, start: int
) -> Float[np.ndarray, " c"]:
    """How far each trajectory is on the right side, in between samples too if that is meant.

    Args:
        loop: of numpy arrays.
        item: what is required.
        runs: trajectories.
        start: the time of their initial states.
    """
    rooms, t = item.simulated(runs.states), item.time - 1
    if not item.throughout:
        return rooms
    _, *drawn = loop.split(runs.scenarios)
    at = [None if part is None else np.asarray(part[:, t]) for part in drawn]
    ends = runs.states[:, t], runs.states[:, t + 1]
    with np.errstate(all="ignore"):
        dense = in_between(loop, *ends, start + t, *at)
    inner = dataclasses.replace(item, time=0).simulated(dense.reshape(-1, 1, dense.shape[-1]))
    return np.fmin.reduce([rooms, *inner.reshape(len(dense), -1)])


class Findings:
    """What is proved and simulated of each requirement so far.

    Args:
        loop: the closed loop.
        X0: the initial set.
        horizon: the number of steps.
        start: the time of the initial set.
        required: the requirements.

    Attributes:
        open: the requirements that are not proved, by name and time.
        example: a counterexample; None as long as there is none.
    """

    def __init__(
        self,
        loop: ClosedLoop,
        X0: AbstractSet,
        horizon: int,
        start: int,
        required: Sequence[Requirement],
    ):
        self._loop, self._X0, self._start, self._required = loop, X0, start, required
        self._on_host = in_numpy(loop)
        self._margins, self._simulated = (
            {item.name: np.full(horizon + 1, np.nan) for item in required} for _ in range(2)
        )
        for item in required:
            self._margins[item.name][item.time] = -np.inf  # as long as nothing is known
        self.open = {(item.name, item.time): item for item in required}
        self.example: Counterexample | None = None

    @property
    def ended(self) -> bool:
        """Whether nothing is left to be decided."""
        return self.example is not None or not self.open

    @property
    def claims(self) -> list[Claim]:
        """What is certified of each requirement."""
        return [
            Claim(
                item, self._margins[item.name][item.time], (item.name, item.time) not in self.open
            )
            for item in self._required
        ]

    def bound(self, item: Requirement, margin: float) -> None:
        """Note a margin that is certified, whether or not it proves the requirement."""
        row = self._margins[item.name]
        row[item.time] = np.fmax(row[item.time], margin)

    def prove(self, item: Requirement, margin: float, holds: bool) -> None:
        """Note what was found of a requirement: what underflows or is no number proves nothing."""
        if not holds:
            margin = min(margin, -TINY) if np.isfinite(margin) else -np.inf
        self.bound(item, margin)
        if holds:
            self.open.pop((item.name, item.time), None)

    def simulate(self, runs: Runs, items: Sequence[Requirement] | None = None) -> None:
        """Note what trajectories show that do not overflow, a counterexample perhaps.

        Args:
            runs: from the initial set.
            items: of which requirements; None of all.

        Raises:
            UnsoundError: JAX runs a counterexample otherwise than it is enclosed.
        """
        runs = runs.some(np.isfinite(runs.states).all(axis=(1, 2)))
        if not len(runs.states):
            return
        found = []
        for item in self._required if items is None else items:
            rooms, row = (
                rooms_of(self._on_host, item, runs, self._start),
                self._simulated[item.name],
            )
            row[item.time] = np.fmin(row[item.time], rooms.min())
            found += suspects(self._on_host, item, rooms, runs)
        if self.example is None:
            example = counterexample(self._loop, self._X0, found, self._start)
            if example is not None:
                require_broken(self._loop, example, self._start)
            self.example = example

    def verdict(self, ends: Mapping[Any, int] | None = None, **more: Any) -> Verdict:
        """The verdict from everything proved and simulated so far.

        Args:
            ends: how the bounds that it rests on ended.
            more: what else it says.
        """
        status = VerdictStatus.UNKNOWN if self.open else VerdictStatus.PROVED
        if self.example is not None:
            status = VerdictStatus.REFUTED
        return Verdict(status, self._margins, self._simulated, self.example, ends or {}, **more)
