"""Reach-avoid requirements and how far a tube is from breaking them.

The paper's equations (reach_avoid): every state is in the goal at the horizon, and outside the
avoided sets, or inside a safe set, all along. A margin is a distance in the units of the state,
certified by the tube's sets; it can be differentiated as the sets can.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.numerics.checks import described, is_concrete, real_number, require_kind
from reachjax.sets import AbstractSet, PolyhedralSet
from reachjax.tubes.reach import ReachTube

AvoidSets = Sequence[PolyhedralSet] | Mapping[int, Sequence[PolyhedralSet]]


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


@dataclasses.dataclass(frozen=True)
class Requirement:
    """A set to be inside of, or to stay out of, at one time.

    Attributes:
        name: `goal`, `safe` or `avoid[i]`.
        time: when.
        region: the set.
        inside: whether states must be in it, or out of it.
    """

    name: str
    time: int
    region: PolyhedralSet
    inside: bool

    def compared(self, tube: ReachTube) -> Compared:
        """What every state surely does not exceed, and should not: of each facet, or of the set."""
        return self.compared_with(tube.sets[self.time])

    def compared_with(self, reached: AbstractSet) -> Compared:
        """The same, of a set that holds every state at this time."""
        if self.inside:
            C, d, norms = self.region.facets_in_units(inner=True)
            return Compared(reached.bounds_along(C), d, norms)
        return Compared(-reached.separation(self.region)[None], jnp.zeros(1), jnp.ones(1))

    def simulated(self, trajectories: np.ndarray) -> np.ndarray:
        """How far each trajectory `(c,)` is on the right side; negative on the wrong one."""
        C, d, norms = (np.asarray(part) for part in self.region.facets_in_units())
        with np.errstate(over="ignore", invalid="ignore"):
            room = (d - trajectories[:, self.time] @ C.T) / norms
        depth = room.min(axis=1)
        return depth if self.inside else -depth

    def proved(self, compared: Compared) -> bool:
        """Whether every state surely is on the right side. Sets are closed: touching is inside.

        Only comparisons are made, which no rounding can turn; what is no number, or too large for
        one, proves nothing.
        """
        attained, limits = np.asarray(compared.attained), np.asarray(compared.limits)
        known = np.isfinite(attained) & np.isfinite(limits)
        right = attained <= limits if self.inside else attained < limits
        return bool(np.all(known & right))


def of_tube(
    tube: ReachTube, goal: PolyhedralSet | None, avoid: AvoidSets | None, safe: PolyhedralSet | None
) -> list[Requirement]:
    """A specification's requirements for a tube, one for each set and time.

    Raises:
        TypeError: there is no tube, or a set is of a kind without facets.
        ValueError: nothing is required, dimensions disagree, a time is beyond the horizon, or a
            part of the tube was exchanged for another one.
    """
    require_kind("tube", tube, ReachTube, "a ReachTube, as reach(...) returns it")
    tube.require_sealed()
    return requirements(tube.loop.states, tube.horizon, goal, avoid, safe)


def requirements(
    states: int,
    horizon: int,
    goal: PolyhedralSet | None,
    avoid: AvoidSets | None,
    safe: PolyhedralSet | None,
) -> list[Requirement]:
    """A specification's requirements, one for each set and time.

    Raises:
        TypeError: a set is of a kind without facets.
        ValueError: nothing is required, dimensions disagree, or a time is beyond the horizon.
    """
    everywhere = range(horizon + 1)
    avoid = {} if avoid is None else avoid
    timed = avoid if isinstance(avoid, Mapping) else dict.fromkeys(everywhere, avoid)
    for regions in timed.values():
        if not isinstance(regions, Sequence):
            raise TypeError(
                "avoid must be a sequence of sets, avoid=[A, ...], or a mapping from a time to "
                f"one, avoid={{t: [A, ...]}}, but {described(regions)} arrived"
            )
    found = [Requirement("goal", horizon, goal, True)] if goal is not None else []
    found += [Requirement("safe", t, safe, True) for t in everywhere if safe is not None]
    for t, regions in timed.items():
        if isinstance(t, bool) or t not in everywhere:
            raise ValueError(f"avoid names time {t!r}, but the tube is for t = 0 .. {horizon}")
        found += [Requirement(f"avoid[{i}]", t, A, False) for i, A in enumerate(regions)]
    if not found:
        raise ValueError("nothing to verify: give a goal, avoid sets or a safe set")
    for item in found:
        require_kind(item.name, item.region, PolyhedralSet, "a Box or a Polytope")
        if item.region.steps is not None:
            raise ValueError(f"{item.name} must be one box, but a time-varying one arrived")
        if item.region.dimension != states:
            raise ValueError(
                f"{item.name} has dimension {item.region.dimension}, "
                f"but the loop has {states} states"
            )
    return found


def shortfall(
    tube: ReachTube,
    goal: PolyhedralSet | None = None,
    avoid: AvoidSets | None = None,
    safe: PolyhedralSet | None = None,
    *,
    margin: float = 0.0,
) -> Float[Array, ""]:
    """By how much a tube misses a specification: zero if every margin is at least `margin`.

    The sum of `max(0, margin - m)` over the certified margins `m` of all requirements: one for each
    facet of the goal and of the safe set at each time, one for each avoided set at each time.
    Differentiable, also inside `jax.jit`.

    Args:
        tube: certified sets for `t = 0 .. horizon`.
        goal: where every state must be at the horizon.
        avoid: closed sets in which no state may be: a sequence for all times, or a mapping from a
            time to a sequence.
        safe: where every state must be at all times.
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
    missing = jnp.zeros(())
    for item in of_tube(tube, goal, avoid, safe):
        missing += jnp.sum(jnp.maximum(0.0, margin - item.compared(tube).margins))
    return missing


def check_margin(margin: Any) -> None:
    """A margin is a number of at least 0, as far as one can see inside `jax.jit`."""
    if is_concrete(margin) or jnp.shape(margin) != ():
        real_number("margin", margin, 0.0)
