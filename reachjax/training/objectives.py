"""What training lowers besides the task's loss: requirements that trajectories or forms miss.

An objective is any function of a `TrainingBatch` with one number for a result. All that is computed
is of the batch's loop, whose controller is being trained, and of cells of its initial set. Nothing
here proves anything: rounding is left out where that is cheaper.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.loops import ClosedLoop
from reachjax.numerics.checks import real_number, whole_number
from reachjax.numerics.pytrees import Replaceable
from reachjax.programs.unrolled import unrolled_at_once
from reachjax.sets import Box
from reachjax.verdicts.facet_rows import FacetRowsByTime
from reachjax.verdicts.specification import Requirement

BETWEEN = 4
"""So many states of a period are simulated where requirements hold at all times."""

COLUMNS_IN_TRAINING = 16
"""Forms keep so many columns of earlier steps, or four a state where these are more."""


@dataclasses.dataclass(frozen=True)
class TrainingBatch:
    """What an objective is computed of at one step of training.

    Attributes:
        loop: the closed loop under the controller as it is.
        lower: `(c, n_x)`, corners of cells of the initial set.
        upper: `(c, n_x)`.
        states: `(b, n_x)`, initial states: drawn from the cells, and those of counterexamples.
        horizon: the number of steps.
        start: the time of the initial states.
        required: the requirements.
        margin: how far they should be from failing, in the units of the state.
    """

    loop: ClosedLoop
    lower: Float[Array, "c n_x"]
    upper: Float[Array, "c n_x"]
    states: Float[Array, "b n_x"]
    horizon: int
    start: int
    required: tuple[Requirement, ...]
    margin: float

    @property
    def throughout(self) -> bool:
        """Whether something is required in between samples."""
        return any(item.throughout for item in self.required)

    def missed(self, rooms: Iterator[tuple[bool, Float[Array, "*k"]]]) -> Float[Array, ""]:
        """The sum of `max(0, margin - room)`, where one of a set's facets will do to be outside.

        Args:
            rooms: of requirements whether they are to be inside, and how far each facet is, along
                the last axis those of one set.
        """
        total = jnp.zeros(())
        for inside, room in rooms:
            least = room if inside else jnp.max(room, axis=-1)
            total += jnp.sum(jnp.maximum(0.0, self.margin - least))
        return total


@dataclasses.dataclass(frozen=True)
class Simulated(Replaceable):
    """By how much simulated trajectories miss the requirements: the worst of them at each facet.

    Of a differential equation states in between samples count too. Disturbances and noise are in
    the middle of their sets. An adversary of this kind proves nothing, and costs least.
    """

    def __call__(self, batch: TrainingBatch) -> Float[Array, ""]:
        """The sum over facets, times and sets that are to be avoided."""
        parts = BETWEEN if batch.throughout else 1
        runs = batch.loop.simulate(batch.states, batch.horizon, batch.start, parts=parts)

        def rooms() -> Iterator[tuple[bool, Array]]:
            for item in batch.required:
                C, d, norms = item.region.facets_in_units(item.inside)
                last = item.time * parts
                seen = runs[:, last - parts + 1 if item.throughout else last : last + 1]
                room = (d - seen @ C.T) / norms
                if item.inside:
                    yield True, room.min(axis=(0, 1))
                else:  # each trajectory by the facet that it is farthest beyond
                    yield False, jnp.max(-room, axis=-1).min()[None]

        return batch.missed(rooms())


@dataclasses.dataclass(frozen=True)
class Certified(Replaceable):
    """By how much affine forms over cells miss the requirements: zero where they prove them.

    The bounds are those by which `decide` proves cells, at all times of a differential equation.

    Args:
        remainder: weight of how much wider forms are than what is simulated from the corners and
            the middle of each cell, on average over the directions that prove the requirements: of
            that it depends into how many cells a set has to be cut.

    Raises:
        TypeError, ValueError: the weight is no number, or negative.
    """

    remainder: float = 0.0

    def __post_init__(self):
        self._set(remainder=real_number("Certified.remainder", self.remainder, 0.0))

    def __call__(self, batch: TrainingBatch) -> Float[Array, ""]:
        """The mean over the cells."""
        loop, steps = batch.loop, batch.horizon
        with jax.ensure_compile_time_eval():  # requirements are known numbers
            by_time = FacetRowsByTime.of(batch.required, steps, loop.states, refuting=False)
        rows, directions, whole = by_time
        limits, units = np.zeros(whole.shape), np.ones(whole.shape)
        inside, outside = np.zeros(whole.shape, bool), dict[tuple[int, int], Any]()
        for each in rows:
            here, ends = (each.item.time, each.proving), (each.first, each.proving.stop)
            limits[here], units[here] = each.limits[: len(each.units)], each.units
            if each.item.inside:
                inside[here] = True
            else:
                outside.setdefault(ends, np.zeros((steps + 1, 1), bool))[each.item.time] = True
        kept = {"between": by_time.parts, "counted": False, "columns": COLUMNS_IN_TRAINING}

        def of_cell(lower: Array, upper: Array) -> Array:
            box, later = Box(lower, upper), jnp.asarray(directions[1:])
            found = unrolled_at_once(loop, box, box, later, batch.start, **kept)
            bounds = found.offsets[:, None]
            if found.between is not None:
                bounds = jnp.where(whole[1:, None], found.between, bounds)
            first = jnp.maximum(directions[0] * lower, directions[0] * upper).sum(axis=1)
            first = jnp.broadcast_to(first, (1, *bounds.shape[1:]))
            room = (limits[:, None] - jnp.concatenate([first, bounds])) / units[:, None]

            def rooms() -> Iterator[tuple[bool, Array]]:
                yield True, jnp.where(inside, room.min(axis=1), jnp.inf)
                for (first, last), times in outside.items():  # in each part by its own facet
                    apart = room[:, :, first:last].max(axis=2).min(axis=1, keepdims=True)
                    yield False, jnp.where(times, apart, jnp.inf)

            return batch.missed(rooms()) + self._wider(batch, box, found.offsets, later)

        return jnp.mean(jax.vmap(of_cell)(batch.lower, batch.upper))

    def _wider(
        self,
        batch: TrainingBatch,
        box: Box,
        offsets: Float[Array, "N m"],
        directions: Float[Array, "N m n_x"],
    ) -> Float[Array, ""] | float:
        """The weighed mean of how much forms are wider than what corners and the middle attain."""
        if not self.remainder:
            return 0.0
        states = jnp.concatenate([box.vertices(), box.center[None]])
        runs = batch.loop.simulate(states, batch.horizon, batch.start)[:, 1:]
        attained = jnp.einsum("cti,tmi->ctm", runs, directions).max(axis=0)
        return self.remainder * jnp.mean(jnp.maximum(0.0, offsets - attained))


@dataclasses.dataclass(frozen=True)
class Stage(Replaceable):
    """A part of training: what it lowers, and how finely the initial set is cut for that.

    It ends when its objective is zero and the controller is still not proved, when no step of an
    epoch has a finite gradient, or after some epochs. The last one does not end by itself.

    Args:
        objective: of a `TrainingBatch`, one number; such as `Simulated()` or `Certified()`.
        cells: into how many cells the initial set is cut, the worst of which are trained on.
        epochs: how many there are at most, if stages come after it.

    Raises:
        TypeError, ValueError: the objective is no function, or a number is none, or below 1.
    """

    objective: object
    cells: int = 1
    epochs: int = 20

    def __post_init__(self):
        if not callable(self.objective):
            raise TypeError(
                "Stage.objective must be a function of a TrainingBatch, such as Certified(), but "
                f"{self.objective!r} arrived"
            )
        self._set(
            cells=whole_number("Stage.cells", self.cells, 1),
            epochs=whole_number("Stage.epochs", self.epochs, 1),
        )
