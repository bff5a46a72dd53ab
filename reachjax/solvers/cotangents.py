"""What derivatives of a solver's results are asked for."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool


def asked_for(proposal: Any) -> Bool[Array, ""]:
    """Whether a derivative of what a solver proposes is asked for; there is none."""
    parts = [part for part in jax.tree.leaves(proposal) if part.dtype == float]
    return jnp.array([jnp.any(part != 0) for part in parts]).any()
