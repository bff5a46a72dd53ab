"""The one door out of JAX: solvers, linear programs and hulls run in numpy on the host.

Inside `jax.jit` and `jax.vmap` they are reached through `jax.pure_callback`; on plain arrays they
are called as they are. No JAX call is made inside a callback, and only arrays cross.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from reachjax.numerics.checks import is_concrete


def shapes_of(tree: Any) -> Any:
    """The shapes and types of a tree of arrays, as `on_host` wants to know them beforehand."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(np.shape(leaf), leaf.dtype), tree)


def all_finite(tree: Any) -> bool:
    """Whether a tree of numpy arrays holds neither NaN nor infinity."""
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


def on_host(function: Any, shapes: Any, argument: Any) -> Any:
    """`function(argument)` in numpy, for concrete arrays, tracers and batches of either.

    Args:
        function: from a tree of numpy arrays to a tree of numpy arrays, without side effects.
        shapes: the tree of `jax.ShapeDtypeStruct` that it returns.
        argument: a tree of JAX arrays.
    """
    if is_concrete(argument):
        return jax.device_put(function(jax.device_get(argument)))
    core = [leaf.ndim for leaf in jax.tree.leaves(argument)]
    structure = jax.tree.structure(argument)

    def batched(*leaves):
        leaves = [np.asarray(leaf) for leaf in leaves]
        leads = [leaf.shape[: leaf.ndim - k] for leaf, k in zip(leaves, core, strict=True)]
        batch = np.broadcast_shapes(*leads)
        whole = [
            np.broadcast_to(leaf, batch + leaf.shape[len(lead) :])
            for leaf, lead in zip(leaves, leads, strict=True)
        ]
        results = [
            jax.tree.leaves(function(jax.tree.unflatten(structure, [leaf[i] for leaf in whole])))
            for i in np.ndindex(batch)
        ]
        return [
            np.stack(parts).reshape(batch + np.shape(parts[0]))
            for parts in zip(*results, strict=True)
        ]

    flat = jax.pure_callback(
        batched,
        jax.tree.leaves(shapes),
        *jax.tree.leaves(argument),
        vmap_method="expand_dims",
    )
    return jax.tree.unflatten(jax.tree.structure(shapes), flat)
