"""The one door out of JAX: solvers, linear programs and hulls run in numpy on the host.

Inside `jax.jit` and `jax.vmap` they are reached through `jax.pure_callback`; on plain arrays they
are called as they are. No JAX call is made inside a callback, and only arrays cross.

A callback runs on a thread of its own, where JAX rounds all numbers to 32 bits if 64-bit floats are
on only in a scope, `with jax.enable_x64(True)`. So numbers of 64 bits cross as pairs of 32.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from reachjax.numerics.checks import is_concrete
from reachjax.numerics.derivatives import ONLY_FIRST


def shapes_of(tree: Any) -> Any:
    """The shapes and types of a tree of arrays, as `on_host` wants to know them beforehand."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(np.shape(leaf), leaf.dtype), tree)


def in_numpy(tree: Any) -> Any:
    """A tree of known numbers with numpy arrays for leaves.

    A tree that has these already is returned itself: functions in it keep their recordings.
    """
    if all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(tree)):
        return tree
    return jax.device_get(tree)


def all_finite(tree: Any) -> bool:
    """Whether a tree of numpy arrays holds neither NaN nor infinity."""
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


def on_host(function: Any, shapes: Any, argument: Any) -> Any:
    """`function(argument)` in numpy, for concrete arrays, tracers and batches of either.

    Args:
        function: from a tree of numpy arrays to a tree of numpy arrays, without side effects.
        shapes: the tree of `jax.ShapeDtypeStruct` that it returns.
        argument: a tree of JAX arrays.

    Raises:
        TypeError: a derivative through it is asked for. Who calls gives the first one by a rule.
    """
    if is_concrete(argument):
        # copied: a solver may use its arrays again
        return jax.device_put(jax.tree.map(np.array, function(jax.device_get(argument))))
    argument = jax.tree.map(_held, argument)
    core = [leaf.ndim for leaf in jax.tree.leaves(argument)]
    kinds = [leaf.dtype for leaf in jax.tree.leaves(argument)]
    structure = jax.tree.structure(argument)

    def batched(*leaves):
        given = map(np.asarray, leaves)
        leaves = [_joined(leaf, kind) for leaf, kind in zip(given, kinds, strict=True)]
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
        stacked = [
            np.stack(parts).reshape(batch + np.shape(parts[0]))
            for parts in zip(*results, strict=True)
        ]
        return [_halved(part.astype(kind)) for part, kind in zip(stacked, returned, strict=True)]

    expected, described = jax.tree.flatten(shapes)
    returned = [leaf.dtype for leaf in expected]
    halves = jax.pure_callback(
        batched,
        [_halved_shape(leaf) for leaf in expected],
        *(_halved(leaf) for leaf in jax.tree.leaves(argument)),
        vmap_method="expand_dims",
    )
    flat = [_joined(half, kind) for half, kind in zip(halves, returned, strict=True)]
    return jax.tree.unflatten(described, flat)


@jax.custom_jvp
def _held(leaf: Any) -> Any:
    """A number that refuses derivatives: as integers, in which it crosses, it would have zero."""
    return leaf


@_held.defjvp
def _refused(primals: Any, tangents: Any) -> Any:
    raise TypeError(ONLY_FIRST)


def _halved(leaf: Array | np.ndarray) -> Array | np.ndarray:
    """Numbers of 64 bits as pairs of 32, `(..., 2)`; others as they are."""
    if leaf.dtype.itemsize != 8:
        return leaf
    if isinstance(leaf, np.ndarray):
        return np.ascontiguousarray(leaf).reshape(*leaf.shape, 1).view(np.uint32)
    return jax.lax.bitcast_convert_type(leaf, jnp.uint32)


def _halved_shape(leaf: jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
    if leaf.dtype.itemsize != 8:
        return leaf
    return jax.ShapeDtypeStruct((*leaf.shape, 2), jnp.uint32)


def _joined(half: Array | np.ndarray, kind: np.dtype) -> Any:
    """What `_halved` took apart."""
    if kind.itemsize != 8:
        return half
    if isinstance(half, np.ndarray):
        return np.ascontiguousarray(half).view(kind)[..., 0]
    return jax.lax.bitcast_convert_type(half, kind)
