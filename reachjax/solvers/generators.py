"""Sums, inner products and the Schur matrix of generators that are products of two rows.

Every multiplier's generator is `G_k = sum w sym(l' r)` over one or two pairs of rows, or, for a
few, a general symmetric matrix. None of the rank-two ones is ever formed: with the Gram matrices
`A = F X F'` and `B = F W F'` of the rows `F`, two pairs `(l, r)` and `(p, q)` have

    <sym(l' r), X sym(p' q) W>  =  1/4 (A_lp B_rq + A_lq B_rp + A_rp B_lq + A_rq B_lp),

so that one iteration costs `O(n^3)` for as many multipliers as columns.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


class Pairs(NamedTuple):
    """One product of rows for each of the first `k` multipliers.

    Attributes:
        left: `(k,)`, row numbers.
        right: `(k,)`, row numbers.
        weight: `(k,)`, zero where the multiplier has no such product.
    """

    left: Int[Array, " k"]
    right: Int[Array, " k"]
    weight: Float[Array, " k"]


class Generators(NamedTuple):
    """The `G_k` of one program: all facets share them.

    Attributes:
        rows: `(m, n)`, the facts; the last one is the constant's unit row `e`.
        first: a pair of each multiplier; the last is the offset's, `-e' e`.
        second: the other pair of the first few multipliers.
        general: `(g, n, n)`, generators of the first `g` multipliers that have no pairs, else zero.
        free: `(K,)`, multipliers of either sign.
        target: `(K,)`, what `<G_k, X>` is at least, or equal to where the multiplier is free: 0,
            and -1 for the offset and for multipliers that have no generator.
        idle: `(n,)`, 1 for columns that no row uses, else 0.
    """

    rows: Float[Array, "m n"]
    first: Pairs
    second: Pairs
    general: Float[Array, "g n n"]
    free: Bool[Array, " K"]
    target: Float[Array, " K"]
    idle: Float[Array, " n"]

    def weighted(self, y: Float[Array, " K"]) -> Float[Array, "n n"]:
        """`sum_k y_k G_k`."""
        half = jnp.zeros_like(self.rows)
        for pairs in (self.first, self.second):
            weights = pairs.weight * y[: len(pairs.weight)]
            half = half.at[pairs.left].add(weights[:, None] * self.rows[pairs.right])
        general = jnp.tensordot(y[: len(self.general)], self.general, 1)
        return symmetric(self.rows.T @ half) + general

    def paired(self, matrix: Float[Array, "n n"]) -> Float[Array, " K"]:
        """`<G_k, M>` for a symmetric matrix."""
        image, found = self.rows @ matrix, jnp.zeros_like(self.target)
        for pairs in (self.first, self.second):
            values = jnp.einsum("kn,kn->k", image[pairs.left], self.rows[pairs.right])
            found = found.at[: len(values)].add(pairs.weight * values)
        return found.at[: len(self.general)].add(jnp.tensordot(self.general, matrix, 2))

    def gram(self, matrix: Float[Array, "n n"]) -> Float[Array, "m m"]:
        """`F M F'`."""
        return self.rows @ matrix @ self.rows.T

    def paired_gram(
        self, gram: Float[Array, "m m"], matrix: Float[Array, "n n"]
    ) -> Float[Array, " K"]:
        """`<G_k, M>` for a symmetric matrix whose Gram matrix `F M F'` is known."""
        found = jnp.zeros_like(self.target)
        for pairs in (self.first, self.second):
            values = pairs.weight * gram[pairs.left, pairs.right]
            found = found.at[: len(values)].add(values)
        return found.at[: len(self.general)].add(jnp.tensordot(self.general, matrix, 2))

    def schur(
        self,
        X: Float[Array, "n n"],
        W: Float[Array, "n n"],
        A: Float[Array, "m m"],
        B: Float[Array, "m m"],
    ) -> Float[Array, "K K"]:
        """`<G_k, X G_l W>` for symmetric `X` and `W` with Gram matrices `A` and `B`."""
        H, k = _block(A, B, self.first, self.first), len(self.second.weight)
        if k:
            mixed = _block(A, B, self.second, self.first)
            H = H.at[:k].add(mixed).at[:, :k].add(mixed.T)
            H = H.at[:k, :k].add(_block(A, B, self.second, self.second))
        for j in range(len(self.general)):
            row = self.paired(symmetric(X @ self.general[j] @ W))
            # one that is empty here has pairs instead
            row = jnp.where(jnp.any(self.general[j] != 0), row, H[j])
            H = H.at[j].set(row).at[:, j].set(row)
        return symmetric(H)


def _block(A: Array, B: Array, ours: Pairs, others: Pairs) -> Float[Array, "k l"]:
    """The formula of this module's docstring for all pairs of two kinds."""
    # columns first: what is left to gather are whole rows
    A_left, A_right = A[:, others.left], A[:, others.right]
    B_left, B_right = B[:, others.left], B[:, others.right]
    left, right = ours.left, ours.right
    crossed = A_left[left] * B_right[right] + A_right[left] * B_left[right]
    crossed += A_left[right] * B_right[left] + A_right[right] * B_left[left]
    return ours.weight[:, None] * others.weight * crossed / 4


def symmetric(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The symmetric part."""
    return (matrix + jnp.swapaxes(matrix, -1, -2)) / 2


def inverse_factor(factor: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse of a lower triangular matrix."""
    eye = jnp.eye(factor.shape[-1], dtype=factor.dtype)
    return jax.lax.linalg.triangular_solve(factor, eye, left_side=True, lower=True)
