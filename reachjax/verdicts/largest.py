"""The largest initial set of a kind from which a specification is proved, as far as is found.

Any box or ellipsoid begins. It is shrunk until it is proved; then its size climbs along the
gradient of affine forms, inside a barrier of their margins; then it grows about its center and side
by side for as long as `decide` proves it. What is returned is proved; that nothing larger is, is
not said: neither is the problem concave, nor is what a relaxation proves all that is true.

Regions are points of a vector space meanwhile, all of it in numpy: values that cost thousands of
evaluations are had without a compilation.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from reachjax.loops import ClosedLoop
from reachjax.methods.propagation import known_numbers
from reachjax.numerics.budget import Budget, Interrupted
from reachjax.numerics.checks import (
    require_bar,
    require_double_precision,
    require_kind,
    whole_number,
    wrapped,
)
from reachjax.numerics.deprecations import once_positional
from reachjax.numerics.flags import lenient
from reachjax.numerics.host import in_numpy
from reachjax.numerics.logs import logged
from reachjax.programs.relaxations import BranchAndCut
from reachjax.programs.unrolled import unrolled
from reachjax.sets import Box, Ellipsoid
from reachjax.verdicts.decide import decide
from reachjax.verdicts.specification import (
    AvoidSets,
    Region,
    Requirement,
    Timed,
    parts_of_periods,
    period_of,
    requirements,
)
from reachjax.verdicts.verdict import Verdict, VerdictStatus

Kind = Box | Ellipsoid

STEP = 1e-7
"""The step of difference quotients, in parts of the axes: rounding leaves half of the digits."""


class Shape(NamedTuple):
    """A box or an ellipsoid as `center + axes s`, over a box or a ball of `s`.

    Attributes:
        center: `(n,)`.
        axes: `(n,)`, half-widths of a box, of which some may be zero: such sides are flat, and
            stay where they are; `(n, n)`, a factor of an ellipsoid's shape.
    """

    center: Float[np.ndarray, " n"]
    axes: Float[np.ndarray, ...]

    @classmethod
    def of(cls, X: Kind) -> Shape:
        """The shape of a set."""
        _, ball = X.parts
        if ball is None:
            return cls(np.asarray(X.center), np.asarray(X.bounding_box().widths) / 2)
        return cls(np.asarray(X.center), np.linalg.cholesky(np.asarray(ball.shape)))

    @property
    def sides(self) -> list[int]:
        """The sides to be extended, which are not flat: of an ellipsoid, ends of axes."""
        return [side for side in range(2 * len(self.center)) if self.lengths[side // 2] > 0]

    @property
    def lengths(self) -> Float[np.ndarray, " n"]:
        """How far it reaches from its center along each coordinate."""
        return self.axes if self.axes.ndim == 1 else np.linalg.norm(self.axes, axis=1)

    def set(self) -> Kind:
        """The set.

        Raises:
            ValueError: an entry is not finite, or there is no inside.
        """
        if self.axes.ndim == 1:
            return Box(self.center - self.axes, self.center + self.axes)
        return Ellipsoid(self.center, self.axes @ self.axes.T)

    def support(self, directions: Float[np.ndarray, "m n"]) -> Float[np.ndarray, " m"]:
        """Upper bounds of directions."""
        if self.axes.ndim == 1:
            return directions @ self.center + abs(directions) @ self.axes
        size = np.sqrt(np.sum((directions @ self.axes) ** 2, axis=1))
        return directions @ self.center + size

    def log_volume(self) -> float:
        """The logarithm of the volume, but for a constant; flat sides do not count."""
        if self.axes.ndim == 1:
            return float(np.sum(np.log(np.where(self.axes > 0, self.axes, 1.0))))
        return float(np.linalg.slogdet(self.axes)[1])

    def volume(self) -> float:
        """The volume, flat sides aside; of an ellipsoid, that of the box of its axes."""
        return float(2.0 ** (len(self.sides) // 2) * np.exp(self.log_volume()))

    def uphill(self, value: Callable[[Shape], float], here: float) -> Shape:
        """A direction in which a value grows, of length one in units of the axes.

        It is the gradient in these units, by difference quotients; of an ellipsoid along its center
        and the symmetric factors of its axes, since turning them changes nothing. Where the value
        is not finite there is no slope.

        Args:
            value: of shapes.
            here: its value at this one.
        """

        def slope(center: np.ndarray, axes: np.ndarray) -> float:
            moved = Shape(self.center + STEP * center, self.axes + STEP * axes)
            found = (value(moved) - here) / STEP
            return found if np.isfinite(found) else 0.0

        n, still = len(self.center), np.zeros_like(self.axes)
        if self.axes.ndim == 1:
            along = np.diag(self.axes)[self.axes > 0]
            center, axes = np.zeros(n), np.zeros(n)
            for each in along:
                center = center + slope(each, still) * each
                axes = axes + slope(np.zeros(n), each) * each
            units = np.where(self.axes > 0, self.axes, 1.0)
            size = np.max(abs(np.stack([center, axes])) / units, initial=0.0)
        else:
            moves, factors = np.zeros(n), np.zeros((n, n))
            for i in range(n):
                moves[i] = slope(self.axes[:, i], still)
            for i, j in itertools.combinations_with_replacement(range(n), 2):
                factor = np.zeros((n, n))
                factor[i, j] = factor[j, i] = 1.0
                share = 1.0 if i == j else 0.5
                factors[i, j] = factors[j, i] = share * slope(np.zeros(n), self.axes @ factor)
            center, axes = self.axes @ moves, self.axes @ factors
            size = np.max(abs(np.column_stack([moves, factors])))
        size = size or 1.0
        return Shape(center / size, axes / size)

    def moved(self, along: Shape, length: float) -> Shape:
        """The shape some way along a direction."""
        return Shape(self.center + length * along.center, self.axes + length * along.axes)

    def enlarged(self, by: float) -> Shape:
        """The shape about its center, larger by this part."""
        return Shape(self.center, (1 + by) * self.axes)

    def extended(self, side: int, by: float) -> Shape:
        """The shape with one end further out by this part of its axis, the other end as it is."""
        i, sign = side // 2, 1.0 if side % 2 else -1.0
        if self.axes.ndim == 1:
            own, half = np.eye(len(self.axes))[i], by * self.axes[i] / 2
            return Shape(self.center + sign * half * own, self.axes + half * own)
        left, sizes, _ = np.linalg.svd(self.axes)
        half = by * sizes[i] / 2
        center = self.center + sign * half * left[:, i]
        return Shape(center, left * (sizes + half * np.eye(len(sizes))[i]))


SMALLEST = 40
"""A set is halved so many times before it is said that nothing is proved."""

BARRIER, SOFTER = 0.1, 0.9
"""The weight of the barrier at first, and what each round leaves of it."""

LONGEST, SHORTEST = 0.3, 1e-4
"""Steps of an ascent, in parts of the half-axes: the first one, and one that is not tried."""

FARTHEST = 2.0**20
"""How many times as long as one of `X0` a side may get: where nothing limits it, it ends there."""

TURN = 0.3
"""The part of the time that is left that a set may take: others are to be tried after it."""

GROWTHS = 0.3, 0.1, 0.03, 0.01, 0.003
"""By which parts of itself a set or one of its sides is enlarged, as long as that is proved."""


class LargestSet(NamedTuple):
    """A set from which a specification is proved.

    Attributes:
        region: the set.
        verdict: the proof of it.
    """

    region: Kind
    verdict: Verdict


@once_positional("goal", "safe", "avoid")
@logged
@lenient
def largest_set(
    loop: ClosedLoop,
    X0: Kind,
    horizon: int,
    *,
    goal: Timed | None = None,
    safe: Region | None = None,
    avoid: AvoidSets | None = None,
    rounds: int = 50,
    relaxation: BranchAndCut = BranchAndCut(),  # noqa: B008  (immutable)
    start: int = 0,
    time_limit: float | None = None,
    progress: Callable[[Iterable[Any]], Iterable[Any]] | None = None,
) -> LargestSet:
    """A box or an ellipsoid, as large as is found, from which a specification is proved.

    Args:
        loop: the closed loop.
        X0: where to begin: a set of the kind that is wanted. To go on with what an earlier call
            found, give its `region`. Sides of a box that are flat stay as they are.
        horizon: the number of steps.
        goal: where every state must be at the horizon; or a mapping from times, or from ranges of
            times, to where it must be then.
        safe: where every state must be at all times.
        avoid: closed sets in which no state may be: a sequence for all times, or a mapping from
            times, or from ranges of times, to sequences.
        rounds: steps of the ascent by affine forms.
        relaxation: how many linear programs a bound may take: most of the time goes into the last
            few percents.
        start: the time of the initial set.
        time_limit: seconds, after which what is proved by then is returned.
        progress: wraps the iteration over sets that are tried, such as `tqdm.tqdm`.

    Returns:
        The set and its proof. A side that nothing limits is a million times as long as that of
        `X0`, and no longer.

    Raises:
        Interrupted: Ctrl-C; its `found` is the largest set so far.
        RuntimeError: JAX's 64-bit floats are off.
        TypeError: an argument is of another kind.
        ValueError: nothing is required, dimensions disagree, a time is beyond the horizon, or
            nothing is proved from the center of `X0`, or before the time is over.

    Example:
        >>> from reachjax import MLP, AffinePlant
        >>> net = MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
        >>> loop = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net, Box([-1.0], [1.0]))
        >>> found = largest_set(loop, Box([0.0], [1.0]), 2, goal=Box([-1.0], [2.0]))
        >>> found.region.upper.round(1).tolist(), found.verdict.status.name
        ([4.0], 'PROVED')
    """
    require_kind("loop", loop, ClosedLoop, "a ClosedLoop")
    require_kind("X0", X0, (Box, Ellipsoid), "a Box or an Ellipsoid")
    require_kind("relaxation", relaxation, BranchAndCut, "a BranchAndCut")
    require_double_precision(loop=loop, X0=X0)
    whole_number("rounds", rounds, 0)
    loop.check_horizon(horizon, start)
    require_bar(progress)
    loop, X0 = known_numbers("largest_set", loop, X0, "X0")
    required = requirements(
        loop.states, horizon, period_of(loop), goal=goal, safe=safe, avoid=avoid
    )

    def decided(region: Kind) -> Verdict:
        limits = {
            "relaxation": dataclasses.replace(relaxation, cells=1),  # what is tried fails often
            "start": start,
            "samples": 200,
            "time_limit": budget.share(TURN).limit,
        }
        return decide(loop, region, horizon, goal=goal, safe=safe, avoid=avoid, **limits)

    budget = Budget.of(time_limit)
    search = _Search(loop, X0, required, horizon, start, decided, budget)
    try:
        for _ in wrapped(progress, search.tried(rounds)):
            if budget.late:
                break
    except KeyboardInterrupt:
        if search.best is None:
            raise
        message = (
            "interrupted: this exception's `found` is the largest set so far, and "
            "largest_set(loop, found.region, ...) goes on"
        )
        raise Interrupted(message, search.best) from None
    if search.best is None:
        if budget.late:
            raise ValueError(
                f"nothing is proved yet after time_limit={time_limit} seconds: give more of them"
            )
        raise ValueError(
            "nothing is proved around the center of X0: give another one, or see "
            "reachjax.winning_set for where to begin"
        )
    return search.best


class _Search:
    """The largest set that is proved so far.

    Attributes:
        best: it; None as long as there is none.
    """

    def __init__(
        self,
        loop: ClosedLoop,
        X0: Kind,
        required: list[Requirement],
        horizon: int,
        start: int,
        decided: Callable[[Kind], Verdict],
        budget: Budget,
    ):
        self._decided, self._budget = decided, budget
        self._shape = Shape.of(X0)
        self._farthest = FARTHEST * self._shape.lengths
        self._margins = _margins(loop, required, horizon, start)
        self.best: LargestSet | None = None

    def tried(self, rounds: int) -> Iterator[float]:
        """The volumes of sets that are tried."""
        yield from self._shrunk()
        if self.best is None or not self._shape.sides:
            return
        yield from self._climbed(rounds)
        yield from self._grown()

    def _attempt(self, shape: Shape) -> bool:
        """Whether a set is proved; it is the best one then."""
        if self._too_long(shape):
            return False
        try:
            region = shape.set()
        except ValueError:  # it is none
            return False
        verdict = self._decided(region)
        if verdict.status is not VerdictStatus.PROVED:
            return False
        self._shape, self.best = shape, LargestSet(region, verdict)
        return True

    def _too_long(self, shape: Shape) -> bool:
        """Whether a side is longer than any shall be."""
        return bool(np.any(shape.lengths > self._farthest))

    def _shrunk(self) -> Iterator[float]:
        for _ in range(SMALLEST):
            found = self._attempt(self._shape)
            yield self._shape.volume()
            if found:
                return
            self._shape = self._shape.enlarged(-0.5)

    def _climbed(self, rounds: int) -> Iterator[float]:
        """Climb along the gradient of affine forms, whose margins stay positive."""
        shape, weight, length, budget = self._shape, BARRIER, LONGEST, self._budget.share(1 / 2)

        def value(shape: Shape, weight: float) -> float:
            margins = np.full(1, -np.inf) if budget.late else self._margins(shape)
            if not np.all(margins > 0):
                return -np.inf
            return shape.log_volume() + weight * float(np.log(margins).sum())

        for _ in range(SMALLEST):
            if np.isfinite(value(shape, weight)):
                break
            shape = shape.enlarged(-0.2)
        else:
            return
        for _ in range(rounds):
            here = value(shape, weight)
            along = shape.uphill(partial(value, weight=weight), here)
            if budget.late:
                break
            while length > SHORTEST:
                other = shape.moved(along, length)
                better = value(other, weight) > here  # not if it is no number
                if better and not self._too_long(other):
                    shape, length = other, min(2 * length, LONGEST)
                    break
                length /= 2
            weight, length = SOFTER * weight, max(length, 4 * SHORTEST)
            yield shape.volume()
        if shape.volume() > self._shape.volume():
            self._attempt(shape)
            yield shape.volume()

    def _grown(self) -> Iterator[float]:
        """Enlarge the set as a whole, then side by side."""
        for by in GROWTHS:
            while self._attempt(self._shape.enlarged(by)):
                yield self._shape.volume()
                if self._budget.late:
                    return
            for side in self._shape.sides:
                while self._attempt(self._shape.extended(side, by)):
                    yield self._shape.volume()
                yield self._shape.volume()


def _margins(
    loop: ClosedLoop, required: list[Requirement], horizon: int, start: int
) -> Callable[[Shape], Float[np.ndarray, " r"]]:
    """The margins of all requirements by affine forms, as a function of a shape."""
    facets = [[np.asarray(part) for part in item.region.facets_in_units()] for item in required]
    rows = [C / norms[:, None] for C, _, norms in facets] + [np.eye(loop.states)]
    directions = np.unique(np.concatenate([*rows, *(-each for each in rows)]), axis=0)
    on_host, rows_of = in_numpy(loop), np.tile(directions, (horizon, 1, 1))
    between = parts_of_periods(required)

    def margins(shape: Shape) -> Float[np.ndarray, " r"]:
        try:
            region = in_numpy(shape.set())
            box = in_numpy(region.bounding_box())
            steps = [*unrolled(on_host, region, box, rows_of, start, between=between)]
            offsets = [shape.support(directions), *(step.offsets for step in steps)]
            spans = [offsets[0], *(step.between for step in steps)]
        except ValueError:  # a unit has no bounds, or there is no set
            return np.full(1, -np.inf)
        found = []
        for item, (C, d, norms) in zip(required, facets, strict=True):
            rows, limits = C / norms[:, None], d / norms
            known = np.atleast_2d((spans if item.throughout else offsets)[item.time])
            if item.inside:
                found.append(limits - known[:, _places(directions, rows)].max(axis=0))
            else:
                room = -known[:, _places(directions, -rows)] - limits
                found.append(room.max(axis=1).min(keepdims=True))
        return np.concatenate(found)

    return margins


def _places(directions: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Which of the directions each row is."""
    return np.array([np.argmax((directions == row).all(axis=1)) for row in rows])
