"""How large sets are, as numbers that can be differentiated and penalised.

Up to four dimensions the volume of a polytope is exact (Qhull), with the derivative
`d vol / d b_i = (area of facet i) / |a_i|`. Beyond that, corners multiply too fast, and the size of
a polytope is that of its bounding box.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from reachjax.numerics.checks import described
from reachjax.numerics.flags import lenient
from reachjax.sets import AbstractSet
from reachjax.tubes.reach import ReachTube


@lenient
def volume(X: AbstractSet) -> Float[Array, ""]:
    """The `n`-dimensional volume; of a polytope beyond four dimensions, that of its bounding box.

    Of an intersection it is an upper bound, the smaller volume of its two parts.

    Differentiable, also inside `jax.jit`, `jax.vmap` and `jax.lax.scan`.

    Raises:
        TypeError: `X` is no set.
        ValueError: a polytope is empty or unbounded (NaN inside `jax.jit`).
        RuntimeError: it is too thin for its corners to be found (NaN inside `jax.jit`).

    Example:
        >>> import jax
        >>> from reachjax import Template
        >>> template = Template.box(2)  # facets x <= 2, -x <= 0, y <= 3, -y <= 0
        >>> jax.grad(lambda b: volume(template.polytope(b)))(jnp.array([2.0, 0, 3, 0])).round(9)
        Array([3., 3., 2., 2.], dtype=float64)
    """
    _require_set(X)
    return X.size()


@lenient
def log_widths(X: AbstractSet) -> Float[Array, " n"]:
    """Logarithms of the widths of a set along each coordinate; differentiable as `volume` is.

    Raises:
        TypeError: `X` is no set.
        ValueError: a polytope is empty or unbounded (NaN inside `jax.jit`).

    Example:
        >>> from reachjax import Box
        >>> log_widths(Box([0.0, 0.0], [1.0, 2.0])).round(6).tolist()
        [0.0, 0.693147]
    """
    _require_set(X)
    return jnp.log(X.bounding_box().widths)


@lenient
def log_volume(X: AbstractSet | ReachTube) -> Float[Array, ""]:
    """The logarithm of a set's volume; of a tube, the sum over `t = 1 .. horizon`.

    Raises:
        TypeError: `X` is neither a set nor a tube.

    Example:
        >>> from reachjax import Box
        >>> round(float(log_volume(Box([0.0, 0.0], [1.0, 2.0]))), 6)
        0.693147
    """
    if isinstance(X, ReachTube):
        return sum((log_volume(region) for region in X.sets[1:]), start=jnp.zeros(()))
    return jnp.log(volume(X))


def _require_set(X: Any) -> None:
    if not isinstance(X, AbstractSet):
        hint = ": of a tube, measure tube.sets[t]" if isinstance(X, ReachTube) else ""
        raise TypeError(
            f"X must be a set such as Box(lower, upper), but {described(X)} arrived{hint}"
        )
