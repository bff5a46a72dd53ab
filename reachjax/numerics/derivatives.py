"""Numbers that have a first derivative, by reverse mode, and no other.

A bound is differentiated with its multipliers held. That derivative differentiated again would be
a number, and a wrong one.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from reachjax.numerics.checks import is_concrete


@jax.custom_vjp
def _twice(slope: Array) -> Array:
    return slope


def _refused(_: None, slope: Array) -> tuple[Array]:
    raise TypeError(
        "certified bounds have first derivatives only: the derivative of theirs was asked"
    )


_twice.defvjp(lambda slope: (slope, None), _refused)


@jax.custom_vjp
def _once(number: Array) -> Array:
    return number


_once.defvjp(lambda number: (number, None), lambda _, slope: (_twice(slope),))


def first_order(tree: Any) -> Any:
    """The same numbers; a derivative of their derivative is an error.

    Example:
        >>> jax.grad(lambda x: first_order(x) ** 2)(3.0).item()
        6.0
    """

    def marked(leaf: Any) -> Any:
        return leaf if is_concrete(leaf) or not _is_number(leaf) else _once(leaf)

    return jax.tree.map(marked, tree)


def _is_number(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jnp.floating)
