"""Seals: what was proved together stays together.

A tube's sets hold for its own loop, initial set and start, and for nothing else. Its seal is a hash
of all of it, taken when it was computed. Where anything is changed or exchanged, by whatever means,
the seal does not fit, and nothing is decided from the tube.
"""

from __future__ import annotations

import abc
import hashlib
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, UInt8

from reachjax.numerics.checks import is_concrete
from reachjax.numerics.host import on_host

Seal = UInt8[Array, " 32"]

SIZE = 32
"""Bytes: two trees never have one seal."""


class AbstractSealed(abc.ABC):
    """A tree of which names and numbers need not say what it computes."""

    @abc.abstractmethod
    def equations(self) -> str:
        """What it computes, as far as its structure does not say so; the same in any process."""


def seal_of(*parts: Any, start: int = 0) -> Seal:
    """The hash of trees of arrays: of their structure, of every bit of their numbers, of equations.

    Works inside `jax.jit` and `vmap` too, where it costs nothing if it is not used.

    Args:
        parts: trees of arrays.
        start: the time that they begin at.

    Example:
        >>> before = seal_of({"W": jnp.array([1.0, 2.0])})
        >>> bool((before == seal_of({"W": jnp.array([1.0, 2.0])})).all())
        True
        >>> bool((before == seal_of({"W": jnp.array([1.0, 2.0 + 4e-16])})).all())
        False
    """
    fixed = parts if is_concrete(parts) else jax.lax.stop_gradient(parts)
    leaves, structure = jax.tree.flatten(fixed)
    # an object that does not say what it is, is called by its address: not so in another process
    named = re.sub(r" at 0x[0-9a-f]+", "", f"{structure}, start={start}")
    named += "".join(part.equations() for part in parts if isinstance(part, AbstractSealed))

    def digest(leaves: list[np.ndarray]) -> np.ndarray:
        found = hashlib.blake2b(named.encode(), digest_size=SIZE)
        for leaf in map(np.asarray, leaves):
            found.update(f"{leaf.dtype.str}{leaf.shape}".encode())
            found.update(np.ascontiguousarray(leaf).reshape(-1).view(np.uint8).data)
        return np.frombuffer(found.digest(), np.uint8)

    if is_concrete(leaves):
        return jax.device_put(digest(leaves))
    return on_host(digest, jax.ShapeDtypeStruct((SIZE,), jnp.uint8), leaves)


def require_sealed(name: str, seal: Seal | None, *parts: Any, start: int = 0) -> None:
    """Raise an error unless the parts are those that were sealed; nothing where they are traced.

    Raises:
        ValueError: there is no seal, or it is that of something else.
    """
    if not is_concrete(seal, parts):
        return
    if seal is None or not np.array_equal(seal, seal_of(*parts, start=start)):
        raise ValueError(
            f"the parts of {name} are not those that were computed together, and what was proved "
            "is true of these only: call reach (or reach_partitioned) again with what has changed"
        )
