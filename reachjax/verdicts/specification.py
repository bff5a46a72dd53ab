"""Reach-avoid requirements and how far a tube is from breaking them.

The paper's equations (reach_avoid): every state is in the goal at the horizon, and outside the
avoided sets, or inside a safe set, all along. A margin is a distance in the units of the state,
certified by the tube's sets; it can be differentiated as the sets can.

Goals and sets to avoid may be those of some times only.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.loops import ClosedLoop
from reachjax.methods.problem import Span, at
from reachjax.numerics.checks import (
    described,
    floats_of,
    is_concrete,
    real_number,
    require_double_precision,
    require_kind,
)
from reachjax.numerics.deprecations import once_positional
from reachjax.numerics.flags import lenient
from reachjax.sets import AbstractSet, Ellipsoid, PolyhedralSet
from reachjax.sets.ball_polytopes import inner_polytope, outer_polytope
from reachjax.sets.linear_programs import is_empty
from reachjax.tubes.reach import ReachTube
from reachjax.tubes.sketches import Sketch

Region = PolyhedralSet | Ellipsoid

AvoidSets = Sequence[Region] | Mapping[int | range, Sequence[Region]]
"""Sets for all times, or by the times, or the spans of times, at which they are meant."""

Timed = Region | Mapping[int | range | float | tuple[float, float], Region]
"""A set, or sets by the times, or the spans of times, at which they are meant: by steps, or of a
differential equation by numbers of type `float` in its units of time, or pairs of such."""

NAMES_INSIDE, NAMES_OUTSIDE = r"goal|safe", r"avoid\[(0|[1-9]\d*)\]"
"""The names that `requirements` gives; any other one may be that of a step of a proof."""

SAME = 1e-13
"""Times are one if they differ by less than this part of themselves: users write decimals, and sums
of them."""


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
        ValueError: a time is no sample, or beyond the horizon, or the period is traced.
    """
    for when, region in goal.items():
        if not isinstance(when, float | tuple):
            continue
        if period is None:
            raise TypeError(
                f"goal names {when}, a time in a plant's units, but the plant is one in discrete "
                "time: name steps, or ranges of them"
            )
        if math.isnan(period):
            raise ValueError(
                f"goal names {when}, a time in the plant's units, but its period is traced, so "
                "that nobody can say which sample that is: make the plant outside of the function "
                "that is compiled and close over it, or name a step, goal={2: G}"
            )
        given = when if isinstance(when, tuple) else (when, when)
        if len(given) != 2 or not all(isinstance(each, float | int) for each in given):
            raise TypeError(f"goal must name pairs of times, (begin, end), but {when} arrived")
        first, last = (round(each / period) for each in given)
        for k, each in ((first, given[0]), (last, given[1])):
            if not 0 <= k <= horizon:
                raise ValueError(f"goal names {each}, but the horizon is {horizon * period:g}")
            if abs(k * period - each) > SAME * abs(each):
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


class Compared(NamedTuple):
    """What every state surely does not exceed, and what it should not.

    Attributes:
        attained: `(k,)`, upper bounds of the states' values.
        limits: `(k,)`, what they are compared with.
        units: `(k,)`, what a distance of 1 in the units of the state changes the values by.
    """

    attained: Float[Array, " k"]
    limits: Float[Array, " k"]
    units: Float[Array, " k"]

    @property
    def margins(self) -> Float[Array, " k"]:
        """How far every state surely is on the right side, in the units of the state.

        To be shown and differentiated: of a margin at rounding level, the sign proves nothing.
        """
        return (self.limits - self.attained) / self.units

    @property
    def least_margin(self) -> float:
        """The least of the margins, whose numbers must be known: its sign proves nothing."""
        numbers: Any = map(np.asarray, self)
        with np.errstate(all="ignore"):
            return float(Compared(*numbers).margins.min())


PARTS = 8
"""Into so many parts the steps of a flow are cut where sets are to be avoided: where states pass a
corner, another facet is between them and the set in each part."""


def parts_of_periods(required: Iterable[Requirement]) -> int:
    """Into how many parts steps of a flow are cut; 0 where nothing is meant in between samples."""
    whole = [item for item in required if item.throughout]
    return PARTS if any(not item.inside for item in whole) else min(len(whole), 1)


@dataclasses.dataclass(frozen=True)
class Requirement:
    """A set to be inside of, or to stay out of, at one time.

    Attributes:
        name: `goal`, `safe` or `avoid[i]`.
        time: when.
        region: the set; of an ellipsoid, a polytope within it where states must be inside, and one
            around it where they must not.
        inside: whether states must be in it, or out of it.
        ball: the ellipsoid; None of other sets.
        throughout: whether it is meant at all times since the sample before.
        units: the facets of the set in units, once they were asked for; of all times together.
    """

    name: str
    time: int
    region: PolyhedralSet
    inside: bool
    ball: Ellipsoid | None = None
    throughout: bool = False
    units: list[Any] = dataclasses.field(default_factory=list, compare=False, repr=False)

    @property
    def span(self) -> Span:
        """The times at which it is meant: one sample, or those since the sample before."""
        return Span(self.time - 1, self.time) if self.throughout else at(self.time)

    @property
    def looser(self) -> PolyhedralSet:
        """A set whose requirement is broken only where this one is."""
        if self.ball is None:
            return self.region
        return (outer_polytope if self.inside else inner_polytope)(self.ball, self.name)

    def compared(self, tube: ReachTube) -> Compared:
        """What every state surely does not exceed, and should not: of each facet, or of the set."""
        return self.compared_with(self.holding(tube))

    def holding(self, tube: ReachTube) -> AbstractSet:
        """The set of a tube that holds all states which the requirement is about."""
        return tube.spans[self.time - 1] if self.throughout else tube.sets[self.time]

    def compared_with(self, reached: AbstractSet, by_offsets: bool = False) -> Compared:
        """What states of a set surely do not exceed, and should not: of each facet, or of the set.

        Args:
            reached: a set that holds every state at this time.
            by_offsets: whether its facets' offsets will do where its support takes programs.
        """
        if self.inside:
            C, d, norms = self.region.facets_in_units(inner=True)
            return Compared((reached.bounds_along if by_offsets else reached.support)(C), d, norms)
        return Compared(-reached.separation(self.region)[None], jnp.zeros(1), jnp.ones(1))

    def margins_in(self, reached: AbstractSet) -> Float[Array, " k"]:
        """The margins in a set that holds every state at this time, by its facets' offsets."""
        return self.compared_with(reached, by_offsets=True).margins

    def simulated(self, trajectories: np.ndarray) -> np.ndarray:
        """How far each trajectory `(c,)` is on the right side; negative on the wrong one."""
        if self.ball is not None:
            depth = _depths(self.ball, trajectories[:, self.time])
            return depth if self.inside else -depth
        C, d, norms = self._in_units()
        with np.errstate(over="ignore", invalid="ignore"):
            room = (d - trajectories[:, self.time] @ C.T) / norms
        depth = room.min(axis=1)
        return depth if self.inside else -depth

    def _in_units(self) -> list[np.ndarray]:
        """The facets of the set, as trajectories are compared with them."""
        if not self.units or self.units[0] is not self.region:
            self.units[:] = self.region, *map(np.asarray, self.region.facets_in_units())
        return self.units[1:]

    def proved(self, compared: Compared) -> bool:
        """Whether every state surely is on the right side. Sets are closed: touching is inside.

        Only comparisons are made, which no rounding can turn; what is no number, or too large for
        one, proves nothing.
        """
        attained, limits = np.asarray(compared.attained), np.asarray(compared.limits)
        known = np.isfinite(attained) & np.isfinite(limits)
        right = attained <= limits if self.inside else attained < limits
        return bool(np.all(known & right))


def of_tube(tube: ReachTube, **required: Any) -> list[Requirement]:
    """A specification's requirements for a tube, one for each set and time.

    Raises:
        TypeError: there is no tube, or a set is of a kind without facets.
        ValueError: nothing is required, dimensions disagree, a time is beyond the horizon, or a
            part of the tube was exchanged for another one.
    """
    require_kind("tube", tube, ReachTube, "a ReachTube, as reach(...) returns it")
    tube.require_sealed()
    return requirements(tube.loop.states, tube.horizon, period_of(tube.loop), **required)


def period_of(loop: ClosedLoop) -> float | None:
    """The period of a plant in continuous time, NaN where it is not known; None in discrete time.

    A period of which a derivative is taken is known.
    """
    plant: Any = loop.plant
    if not plant.continuous:
        return None
    period = plant.period
    if not is_concrete(period):  # within compiled code a held number that is known is traced
        period = jax.lax.stop_gradient(period)
    return float(period) if is_concrete(period) else math.nan


def requirements(
    states: int,
    horizon: int,
    period: float | None = None,
    *,
    goal: Timed | None = None,
    safe: Region | None = None,
    avoid: AvoidSets | None = None,
) -> list[Requirement]:
    """A specification's requirements, one for each set and time.

    Args:
        states: of the loop.
        horizon: the number of steps.
        period: of a plant in continuous time: then the last two are meant at all times, in
            between samples too, at a sample since the one before.
        goal: where states must be, at samples or over spans.
        safe: where they must be all along.
        avoid: where they must not be.

    Raises:
        TypeError: a set is no Box, Polytope or Ellipsoid, or a time no whole number.
        ValueError: nothing is required, a set is empty, dimensions disagree, or a time is beyond
            the horizon.
    """
    everywhere = range(horizon + 1)
    goals = timed_goals(goal, horizon, period)
    found = [Requirement("goal", t, G, True, throughout=whole) for t, G, whole in goals]
    found += [Requirement("safe", t, safe, True) for t in everywhere if safe is not None]  # type: ignore[arg-type]
    for t, regions in timed_sets_to_avoid(avoid, horizon):
        found += [Requirement(f"avoid[{i}]", t, A, False) for i, A in regions]  # type: ignore[arg-type]
    if not found:
        raise ValueError("nothing to verify: give a goal, avoid sets or a safe set")
    return _each_checked(
        [
            dataclasses.replace(
                item,
                throughout=item.throughout or _is_throughout(item, period is not None),
            )
            for item in found
        ],
        states,
    )


def _is_throughout(item: Requirement, continuous: bool) -> bool:
    """Whether a requirement that is no goal is meant in between samples too."""
    return continuous and item.name != "goal" and item.time > 0


def asked_again(
    said: Sequence[Requirement], states: int, horizon: int, period: float | None
) -> tuple[Requirement, ...]:
    """Requirements that somebody wrote into a file, made again from the sets that they are about.

    Args:
        said: the requirements.
        states: of the loop.
        horizon: the number of steps.
        period: of a plant in continuous time; None of others.

    Raises:
        TypeError: a set is no Box, Polytope or Ellipsoid.
        ValueError: there is none, one is there twice, or a name, a time or a set cannot be.
    """
    keys = [(item.name, item.time) for item in said]
    if not keys or len(set(keys)) < len(keys):
        raise ValueError("nothing is required, or the same twice")
    times = {item.time for item in said if item.name == "safe"}
    if times and times != set(range(horizon + 1)):
        raise ValueError("a safe set must be required at all times")
    meant: dict[str, Any] = {}
    for item in said:
        own = bits_of(item.ball or item.region)
        if item.name != "goal" and own != meant.setdefault(item.name, own):
            raise ValueError(f"{item.name} must be one set, the same at all times")
        names = NAMES_INSIDE if item.inside else NAMES_OUTSIDE
        if re.fullmatch(names, item.name, re.ASCII) is None:
            raise ValueError(f"{item.name!r} is no part of a specification")
        if not 0 <= item.time <= horizon:
            raise ValueError(f"{item.name} is required at t = {item.time}, beyond the horizon")
        held = item.throughout or not _is_throughout(item, period is not None)
        if not held or (item.throughout and (period is None or item.time == 0)):
            raise ValueError(f"{item.name} is not meant in between samples as it should be")
    kept: Any = [(item, item.ball or item.region) for item in said]
    whole = [
        Requirement(item.name, item.time, region, item.inside, None, item.throughout)
        for item, region in kept
    ]
    return tuple(_each_checked(whole, states))


def bits_of(region: AbstractSet) -> Any:
    """The bits of a set, by which it is told from any other one."""
    leaves, structure = jax.tree.flatten(region)
    arrays = map(np.asarray, leaves)
    return structure, *((each.dtype.str, each.shape, each.tobytes()) for each in arrays)


def _each_checked(found: Sequence[Requirement], states: int) -> list[Requirement]:
    """Requirements of sets that can be decided, each set being looked at once."""
    known: dict[tuple[int, bool], Requirement] = {}
    for item in found:
        key = id(item.region), item.inside
        if key not in known:
            known[key] = _checked(item, states)
    checked = (known[id(item.region), item.inside] for item in found)
    return [
        dataclasses.replace(one, name=item.name, time=item.time, throughout=item.throughout)
        for one, item in zip(checked, found, strict=True)
    ]


def _checked(item: Requirement, states: int) -> Requirement:
    """A requirement of a set that can be decided.

    Raises:
        RuntimeError: it was built while 64-bit floats were off.
        TypeError: it is of another kind.
        ValueError: its dimension is another one, it is empty, or it is an ellipsoid that cannot be
            decided.
    """
    region, kinds = item.region, (PolyhedralSet, Ellipsoid)
    require_kind(item.name, region, kinds, "a Box, a Polytope or an Ellipsoid")
    if region.steps is not None:
        raise ValueError(f"{item.name} must be one box, but a time-varying one arrived")
    if region.dimension != states:
        raise ValueError(
            f"{item.name} has dimension {region.dimension}, but the loop has {states} states"
        )
    require_double_precision(**{item.name: floats_of(region)})
    flat, ball = region.parts
    if flat is not None and flat.needs_programs and is_concrete(flat):
        A, b = (np.asarray(part, float) for part in region.facets)
        if _empty(A.tobytes(), b.tobytes()):
            raise ValueError(f"{item.name} is empty: no point satisfies all facets of its polytope")
    if ball is None:
        return item
    if not is_concrete(region):
        raise ValueError(
            f"{item.name} must be a polytope inside jax.jit, but a traced ellipsoid arrived"
        )
    polytope = (inner_polytope if item.inside else outer_polytope)(ball, item.name)
    return dataclasses.replace(item, region=polytope, ball=ball)


@lru_cache(maxsize=256)
def _empty(normals: bytes, offsets: bytes) -> bool:
    """Whether a polytope has no point: one linear program, whoever asks how often."""
    b = np.frombuffer(offsets)
    return is_empty(np.frombuffer(normals).reshape(len(b), -1), b)


def _depths(ball: Ellipsoid, points: np.ndarray) -> Float[np.ndarray, " c"]:
    """How deep points lie within an ellipsoid, at least, in the units of the state."""
    with np.errstate(over="ignore", invalid="ignore"):
        away = np.linalg.norm(
            (points - np.asarray(ball.center)) @ np.asarray(ball.normal_form.A).T, axis=1
        )
    return (1 - away) * np.sqrt(np.linalg.eigvalsh(np.asarray(ball.shape))[0])


@once_positional("goal", "avoid", "safe")
@lenient
def shortfall(
    tube: ReachTube,
    *,
    goal: Timed | None = None,
    safe: Region | None = None,
    avoid: AvoidSets | None = None,
    margin: float = 0.0,
) -> Float[Array, ""]:
    """By how much a tube misses a specification: zero if every margin is at least `margin`.

    The sum of `max(0, margin - m)` over the certified margins `m` of all requirements: one for each
    facet of the goal and of the safe set at each time, one for each avoided set at each time.
    Differentiable, and the same inside `jax.jit`, but for what is required between samples, where
    spans are wider in both (`ReachTube.spans`): where a facet of a tube's set has the normal of a
    facet of the goal or of the safe set, its offset counts, though others may cut it off.

    Args:
        tube: certified sets for `t = 0 .. horizon`.
        goal: where every state must be at the horizon; or a mapping from times, or from ranges of
            times, to where it must be then.
        safe: where every state must be at all times.
        avoid: closed sets in which no state may be: a sequence for all times, or a mapping from
            times, or from ranges of times, to sequences.
        margin: how far the sets should be from breaking a requirement, in the units of the state.

    Raises:
        TypeError: a set is of a kind without facets, or the margin is no number.
        ValueError: nothing is required, dimensions disagree, a time is beyond the horizon, or the
            margin is negative.

    Example:
        >>> from reachjax import MLP, AffinePlant, Box, ClosedLoop, Template, reach
        >>> loop = ClosedLoop(AffinePlant([[0.5]], [[1.0]]), MLP.from_layers([([[0]], [0])]))
        >>> tube = reach(loop, Box([1.0], [2.0]), 1, Template.box(1))  # [0.5, 1] at t = 1
        >>> round(float(shortfall(tube, goal=Box([0.0], [0.9]))), 6)
        0.1
    """
    check_margin(margin)
    return missing(of_tube(tube, goal=goal, safe=safe, avoid=avoid), tube, margin)


def missing(
    required: Sequence[Requirement], tube: ReachTube | Sketch, margin: float
) -> Float[Array, ""]:
    """By how much sets miss requirements, in all: see `shortfall`."""

    def hinged(margins: Float[Array, "*k"]) -> Float[Array, ""]:
        return jnp.sum(jnp.maximum(0.0, margin - margins))

    total = jnp.zeros(())
    for items in _alike(required):
        if isinstance(tube, Sketch):
            times, (first, *_) = [item.time for item in items], items
            found = tube.of_each(first.margins_in, times, first.throughout)
        else:
            found = [item.margins_in(item.holding(tube)) for item in items]
        total += sum(map(hinged, found), start=jnp.zeros(()))
    return total


def _alike(required: Sequence[Requirement]) -> Iterable[list[Requirement]]:
    """Requirements that differ in their times alone, those of the initial set apart."""
    found: dict[Any, list[Requirement]] = {}
    for item in required:
        key = id(item.region), item.inside, item.throughout, item.time == 0
        found.setdefault(key, []).append(item)
    return found.values()


def check_margin(margin: Any) -> None:
    """A margin is a number of at least 0, as far as one can see inside `jax.jit`."""
    if is_concrete(margin) or jnp.shape(margin) != ():
        real_number("margin", margin, 0.0)
