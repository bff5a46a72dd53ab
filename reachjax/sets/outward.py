"""Ellipsoids rounded outwards: what surely holds of the exact set `(x - q)' Q^-1 (x - q) <= 1`.

Everything rests on `A Q A'`, with `A` nearly the inverse of a factor of `Q`, which is nearly the
identity: its eigenvalues lie within its diagonal plus or minus the row sums of the rest, rounding
included (Gershgorin). What follows from it is held constant by derivatives; the support is not.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from reachjax.numerics.rounding import TINY, exponents, gamma, lengths, raised, shifted

Matrix = Float[Array | np.ndarray, "n n"]
Vector = Float[Array | np.ndarray, " n"]


def _rounding(A: Matrix, Q: Matrix) -> Matrix:
    """A bound of the rounding errors of `A Q A'`."""
    return gamma(2 * len(Q)) * (abs(A) @ abs(Q) @ abs(A).T)


def _off_identity(A: Matrix, Q: Matrix) -> Float[Array, ""]:
    """What no eigenvalue of `A Q A'` differs from 1 by more than."""
    n = len(Q)
    off = abs(A @ Q @ A.T - jnp.eye(n)) + _rounding(A, Q)
    return jnp.max(jnp.sum(off, axis=1)) * (1 + gamma(2 * n + 4))


def level(A: Matrix, q: Vector, Q: Matrix) -> Float[Array, ""]:
    """A bound of `|A x + b|` on the set, `b` being `-A q` as it is rounded."""
    n = len(q)
    largest = jnp.max(jnp.sum(abs(A @ Q @ A.T) + _rounding(A, Q), axis=1)) * (1 + gamma(n))
    offset = lengths(gamma(n) * (abs(A) @ abs(q))) * (1 + gamma(n))
    return jax.lax.stop_gradient((jnp.sqrt(largest) + offset) * (1 + gamma(4)))


def ball_map(A: Matrix, q: Vector, Q: Matrix) -> Array:
    """A matrix `M` with `x = q + M w`, `|w| <= 1`, on the set: the factor `L`, a little larger.

    With `r >= |A L - I|`, `|L^-1 (x - q)| <= |A (x - q)| / (1 - r)`.
    """
    L, n = jnp.linalg.cholesky(Q), len(q)
    formed = abs(A @ L - jnp.eye(n)) + 2 * gamma(n + 2) * (abs(A) @ abs(L))
    off = jnp.linalg.norm(formed) * (1 + gamma(n * n))
    larger = level(A, q, Q) / (1 - off) * (1 + gamma(4))
    return L * jax.lax.stop_gradient(jnp.where(off < 1, larger, jnp.inf))


def inflation(
    A: Matrix,
    b: Vector,
    q: Vector,
    Q: Matrix,
    level: Float[Array, ""],
) -> Float[Array, ""]:
    """A factor `f` with which `(q, f Q)` contains `|A x + b| <= level`.

    With `|A q + b| <= e` and `A (f Q) A' >= (level + e)^2 I`, a point of that set has
    `|A (x - q)| <= level + e`, so `(x - q)' (f Q)^-1 (x - q) <= 1`.
    """
    n = len(b)
    residual = abs(A @ q + b) + gamma(n + 2) * (abs(A) @ abs(q) + abs(b))
    needed = ((level + lengths(residual)) * (1 + gamma(n + 8))) ** 2
    return jax.lax.stop_gradient(needed / (1 - _off_identity(A, Q)) * (1 + gamma(8)))


def surely_inside(A: Matrix, q: Vector, Q: Matrix, x: Vector) -> Bool[Array, ""]:
    """Whether `|A (x - q)|^2` is so small that `x` is in the set."""
    n = len(q)
    distance = abs(A @ (x - q)) + gamma(n + 2) * (abs(A) @ (abs(x) + abs(q)))
    return jnp.sum(distance**2) * (1 + gamma(n)) <= 1 - _off_identity(A, Q)


@jax.jit
def support(q: Vector, Q: Matrix, directions: Float[Array, "m n"]) -> Float[Array, " m"]:
    """Upper bounds of `a . q + sqrt(a' Q a)`, whatever the size of the numbers."""
    n, some = len(q), jnp.any(directions != 0, axis=1)
    by = exponents(directions)
    D = shifted(directions, -by[:, None])
    lost = jnp.where(some, n * TINY * (1 + jnp.max(abs(q))), 0.0)  # by underflow
    middle = raised(D @ q + gamma(n + 4) * (abs(D) @ abs(q)) + lost, by)
    # half-axes as units: whatever underflows is little beside the largest of a direction
    units = exponents(jnp.diag(Q)[:, None]) // 2
    S = shifted(Q, -(units[:, None] + units))
    logs = jnp.where(directions != 0, jnp.frexp(directions)[1] - 1 + units, -(2**20))
    by = jnp.where(some, jnp.max(logs, axis=1), 0)
    D = shifted(directions, units - by[:, None])
    squares = jnp.einsum("mi,ij,mj->m", D, S, D)
    sizes = jnp.einsum("mi,ij,mj->m", abs(D), abs(S), abs(D))
    above = squares + gamma(2 * n) * sizes + 64 * n**2 * TINY
    # the root has no derivative at zero
    root = jnp.where(some, jnp.sqrt(jnp.where(some, above, 1.0)), 0.0)
    reach = raised(root * (1 + gamma(n + 4)), by)
    return middle + reach + gamma(4) * (abs(middle) + reach)
