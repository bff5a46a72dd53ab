"""A training as a file holds it, from which the same call goes on."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reachjax.loops import ClosedLoop
from reachjax.numerics.seals import Seal, seal_of
from reachjax.numerics.storage import read, write
from reachjax.sets import Box
from reachjax.training.history import Epoch
from reachjax.training.steps import Specification


class Kept(NamedTuple):
    """What a file holds of a training.

    Attributes:
        seal: of what it is told from others by.
        weights: the controller's arrays.
        optimizer: the numbers of the optimizer's state.
        examples: initial states of counterexamples.
        stage: the number of the stage, from 0.
        begun: the epoch that it began with.
        epochs: so far.
        gained: by what part of it the last one of a proved controller lowered its loss.
        proof_seconds: those that the last proof took; zero before.
    """

    seal: Any
    weights: tuple[Any, ...]
    optimizer: tuple[Any, ...]
    examples: Any
    stage: int
    begun: int
    epochs: tuple[Epoch, ...]
    gained: float
    proof_seconds: float


def training_seal(loop: ClosedLoop, X0: Box, spec: Specification, state: Any) -> Seal:
    """What a training is told from others by.

    Args:
        loop: as it was given.
        X0: the initial set.
        spec: what is required.
        state: of the optimizer, whose kinds and shapes count.
    """
    shapes = [np.shape(leaf) for leaf in jax.tree.leaves(state)]
    words = repr((spec.key, str(jax.tree.structure(state)), shapes))
    return seal_of(loop, X0, np.frombuffer(words.encode(), np.uint8))


def write_kept(path: Path, kept: Kept) -> None:
    """Write a file.

    Raises:
        OSError: it cannot be written.
    """
    write(path, kept, outside=ClosedLoop)


def read_kept(path: Path, seal: Seal, stages: int) -> Kept:
    """What a file holds.

    Args:
        path: of the file.
        seal: of the training that is to go on.
        stages: how many it has.

    Raises:
        UnreadableError: it is none of such files.
        ValueError: it is of another training.
    """
    kept = read(path, None, "holds no training")
    if not (isinstance(kept, Kept) and np.array_equal(kept.seal, seal) and kept.stage < stages):
        raise ValueError(
            f"path must be that of a training of this loop, from this X0, for these requirements, "
            f"by an optimizer of this kind in as many stages, but {path} is of another one: name "
            "another file, or remove it"
        )
    return kept


def numbers_of(state: Any) -> tuple[np.ndarray, ...]:
    """The numbers of an optimizer's state, of kinds that files hold: keys are their data."""
    return tuple(_numbers(jnp.asarray(leaf)) for leaf in jax.tree.leaves(state))


def state_from(state: Any, numbers: tuple[Any, ...]) -> Any:
    """A state like one of an optimizer, with these numbers."""
    leaves, structure = jax.tree.flatten(state)
    pairs = zip(map(jnp.asarray, leaves), numbers, strict=True)
    return jax.tree.unflatten(structure, [_like(leaf, each) for leaf, each in pairs])


def _is_key(leaf: jax.Array) -> bool:
    """Whether an array holds keys of random numbers."""
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _numbers(leaf: jax.Array) -> np.ndarray:
    if _is_key(leaf):
        return np.asarray(jax.random.key_data(leaf))
    floats = jnp.issubdtype(leaf.dtype, jnp.floating)
    return np.asarray(leaf, dtype=float if floats else None)


def _like(leaf: jax.Array, numbers: Any) -> jax.Array:
    if _is_key(leaf):
        return jax.random.wrap_key_data(jnp.asarray(numbers), impl=jax.random.key_impl(leaf))
    return jnp.asarray(numbers, dtype=leaf.dtype)
