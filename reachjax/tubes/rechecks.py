"""Tubes proved anew, from loop, initial set, template and start, and from nothing else they say.

What their proofs rest on is made again (`repeats`), step after step, and sets are held against the
bounds that it proves; so a certificate of another loop, set, start or step proves nothing of use
here. Witnesses are simulated again. A bound that rounding proves a little larger than it was, as on
another machine, is raised to what is proved; one that is larger by more is a disagreement.
"""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from reachjax.loops.scenarios import Scenarios
from reachjax.numerics.rounding import namespace
from reachjax.numerics.seals import seal_of
from reachjax.proofs.certificates import AbstractProof
from reachjax.proofs.proposal import SolverStatus
from reachjax.sets import AbstractSet, Ellipsoid, Intersection, Polytope
from reachjax.sets.base import RoundSet
from reachjax.sets.cells import covers
from reachjax.tubes.partitions import PartitionedTube
from reachjax.tubes.reach import ReachTube
from reachjax.tubes.repeats import DisagreementError, Repeat

ROUNDING = 1e-9
"""The part of a number's size by which a recheck may differ on another machine."""


class Recheck:
    """A tube on its way to be proved anew, step after step.

    Args:
        tube: whose parts have the kinds and sizes that they should have.
    """

    def __init__(self, tube: ReachTube):
        self._given, self._sets, self._proofs = tube, [tube.sets[0]], list[AbstractProof]()
        self._repeat = Repeat(tube, self._sets)

    @property
    def left(self) -> int:
        """How many steps are not proved yet."""
        return self._given.horizon - len(self._proofs)

    def advance(self) -> None:
        """Prove the next set.

        Raises:
            DisagreementError: it is not proved.
        """
        k = len(self._sets)
        try:
            region, proof = self._proved(k, self._given.sets[k], self._given.proof(k))
        except DisagreementError:
            raise
        except Exception as error:  # what is read may be of any shape and size
            raise DisagreementError(
                f"the recheck of step {k} proves nothing, for its certificate does not fit the "
                f"tube's loop, initial set, start and earlier sets: {error}",
                k,
            ) from error
        self._sets.append(region)
        self._proofs.append(_unclaimed(proof))

    def finished(self) -> ReachTube:
        """The tube as it is proved, once all steps are.

        Raises:
            DisagreementError: a witness is no trajectory's value.
            ValueError: there are steps left.
        """
        if self.left:
            raise ValueError(
                f"progress must pass on each step, but {self.left} of {self._given.horizon} did "
                "not arrive"
            )
        tube = self._given
        _require_witnesses(tube)
        sets, proofs = tuple(self._sets), (None, *self._proofs)
        return ReachTube.sealed(tube.loop, tube.template, sets, proofs, tube.start)

    def _proved(
        self, k: int, region: AbstractSet, proof: AbstractProof
    ) -> tuple[AbstractSet, AbstractProof]:
        """The set after `k` steps and its proof, as they are made again."""
        flat, ball = region.parts
        offsets = np.asarray(region.facets[1])
        _require_template(self._given, k, region)
        said = np.asarray(proof.bounds)[: len(offsets)]
        for facet in np.flatnonzero(offsets != said)[:1].tolist():
            numbers = float(offsets[facet]), float(said[facet])
            raise DisagreementError(
                f"sets[{k}] bounds facet {facet} by {numbers[0]!r}, but its certificate by "
                f"{numbers[1]!r}",
                k,
                facet,
                *numbers,
            )
        with np.errstate(all="ignore"):  # what overflows proves nothing
            proof, found = self._repeat.of(k, proof)
        bounds = np.asarray(proof.bounds)
        slack = ROUNDING * np.fmax(abs(bounds), self._sizes(k, region))
        for facet in np.flatnonzero(~(found <= bounds + slack))[:1].tolist():
            numbers = float(bounds[facet]), float(found[facet])
            raise DisagreementError(
                f"the recheck of step {k} proves {numbers[1]:.12g} for facet {facet}, but the tube "
                f"says {numbers[0]:.12g}: it was computed for another loop, initial set or start, "
                "or by another version, or it was changed",
                k,
                facet,
                *numbers,
            )
        raised = np.fmax(bounds, found)
        if np.any(raised > bounds):
            proof = proof.replace(bounds=jnp.asarray(raised))
            if flat is not None:
                flat = Polytope(flat.facets[0], proof.bounds[: len(offsets)])
        if ball is None:
            return flat or region, proof
        own: Any = proof
        level = own.level * raised[-1]
        made = Ellipsoid.enclosing(own.form, level)
        if not _alike(own.form.A, level, ball, made):
            raise DisagreementError(f"the ellipsoid of sets[{k}] is not its certificate's", k)
        if raised[-1] > 1:
            proof = own.replace(level=level, bounds=own.bounds.at[-1].set(1.0))
        return made if flat is None else Intersection(flat, made), proof

    def _sizes(self, k: int, region: AbstractSet) -> np.ndarray:
        """The size of what facets add up on a few trajectories; 1 of an ellipsoid."""
        sizes = abs(np.asarray(region.facets[0])) @ self._states[k]
        return np.append(sizes, np.ones(len(region.limits) - len(sizes)))

    @cached_property
    def _states(self) -> np.ndarray:
        """The size of the states up to each time on trajectories from around the initial set."""
        tube = self._given
        loop, box = jax.device_get((tube.loop, tube.sets[0].bounding_box()))
        scenarios = Scenarios.of(loop, tube.sets[0], tube.horizon, tube.start)
        begun = np.stack([scenarios.middle(each) for each in (box.lower, box.center, box.upper)])
        runs = scenarios.runs(loop, begun, tube.horizon, tube.start)
        sizes = np.where(np.isfinite(runs), abs(runs), 0.0).max(axis=0)
        return np.maximum.accumulate(sizes, axis=0)


def _unclaimed(said: Any) -> Any:
    """A proof, or several, without what nobody can prove: how a search ended, and its seconds."""
    if type(said) is tuple:
        return tuple(map(_unclaimed, said))
    if not isinstance(said, AbstractProof):
        return said
    parts = {field.name: getattr(said, field.name) for field in dataclasses.fields(said)}
    nested = {
        name: _unclaimed(part)
        for name, part in parts.items()
        if isinstance(part, AbstractProof) or type(part) is tuple
    }
    xp = namespace(said.codes)
    return said.replace(
        **nested,
        codes=xp.full_like(said.codes, int(SolverStatus.RECHECKED)),
        seconds=xp.full_like(said.seconds, np.nan),
    )


def _require_template(tube: ReachTube, k: int, region: AbstractSet) -> None:
    """Raise an error unless a set looks as the template says."""
    facets, ellipsoid = tube.template.at(k).parts
    flat, ball = region.parts
    fits = (flat is None, ball is None) == (facets is None, ellipsoid is None)
    if fits and facets is not None:
        fits = np.array_equal(region.facets[0], facets.directions)
    if fits and ball is not None and ellipsoid is not None and ellipsoid.shape is not None:
        shapes = [np.asarray(each) / np.trace(each) for each in (ball.shape, ellipsoid.shape)]
        fits = np.allclose(*shapes, rtol=0, atol=ROUNDING)
    if not fits:
        raise DisagreementError(f"sets[{k}] does not look as the template says", k)


def _alike(A: Any, level: Any, one: RoundSet, other: Ellipsoid) -> bool:
    """Whether two ellipsoids are the same where `|A x| <= level` is a ball."""
    M = np.asarray(A) / float(level)
    moved = M @ np.asarray(one.center - other.center)
    grown = M @ np.asarray(one.shape - other.shape) @ M.T
    return bool(abs(moved).max() <= ROUNDING and abs(grown).max() <= ROUNDING)


def _require_witnesses(tube: ReachTube) -> None:
    """Raise an error unless trajectories from the initial set attain the witnesses.

    Raises:
        DisagreementError: that is so of none of the trajectories that are said to.
    """
    loop, X0 = jax.device_get(tube.loop), tube.sets[0]
    scenarios = Scenarios.of(loop, X0, tube.horizon, tube.start)
    middle = scenarios.middle(np.asarray(X0.bounding_box().center))
    claims = []
    for k in range(1, tube.horizon + 1):
        proof = tube.proof(k)
        witnesses, states = np.asarray(proof.witnesses), np.asarray(proof.witness_states)
        for facet in np.flatnonzero(~np.isnan(witnesses)).tolist():
            known = states.shape[1] >= X0.dimension
            state = scenarios.completed(states[facet : facet + 1], middle)[0] if known else middle
            claims.append((k, facet, float(witnesses[facet]), state))
    if not claims:
        return
    begun = np.stack([state for *_, state in claims])
    inside = np.isfinite(begun).all(axis=1) & scenarios.nearly_contains(begun)
    runs = scenarios.runs(loop, begun, tube.horizon, tube.start)
    for (k, facet, said, _), run, within in zip(claims, runs, inside, strict=True):
        with np.errstate(all="ignore"):  # what overflows attains nothing
            value, size = _value(tube.sets[k], facet, run[: k + 1])
        attained = np.isfinite(size) and abs(value - said) <= ROUNDING * size
        if not (within and attained):
            found = "it does not begin in the initial set" if not within else f"{value:.12g}"
            raise DisagreementError(
                f"the witness of step {k} for facet {facet} is said to attain {said:.12g}, but "
                f"its trajectory does not: {found}",
                k,
                facet,
                said,
                value,
            )


def _value(region: AbstractSet, facet: int, run: np.ndarray) -> tuple[float, float]:
    """What a facet, or the ellipsoid, of a set has at the end of a run, and the size of its terms.

    It is that of all states so far: what is left of a contracting loop's has their rounding.
    """
    x, largest = run[-1], abs(run).max(axis=0)
    A, _ = map(np.asarray, region.facets)
    if facet < len(A):
        return float(A[facet] @ x), float(abs(A[facet]) @ largest)
    _, ball = region.parts
    assert ball is not None
    form, center = np.asarray(ball.normal_form.A), np.asarray(ball.center)
    terms = abs(form) @ (largest + abs(center))
    return float(np.linalg.norm(form @ (x - center))), float(np.linalg.norm(terms))


def require_partition(tube: PartitionedTube) -> None:
    """Raise an error unless the tubes are of one question, and from parts that cover the set.

    Raises:
        DisagreementError: that is not so.
    """
    first, *others = ((each.loop, each.template) for each in tube.tubes)
    times = {(each.horizon, each.start) for each in tube.tubes}
    seals = {np.asarray(seal_of(*parts)).tobytes() for parts in (first, *others)}
    if len(times) > 1 or len(seals) > 1:
        raise DisagreementError("the tubes are of different loops, templates, horizons or starts")
    if not covers([each.sets[0] for each in tube.tubes], tube.X0):
        raise DisagreementError("the cells are not shown to cover the initial set")
