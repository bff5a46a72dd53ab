"""At which times sets are goals, or to be avoided."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from reachjax.numerics.checks import described
from reachjax.sets import Ellipsoid, PolyhedralSet

Region = PolyhedralSet | Ellipsoid

AvoidSets = Sequence[Region] | Mapping[int | range, Sequence[Region]]
"""Sets for all times, or by the times, or the spans of times, at which they are meant."""

Timed = Region | Mapping[int | range, Region]
"""A set, or sets by the times, or the spans of times, at which they are meant."""


def timed_goals(goal: Timed | None, horizon: int) -> list[tuple[int, Any]]:
    """The goals, with their times.

    Raises:
        TypeError: a time is no whole number.
        ValueError: a time is beyond the horizon, or named twice; or none is named.
    """
    if goal is None:
        return []
    if not isinstance(goal, Mapping):
        return [(horizon, goal)]
    found: dict[int, Any] = {}
    for t, region in _by_times("goal", goal, horizon):
        if t in found:
            raise ValueError(f"goal names time {t} twice: give the intersection of both sets")
        found[t] = region
    if not found:
        raise ValueError("goal must name a time, goal={t: G}, but none arrived")
    return sorted(found.items(), key=lambda one: one[0])


def timed_sets_to_avoid(
    avoid: AvoidSets | None, horizon: int
) -> list[tuple[int, list[tuple[int, Any]]]]:
    """The sets to be avoided at each time; what is named twice for a time is avoided all together.

    Returns:
        At each time the sets with their numbers, in the order in which they are given. A set that
        is given more than once has one number.

    Raises:
        TypeError: a time is no whole number, or there is no sequence of sets.
        ValueError: a time is beyond the horizon.
    """
    if avoid is None:
        return []
    given = avoid if isinstance(avoid, Mapping) else {range(horizon + 1): avoid}
    found: dict[int, list[tuple[int, Any]]] = {}
    numbers: dict[int, int] = {}
    for t, regions in _by_times("avoid", given, horizon):
        if not isinstance(regions, Sequence):
            raise TypeError(
                "avoid must be a sequence of sets, avoid=[A, ...], or a mapping from times to "
                f"them, avoid={{t: [A, ...]}}, but {described(regions)} arrived"
            )
        for region in regions:
            number = numbers.setdefault(id(region), len(numbers))
            found.setdefault(t, []).append((number, region))
    return sorted(found.items(), key=lambda one: one[0])


def _by_times(name: str, given: Mapping[Any, Any], horizon: int) -> Iterator[tuple[int, Any]]:
    """What is meant at each time, time by time of each span.

    Raises:
        TypeError: a time is no whole number.
        ValueError: a time is beyond the horizon, or there is none in a span.
    """
    for when, meant in given.items():
        if isinstance(when, range) and not when:
            raise ValueError(f"{name} names the span {when}, in which there is no time")
        for t in when if isinstance(when, range) else [when]:
            if isinstance(t, bool) or not isinstance(t, int | np.integer):
                raise TypeError(
                    f"{name} must name times or ranges of them, but {described(t)} arrived"
                )
            if not 0 <= t <= horizon:
                raise ValueError(f"{name} names time {t!r}, but the horizon is {horizon}")
            yield int(t), meant
