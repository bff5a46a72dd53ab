"""The guard of every verdict: what is proved holds on trajectories of the loop as JAX runs it.

Bounds, and trajectories on the host, come from one reading of the loop's functions. Were that
reading wrong, both would be, and agree. So some trajectories of the loop as it is compiled are held
against what is proved. One that breaks it by more than rounding is no verdict but an error. What is
refuted rests on an enclosed trajectory, each step of which is held against the compiled one.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from reachjax.loops import ClosedLoop
from reachjax.loops.closed_loop import Scenario
from reachjax.loops.scenarios import Runs, Scenarios
from reachjax.numerics.pytrees import unchecked
from reachjax.numerics.rounding import TINY
from reachjax.sets import AbstractSet, Box
from reachjax.verdicts.compiled import TRIALS, compiled_runs, compiled_steps, is_telling
from reachjax.verdicts.counterexamples import (
    Departure,
    departures,
    deviates,
    enclosures,
    most_room,
)
from reachjax.verdicts.specification import Requirement
from reachjax.verdicts.verdict import Counterexample, DecidedCell, VerdictStatus

EXAMINED = 3
"""So many of the worst trajectories of each requirement are examined with their rounding."""

SHOWN = 1e-9
"""Margins are shown, not decided on: they may be off by this part of the states' sizes."""


class UnsoundError(Exception):
    """Something is proved or refuted of another loop than JAX runs, by more than rounding.

    This is a defect of reachjax, and of no argument that it was given; none of what it says of this
    loop can be relied on. Please report it, with the loop and the trajectory.

    Attributes:
        requirement: which part of the specification: `goal`, `safe` or `avoid[i]`.
        time: when, in steps after the initial set.
        certified: the margin that was proved; NaN of what was refuted.
        simulated: the margin of the trajectory.
        states: `(time + 1, n_x)`, the trajectory.
        departs: of what was refuted, the step that JAX runs otherwise than it is enclosed: `step`,
            `coordinate`, and its values `run` and `enclosed`; None of what was proved.
    """

    def __init__(
        self,
        requirement: str,
        time: int,
        certified: float,
        simulated: float,
        states: Float[np.ndarray, "t n_x"],
        departs: Departure | None = None,
    ):
        if departs is None:
            said = (
                f"{requirement} at t = {time} is certified with margin {certified:+.4g}, but the "
                f"trajectory {np.asarray(states).tolist()} has margin {simulated:+.4g}, and "
                "rounding is less than that"
            )
        else:
            said = (
                f"{requirement} at t = {time} is broken by the trajectory "
                f"{np.asarray(states).tolist()} with margin {simulated:+.4g}, but JAX runs the "
                f"loop otherwise: coordinate {departs.coordinate} of the state after step "
                f"{departs.step} is {departs.run!r} there, and in the enclosure of the step at "
                f"closest {departs.enclosed!r}, which rounding does not explain"
            )
        super().__init__(
            f"{said}: this is a defect of reachjax, and nothing that it says of this loop can be "
            "relied on. Please report it, with the loop and this trajectory"
        )
        self.requirement, self.time, self.states = requirement, time, np.asarray(states)
        self.certified, self.simulated, self.departs = certified, simulated, departs

    def __reduce__(self) -> tuple[Any, ...]:
        given = self.requirement, self.time, self.certified, self.simulated, self.states
        return type(self), (*given, self.departs)


class Claim(NamedTuple):
    """A requirement, and what is certified of it for each of some trajectories.

    Attributes:
        item: the requirement.
        margins: `(c,)`, the certified margins; of one for all, `()`; NaN where none is known.
        proved: `(c,)` or `()`, whether it is said to hold.
    """

    item: Requirement
    margins: Any
    proved: Any = True


def require_unbroken(
    loop: ClosedLoop, scenarios: Scenarios, start: int, runs: Runs, claims: Iterable[Claim]
) -> None:
    """Raise an error if a trajectory contradicts what is certified, by more than rounding.

    Args:
        loop: the closed loop, of numbers.
        scenarios: what is claimed is claimed of all of these.
        start: the time of the initial set.
        runs: trajectories, as JAX simulates them.
        claims: what is certified.

    Raises:
        UnsoundError: one of them does.
    """
    runs = runs.some(np.isfinite(runs.states).all(axis=(1, 2)))
    if not len(runs.states):
        return
    for item, *certified in claims:
        rooms = item.simulated(runs.states)
        margins, proved = (np.broadcast_to(np.asarray(part), rooms.shape) for part in certified)
        size = abs(runs.states[:, item.time]).max(axis=1)
        with np.errstate(invalid="ignore"):
            less = rooms < margins - SHOWN * (size + abs(margins))
        less &= item.ball is None  # what is simulated of an ellipsoid is less than its margin
        suspicious = np.flatnonzero((proved & (rooms < 0)) | less)
        for k in suspicious[np.argsort((rooms - np.nan_to_num(margins))[suspicious])][:EXAMINED]:
            scenario, states = runs.scenarios[k], runs.states[k, : item.time + 1]
            if _contradicts(loop, scenarios, start, Claim(item, margins[k]), scenario, states):
                given = item.name, item.time, float(margins[k]), float(rooms[k]), states
                raise UnsoundError(*given)


def require_broken(loop: ClosedLoop, example: Counterexample, start: int) -> None:
    """Raise an error if JAX runs a step of a counterexample otherwise than it is enclosed.

    Each step is run from the middle of its own enclosure, so that loops that amplify rounding, or
    go another way at a tie, are held to single steps alone. A step in numbers of few bits, or too
    large or too small for XLA, is held to nothing.

    Args:
        loop: the closed loop, of numbers.
        example: with an enclosure.
        start: the time of its initial state.

    Raises:
        UnsoundError: JAX does: what is refuted may be true.
    """
    if example.lower is None or example.upper is None:
        return
    count, states = example.time, np.array(example.states[: example.time])
    middles = example.lower[:count] + (example.upper - example.lower)[:count] / 2
    known = np.asarray(np.isfinite(middles).all(axis=1))
    known[:1] = False  # where it begins is exact
    states[known] = middles[known]
    states[abs(states) < TINY] = 0.0  # as XLA has it
    drawn = [None if p is None else p[:count] for p in (example.disturbances, example.noises)]
    following = compiled_steps(loop, states, *drawn, start=start)
    ends = zip(example.lower[1:], example.upper[1:], strict=True)
    boxes = [unchecked(Box, lower=lower, upper=upper) for lower, upper in ends]
    for found in departures(loop, Scenario(states, *drawn), following, start, boxes):
        k = found.step
        here = (None if part is None else part[k] for part in drawn)
        if is_telling(loop, states[k], start + k, *here):
            given = example.requirement, count, np.nan, -example.violation
            raise UnsoundError(*given, example.states[: count + 1], found)


def _contradicts(
    loop: ClosedLoop,
    scenarios: Scenarios,
    start: int,
    claim: Claim,
    scenario: Float[np.ndarray, " s"],
    states: Float[np.ndarray, "t n_x"],
) -> bool:
    """Whether a trajectory is of another loop than was bounded, or its enclosure breaks a claim."""
    drawn = loop.split(scenario)
    if deviates(loop, drawn, states, start):
        return True
    if not scenarios.surely_contains(scenario):
        return False
    *_, reached = enclosures(loop, drawn, claim.item.time, start)
    room = most_room(claim.item, reached)
    with np.errstate(invalid="ignore"):
        slack = SHOWN * (np.max(abs(states[-1])) + abs(claim.margins))
        return bool(room < 0 or (claim.item.ball is None and room < claim.margins - slack))


def worst_of(runs: Runs, items: Sequence[Requirement]) -> Float[np.ndarray, "c s"]:
    """Scenarios to be held against what is proved: the worst ones on the host, and any others."""
    if not len(runs.states):
        return runs.scenarios
    rooms = np.min([item.simulated(runs.states) for item in items], axis=0)
    worst = np.argsort(rooms)[: TRIALS // 2]
    others = np.arange(len(rooms))[:: -(-len(rooms) // (TRIALS // 2))]
    return runs.scenarios[np.union1d(worst, others)]


def require_unbroken_cells(
    loop: ClosedLoop,
    X0: AbstractSet,
    horizon: int,
    start: int,
    required: Sequence[Requirement],
    cells: Iterable[DecidedCell],
    example: Counterexample | None = None,
) -> None:
    """Raise an error if a trajectory from a proved cell breaks what is required.

    Args:
        loop: the closed loop, of numbers.
        X0: the set that is cut into cells.
        horizon: the number of steps.
        start: the time of the initial set.
        required: the requirements.
        cells: what is said of each.
        example: a counterexample, which begins in none of the proved ones.

    Raises:
        UnsoundError: one does.
    """
    proved = [cell for cell in cells if cell.status is VerdictStatus.PROVED]
    for cell in proved if example else ():
        assert example is not None
        k, states = example.time, example.states
        if np.all((cell.lower <= states[0]) & (states[0] <= cell.upper)):
            given = cell.margin, -example.violation, states[: k + 1]
            raise UnsoundError(example.requirement, k, *given)
    proved = proved[:: -(-len(proved) // TRIALS) or 1]
    if not proved:
        return
    each = max(TRIALS // len(proved), 1)
    lower, upper = (
        np.repeat(np.stack([getattr(cell, end) for cell in proved]), each, axis=0)
        for end in ("lower", "upper")
    )
    shares = np.random.default_rng(0).uniform(size=lower.shape)
    shares[::2] = shares[::2] > 0.5  # corners
    states = np.clip(lower + shares * (upper - lower), lower, upper)
    inside = np.asarray(X0.contains(states))
    margins = np.repeat([cell.margin for cell in proved], each)[inside]
    scenarios = Scenarios.of(loop, X0, horizon, start)
    rows = scenarios.drawn(states[inside], 0)
    runs = compiled_runs(loop, scenarios, rows, start)
    claims = (Claim(item, margins) for item in required)
    require_unbroken(loop, scenarios, start, runs, claims)
