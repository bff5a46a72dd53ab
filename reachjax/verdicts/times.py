"""At which times sets are goals, or to be avoided."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from reachjax.numerics.checks import described
from reachjax.sets import Ellipsoid, PolyhedralSet

Region = PolyhedralSet | Ellipsoid

AvoidSets = Sequence[Region] | Mapping[int | range, Sequence[Region]]
"""Sets for all times, or by the times, or the spans of times, at which they are meant."""

Timed = Region | Mapping[int | range | float | tuple[float, float], Region]
"""A set, or sets by the times, or the spans of times, at which they are meant: by steps, or of a
differential equation by numbers of type `float` in its units of time, or pairs of such."""

SAME = 1e-9
"""Times are one if they differ by less than this part of a period: users write decimals."""


class TimedGoal(NamedTuple):
    """A goal at a time.

    Attributes:
        time: a number of steps.
        region: the set.
        throughout: whether it is meant at all times since the sample before.
    """

    time: int
    region: Any
    throughout: bool = False


def timed_goals(goal: Timed | None, horizon: int, period: float | None = None) -> list[TimedGoal]:
    """The goals, with their times.

    Args:
        goal: as users give it.
        horizon: the number of steps.
        period: of a plant in continuous time, where times may be given in its units.

    Raises:
        TypeError: a time is no whole number.
        ValueError: a time is beyond the horizon, no sample, or named twice; or none is named.
    """
    if goal is None:
        return []
    if not isinstance(goal, Mapping):
        return [TimedGoal(horizon, goal)]
    found: dict[int, TimedGoal] = {}
    samples = {when: each for when, each in goal.items() if not isinstance(when, float | tuple)}
    named = [TimedGoal(*each) for each in _by_times("goal", samples, horizon)]
    named += _in_units(goal, horizon, period)
    for each in named:
        if each.time in found:
            raise ValueError(
                f"goal names time {each.time} twice: give the intersection of both sets"
            )
        found[each.time] = each
    if not found:
        raise ValueError("goal must name a time, goal={t: G}, but none arrived")
    return sorted(found.values(), key=lambda one: one.time)


def _in_units(goal: Mapping[Any, Any], horizon: int, period: float | None) -> Iterator[TimedGoal]:
    """Goals at instants and over spans that are given in the plant's units of time.

    Raises:
        TypeError: the plant is one in discrete time, or a span is no pair of numbers.
        ValueError: a time is no sample, or beyond the horizon.
    """
    for when, region in goal.items():
        if not isinstance(when, float | tuple):
            continue
        if period is None:
            raise TypeError(
                f"goal names {when}, a time in a plant's units, but the plant is one in discrete "
                "time: name steps, or ranges of them"
            )
        given = when if isinstance(when, tuple) else (when, when)
        if len(given) != 2 or not all(isinstance(each, float | int) for each in given):
            raise TypeError(f"goal must name pairs of times, (begin, end), but {when} arrived")
        first, last = (round(each / period) for each in given)
        for k, each in ((first, given[0]), (last, given[1])):
            if not 0 <= k <= horizon:
                raise ValueError(f"goal names {each}, but the horizon is {horizon * period:g}")
            if abs(k * period - each) > SAME * period:
                raise ValueError(
                    f"goal names {each}, which is no sample: samples are {period:g} apart"
                )
        if last < first:
            raise ValueError(f"goal names {when}, a span that ends before it begins")
        yield TimedGoal(first, region)
        yield from (TimedGoal(k, region, True) for k in range(first + 1, last + 1))


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
