"""Random vector fields, once for JAX and for numbers of 40 digits, and reference solutions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import mpmath
import numpy as np
from mpmath import mpf

DIGITS = 40
COLUMNS = 10
"""Results that are extrapolated: of order 20."""


class Digits:
    """Functions of numbers of 40 digits, by the names that JAX has for them."""

    sin, cos, exp, tanh = mpmath.sin, mpmath.cos, mpmath.exp, mpmath.tanh
    sqrt, log, arctan = mpmath.sqrt, mpmath.log, mpmath.atan
    arcsinh = mpmath.asinh


@dataclass(frozen=True)
class Field:
    """The right-hand side of `x' = f(x, u, ...)`, over any functions of numbers.

    Attributes:
        states: how many there are.
        of: from functions, and lists of numbers, to a list of numbers.
    """

    states: int
    of: Callable

    def __call__(self, *given):
        """The field, of arrays of JAX."""
        return jnp.stack(self.of(jnp, *given))

    def exact(self, *given):
        """The field, of numbers of 40 digits."""
        return self.of(Digits, *given)


def number(rng: np.random.Generator, low: float = -1.0, high: float = 1.0) -> float:
    """A number of few digits, so that it is the same everywhere."""
    return round(float(rng.uniform(low, high)), 3)


def term(rng: np.random.Generator, kind: str, size: int) -> Callable:
    """A random function of `size` numbers."""
    i, j, k = rng.integers(size, size=3)
    a, b, c = (number(rng) for _ in range(3))
    if kind == "polynomial":
        power = int(rng.integers(1, 4))
        return lambda m, z: a * z[i] * z[j] ** power + b * z[k] * z[k] + c * z[j]
    if kind == "rational":
        return lambda m, z: (
            (a * z[i] + b) / (1.5 + z[j] * z[j] + 0.5 * z[k]) + c / (2.0 + z[i] ** 2)
        )
    if kind == "trigonometric":
        return lambda m, z: m.sin(2 * a * z[i] + z[j]) * m.cos(z[k]) + b * m.arctan(z[j] - c)
    if kind == "exponential":
        return lambda m, z: a * m.exp(b * z[i] - z[j] ** 2) + c * m.tanh(z[k] + z[i])
    return lambda m, z: a * m.sqrt(1.2 + z[i] ** 2) + b * m.log(3.0 + z[j]) * m.arcsinh(c * z[k])


KINDS = "polynomial", "rational", "trigonometric", "exponential", "roots"


def field(rng: np.random.Generator, kind: str, states: int, others: int = 1) -> Field:
    """A random field of a kind, of states and so many other numbers."""
    parts = [[term(rng, kind, states + others) for _ in range(2)] for _ in range(states)]
    shifts = [number(rng) for _ in range(states)]

    def of(m, x, *rest):
        z = [*x, *(each for part in rest for each in part)]
        return [sum((one(m, z) for one in row), b) for row, b in zip(parts, shifts, strict=True)]

    return Field(states, of)


def solution(field: Field, x, others, times, steps: int = 1) -> list[list[mpf]]:
    """States at some times, of constant other arguments: extrapolated midpoints of 40 digits."""
    mpmath.mp.dps = DIGITS
    x, others = [mpf(a) for a in x], [[mpf(a) for a in part] for part in others]
    found, before = [], mpf(0)
    for time in times:
        time = mpf(time) if isinstance(time, mpf) else mpf(float(time))
        for _ in range(steps if time > before else 0):
            x = _extrapolated(field, x, others, (time - before) / steps)
        before = time
        found.append(x)
    return found


def _extrapolated(field: Field, x, others, h):
    rows: list = []
    for row in range(COLUMNS):
        count = 2 * (row + 1)
        part, last, here = h / count, x, None
        rate = field.exact(x, *others)
        here = [a + part * b for a, b in zip(x, rate, strict=True)]
        for _ in range(count - 1):
            rate = field.exact(here, *others)
            last, here = here, [a + 2 * part * b for a, b in zip(last, rate, strict=True)]
        rate = field.exact(here, *others)
        column = [(a + b + part * c) / 2 for a, b, c in zip(last, here, rate, strict=True)]
        for k in range(row):
            ratio = (mpf(count) / (count - 2 * (k + 1))) ** 2 - 1
            new = [a + (a - b) / ratio for a, b in zip(column, rows[k], strict=True)]
            rows[k], column = column, new
        rows.append(column)
    return rows[-1]
