"""Columns of forms as fewer ones, so that a step costs the same however long the horizon is.

Columns `g_j v_j`, `|v_j| <= 1`, are held by a parallelotope of any frame `T`:

    sum_j g_j v_j  =  T d,    |d_i| <= sum_j |T^-1 g_j|_i,

that is by as many columns as there are states. Those are merged that this widens least (Girard,
Reachability of uncertain linear systems using zonotopes, HSCC 2005): columns along an axis of the
frame are not widened at all, and small ones not by much. The frame is the triangular root of the
covariance of all columns, `T T' = G G'`: it turns as the feedback turns the set, so old columns,
which have contracted, lie in it as their successors do, and it scales as the states are scaled.

Nothing rests on how good a frame is, nor on its inverse: what is left of a column by `T T^-1` is
bounded as it is, and widens the numbers.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from reachjax.numerics.rounding import NOTHING, TINY, gamma, select, settled
from reachjax.programs.affine import AffineForms, radii_of

RIDGE = 1e-6
"""What is added to correlations, so that states of which one is a function of others have a frame
in which none is divided by what rounding makes of zero."""


def merged_columns(
    state: AffineForms, first: int, count: int, last: int | None = None
) -> AffineForms:
    """The state with the columns from some on as fewer, the rest empty; compiled.

    Args:
        state: of all columns.
        first: where those begin that may be merged.
        count: how many are left of them, more than twice as many as there are states.
        last: where they end, and only empty ones come; None for all columns.
    """
    n, given = len(state), state.columns[:, first:last]
    counted = state.off is not NOTHING
    held = count - (2 * n if counted else n)
    frame, back = _frame(jax.lax.stop_gradient(state.columns))
    inside = settled(back @ given)
    size = jax.lax.stop_gradient(abs(inside))
    widened = size.sum(axis=0) - size.max(axis=0)
    order = jnp.argsort(-jnp.nan_to_num(widened, nan=jnp.inf, posinf=jnp.inf))
    small = order[held:]
    parts, merged = inside[:, small], given[:, small]
    reach = abs(parts).sum(axis=1) * (1 + gamma(given.shape[1]))
    block = settled(frame * reach)
    rows = [state.rows[:, : 2 + first], given[:, order[:held]], block]
    if counted:  # they contract as columns, not as radii
        off = jax.lax.stop_gradient(state.off + _lost(frame, parts, merged, block))
        rows.append(select(jnp.eye(n, dtype=bool), off[:, None] * (1 + gamma(2)), 0.0))
    rows.append(jnp.zeros((n, state.columns.shape[1] - first - count)))
    radii = radii_of(state.off * 0.0, state.radii[:, -1])
    return AffineForms(jnp.concatenate(rows, axis=1), radii)


def _lost(
    frame: Float[Array, "n n"],
    parts: Any,
    merged: Any,
    block: Float[Array, "n n"],
) -> Float[Array, " n"]:
    """What the frame does not hold of columns, and what rounding takes from the new ones."""
    n, count = parts.shape
    rounded = gamma(n + 4) * (abs(frame) @ abs(parts) + abs(merged))
    left = abs(merged - frame @ parts) * (1 + gamma(4)) + rounded
    flushed = TINY * (n + 1) * (count + n) * (2 + abs(frame).sum(axis=1) + abs(parts).sum())
    off = left.sum(axis=1) * (1 + gamma(count)) + gamma(2) * abs(block).sum(axis=1)
    return (off + flushed) * (1 + gamma(8))


def _frame(columns: Any) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """The triangular root of the covariance of columns, and nearly its inverse; finite numbers."""
    sizes = abs(columns).max(axis=1)
    known = (sizes > 0) & (sizes < jnp.inf)
    sizes = select(known, sizes, 1.0)
    scaled = select(known[:, None], columns / sizes[:, None], 0.0)
    covariance = scaled @ scaled.T
    lengths = select(known, jnp.sqrt(jnp.diagonal(covariance)), 1.0)
    correlation = covariance / (lengths[:, None] * lengths) + RIDGE * jnp.eye(len(sizes))
    root = jnp.linalg.cholesky(correlation)
    inverse = jax.scipy.linalg.solve_triangular(root, jnp.eye(len(sizes)), lower=True)
    scale = lengths * sizes
    frame, back = root * scale[:, None], inverse / scale
    fine = jnp.isfinite(frame).all() & jnp.isfinite(back).all()
    plain = jnp.diag(sizes), jnp.diag(1 / sizes)
    return settled((select(fine, frame, plain[0]), select(fine, back, plain[1])))
