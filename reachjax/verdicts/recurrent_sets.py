"""Sets that a loop may return into: around where trajectories end, as large as these say."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from reachjax.loops import ClosedLoop
from reachjax.loops.scenarios import Scenarios
from reachjax.methods.witnesses import initial_states
from reachjax.sets import AbstractSet, Box, PolyhedralSet, Polytope, Template
from reachjax.tubes.reach import ReachTube
from reachjax.verdicts.specification import Requirement

TRAJECTORIES = 300
"""How many trajectories are simulated from a set that may return into itself."""

PERIODS = 150
"""A set must return into itself after no more steps than this."""

WIDER = 1.2
"""By how much a set that later states shall be in is larger than what is simulated."""

FLATTEST = 1e-2
"""A set's smallest radius, in parts of its largest, in units of the states' ranges."""

INSIDE = 0.1, 0.4
"""How far inside, in parts of a radius, states shall be when they return, as simulation has it."""

DIFFERENCE = 1e-6
"""The step of differences of a loop, as a part of a state's size."""

TURNS = 4
"""Directions for the plane of a pair of complex modes."""


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


def within(sets: Sequence[AbstractSet], region: PolyhedralSet) -> tuple[bool, float]:
    """Whether sets surely are in another one, and by which margin."""
    inside = Requirement("goal", 0, region, True)
    compared = [inside.compared_with(each) for each in sets]
    margin = min(each.least_margin for each in compared)
    return all(map(inside.proved, compared)), margin


def candidate_sets(
    tubes: Sequence[ReachTube], runs: Float[np.ndarray, "c T n"], safe: PolyhedralSet | None
) -> Iterator[Candidate]:
    """Sets around where trajectories end that hold what comes from a step on and is safe."""
    loop, horizon = tubes[0].loop, tubes[0].horizon
    runs = runs[np.isfinite(runs).all(axis=(1, 2))]
    if not len(runs):
        return
    own = tubes[0].template.at(horizon)
    step = horizon
    while step <= runs.shape[1] // 2:
        last = [tube.sets[-1] for tube in tubes] if step == horizon else []
        for candidate in sets_around(loop, runs, step, WIDER, own.alone, last):
            region = _safe_part(candidate.region, safe)
            if region is not None:
                yield candidate._replace(region=region)
        step *= 2


def sets_around(
    loop: ClosedLoop,
    runs: Float[np.ndarray, "c T n"],
    step: int,
    wider: float,
    template: Template | None = None,
    sets: Sequence[AbstractSet] = (),
) -> Iterator[Candidate]:
    """Sets around where trajectories end that hold what comes from a step on.

    Args:
        loop: the closed loop.
        runs: trajectories.
        step: from which on they are looked at.
        wider: by how much the sets are larger.
        template: directions to be tried after the modes of the loop; None for the axes.
        sets: what else they shall hold.
    """
    center, scale = runs[:, -1].mean(axis=0), np.ptp(runs, axis=(0, 1))
    scale = np.where(scale > 0, scale, max(scale.max(), 1e-9))
    for directions in _directions(template or Template.box(loop.states), loop, center):
        normals = directions / (abs(directions) @ scale)[:, None]
        radii = wider * abs((runs[:, step:] - center) @ normals.T).max(axis=(0, 1))
        for each in sets:
            ends = np.asarray(each.bounds_along(jnp.asarray(normals)))
            radii = np.maximum(radii, wider * (ends - normals @ center))
        radii = np.maximum(radii, FLATTEST * radii.max())
        if radii.max() > 0:
            yield Candidate(step, _region(normals, center, radii), normals, center, radii)


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


def _safe_part(region: PolyhedralSet, safe: PolyhedralSet | None) -> PolyhedralSet | None:
    """A set without what is not safe; None if nothing of it is, or too little to draw states."""
    if safe is None or within([region], safe)[0]:
        return region
    if region.intervals is not None and safe.intervals is not None:
        around = Box(*safe.intervals)
        return None if region.misses(around) else region.cut(around)
    (A, b), (C, d) = region.facets, safe.facets
    part = Polytope(jnp.concatenate([A, C]), jnp.concatenate([b, d]))
    try:
        part.sample(jax.random.key(0), 1)
    except (ValueError, RuntimeError):
        return None
    return part


def _directions(
    template: Template, loop: ClosedLoop, center: Float[np.ndarray, " n"]
) -> Iterator[Float[np.ndarray, "m n"]]:
    """Normals along the modes of the loop at a point, then those of a template."""
    jacobian = _jacobian(loop, center)
    if np.isfinite(jacobian).all():
        values, vectors = np.linalg.eig(jacobian.T)
        real = np.real(vectors[:, np.imag(values) == 0].T)
        turns = np.exp(1j * np.pi * np.arange(TURNS) / TURNS)
        pairs = np.real(turns[:, None, None] * vectors[:, np.imag(values) > 0].T)
        modes = np.concatenate([real, pairs.reshape(-1, len(jacobian))])
        if np.linalg.matrix_rank(modes, 1e-6) == len(jacobian):
            yield np.concatenate([modes, -modes])
    yield np.asarray(template.directions)


def _jacobian(loop: ClosedLoop, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n n"]:
    """The Jacobian of a step at a state, by differences: they are good enough for directions."""
    off, host = DIFFERENCE * (1 + abs(x)), jax.device_get(loop)
    scenarios = Scenarios.of(loop, Box(x, x), 1)
    before, after = (
        scenarios.runs(host, scenarios.drawn(x + sign * np.diag(off), 0), 1, 0)[:, 1]
        for sign in (-1, 1)
    )
    return ((after - before) / (2 * off[:, None])).T


def periods(loop: ClosedLoop, candidate: Candidate) -> list[int]:
    """After how many steps simulated states of a set are inside it again, well inside and more."""
    states = initial_states(candidate.region, TRAJECTORIES, 0)
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
