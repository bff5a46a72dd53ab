"""Long horizons that close, or begin again from a common set.

What is required after a step at which all states are in a set is required of the states from that
set (`halfway`), whatever the initial set was: one proof for all cells of it.

A set is looked for around where simulated trajectories are. That it is one, is proved: an inclusion
of closed sets, decided as goals are.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np
from jaxtyping import Float

from reachjax.loops import ClosedLoop
from reachjax.methods.witnesses import Simulations
from reachjax.numerics.budget import Budget, Interrupted
from reachjax.sets import AbstractSet
from reachjax.sets.unusable import ThinSetError
from reachjax.verdicts.findings import Findings
from reachjax.verdicts.grounds import Asked, Closing, Grounds
from reachjax.verdicts.halfway import Halfway, proof_of
from reachjax.verdicts.recurrent_sets import Candidate, periods, sets_around
from reachjax.verdicts.specification import Requirement
from reachjax.verdicts.verdict import Verdict

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
        halfway: the two questions.
        verdict: the proof of the second one.
    """

    halfway: Halfway
    verdict: Verdict


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
        UnsoundError: a trajectory breaks what is proved, or JAX runs a counterexample otherwise.
    """
    if loop.varies or horizon < LONG:
        return None
    asked = Asked(loop, X0, horizon, start, tuple(required))
    findings = Findings(loop, X0, horizon, start, required)
    findings.simulate(simulations.runs)
    if findings.ended:
        return None
    budget, attempts = budget.share(FOR_CLOSING), 0
    for candidate in _candidates(loop, simulations.runs.states, horizon):
        step, region = candidate.step, candidate.region
        rest = any(item.time > step for item in required)
        if budget.late or attempts == ATTEMPTS or not rest:
            return None
        try:
            share = budget.share(FOR_RETURN)
            found = _for_ever(asked, candidate, later, share)
            if found is None and begins_again:
                found = _later(Halfway(asked, step, region, 0), later, share)
            if found is None:
                continue
            attempts += 1
            begun = _decided(found.halfway.before, first, budget)
        except (ThinSetError, ValueError):  # a unit has no bounds from it, or it is no set
            continue
        except Interrupted:  # its cells are of another set, or for other requirements
            message = "interrupted: this exception's `found` is the verdict so far"
            raise Interrupted(message, findings.verdict()) from None
        if begun.proved:
            proof = found.halfway.joined(
                proof_of(found.halfway.before, begun.margins),
                proof_of(found.halfway.after, found.verdict.margins, found.verdict.recurrence),
            )
            for item in required:
                findings.prove(item, *proof.margins[item.name, item.time])
            parts = (each.grounds or Grounds() for each in (begun, found.verdict))
            more: dict[str, Any] = {"asked": asked._replace(loop=jax.device_put(loop))}
            more["grounds"] = Closing(step, region, found.halfway.period, *parts)
            more |= {"cells": begun.cells, "certificates": begun.certificates}
            more["recurrence"] = proof.recurrence
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


def _for_ever(asked: Asked, candidate: Candidate, later: Decides, budget: Budget) -> _Later | None:
    """The proof that a set is come back to, and what is required holds meanwhile; None of none."""
    for period in periods(asked.loop, candidate):
        try:
            halfway = Halfway(asked, candidate.step, candidate.region, period)
        except ValueError:  # too much of it varies in time
            continue
        found = _later(halfway, later, budget)
        if found is not None:
            return found
    return None


def _later(halfway: Halfway, later: Decides, budget: Budget) -> _Later | None:
    """The proof of what is required from a set on; None of none."""
    verdict = _decided(halfway.after, later, budget)
    return _Later(halfway, verdict) if verdict.proved else None


def _decided(asked: Asked, decides: Decides, budget: Budget) -> Verdict:
    """The verdict on a question."""
    return decides(asked.X0, asked.horizon, list(asked.required), budget)
