"""Two questions that answer one: what holds until a set is reached, and what holds from it on.

Let every state of step `m` be in a set `R`. What is required at `t > m` is then required of the
states from `R` after `t - m` steps. If they are in `R` again after `p` steps, they are of those
after `(t - m - 1) mod p + 1` steps: what holds at each of the first `p` steps, or throughout each
of the first `p` periods, holds at all of them. Both are of loops that do not vary in time.

Both questions follow from the one that they answer, from `m`, `R` and `p`: whoever proves them, or
proves them anew, asks what is asked here and nothing else.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from reachjax.numerics.checks import require_kind
from reachjax.sets import PolyhedralSet
from reachjax.verdicts.grounds import Asked, Key
from reachjax.verdicts.specification import Requirement, bits_of
from reachjax.verdicts.verdict import Recurrence

ARRIVES = "in the set at the end"
"""The name of the requirement that states are in the set, which no specification has."""


class Proof(NamedTuple):
    """What is proved of a question.

    Attributes:
        margins: the least of each requirement, and whether it surely holds.
        left_out: how many cells a progress bar left out.
        recurrence: a set that states come into and come back to, if what holds from it on rests on
            one.
    """

    margins: Mapping[Key, tuple[float, bool]]
    left_out: int = 0
    recurrence: Recurrence | None = None


class Halfway:
    """A question, and the two that answer it.

    Args:
        asked: the question.
        step: when all states shall be in the set.
        region: the set.
        period: after how many steps they shall be in it again; 0 where they need not be.

    Attributes:
        period: as given.
        before: what is required until that step, and that all states are in the set then.
        after: what is required from the set on: at each step of the period, at the last of which
            all states are in the set again, or until the horizon.

    Raises:
        TypeError: the set has no facets.
        ValueError: the loop varies in time, the set is not of its states, the step is not within
            the horizon, nothing is required later, or more of the period than of the horizon.
    """

    def __init__(self, asked: Asked, step: int, region: PolyhedralSet, period: int):
        require_kind("region", region, PolyhedralSet, "a Box or a Polytope")
        if asked.loop.varies:
            raise ValueError("a loop that varies in time does not begin again from a set")
        if region.dimension != asked.loop.states or region.steps is not None:
            raise ValueError("the set halfway must be one of the loop's states")
        if not 1 <= step < asked.horizon or period < 0:
            raise ValueError(f"step {step} and period {period} are not of {asked.horizon} steps")
        self._step, self._region, self.period = step, region, period
        until = [item for item in asked.required if item.time <= step]
        rest = [item for item in asked.required if item.time > step]
        self._names, kinds = _kinds(rest)
        if not rest or len(kinds) * period > max(len(rest), asked.horizon - step):
            raise ValueError("too little is required after the set halfway, or too much in between")
        until.append(Requirement(ARRIVES, step, region, True))
        self.before = asked._replace(horizon=step, required=_of_one_name_each(until))
        if period:
            later = [
                dataclasses.replace(item, name=name, time=time)
                for name, item in kinds.items()
                for time in range(1, period + 1)
            ]
            later.append(Requirement(ARRIVES, period, region, True))
        else:
            later = [
                dataclasses.replace(item, name=self._names[_key(item)], time=item.time - step)
                for item in rest
            ]
        horizon = period or asked.horizon - step
        given = {"X0": region, "horizon": horizon, "required": _of_one_name_each(later)}
        self.after = asked._replace(**given)
        self._required = asked.required

    def joined(self, before: Proof, after: Proof) -> Proof:
        """What the proofs of both questions prove of the one that they answer."""
        step, period = self._step, self.period
        arrivals = [before.margins[ARRIVES, step]]
        if period:
            arrivals.append(after.margins[ARRIVES, period])
        arrives = all(holds for _, holds in arrivals)
        margins = dict[Key, tuple[float, bool]]()
        for item in self._required:
            if item.time <= step:
                margins[_key(item)] = before.margins[_key(item)]
                continue
            name = self._names[_key(item)]
            times = range(1, period + 1) if period else [item.time - step]
            found = [after.margins[name, time] for time in times]
            holds = arrives and all(each for _, each in found)
            margins[_key(item)] = min(margin for margin, _ in found), holds
        least = min(margin for margin, _ in arrivals)
        recurrence = self._recurrence(after, least) if arrives else None
        return Proof(margins, before.left_out + after.left_out, recurrence)

    def _recurrence(self, after: Proof, margin: float) -> Recurrence | None:
        """What a statement for all time rests on; None where the horizon was gone to its end."""
        step, inner = self._step, after.recurrence
        if self.period:
            return Recurrence(step, self.period, self._region, margin, True)
        if inner is None:
            return None
        return dataclasses.replace(inner, step=step + inner.step, margin=min(margin, inner.margin))


def proof_of(
    asked: Asked,
    margins: Mapping[str, Float[np.ndarray, " h+1"]],
    recurrence: Recurrence | None = None,
) -> Proof:
    """What is proved by a verdict that proves all that is required, with these margins."""
    found = {_key(item): (float(margins[item.name][item.time]), True) for item in asked.required}
    return Proof(found, recurrence=recurrence)


def _key(item: Requirement) -> Key:
    return item.name, item.time


def _of_one_name_each(required: list[Requirement]) -> tuple[Requirement, ...]:
    """The requirements, of which no two have one name and time.

    Raises:
        ValueError: two have.
    """
    if len(set(map(_key, required))) < len(required):
        raise ValueError("the same is required twice")
    return tuple(required)


def _kinds(rest: list[Requirement]) -> tuple[dict[Key, str], dict[str, Requirement]]:
    """How requirements are called whenever they are meant, and the strictest one of each name.

    Of one kind are those of one name and one set, bit for bit; a requirement throughout a period is
    one at its end, too.
    """
    bits: dict[int, Any] = {}
    kinds: dict[Any, str] = {}
    names: dict[Key, str] = {}
    strictest: dict[str, Requirement] = {}
    for item in rest:
        if id(item.region) not in bits:
            bits[id(item.region)] = bits_of(item.region)
        kind = item.name, item.inside, bits[id(item.region)]
        name = kinds.setdefault(kind, f"{item.name}, {len(kinds)}")
        names[_key(item)] = name
        if name not in strictest or item.throughout:
            strictest[name] = item
    return names, strictest
