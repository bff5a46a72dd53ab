"""Sums, inner products and the Schur matrix of generators that are products of two rows.

Every multiplier's generator is `G_k = sum w sym(l' r)` over one or two pairs of rows, or, for a
few, a general symmetric matrix. None of the rank-two ones is ever formed: with the Gram matrices
`A = F X F'` and `B = F W F'` of the rows `F`, two pairs `(l, r)` and `(p, q)` have

    <sym(l' r), X sym(p' q) W>  =  1/4 (A_lp B_rq + A_lq B_rp + A_rp B_lq + A_rq B_lp),

so that one iteration costs `O(n^3)` for as many multipliers as columns.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


class Generators(NamedTuple):
    """The `G_k` of one program: all facets share them.

    Attributes:
        rows: `(m, n)`, the facts; the last one is the constant's unit row `e`.
        left: `(s, K)`, row numbers: multiplier `k` weighs the `s` pairs `left[:, k], right[:, k]`.
        right: `(s, K)`, row numbers. The last multiplier is the offset's, `-e' e`.
        weight: `(s, K)`, zero where a multiplier has no such pair.
        general: `(g, n, n)`, generators of the first `g` multipliers that have no pairs, else zero.
        free: `(K,)`, multipliers of either sign.
        target: `(K,)`, what `<G_k, X>` is at least, or equal to where the multiplier is free: 0,
            and -1 for the offset and for multipliers that have no generator.
        idle: `(n,)`, 1 for columns that no row uses, else 0.
    """

    rows: Float[Any, "m n"]
    left: Int[Any, "s K"]
    right: Int[Any, "s K"]
    weight: Float[Any, "s K"]
    general: Float[Any, "g n n"]
    free: Bool[Any, " K"]
    target: Float[Any, " K"]
    idle: Float[Any, " n"]

    def weighted(self, y: Float[Array, " K"]) -> Float[Array, "n n"]:
        """`sum_k y_k G_k`."""
        weights = (self.weight * y).ravel()[:, None]
        half = (
            jnp.zeros_like(self.rows)
            .at[self.left.ravel()]
            .add(weights * self.rows[self.right.ravel()])
        )
        general = jnp.tensordot(y[: len(self.general)], self.general, 1)
        return symmetric(self.rows.T @ half) + general

    def paired(self, matrix: Float[Array, "n n"]) -> Float[Array, " K"]:
        """`<G_k, M>` for a symmetric matrix."""
        values = jnp.sum((self.rows @ matrix)[self.left] * self.rows[self.right], axis=2)
        return self._with_general(jnp.sum(self.weight * values, axis=0), matrix)

    def _with_general(self, values: Array, matrix: Array) -> Float[Array, " K"]:
        more = jnp.tensordot(self.general, matrix, 2)
        return values.at[: len(self.general)].add(more)

    def gram(self, matrix: Float[Array, "n n"]) -> Float[Array, "m m"]:
        """`F M F'`."""
        return self.rows @ matrix @ self.rows.T

    def paired_gram(
        self, gram: Float[Array, "m m"], matrix: Float[Array, "n n"]
    ) -> Float[Array, " K"]:
        """`<G_k, M>` for a symmetric matrix whose Gram matrix `F M F'` is known."""
        values = jnp.sum(self.weight * gram[self.left, self.right], axis=0)
        return self._with_general(values, matrix)

    def schur(
        self,
        X: Float[Array, "n n"],
        W: Float[Array, "n n"],
        A: Float[Array, "m m"],
        B: Float[Array, "m m"],
    ) -> Float[Array, "K K"]:
        """`<G_k, X G_l W>` for symmetric `X` and `W` with Gram matrices `A` and `B`."""
        slots, count = self.weight.shape
        left, right = self.left.ravel(), self.right.ravel()
        # columns first: what is left to pick are whole rows
        A_left, A_right, B_left, B_right = A[:, left], A[:, right], B[:, left], B[:, right]

        def row(pairs):
            values = jnp.zeros(slots * count)
            for number in range(slots):
                p, q, weight = (part[number] for part in pairs)
                crossed = A_left[p] * B_right[q] + A_right[p] * B_left[q]
                crossed += A_left[q] * B_right[p] + A_right[q] * B_left[p]
                values += weight / 4 * crossed
            return jnp.sum(self.weight * values.reshape(slots, count), axis=0)

        # row by row: fused into each of its uses, the whole would be gathered again there
        H = jax.lax.map(row, (self.left.T, self.right.T, self.weight.T))
        for j in range(len(self.general)):
            values = self.paired(symmetric(X @ self.general[j] @ W))
            # one that is empty here has pairs instead
            values = jnp.where(jnp.any(self.general[j] != 0), values, H[j])
            H = H.at[j].set(values).at[:, j].set(values)
        return H


def symmetric(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The symmetric part."""
    return (matrix + jnp.swapaxes(matrix, -1, -2)) / 2
