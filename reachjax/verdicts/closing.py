"""Long horizons that close, or begin again from a common set.

Let all states of step `k` be in a set `S`. What is required later is then required of the states
from `S` after `t - k` steps, whatever the initial set was: one proof for all cells of it. If every
state of `S` is in it again after `m` steps, the states of step `t > k` are among those from `S`
after `(t - k - 1) mod m + 1` steps; so what holds from `S` at all steps up to the `m`-th one, and
in between, holds for ever. Both are of loops that do not vary in time.

A set is looked for around where simulated trajectories are. That it is one, is proved: an inclusion
of closed sets, decided as goals are.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from jaxtyping import Float

from reachjax.loops import ClosedLoop
from reachjax.methods.witnesses import Simulations
from reachjax.numerics.budget import Budget, Interrupted
from reachjax.sets import AbstractSet, PolyhedralSet
from reachjax.sets.unusable import ThinSetError
from reachjax.verdicts.findings import Findings
from reachjax.verdicts.recurrent_sets import Candidate, periods, sets_around
from reachjax.verdicts.specification import Requirement
from reachjax.verdicts.verdict import Recurrence, Verdict

LONG = 100
"""Shorter horizons are done step by step: what comes back does so after tens of steps."""

EARLIEST, LATEST, LATER = 25, 0.6, math.sqrt(2)
"""From this step on until this part of the horizon, and after so many times as many each time, a
set that holds later states is tried."""

WIDER, PUSHED = (1.5,), (1.5, 6.0)
"""By how much it is larger than what is simulated: bounds of its states are. Of a loop with
disturbances these are several times as large, as none that is drawn is in tune with it."""

ATTEMPTS = 2
"""With so many sets the way of the initial set into them is tried: it is most of the work."""

FOR_CLOSING = 0.6
"""The part of the time in which that is tried; the rest is for the whole horizon."""

FOR_RETURN = 0.3
"""The part of this time in which sets are proved to be come back to."""

ARRIVES = "in the set at the end"
"""The name of the requirement that states are in a set, in short problems."""


class Decides(Protocol):
    """Whatever decides requirements."""

    def __call__(
        self, X: AbstractSet, steps: int, required: list[Requirement], budget: Budget, /
    ) -> Verdict:
        """The verdict on states from a set, over so many steps."""
        ...


class _Later(NamedTuple):
    """What is proved of the states from a set.

    Attributes:
        margins: certified ones of the requirements, by names and times since the set.
        names: how the requirements of the loop are called there.
        period: after how many steps all states are in it again; 0 if that is not known.
        verdict: the proof.
    """

    margins: dict[str, Float[np.ndarray, " m+1"]]
    names: dict[tuple[str, int, bool], str]
    period: int
    verdict: Verdict

    def margin(self, item: Requirement, step: int) -> float:
        """The margin of a requirement, of states that are in the set at a step."""
        row = self.margins[self.names[_kind(item)]]
        return float(np.nanmin(row) if self.period else row[item.time - step])


def _kind(item: Requirement) -> tuple[str, int, bool]:
    """What a requirement is, whenever it is meant."""
    return item.name, id(item.region), item.inside


def closed(
    loop: ClosedLoop,
    X0: AbstractSet,
    horizon: int,
    start: int,
    required: Sequence[Requirement],
    simulations: Simulations,
    first: Decides,
    later: Decides,
    begins_again: bool,
    budget: Budget,
) -> Verdict | None:
    """The verdict by a set that all states come into; None if it is not proved so.

    Args:
        loop: the closed loop.
        X0: the initial set.
        horizon: the number of steps.
        start: the time of the initial set.
        required: the requirements.
        simulations: trajectories from the initial set.
        first: decides what is required until states are in the set.
        later: decides what is required from the set on.
        begins_again: whether a set that is not proved to be come back to is worth a proof.
        budget: of the call.

    Raises:
        Interrupted: Ctrl-C.
        UnsoundError: a trajectory breaks what is proved.
    """
    if loop.varies or horizon < LONG:
        return None
    findings = Findings(loop, X0, horizon, start, required)
    findings.simulate(simulations.runs)
    if findings.ended:
        return None
    budget, attempts = budget.share(FOR_CLOSING), 0
    for candidate in _candidates(loop, simulations.runs.states, horizon):
        step, region = candidate.step, candidate.region
        rest = [item for item in required if item.time > step]
        if budget.late or attempts == ATTEMPTS or not rest:
            return None
        try:
            share = budget.share(FOR_RETURN)
            found = _for_ever(loop, candidate, horizon, rest, later, share)
            if found is None and begins_again:
                found = _begun_again(region, step, horizon, rest, later, share)
            if found is None:
                continue
            attempts += 1
            arrives = Requirement(ARRIVES, step, region, True)
            before = [*(item for item in required if item.time <= step), arrives]
            begun = first(X0, step, before, budget)
        except (ThinSetError, ValueError):  # a unit has no bounds from it, or it is no set
            continue
        except Interrupted as error:
            cells = getattr(error.found, "cells", ())
            raise Interrupted(str(error), findings.verdict(cells=cells)) from None
        if begun.proved:
            for item in required:
                early = item.time <= step
                margin = begun.margins[item.name][item.time] if early else found.margin(item, step)
                findings.prove(item, margin, True)
            more = {"cells": begun.cells, "certificates": begun.certificates}
            more["recurrence"] = _recurrence(candidate, found, begun)
            ends = Counter(begun.ends) + Counter(found.verdict.ends)
            return findings.verdict(dict(ends), **more)
    return None


def _candidates(
    loop: ClosedLoop, states: Float[np.ndarray, "c T n"], horizon: int
) -> Iterator[Candidate]:
    """Sets that hold what is simulated from a step on."""
    states = states[np.isfinite(states).all(axis=(1, 2))]
    step = EARLIEST
    while len(states) and step <= LATEST * horizon:
        for wider in PUSHED if loop.is_disturbed else WIDER:
            # of a polytope forms know the box around it alone
            yield from reversed([*sets_around(loop, states, step, wider)])
        step = round(LATER * step)


def _for_ever(
    loop: ClosedLoop,
    candidate: Candidate,
    horizon: int,
    rest: Sequence[Requirement],
    later: Decides,
    budget: Budget,
) -> _Later | None:
    """The proof that a set is come back to, and what is required holds meanwhile; None of none."""
    kinds: dict[tuple[str, int, bool], Requirement] = {}
    for item in rest:
        if _kind(item) not in kinds or item.throughout:
            kinds[_kind(item)] = item
    names = {kind: f"{kind[0]}, {number}" for number, kind in enumerate(kinds)}
    for period in periods(loop, candidate):
        if len(kinds) * period > max(len(rest), horizon - candidate.step):
            continue  # too much of it varies in time
        items = [
            dataclasses.replace(item, name=names[kind], time=step)
            for kind, item in kinds.items()
            for step in range(1, period + 1)
        ]
        items.append(Requirement(ARRIVES, period, candidate.region, True))
        verdict = later(candidate.region, period, items, budget)
        if verdict.proved:
            return _Later(verdict.margins, names, period, verdict)
    return None


def _begun_again(
    region: PolyhedralSet,
    step: int,
    horizon: int,
    rest: Sequence[Requirement],
    later: Decides,
    budget: Budget,
) -> _Later | None:
    """The proof of what is required from a set on until the horizon; None of none."""
    names = {_kind(item): f"{item.name}, {item.inside}" for item in rest}
    items = [
        dataclasses.replace(item, name=names[_kind(item)], time=item.time - step) for item in rest
    ]
    verdict = later(region, horizon - step, items, budget)
    return _Later(verdict.margins, names, 0, verdict) if verdict.proved else None


def _recurrence(candidate: Candidate, found: _Later, begun: Verdict) -> Recurrence | None:
    """What a statement for all time rests on; None where the horizon was gone to its end."""
    step, arrival = candidate.step, begun.margins[ARRIVES][-1]
    if found.period:
        margin = float(min(arrival, found.margins[ARRIVES][-1]))
        return Recurrence(step, found.period, candidate.region, margin, True)
    inner = found.verdict.recurrence
    if inner is None:
        return None
    return dataclasses.replace(inner, step=step + inner.step, margin=min(arrival, inner.margin))
