"""Newton's method for a barrier function, from one weight to the next."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from reachjax.numerics.budget import ENDLESS, TimeOverError, clock
from reachjax.solvers.barrier import EllipsoidBarrier

FROM_AFAR = (10.0, 3.0, 1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001, 3e-4, 1e-4, 1e-5)
"""Weights to begin with far from the path. Measured with every neuron kept: the first takes some 60
Newton steps and each of the others about ten; beginning at 0.1 takes 200."""

PRICES = (10.0, 100.0, 1000.0)
"""Prices of `t` that are tried, in units of the sizes of basis and successor
(`EllipsoidBarrier.unit`). The trace of moments stays below the price; with many neurons kept, 1 was
seen to be too low by half."""

MOST_MULTIPLIERS = 1500
"""Multipliers beyond which no path is followed: a step costs their cube."""

NEWTON_STEPS = 200
"""Newton steps after which the centre counts as not found."""

CENTRED = 1e-8
"""The squared Newton decrement, in units of `mu`, at which it is found."""

STAGNANT = 1e-3
"""So it is below this one if another step does not halve it: rounding moves multipliers along
directions in which the function is flat."""

QUADRATIC = 0.05
"""The squared decrement, in units of `mu`, below which full Newton steps surely converge."""


class Centre(NamedTuple):
    """A point of the path.

    Attributes:
        y: the minimiser.
        hessian: of the barrier function there.
        weight: `mu`.
    """

    y: np.ndarray
    hessian: np.ndarray
    weight: float


def path_end(
    barrier: EllipsoidBarrier,
    start: Callable[[], np.ndarray | None],
    weights: tuple[float, ...],
    prices: tuple[float, ...] = PRICES,
) -> Centre | None:
    """The last centre that is reached.

    At too low a price `t` stays, and what is found is smaller than the relaxation itself allows.
    """
    for price in prices:
        if clock().late:
            return None
        barrier.price = price
        first = start()
        found = None if first is None else follow(barrier, first, weights)
        # it bounds alone the columns that no product does: of each, the moment takes mu / t
        unit = (1 + barrier.n) * found.weight / barrier.cost[barrier.count] if found else np.inf
        if found is None or found.y[barrier.count] <= unit:
            return found
    return None


def follow(barrier: EllipsoidBarrier, y: np.ndarray, weights: tuple[float, ...]) -> Centre | None:
    """The last centre that is reached, from one weight to the next; None without any."""
    last = None
    for weight in weights:
        centre = minimiser(barrier, y, weight)
        if centre is None:
            break
        last, y = Centre(*centre, weight), centre[0]
    return last


def minimiser(
    barrier: EllipsoidBarrier, y: np.ndarray, weight: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Newton's method from a point inside: the minimiser and the Hessian there."""
    value, before = barrier.value(y, weight), np.inf
    for _ in range(NEWTON_STEPS if np.isfinite(value) else 0):
        if clock().late:
            return None
        try:
            gradient, hessian = barrier.derivatives(y, weight)
        except TimeOverError:
            return None
        step = -solved(hessian, gradient)
        decrement = -float(gradient @ step)
        stagnant = before / 2 < decrement <= STAGNANT * weight
        if decrement <= CENTRED * weight or stagnant:
            better = y + step  # by the square of the decrement; the Hessian is to match
            y = better if np.isfinite(barrier.value(better, weight)) else y
            with ENDLESS.in_force():  # it is found
                return y, barrier.derivatives(y, weight)[1]
        if not np.isfinite(decrement):
            return None
        length, near = 1.0, decrement <= QUADRATIC * weight
        # near the centre, differences of values are not seen: any point inside will do
        while not (
            (after := barrier.value(y + length * step, weight)) <= value - length * decrement / 4
            or (near and np.isfinite(after))
        ):
            length /= 2
            if length < 1e-10:
                return None
        y, value, before = y + length * step, after, decrement
    return None


def solved(hessian: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """`hessian^-1 vector`, scaled to a unit diagonal and regularised at rounding level."""
    scale = 1 / np.sqrt(np.diag(hessian))
    matrix = hessian * np.outer(scale, scale)
    for shift in 1e-14 * 100.0 ** np.arange(4):
        try:
            factor = cho_factor(matrix + shift * np.eye(len(matrix)), check_finite=False)
            break
        except LinAlgError:
            continue
    else:
        return np.full(len(vector), np.nan)
    solution = cho_solve(factor, scale * vector, check_finite=False)
    residual = scale * vector - matrix @ solution  # one step of refinement
    return scale * (solution + cho_solve(factor, residual, check_finite=False))
