"""The hard hyperbolic tangent, `z = min(max(y, -1), 1)`: two rectified linear units, one by one."""

from __future__ import annotations

import dataclasses
from typing import Any

from reachjax.loops.units.base import AbstractActivation, AtUnit
from reachjax.loops.units.clip import clipped


@dataclasses.dataclass(frozen=True)
class HardTanh(AbstractActivation):
    """`y` clipped to `[-1, 1]`.

    Example:
        >>> import jax.numpy as jnp
        >>> HardTanh()(jnp.array([-3.0, 0.5, 2.0])).tolist()
        [-1.0, 0.5, 1.0]
    """

    def propagate(self, y: Any, unit: AtUnit) -> Any:
        """The clipping, at whose units `unit` is done."""
        return clipped(y, -1.0, 1.0, unit)
