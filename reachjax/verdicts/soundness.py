"""The guard of every verdict: what is proved holds on trajectories of the loop as JAX runs it.

Bounds, and trajectories on the host, come from one reading of the loop's functions. Were that
reading wrong, both would be, and agree. So some trajectories of the loop as it is compiled are held
against what is proved. One that breaks it by more than rounding is no verdict but an error.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from reachjax.loops import ClosedLoop
from reachjax.loops.scenarios import Runs, Scenarios
from reachjax.loops.tracing.functions import Compiled
from reachjax.numerics.compilations import ONCE
from reachjax.sets import AbstractSet
from reachjax.verdicts.counterexamples import deviates, enclosures, most_room
from reachjax.verdicts.specification import Requirement
from reachjax.verdicts.verdict import Counterexample, DecidedCell, VerdictStatus

TRIALS = 64
"""So many trajectories are run by JAX where bounds and simulations are of the host."""

EXAMINED = 3
"""So many of the worst trajectories of each requirement are examined with their rounding."""

SHOWN = 1e-9
"""Margins are shown, not decided on: they may be off by this part of the states' sizes."""


class UnsoundError(Exception):
    """Something is proved that a trajectory of the loop breaks by more than rounding.

    This is a defect of reachjax, and of no argument that it was given; none of what it says of this
    loop can be relied on. Please report it, with the loop and the trajectory.

    Attributes:
        requirement: which part of the specification: `goal`, `safe` or `avoid[i]`.
        time: when, in steps after the initial set.
        certified: the margin that was proved.
        simulated: the margin of the trajectory.
        states: `(time + 1, n_x)`, the trajectory.
    """

    def __init__(
        self,
        requirement: str,
        time: int,
        certified: float,
        simulated: float,
        states: Float[np.ndarray, "t n_x"],
    ):
        super().__init__(
            f"{requirement} at t = {time} is certified with margin {certified:+.4g}, but the "
            f"trajectory {np.asarray(states).tolist()} has margin {simulated:+.4g}, and rounding "
            "is less than that: this is a defect of reachjax, and nothing that it says of this "
            "loop can be relied on. Please report it, with the loop and this trajectory"
        )
        self.requirement, self.time, self.states = requirement, time, np.asarray(states)
        self.certified, self.simulated = certified, simulated

    def __reduce__(self) -> tuple[Any, ...]:
        given = self.requirement, self.time, self.certified, self.simulated, self.states
        return type(self), given


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


def compiled_runs(
    loop: ClosedLoop, scenarios: Scenarios, rows: Float[np.ndarray, "c s"], start: int
) -> Runs:
    """Trajectories of some scenarios as JAX runs the loop, step by step: one step is compiled."""
    rows = np.asarray(rows)[:TRIALS]
    if not len(rows):
        return Runs(rows, np.zeros((0, scenarios.steps + 1, loop.states)))
    states, *drawn = scenarios.split(np.resize(rows, (TRIALS, rows.shape[1])))
    loop, found = jax.device_put(loop), [states]
    for k in range(scenarios.steps):
        at = [None if part is None else part[:, k] for part in drawn]
        found.append(_stepped(loop, found[-1], start + k, *at))
    return Runs(rows, np.stack(jax.device_get(found), axis=1)[: len(rows)])


@partial(Compiled, compiler_options=ONCE)
def _stepped(
    loop: ClosedLoop,
    states: Float[Array, "c n_x"],
    t: int,
    disturbances: Float[Array, "c n_w"] | None,
    noises: Float[Array, "c n_x"] | None,
) -> Float[Array, "c n_x"]:
    """The successors of many states."""
    given = states, disturbances, noises
    return jax.vmap(lambda x, w, v: loop.step(x, t, w=w, v=v))(*given)


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
