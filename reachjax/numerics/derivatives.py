"""Numbers that have a first derivative, by reverse mode, and no other.

A bound is differentiated with its multipliers held (`moved_by`). That derivative differentiated
again would be a number, and a wrong one (`first_order`).
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array

from reachjax.numerics.checks import is_concrete

ONLY_FIRST = (
    "certified bounds have first derivatives only, and in reverse mode: take jax.grad, jax.vjp or "
    "jax.jacrev once. jax.jvp, jax.jacfwd, jax.hessian, or a derivative of a derivative, has no "
    "bounds to rest on: hold what is differentiated once more by jax.lax.stop_gradient, or take "
    "differences of gradients"
)
"""What is said of other derivatives."""


def _modes(leaf: Any) -> Iterator[str]:
    """How a number is being differentiated, the innermost first, as far as can be seen."""
    while isinstance(leaf, Tracer):
        if hasattr(leaf, "primal"):
            yield type(leaf).__name__
            leaf = leaf.primal
        else:  # a batch has a value; inside of `jax.jit` nothing is seen
            leaf = getattr(leaf, "val", None)


@lru_cache
def _reverse_mode() -> str:
    """What JAX calls a number of which `jax.grad` takes a derivative."""
    found: list[str] = []

    def seen(number: Any) -> Any:
        found.extend(_modes(number))
        return number

    jax.grad(seen)(1.0)
    return found[0]


@jax.custom_vjp
def _twice(slope: Array) -> Array:
    return slope


def _refused(_: None, slope: Array) -> tuple[Array]:
    raise TypeError(ONLY_FIRST)


_twice.defvjp(lambda slope: (slope, None), _refused)


@jax.custom_vjp
def _once(number: Array) -> Array:
    return number


_once.defvjp(lambda number: (number, None), lambda _, slope: (_twice(slope),))


@jax.custom_vjp
def moved_by(value: Array, moving: Array) -> Array:
    """A number with the derivatives of another one, NaN where that one is not finite.

    Args:
        value: the number, which is held.
        moving: what has its derivatives, of the same shape.

    Example:
        >>> value, slope = jax.value_and_grad(lambda x: moved_by(5.0, x**2))(3.0)
        >>> float(value), float(slope)
        (5.0, 6.0)
    """
    return value


def _held(value: Array, moving: Array) -> tuple[Array, Array]:
    return value, jnp.isfinite(moving)


def _passed_on(finite: Array, slope: Array) -> tuple[Array, Array]:
    return jnp.zeros_like(slope), jnp.where(finite | (slope == 0), slope, jnp.nan)


moved_by.defvjp(_held, _passed_on)


def first_order(tree: Any) -> Any:
    """The same numbers; a derivative of their derivative is an error.

    Forward mode and second derivatives are refused at once where they can be seen: around
    `jax.jit` JAX refuses the one, and the other ends as an error once all is computed.

    Raises:
        TypeError: forward mode, or a second derivative, is being asked for.

    Example:
        >>> jax.grad(lambda x: first_order(x) ** 2)(3.0).item()
        6.0
    """
    for leaf in jax.tree.leaves(tree):
        modes = list(_modes(leaf))
        if len(modes) > 1 or not {*modes} <= {_reverse_mode()}:
            raise TypeError(ONLY_FIRST)

    def marked(leaf: Any) -> Any:
        return leaf if is_concrete(leaf) or not _is_number(leaf) else _once(leaf)

    return jax.tree.map(marked, tree)


def _is_number(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jnp.floating)
