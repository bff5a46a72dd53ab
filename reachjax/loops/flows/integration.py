"""Solutions of differential equations by extrapolation, for simulations: nothing is proved.

The explicit midpoint rule has an error in even powers of its step, so the results of 2, 4, 6 and 8
steps give one of order eight (Gragg 1965; Bulirsch, Stoer, Numerische Mathematik 1966).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax

COUNTS = (2, 4, 6, 8)
"""Steps whose results are extrapolated."""


def integrated(rate: Callable[[Any], Any], x: Any, h: Any, steps: int) -> Any:
    """The solution of `x' = rate(x)` after a time `h`.

    Args:
        rate: of numbers.
        x: the first state, numbers with affine arithmetic.
        h: how long it goes.
        steps: of order eight each.
    """
    part = h / steps

    def step(_: int, x: Any) -> Any:
        found: list[Any] = []
        for row, count in enumerate(COUNTS):
            column = _midpoints(rate, x, part, count)
            for k in range(row):
                ratio = (count / COUNTS[row - 1 - k]) ** 2 - 1
                found[k], column = column, column + (1 / ratio) * (column - found[k])
            found.append(column)
        return found[-1]

    return _repeated(steps, step, x)


def _midpoints(rate: Callable[[Any], Any], x: Any, h: Any, count: int) -> Any:
    """So many steps of the midpoint rule, smoothed at the end."""
    part = h / count

    def step(_: int, pair: tuple[Any, Any]) -> tuple[Any, Any]:
        before, here = pair
        return here, before + (2 * part) * rate(here)

    before, here = _repeated(count - 1, step, (x, x + part * rate(x)))
    return 0.5 * (before + here + part * rate(here))


def _repeated(count: int, step: Callable[[int, Any], Any], first: Any) -> Any:
    """A step done so often: compiled once, if numbers are of JAX."""
    if count > 1 and all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(first)):
        return jax.lax.fori_loop(0, count, step, first)
    for k in range(count):
        first = step(k, first)
    return first
