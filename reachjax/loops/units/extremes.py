"""Absolute value, maximum and minimum, by one layer of rectified linear units each."""

from __future__ import annotations

from typing import Any

from reachjax.loops.units.base import AtUnit
from reachjax.loops.units.relu import ReLU


def absolute(y: Any, unit: AtUnit) -> Any:
    """`|y| = 2 max(y, 0) - y`, for any kind of number, with `unit` at the units.

    Example:
        >>> import jax.numpy as jnp
        >>> from reachjax.loops.units import evaluate
        >>> absolute(jnp.array([-3.0, 2.0]), evaluate).tolist()
        [3.0, 2.0]
    """
    return 2.0 * unit(ReLU(), y) - y


def maximum(one: Any, other: Any, unit: AtUnit) -> Any:
    """`max(a, b) = b + max(a - b, 0)`, for any kind of number, with `unit` at the units.

    Example:
        >>> import jax.numpy as jnp
        >>> from reachjax.loops.units import evaluate
        >>> maximum(jnp.array([-3.0, 2.0]), jnp.array([1.0, 1.0]), evaluate).tolist()
        [1.0, 2.0]
    """
    return other + unit(ReLU(), one - other)


def minimum(one: Any, other: Any, unit: AtUnit) -> Any:
    """`min(a, b) = a - max(a - b, 0)`, for any kind of number, with `unit` at the units.

    Example:
        >>> import jax.numpy as jnp
        >>> from reachjax.loops.units import evaluate
        >>> minimum(jnp.array([-3.0, 2.0]), jnp.array([1.0, 1.0]), evaluate).tolist()
        [-3.0, 1.0]
    """
    return one - unit(ReLU(), one - other)
