"""Statements for all time: a set that states come into, and come back to.

A tube that ends says nothing of later times. If its last set is in a set `S` from which every state
is in `S` again after `m` steps, and all is well until then, all is well for ever. The initial set
may be such a set. Else one is looked for around where trajectories end: along the modes of the loop
there, or along the directions of the tube; simulation says how large and after how many steps, and
`decide` proves it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from reachjax.loops import ClosedLoop
from reachjax.loops.scenarios import Runs, Scenarios
from reachjax.methods.witnesses import initial_states
from reachjax.numerics.budget import Budget, Interrupted
from reachjax.numerics.host import in_numpy
from reachjax.programs.relaxations import BranchAndCut
from reachjax.sets import AbstractSet, PolyhedralSet
from reachjax.sets.ball_polytopes import inner_polytope
from reachjax.tubes.reach import ReachTube
from reachjax.verdicts.compiled import compiled_runs
from reachjax.verdicts.counterexamples import SUSPECTS, counterexample, suspects
from reachjax.verdicts.decide import decide
from reachjax.verdicts.findings import rooms_of
from reachjax.verdicts.recurrent_sets import (
    TRAJECTORIES,
    Candidate,
    candidate_sets,
    periods,
    within,
)
from reachjax.verdicts.soundness import Claim, require_broken, require_unbroken, worst_of
from reachjax.verdicts.specification import AvoidSets, Region, Requirement, period_of, requirements
from reachjax.verdicts.verdict import Counterexample, Recurrence, Verdict, VerdictStatus

LONG = 500
"""So many steps are simulated to see where trajectories end, and whether they break anything."""

TURNS = 4
"""In so many turns these are simulated, between which the clock is asked."""

PROGRAMS = 0, 10, 10_000
"""How many linear programs a bound may take, by turns: there are other sets to try. Of smooth loops
there are a tenth as many cells."""


LOOKING = 0.3
"""The part of the time in which sets to try are found."""


class Wanted(NamedTuple):
    """What must hold at all times.

    Attributes:
        safe: where every state must be.
        avoid: where none may be.
    """

    safe: Region | None
    avoid: tuple[Region, ...]


def for_ever(
    verdict: Verdict,
    tubes: Sequence[ReachTube],
    X0: AbstractSet,
    safe: Region | None,
    avoid: AvoidSets | None,
    seed: int,
    budget: Budget,
) -> Verdict:
    """The same verdict for all time.

    Args:
        verdict: until the horizon.
        tubes: what it rests on, from sets that cover the initial set.
        X0: the initial set.
        safe: where every state must be.
        avoid: closed sets in which no state may be.
        seed: of simulations.
        budget: after whose time no other set is tried.

    Raises:
        ValueError: the loop varies in time, or nothing is required at all times.
        UnsoundError: a trajectory breaks what is proved, or JAX runs a counterexample otherwise.
    """
    loop, start = tubes[0].loop, tubes[0].start
    if loop.varies:
        this = f"is given for {loop.steps} time steps" if loop.steps else "has a clock"
        raise ValueError(f"forever=True is of loops that do not vary in time, but this one {this}")
    if isinstance(avoid, Mapping):
        raise ValueError("with forever=True avoid must be a sequence of sets, for all times")
    if safe is None and not avoid:
        raise ValueError("nothing is required for ever: give avoid sets or a safe set")
    if verdict.status is VerdictStatus.REFUTED:
        return verdict
    wanted, runs = Wanted(safe, tuple(avoid or ())), _long_runs(loop, X0, start, seed, budget)
    example = _broken_later(loop, X0, wanted, runs, start, budget)
    if example is not None:
        require_broken(loop, example, start)
        refuted = VerdictStatus.REFUTED
        return dataclasses.replace(verdict, status=refuted, counterexample=example)
    if verdict.status is VerdictStatus.UNKNOWN:
        return verdict
    try:
        found = recurrence(tubes, X0, wanted, runs.states, budget)
    except KeyboardInterrupt:
        message = (
            "interrupted: this exception's `found` is the verdict until the horizon; verify(..., "
            "forever=True) looks again for a set that states come back to"
        )
        unknown = dataclasses.replace(verdict, status=VerdictStatus.UNKNOWN)
        raise Interrupted(message, unknown) from None
    proved = found is not None and found.proved
    if proved:
        _require_unbroken(loop, X0, wanted, runs, start)
    status = VerdictStatus.PROVED if proved else VerdictStatus.UNKNOWN
    return dataclasses.replace(verdict, status=status, recurrence=found)


def _long_runs(loop: ClosedLoop, X0: AbstractSet, start: int, seed: int, budget: Budget) -> Runs:
    """Many steps of trajectories from corners of a set and from points of it; few without time."""
    scenarios, on_host = Scenarios.of(loop, X0, LONG, start), in_numpy(loop)
    drawn = scenarios.drawn(initial_states(X0, TRAJECTORIES, seed), seed)
    found = list[Runs]()
    for some in np.array_split(drawn, min(TURNS, len(drawn))):
        if found and budget.late:
            break
        found.append(Runs(some, scenarios.runs(on_host, some, LONG, start)))
    return Runs(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def _broken_later(
    loop: ClosedLoop, X0: AbstractSet, wanted: Wanted, runs: Runs, start: int, budget: Budget
) -> Counterexample | None:
    """A trajectory that breaks what must hold at all times, cut where it does.

    One that is found after the time is not looked for.
    """
    tried = 0
    size = (runs.scenarios.shape[1] - loop.states) // LONG
    on_host = in_numpy(loop)
    for item in _for_long(loop, wanted):
        if budget.late:
            return None
        until = runs.states[:, : item.time + 1]
        some = Runs(runs.scenarios, until).some(np.isfinite(until).all(axis=(1, 2)))
        if len(some.states):
            begun = some.scenarios[:, : loop.states + item.time * size]
            cut = Runs(begun, some.states)
            found = suspects(on_host, item, rooms_of(on_host, item, cut, start), cut)
            example = counterexample(loop, X0, found, start)
            tried += min(len(found), SUSPECTS)
            if example is not None or tried > SUSPECTS:
                return example
    return None


def _for_long(loop: ClosedLoop, wanted: Wanted) -> list[Requirement]:
    """What is wanted at all times of long simulations."""
    wanted_of = {"safe": wanted.safe, "avoid": wanted.avoid or None}
    return requirements(loop.states, LONG, period_of(loop), **wanted_of)


def _require_unbroken(
    loop: ClosedLoop, X0: AbstractSet, wanted: Wanted, runs: Runs, start: int
) -> None:
    """Raise an error if a trajectory, as JAX runs it, breaks what is proved for all time."""
    items = _for_long(loop, wanted)
    scenarios = Scenarios.of(loop, X0, LONG, start)
    rows = worst_of(runs.some(np.isfinite(runs.states).all(axis=(1, 2))), items)
    long_runs = compiled_runs(loop, scenarios, rows, start)
    require_unbroken(loop, scenarios, start, long_runs, [Claim(item, np.nan) for item in items])


def _flat(safe: Region | None) -> PolyhedralSet | None:
    """A set of facets in which all that is looked for must lie."""
    if safe is None:
        return None
    flat, ball = safe.parts
    return flat if ball is None else inner_polytope(ball, "safe")


def recurrence(
    tubes: Sequence[ReachTube],
    X0: AbstractSet,
    wanted: Wanted,
    runs: Float[np.ndarray, "c T n"],
    budget: Budget,
) -> Recurrence | None:
    """A set that all states of some tubes come into and come back to, or what comes nearest to it.

    Args:
        tubes: from sets that cover the initial set, of the same horizon.
        X0: the initial set.
        wanted: what must hold at all times.
        runs: many steps of trajectories from it.
        budget: after whose time no other set is tried.

    Returns:
        With a margin that is not negative if it is proved, of which the requirements are a part;
        None if nothing comes near.
    """
    nearest = None
    flat, ball = X0.parts
    if flat is not None and ball is None:
        for k in range(1, tubes[0].horizon + 1):
            proved, margin = within([tube.sets[k] for tube in tubes], flat)
            found = Recurrence(k, k, flat, margin, proved)
            if proved:
                return found
            nearest = _nearer(nearest, found)
    if budget.late:
        return nearest
    loop, looking = tubes[0].loop, budget.share(LOOKING)
    tries = list[tuple[Candidate, int]]()
    for candidate in candidate_sets(tubes, runs, _flat(wanted.safe)):
        if looking.late:
            break
        tries += ((candidate, period) for period in periods(loop, candidate))
    tries.sort(key=lambda each: each[0].step + each[1])  # what takes fewer steps is cheaper
    many = len(PROGRAMS) * len(tries)
    for nodes in PROGRAMS:
        for candidate, period in tries:
            if budget.late:
                return nearest
            share, many = budget.share(1 / many), many - 1
            limits = BranchAndCut(nodes=nodes, cells=max(1, nodes // 10))
            found = _tried(tubes, candidate, period, wanted, limits, share)
            if found.proved:
                return found
            nearest = _nearer(nearest, found)
    return nearest


def _nearer(one: Recurrence | None, other: Recurrence | None) -> Recurrence | None:
    """The one with the larger margin."""
    if one is None or other is None:
        return one or other
    return max(one, other, key=lambda each: each.margin)


def _tried(
    tubes: Sequence[ReachTube],
    candidate: Candidate,
    period: int,
    wanted: Wanted,
    relaxation: BranchAndCut,
    budget: Budget,
) -> Recurrence:
    """What is proved of a set that shall be entered, and left only to come back."""
    loop, step, region = tubes[0].loop, candidate.step, candidate.region
    calls = 1 + len(tubes)

    def arrives(begun: AbstractSet, steps: int) -> tuple[bool, float]:
        nonlocal calls
        seconds, calls = budget.share(1 / calls).limit, calls - 1
        required = {"goal": region, "safe": wanted.safe, "avoid": wanted.avoid or None}
        limits = {"relaxation": relaxation, "samples": TRAJECTORIES, "time_limit": seconds}
        found = decide(loop, begun, steps, **required, **limits)
        margin = np.nan_to_num(found.margins["goal"][-1], nan=-np.inf)
        return found.status is VerdictStatus.PROVED, float(margin)

    proved, margin = arrives(region, period)
    if proved:
        if step > tubes[0].horizon:
            ways = [arrives(tube.sets[0], step) for tube in tubes]
        else:
            ways = [within([tube.sets[-1] for tube in tubes], region)]
        proved, margin = all(way for way, _ in ways), min(margin, *(room for _, room in ways))
    return Recurrence(step, period, region, margin, proved)
