"""Continuous affine plants, `dx/dt = A x + B u + c`, sampled with a constant input in between.

With `M = [A B c; 0 0 0]` the state and the input after a time `h` are `exp(h M) [x, u, 1]`. The
zero-order hold is exact; one step of the classical Runge-Kutta method is its Taylor polynomial of
degree four.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax.scipy.linalg import expm
from jaxtyping import Array, ArrayLike, Float

from reachjax.loops.plants import AffinePlant
from reachjax.numerics.checks import is_concrete, real_number
from reachjax.numerics.flags import lenient

RUNGE_KUTTA_DEGREE = 4


@lenient
def zero_order_hold(
    A: Float[ArrayLike, "n n"],
    B: Float[ArrayLike, "n m"],
    c: Float[ArrayLike, " n"] | None = None,
    *,
    period: float,
) -> AffinePlant:
    """The sampled plant, exactly (the matrix exponential); differentiable in A, B and c.

    Args:
        A: `(n_x, n_x)`, per unit of time.
        B: `(n_x, n_u)`, per unit of time.
        c: `(n_x,)`, per unit of time; zero when left out.
        period: the sampling period, in units of time.

    Raises:
        TypeError: an argument is not numeric.
        ValueError: shapes disagree, an entry is not finite, the period is not above 0, or the
            sampled plant overflows.

    Example:
        >>> plant = zero_order_hold([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], period=0.5)
        >>> plant.A.tolist(), plant.B.tolist()
        ([[1.0, 0.5], [0.0, 1.0]], [[0.125], [0.5]])
    """
    continuous = _continuous(A, B, c, period)
    return _sampled(continuous, expm(period * _generator(continuous)))


@lenient
def runge_kutta(
    A: Float[ArrayLike, "n n"],
    B: Float[ArrayLike, "n m"],
    c: Float[ArrayLike, " n"] | None = None,
    *,
    period: float,
) -> AffinePlant:
    """The plant sampled by one classical Runge-Kutta step; differentiable in A, B and c.

    Args:
        A: `(n_x, n_x)`, per unit of time.
        B: `(n_x, n_u)`, per unit of time.
        c: `(n_x,)`, per unit of time; zero when left out.
        period: the sampling period, in units of time.

    Raises:
        TypeError: an argument is not numeric.
        ValueError: shapes disagree, an entry is not finite, the period is not above 0, or the
            sampled plant overflows.

    Example:
        >>> plant = runge_kutta([[-1.0]], [[1.0]], period=1.0)
        >>> round(float(plant.A[0, 0]), 6)  # 1 - 1 + 1/2 - 1/6 + 1/24
        0.375
    """
    continuous = _continuous(A, B, c, period)
    step = period * _generator(continuous)
    term = total = jnp.eye(len(step))
    for k in range(1, RUNGE_KUTTA_DEGREE + 1):
        term = term @ step / k
        total = total + term
    return _sampled(continuous, total)


def _continuous(A: Any, B: Any, c: Any, period: float) -> AffinePlant:
    """The three matrices, checked as those of a plant are."""
    plant = AffinePlant(A, B, c)
    if plant.steps is not None:
        raise ValueError("A, B and c must be constant to be sampled, but a time axis arrived")
    if real_number("period", period, 0.0) == 0:
        raise ValueError("period must be above 0, but 0 arrived")
    return plant


def _generator(plant: AffinePlant) -> Float[Array, "k k"]:
    size = plant.states + plant.inputs + 1
    rows = jnp.hstack([plant.A, plant.B, plant.c[:, None]])
    return jnp.zeros((size, size)).at[: plant.states].set(rows)


def _sampled(plant: AffinePlant, transition: Float[Array, "k k"]) -> AffinePlant:
    n, m = plant.states, plant.inputs
    if is_concrete(transition) and not jnp.isfinite(transition).all():
        raise ValueError("the sampled plant overflows: A times the period is too large")
    return AffinePlant(transition[:n, :n], transition[:n, n : n + m], transition[:n, -1])
