"""Many trajectories at once on the host, in numpy: nothing is compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from reachjax.loops.closed_loop import ClosedLoop
from reachjax.loops.units import AbstractUnit
from reachjax.numerics.numbers import AbstractNumber


class Batch(AbstractNumber):
    """The values of `k` numbers at `c` points, as `(c, k)`: a kind of number.

    In a branch that most points do not take these stand for one another, and it is computed once
    for all of them.

    Args:
        own: `(m, k)`, the values at points that differ.
        rows: `(c,)`, which of these each point has; None: its own.
    """

    def __init__(self, own: Float[np.ndarray, "m k"], rows: Int[np.ndarray, " c"] | None = None):
        self._own, self._rows = own, rows

    @property
    def values(self) -> Float[np.ndarray, "c k"]:
        """The values at all points."""
        return self._own if self._rows is None else self._own[self._rows]

    def __len__(self) -> int:
        return self._own.shape[1]

    def __rmatmul__(self, matrix: Any) -> Batch:
        return Batch(self._own @ np.asarray(matrix).T, self._rows)

    def __add__(self, other: Any) -> Batch:
        if isinstance(other, Batch):
            return _together(np.add, self, other)
        return Batch(np.add(self._own, other), self._rows)

    def __neg__(self) -> Batch:
        return Batch(-self._own, self._rows)

    def __sub__(self, other: Any) -> Batch:
        if isinstance(other, Batch):
            return _together(np.subtract, self, other)
        return Batch(np.subtract(self._own, other), self._rows)

    def __rsub__(self, other: Any) -> Batch:
        return Batch(np.subtract(other, self._own), self._rows)

    def __rmul__(self, factor: Any) -> Batch:
        return Batch(self._own * factor, self._rows)

    def __getitem__(self, index: Any) -> Batch:
        return Batch(self._own[:, index], self._rows)

    def widened(self, by: Any) -> Batch:
        """The numbers as they are: values know nothing of errors."""
        return self

    def flowed(self, flow: Any, given: tuple[Any, ...], unit: Callable[..., Any]) -> Any:
        """The state after one period of a flow, simulated."""
        return flow.simulated(given, unit)

    def _standing(self, idle: Bool[np.ndarray, " c"]) -> Batch:
        """One point standing for all that are idle."""
        values = self.values
        different = np.append(np.flatnonzero(~idle), np.flatnonzero(idle)[0])
        rows = np.full(len(values), len(different) - 1)
        rows[~idle] = np.arange(len(different) - 1)
        return Batch(values[different], rows)

    @staticmethod
    def evaluated(unit: AbstractUnit, y: Batch, *others: Batch) -> Batch:
        """What a layer of units makes of numbers."""
        if others:
            return _together(unit, y, *others)
        idle = unit.idle(lambda: y.values)
        if idle is not None and np.count_nonzero(idle) > 1:
            y = y._standing(idle)
        own: Any = y._own
        return Batch(np.asarray(unit(own)), y._rows)


def _together(function: Callable[..., Any], *given: Any) -> Batch:
    """A function of numbers, computed once for points that stand for one another in all of them."""
    batches = [each for each in given if isinstance(each, Batch)]
    rows = batches[0]._rows
    if any(each._rows is not rows for each in batches):
        rows = None
        given = tuple(each.values if isinstance(each, Batch) else each for each in given)
    parts = [each._own if isinstance(each, Batch) else each for each in given]
    return Batch(np.asarray(function(*parts)), rows)


PARTS = tuple(k / 8 for k in range(1, 8))
"""At these parts of a period states in between samples are looked at."""


def in_between(
    loop: ClosedLoop,
    states: Float[np.ndarray, "c n_x"],
    following: Float[np.ndarray, "c n_x"],
    t: int,
    disturbances: Float[np.ndarray, "c n_w"] | None = None,
    noises: Float[np.ndarray, "c n_x"] | None = None,
) -> Float[np.ndarray, "s c n_x"]:
    """States in between two samples, as the cubic with the right ends and derivatives has them.

    Args:
        loop: of numpy arrays, with a differential equation for a plant.
        states: at a sample.
        following: at the next one.
        t: the time of the former.
        disturbances: those of the period, of a loop that has some.
        noises: the same.
    """
    plant: Any = loop.plant
    w, v = (None if part is None else Batch(part) for part in (disturbances, noises))
    begun, u = plant.beginning(Batch(states), loop.input(Batch(states), t, Batch.evaluated, v))
    states = begun.values
    others, period = [u] if w is None else [u, w], float(plant.period)
    first, last = (
        period * plant.flow_at(time).rate((Batch(x), *others), Batch.evaluated).values
        for time, x in ((t, states), (t + 1, following))
    )
    found = []
    for s in PARTS:
        ends = (1 - s) ** 2 * (1 + 2 * s) * states + s**2 * (3 - 2 * s) * following
        found.append(ends + s * (1 - s) ** 2 * first - s**2 * (1 - s) * last)
    return np.stack(found)


def trajectories(
    loop: ClosedLoop,
    states: Float[np.ndarray, "c n_x"],
    disturbances: Float[np.ndarray, "c h n_w"] | None = None,
    noises: Float[np.ndarray, "c h n_x"] | None = None,
    *,
    horizon: int,
    start: int = 0,
) -> Float[np.ndarray, "c h+1 n_x"]:
    """Trajectories from many initial states, these included.

    Args:
        loop: of numpy arrays.
        states: where they begin.
        disturbances: those of each step, of a loop that has some.
        noises: the same.
        horizon: the number of steps.
        start: the time of the initial states.

    Example:
        >>> import jax
        >>> from reachjax import MLP, AffinePlant
        >>> net = MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
        >>> loop = jax.device_get(ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net))
        >>> trajectories(loop, np.array([[1.0], [-1.0]]), horizon=1)[:, 1].tolist()
        [[0.6], [-0.6]]
    """
    found, batch = [states], Batch(states)
    with np.errstate(all="ignore"):  # what overflows is no trajectory
        for k in range(horizon):
            w, v = (None if part is None else Batch(part[:, k]) for part in (disturbances, noises))
            batch = loop.step(batch, start + k, Batch.evaluated, w, v)
            found.append(batch.values)
    return np.stack(found, axis=1)
