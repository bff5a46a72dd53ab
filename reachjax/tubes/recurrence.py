"""Statements for all time: a set that states come into, and come back to.

A tube that ends says nothing of later times. If its last set is in a set `S` from which every state
is in `S` again after `m` steps, and all is well until then, all is well for ever. The initial set
may be such a set. Else one is looked for around where trajectories end: along the modes of the loop
there, or along the directions of the tube; simulation says how large and after how many steps, and
`decide` proves it.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from reachjax.loops import ClosedLoop
from reachjax.loops.scenarios import Runs, Scenarios
from reachjax.proofs.witnesses import initial_states
from reachjax.sets import AbstractSet, Box, PolyhedralSet, Polytope, Template
from reachjax.tubes.decisions import decide
from reachjax.tubes.reach import ReachTube
from reachjax.tubes.refutations import SUSPECTS, counterexample, suspects
from reachjax.tubes.requirements import AvoidSets, Requirement, requirements
from reachjax.tubes.verdicts import Counterexample, Recurrence, Verdict, VerdictStatus

LONG = 500
"""So many steps are simulated to see where trajectories end, and whether they break anything."""

PERIODS = 60
"""A set must return into itself after no more steps than this."""

SAMPLES = 300
"""How many trajectories are simulated from a set that may return into itself."""

WIDER = 1.2
"""By how much a set that later states shall be in is larger than what is simulated."""

FLATTEST = 1e-2
"""A set's smallest radius, in parts of its largest, in units of the states' ranges."""

INSIDE = 0.1, 0.4
"""How far inside, in parts of a radius, states shall be when they return, as simulation has it."""

TURNS = 4
"""Directions for the plane of a pair of complex modes."""


class Wanted(NamedTuple):
    """What must hold at all times.

    Attributes:
        safe: where every state must be.
        avoid: where none may be.
    """

    safe: PolyhedralSet | None
    avoid: tuple[PolyhedralSet, ...]


class Candidate(NamedTuple):
    """A set that may return into itself.

    Attributes:
        step: when states shall be in it.
        region: the set.
        normals: `(m, n)`, of its facets.
        center: `(n,)`.
        radii: `(m,)`, `normals (x - center) <= radii` in it.
    """

    step: int
    region: PolyhedralSet
    normals: Float[np.ndarray, "m n"]
    center: Float[np.ndarray, " n"]
    radii: Float[np.ndarray, " m"]


def for_ever(
    verdict: Verdict,
    tubes: Sequence[ReachTube],
    X0: AbstractSet,
    safe: PolyhedralSet | None,
    avoid: AvoidSets | None,
    seed: int,
    deadline: float,
) -> Verdict:
    """The same verdict for all time.

    Args:
        verdict: until the horizon.
        tubes: what it rests on, from sets that cover the initial set.
        X0: the initial set.
        safe: where every state must be.
        avoid: closed sets in which no state may be.
        seed: of simulations.
        deadline: after which no other set is tried, as `time.monotonic` says it.

    Raises:
        ValueError: the loop varies in time, or nothing is required at all times.
    """
    loop, start = tubes[0].loop, tubes[0].start
    if loop.steps is not None:
        raise ValueError(
            f"forever=True is of loops that do not vary in time, but this one is given for "
            f"{loop.steps} time steps"
        )
    if isinstance(avoid, Mapping):
        raise ValueError("with forever=True avoid must be a sequence of sets, for all times")
    if safe is None and not avoid:
        raise ValueError("nothing is required for ever: give avoid sets or a safe set")
    if verdict.status is VerdictStatus.REFUTED:
        return verdict
    wanted, runs = Wanted(safe, tuple(avoid or ())), _long_runs(loop, X0, start, seed)
    example = _broken_later(loop, X0, wanted, runs, start)
    if example is not None:
        refuted = VerdictStatus.REFUTED
        return dataclasses.replace(verdict, status=refuted, counterexample=example)
    if verdict.status is VerdictStatus.UNKNOWN:
        return verdict
    found = recurrence(tubes, X0, wanted, runs.states, deadline)
    proved = found is not None and found.proved
    status = VerdictStatus.PROVED if proved else VerdictStatus.UNKNOWN
    return dataclasses.replace(verdict, status=status, recurrence=found)


def _long_runs(loop: ClosedLoop, X0: AbstractSet, start: int, seed: int) -> Runs:
    """Many steps of trajectories from corners of a set and from points of it."""
    scenarios = Scenarios.of(loop, X0, LONG, start)
    drawn = scenarios.drawn(initial_states(X0, SAMPLES, seed), seed)
    return Runs(drawn, scenarios.runs(jax.device_get(loop), drawn, LONG, start))


def _broken_later(
    loop: ClosedLoop, X0: AbstractSet, wanted: Wanted, runs: Runs, start: int
) -> Counterexample | None:
    """A trajectory that breaks what must hold at all times, cut where it does."""
    tried = 0
    size = (runs.scenarios.shape[1] - loop.states) // LONG
    for item in requirements(loop.states, LONG, None, wanted.avoid or None, wanted.safe):
        until = runs.states[:, : item.time + 1]
        some = Runs(runs.scenarios, until).some(np.isfinite(until).all(axis=(1, 2)))
        if len(some.states):
            begun = some.scenarios[:, : loop.states + item.time * size]
            found = suspects(item, item.simulated(some.states), Runs(begun, some.states))
            example = counterexample(loop, X0, found, start)
            tried += len(found)
            if example is not None or tried > SUSPECTS:
                return example
    return None


def recurrence(
    tubes: Sequence[ReachTube],
    X0: AbstractSet,
    wanted: Wanted,
    runs: Float[np.ndarray, "c T n"],
    deadline: float,
) -> Recurrence | None:
    """A set that all states of some tubes come into and come back to, or what comes nearest to it.

    Args:
        tubes: from sets that cover the initial set, of the same horizon.
        X0: the initial set.
        wanted: what must hold at all times.
        runs: many steps of trajectories from it.
        deadline: after which no other set is tried, as `time.monotonic` says it.

    Returns:
        With a margin that is not negative if it is proved, of which the requirements are a part;
        None if nothing comes near.
    """
    nearest = None
    if isinstance(X0, PolyhedralSet):
        for k in range(1, tubes[0].horizon + 1):
            proved, margin = _within([tube.sets[k] for tube in tubes], X0)
            found = Recurrence(k, k, X0, margin, proved)
            if proved:
                return found
            nearest = _nearer(nearest, found)
    for candidate in _candidates(tubes, runs, wanted.safe):
        for period in _periods(tubes[0].loop, candidate):
            left = deadline - time.monotonic()
            if left <= 0:
                return nearest
            found = _tried(tubes, candidate, period, wanted, left if np.isfinite(left) else None)
            if found.proved:
                return found
            nearest = _nearer(nearest, found)
    return nearest


def _nearer(one: Recurrence | None, other: Recurrence | None) -> Recurrence | None:
    """The one with the larger margin."""
    if one is None or other is None:
        return one or other
    return max(one, other, key=lambda each: each.margin)


def _within(sets: Sequence[AbstractSet], region: PolyhedralSet) -> tuple[bool, float]:
    """Whether sets surely are in another one, and by which margin."""
    inside = Requirement("goal", 0, region, True)
    compared = [inside.compared_with(each) for each in sets]
    margin = min(float(each.margins.min()) for each in compared)
    return all(map(inside.proved, compared)), margin


def _tried(
    tubes: Sequence[ReachTube],
    candidate: Candidate,
    period: int,
    wanted: Wanted,
    seconds: float | None,
) -> Recurrence:
    """What is proved of a set that shall be entered, and left only to come back."""
    loop, horizon = tubes[0].loop, tubes[0].horizon
    step, region = candidate.step, candidate.region

    def arrives(begun: AbstractSet, steps: int) -> tuple[bool, float]:
        more = {"avoid": wanted.avoid or None, "samples": SAMPLES, "time_limit": seconds}
        found = decide(loop, begun, steps, goal=region, safe=wanted.safe, **more)
        margin = np.nan_to_num(found.margins["goal"][-1], nan=-np.inf)
        return found.status is VerdictStatus.PROVED, float(margin)

    proved, margin = arrives(region, period)
    if proved:
        if step > horizon:
            ways = [arrives(tube.sets[-1], step - horizon) for tube in tubes]
        else:
            ways = [_within([tube.sets[-1] for tube in tubes], region)]
        proved, margin = all(way for way, _ in ways), min(margin, *(room for _, room in ways))
    return Recurrence(step, period, region, margin, proved)


def _candidates(
    tubes: Sequence[ReachTube], runs: Float[np.ndarray, "c T n"], safe: PolyhedralSet | None
) -> Iterator[Candidate]:
    """Sets around where trajectories end that hold what comes from a step on and is safe."""
    loop, horizon = tubes[0].loop, tubes[0].horizon
    runs = runs[np.isfinite(runs).all(axis=(1, 2))]
    if not len(runs):
        return
    center = runs[:, -1].mean(axis=0)
    scale = np.ptp(runs, axis=(0, 1))
    scale = np.where(scale > 0, scale, max(scale.max(), 1e-9))
    step = horizon
    while step <= runs.shape[1] // 2:
        for directions in _directions(tubes[0], loop, center):
            normals = directions / (abs(directions) @ scale)[:, None]
            radii = WIDER * abs((runs[:, step:] - center) @ normals.T).max(axis=(0, 1))
            if step == horizon:
                ends = [
                    np.asarray(tube.sets[-1].bounds_along(jnp.asarray(normals))) for tube in tubes
                ]
                radii = np.maximum(radii, np.max(ends, axis=0) - normals @ center)
            radii = np.maximum(radii, FLATTEST * radii.max())
            if radii.max() > 0:
                region = _safe_part(_region(normals, center, radii), safe)
                yield Candidate(step, region, normals, center, radii)
        step *= 2


def _region(
    normals: Float[np.ndarray, "m n"],
    center: Float[np.ndarray, " n"],
    radii: Float[np.ndarray, " m"],
) -> PolyhedralSet:
    """The set of these facets; a box if they are along axes."""
    if (np.count_nonzero(normals, axis=1) > 1).any():
        return Polytope(normals, radii + normals @ center)
    lower, upper = np.full((2, len(center)), np.inf)
    for normal, radius in zip(normals, radii, strict=True):
        (i,) = np.flatnonzero(normal)
        ends = upper if normal[i] > 0 else lower
        ends[i] = min(ends[i], radius / abs(normal[i]))
    return Box(center - lower, center + upper)


def _safe_part(region: PolyhedralSet, safe: PolyhedralSet | None) -> PolyhedralSet:
    """A set without what is not safe."""
    if safe is None or _within([region], safe)[0]:
        return region
    if isinstance(region, Box) and isinstance(safe, Box):
        lower = jnp.maximum(region.lower, safe.lower)
        return Box(lower, jnp.maximum(lower, jnp.minimum(region.upper, safe.upper)))
    (A, b), (C, d) = region.facets, safe.facets
    return Polytope(jnp.concatenate([A, C]), jnp.concatenate([b, d]))


def _directions(
    tube: ReachTube, loop: ClosedLoop, center: Float[np.ndarray, " n"]
) -> Iterator[Float[np.ndarray, "m n"]]:
    """Normals along the modes of the loop at a point, then those of the tube."""
    jacobian = np.asarray(jax.jacobian(loop.step)(jnp.asarray(center)))
    if np.isfinite(jacobian).all():
        values, vectors = np.linalg.eig(jacobian.T)
        real = np.real(vectors[:, np.imag(values) == 0].T)
        turns = np.exp(1j * np.pi * np.arange(TURNS) / TURNS)
        pairs = np.real(turns[:, None, None] * vectors[:, np.imag(values) > 0].T)
        modes = np.concatenate([real, pairs.reshape(-1, len(jacobian))])
        if np.linalg.matrix_rank(modes, 1e-6) == len(jacobian):
            yield np.concatenate([modes, -modes])
    own = tube.template.at(tube.horizon)
    box = Template.box(loop.states)
    yield np.asarray((own if isinstance(own, Template) else box).directions)


def _periods(loop: ClosedLoop, candidate: Candidate) -> list[int]:
    """After how many steps simulated states of a set are inside it again, well inside and more."""
    states = initial_states(candidate.region, SAMPLES, 0)
    scenarios = Scenarios.of(loop, candidate.region, PERIODS)
    drawn = scenarios.drawn(states, 0)
    runs = scenarios.runs(jax.device_get(loop), drawn, PERIODS, 0)
    with np.errstate(all="ignore"):
        values = ((runs[:, 1:] - candidate.center) @ candidate.normals.T) / candidate.radii
    inside = 1.0 - np.nan_to_num(values, nan=np.inf).max(axis=(0, 2))
    found = [int(np.argmax(inside >= least)) + 1 for least in INSIDE if (inside >= least).any()]
    if not found and inside.max() > 0:
        found = [int(inside.argmax()) + 1]
    return sorted(set(found))
