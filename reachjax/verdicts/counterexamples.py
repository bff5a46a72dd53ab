"""Counterexamples: trajectories that surely break a requirement, rounding accounted for."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from reachjax.loops import ClosedLoop
from reachjax.loops.batches import PARTS
from reachjax.loops.closed_loop import Scenario
from reachjax.loops.scenarios import Runs, Scenarios
from reachjax.loops.units import UnboundedError
from reachjax.numerics.host import in_numpy
from reachjax.numerics.rounding import TINY, gamma
from reachjax.programs.bounds import successor_box
from reachjax.programs.unrolled import boxes_from_point
from reachjax.sets import AbstractSet, Box, Ellipsoid
from reachjax.sets.balance import balanced
from reachjax.sets.unusable import ThinSetError
from reachjax.verdicts.specification import Requirement
from reachjax.verdicts.verdict import Counterexample

SUSPECTS = 5
"""So many of the worst trajectories of each requirement are examined with their rounding."""

AMONG = 32
"""So many are looked at where loops jump: where numbers that are compared are equal, as at the
corners of a set of choices, rounding decides, and others are examined before."""

CLEAR = 0.1
"""A violation is clear if it is at least this part of the largest one of its requirement."""

TOLERATED = 16
"""A simulated state may be beside the enclosure of its step by so many widths of that: rounding of
compiled code is within it, but for what libraries of functions leave out."""

THIN = 1e-9
"""An enclosure is thin if no coordinate is wider than this, or than this part of its size."""

INWARDS, AROUND = 1e-9, 64
"""By this part of its way to the mean of so many samples a scenario is moved that rounding may have
left outside of a round set or of a polytope."""


class Suspect(NamedTuple):
    """A simulated trajectory that seems to break a requirement.

    Attributes:
        room: how far it is on the right side: not at all.
        item: the requirement.
        scenario: `(s,)`, what it is a function of.
        states: `(h + 1, n_x)`.
    """

    room: float
    item: Requirement
    scenario: np.ndarray
    states: np.ndarray


def suspects(loop: ClosedLoop, item: Requirement, rooms: np.ndarray, runs: Runs) -> list[Suspect]:
    """The worst of some runs, of which these are the rooms `(c,)`: more where the loop jumps."""
    worst = np.argsort(rooms, kind="stable")[: AMONG if loop.jumps else SUSPECTS]
    return [Suspect(float(rooms[k]), item, *runs.some(k)) for k in worst if rooms[k] <= 0]


def counterexample(
    loop: ClosedLoop, X0: AbstractSet, found: Iterable[Suspect], start: int
) -> Counterexample | None:
    """A suspect whose scenario surely is one and breaks its requirement; None if there is none.

    The earliest of those that are clear, then the worst of the others: of an early one few periods
    are enclosed.
    """
    ordered = _clear_ones_first([*found])
    if not ordered:
        return None
    scenarios = Scenarios.of(loop, X0, len(ordered[0].states) - 1, start)
    on_host = in_numpy(loop)
    for room, item, scenario, states in _those_that_are_known_first(on_host, ordered, start):
        if not scenarios.surely_contains(scenario):
            scenario = _moved_inwards(scenarios, scenario)
            if not scenarios.surely_contains(scenario):
                continue
            states = scenarios.runs(on_host, scenario[None], len(states) - 1, start)[0]
        drawn = loop.split(scenario)
        try:
            reached = enclosures(on_host, drawn, item.time, start)
        except UnboundedError:  # it escapes, and breaks what is required before
            continue
        found_at = broken_at(on_host, item, drawn, start, reached)
        if found_at is not None:
            part, last = found_at
            boxes = [*reached[:-1], last]
            lower, upper = (
                np.stack([np.asarray(getattr(box, end)) for box in boxes])
                for end in ("lower", "upper")
            )
            _, w, v = drawn
            noises = [None] * (len(states) - 1) if v is None else v
            inputs = [
                on_host.input(x, start + t, v=noise)
                for t, (x, noise) in enumerate(zip(states[:-1], noises, strict=True))
            ]
            parts = item.name, item.time, -room, states, np.stack(inputs)
            plant: Any = on_host.plant
            instant = (item.time - 1 + part) * float(plant.period) if plant.continuous else None
            enclosed = {"lower": lower, "upper": upper, "region": item.ball or item.region}
            closest = closest_decision(on_host, states[: item.time + 1], drawn, start)
            more = {"disturbances": w, "noises": v, "instant": instant, "decision": closest}
            return Counterexample(*parts, **more, **enclosed)
    return None


def _clear_ones_first(found: list[Suspect]) -> list[Suspect]:
    """Suspects nearly as far beside a requirement as its worst, the earliest first; then others."""
    worst = dict[str, float]()
    for room, item, *_ in found:
        worst[item.name] = min(room, worst.get(item.name, 0.0))

    def order(suspect: Suspect) -> tuple[bool, int, float]:
        unclear = suspect.room > CLEAR * worst[suspect.item.name]
        return unclear, 0 if unclear else suspect.item.time, suspect.room

    return sorted(found, key=order)


def _moved_inwards(
    scenarios: Scenarios, scenario: Float[np.ndarray, " s"]
) -> Float[np.ndarray, " s"]:
    """A scenario beside one at the surface of its sets, on the way to the middle of these.

    A set that is too thin to be sampled has no middle that is known: the scenario stays.
    """
    try:
        states = scenarios.X0.drawn(AROUND, 0)
    except ThinSetError:
        return scenario
    middle = scenarios.middle(states.mean(axis=0))
    return middle + (1 - INWARDS) * (scenario - middle)


def _those_that_are_known_first(
    loop: ClosedLoop, ordered: list[Suspect], start: int
) -> Iterator[Suspect]:
    """Suspects on whose trajectories no numbers that are compared are equal, then the others.

    Of each of the two `SUSPECTS` of a requirement at most.
    """
    later, counts = list[Suspect](), Counter[tuple[bool, str, int]]()
    for suspect in ordered:
        _, item, scenario, states = suspect
        if counts[False, item.name, item.time] == SUSPECTS:
            continue
        closest = closest_decision(loop, states[: item.time + 1], loop.split(scenario), start)
        tied = closest is not None and not closest > 0
        counts[tied, item.name, item.time] += 1
        if not tied:
            yield suspect
        elif counts[True, item.name, item.time] <= SUSPECTS:
            later.append(suspect)
    yield from later


def closest_decision(
    loop: ClosedLoop, states: Float[np.ndarray, "t n_x"], scenario: Scenario, start: int
) -> float | None:
    """How far from zero what is compared on a trajectory is at least; None if nothing jumps."""
    (_, w, v), found = scenario, list[float]()

    def apply(unit: Any, *y: Any) -> Any:
        if unit.jumps:
            found.append(unit.distance(*y))
        return unit(*y)

    if loop.jumps:
        for t, x in enumerate(states[:-1]):
            push, noise = (None if part is None else part[t] for part in (w, v))
            loop.step(x, start + t, apply, push, noise)
    return min(found, default=None)


def broken_at(
    loop: ClosedLoop, item: Requirement, scenario: Scenario, start: int, reached: list[Box]
) -> tuple[float, Box] | None:
    """Where the exact trajectory of a scenario surely breaks a requirement, rounding accounted for.

    Args:
        loop: of numpy arrays.
        item: the requirement.
        scenario: of the trajectory.
        start: the time of its initial state.
        reached: boxes around its states, up to the time of the requirement.

    Returns:
        The part of the period before, 1 at the sample, and a box around the state there; None where
        that is not known.
    """
    if most_room(item, reached[-1]) < 0:
        return 1.0, reached[-1]
    if not item.throughout:
        return None
    plant: Any = loop.plant
    t, before = item.time - 1, reached[-2]
    drawn = [None if each is None else each[t] for each in scenario[1:]]
    for part in PARTS:
        shorter = in_numpy(loop.replace(plant=plant.shortened(part)))
        there = successor_box(shorter, before, start + t, *drawn)
        if most_room(item, there) < 0:
            return part, there
    return None


def enclosures(loop: ClosedLoop, scenario: Scenario, steps: int, start: int) -> list[Box]:
    """Boxes around the states of the exact trajectory of a scenario, rounding accounted for.

    By forms over all steps; from where these have no bounds on, from box to box. A flow that leaves
    forms leaves boxes as well, which takes long to see.

    Raises:
        UnboundedError: neither has, as a unit leaves its domain or a solution escapes.
    """
    loop, (x0, w, v) = in_numpy(loop), scenario
    found = [Box(x0, x0)]
    try:
        for box in boxes_from_point(loop, scenario, steps, start):
            if not _is_finite(box):
                break
            found.append(box)
    except UnboundedError:
        if loop.plant.continuous:
            raise
    for t in range(len(found) - 1, steps):
        drawn = (None if part is None else part[t] for part in (w, v))
        found.append(successor_box(loop, found[-1], start + t, *drawn))
    return found


def _is_finite(box: Box) -> bool:
    """Whether a box has ends that are numbers."""
    return bool(np.isfinite(box.lower).all() and np.isfinite(box.upper).all())


class Departure(NamedTuple):
    """A step that is run otherwise than it is enclosed, by more than rounding.

    Attributes:
        step: how many there are before.
        coordinate: of the state after it.
        run: its value, as the loop is run.
        enclosed: the closest value that the enclosure of this step has.
    """

    step: int
    coordinate: int
    run: float
    enclosed: float


def departures(
    loop: ClosedLoop,
    scenario: Scenario,
    following: Float[np.ndarray, "h n_x"],
    start: int,
    known: Sequence[Box] | None = None,
) -> Iterator[Departure]:
    """The steps whose results are beside the enclosures of their recording by more than rounding.

    Each is enclosed from its own state, so that nothing adds up. Where numbers that are compared
    are equal but for rounding, each winner is right. What is integrated is beside the flow by more
    than rounding: by about as much as it is beside what twice as many steps say. Steps from which
    nothing is known to follow, or after which there are no numbers, say nothing.

    Args:
        loop: the closed loop.
        scenario: the states `(h, n_x)` from which steps are made, disturbances and noise.
        following: the state after each.
        start: the time of the first one.
        known: for each step a box that holds what follows the state; what is in it needs no other
            enclosure, which takes longer. None for none.
    """
    loop, (states, w, v) = in_numpy(loop), scenario
    plant: Any = loop.plant
    finer = in_numpy(loop.replace(plant=plant.finer)) if plant.continuous else None
    for t, (x, run) in enumerate(zip(states, following, strict=True)):
        drawn = [None if part is None else part[t] for part in (w, v)]
        beside = np.zeros(0)
        if finer is not None:
            with np.errstate(all="ignore"):
                one, other = (
                    each.step(x, start + t, w=drawn[0], v=drawn[1]) for each in (loop, finer)
                )
                beside = TOLERATED * np.nan_to_num(abs(other - one), nan=np.inf)
        if known is not None and _is_thin(known[t]) and not _excess(known[t], run, beside).any():
            continue
        try:
            reached = successor_box(loop, Box(x, x), start + t, *drawn, doubt=TOLERATED)
        except UnboundedError:
            continue
        found = np.flatnonzero(_excess(reached, run, beside))
        if len(found):
            i = int(found[0])
            closest = np.clip(run, np.asarray(reached.lower), np.asarray(reached.upper))
            yield Departure(t, i, float(run[i]), float(closest[i]))


def _is_thin(box: Box) -> bool:
    """Whether what is in a box is known but for rounding."""
    lower, upper = np.asarray(box.lower), np.asarray(box.upper)
    with np.errstate(all="ignore"):
        return bool(np.all(upper - lower <= THIN * (1 + abs(lower))))


def _excess(
    box: Box, run: Float[np.ndarray, " n_x"], beside: Float[np.ndarray, " k"]
) -> Bool[np.ndarray, " n_x"]:
    """Which numbers are out of a box by more than rounding, and than integration leaves out."""
    lower, upper = np.asarray(box.lower), np.asarray(box.upper)
    with np.errstate(all="ignore"):
        slack = TOLERATED * (upper - lower + np.spacing(abs(run)) + TINY)
        if len(beside):
            slack = slack + beside
        return (np.maximum(lower - run, run - upper) > slack) & np.isfinite(run)


def deviates(
    loop: ClosedLoop, scenario: Scenario, states: Float[np.ndarray, "t n_x"], start: int
) -> bool:
    """Whether a simulated trajectory tells that what is bounded is another loop.

    A step is beside its enclosure by more than rounding; or intervals and affine forms enclose one
    step by boxes that are apart by more than that.
    """
    _, *drawn = scenario
    if any(departures(loop, Scenario(states[:-1], *drawn), states[1:], start)):
        return True
    return any(
        _enclosures_disagree(
            loop, Scenario(x, *(None if part is None else part[[t]] for part in drawn)), start + t
        )
        for t, x in enumerate(states[:-1])
    )


def _enclosures_disagree(loop: ClosedLoop, scenario: Scenario, t: int) -> bool:
    """Whether intervals and affine forms enclose one step by boxes apart by more than rounding."""
    x, *drawn = scenario
    now = (None if part is None else part[0] for part in drawn)
    try:
        one = successor_box(loop, Box(x, x), t, *now, doubt=TOLERATED)
        (other,) = boxes_from_point(loop, scenario, 1, t)
    except UnboundedError:
        return False
    nearest = np.clip(one.lower, other.lower, other.upper)
    return bool(_excess(one, np.asarray(nearest), np.zeros(0)).any())


def most_room(item: Requirement, reached: Box) -> float:
    """How far a state of a box may be on the right side of a requirement, at most.

    Negative where every state of it surely breaks the requirement. Of an ellipsoid only the sign is
    known: infinite, or the least negative number.
    """
    lower, upper = np.asarray(reached.lower), np.asarray(reached.upper)
    if item.ball is not None:
        broken = _surely_beyond if item.inside else _surely_within
        return -TINY if broken(item.ball, reached) else np.inf
    C, d = balanced(*(np.asarray(part) for part in item.region.facets), inner=not item.inside)
    ends = np.where(C > 0, lower, upper), np.where(C > 0, upper, lower)
    with np.errstate(over="ignore", invalid="ignore"):
        least, most = (np.sum(C * end, axis=1) for end in ends)
        size = np.sum(abs(C) * np.maximum(abs(lower), abs(upper)), axis=1)
        underflow = TINY * ((C != 0) @ ((lower != 0) | (upper != 0)))
        error = gamma(len(lower)) * size + underflow
        lengths = np.linalg.norm(C, axis=1)
        if item.inside:  # the comparison decides, whatever becomes of the quotient
            broken = bool(np.any(least - error > d))
            room = float(np.min((d - (least - error)) / lengths))
        else:
            broken = bool(np.all(most + error <= d))
            room = float(np.max((most + error - d) / lengths))
    if broken:
        return min(room, -TINY)
    return np.inf if np.isnan(room) else max(room, 0.0)


def _surely_within(ball: Ellipsoid, box: Box) -> bool:
    """Whether a box lies in an ellipsoid, in exact arithmetic: its corners do."""
    corners = np.asarray(box.corners())  # none of a box that has too many
    return len(corners) > 0 and all(map(ball.surely_contains, corners))


def _surely_beyond(ball: Ellipsoid, box: Box) -> bool:
    """Whether a box and an ellipsoid surely have no point in common: a tangent is between them."""
    normal = np.asarray(ball.normal_towards(box))
    least = np.where(normal > 0, np.asarray(box.lower), np.asarray(box.upper))
    size = np.sum(abs(normal * least)) + TINY * len(normal)
    with np.errstate(over="ignore", invalid="ignore"):
        near = np.sum(normal * least) - gamma(len(normal)) * size - TINY * len(normal)
    return bool(near > float(ball.support(normal[None])[0]))
