"""Clipping to an interval, as two layers of rectified linear units (the paper's (proj_NN)).

`v = max(y - lower, 0) + lower`, then `z = upper - max(upper - v, 0)`.
"""

from __future__ import annotations

from typing import Any

from jaxtyping import Array

from reachjax.loops.units.base import AtUnit
from reachjax.loops.units.relu import ReLU


def clipped(y: Any, lower: Array | float, upper: Array | float, unit: AtUnit) -> Any:
    """`y` brought into `[lower, upper]`, for any kind of number.

    Args:
        y: `(k,)`.
        lower: `(k,)`, or one for all.
        upper: `(k,)`, or one for all.
        unit: what is done at a unit.

    Example:
        >>> import jax.numpy as jnp
        >>> from reachjax.loops.units import evaluate
        >>> clipped(jnp.array([-3.0, 0.5, 2.0]), -1.0, 1.0, evaluate).tolist()
        [-1.0, 0.5, 1.0]
    """
    v = unit(ReLU(), y - lower) + lower
    return upper - unit(ReLU(), upper - v)
