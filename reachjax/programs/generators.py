"""Symmetric matrices that are sums of products of two rows, on the host.

`G_k = sum w sym(l' r)` over the pairs that belong to `k`. Sums and inner products need Gram
matrices of the rows alone; only conic solvers ask for the `G_k`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from reachjax.numerics.budget import clock

CHUNK = 256
"""Pairs that are treated together: it bounds the memory that products of them take."""


class Generators(NamedTuple):
    """The matrices `G_k`.

    Attributes:
        rows: `(m, n)`.
        left: `(p,)`, row numbers.
        right: `(p,)`, row numbers.
        sharing: sparse `(K, p)`, the weight of each pair in each matrix.
    """

    rows: np.ndarray
    left: np.ndarray
    right: np.ndarray
    sharing: sp.csr_array

    @property
    def size(self) -> int:
        """How many matrices there are."""
        return self.sharing.indptr.size - 1

    def weighted(self, y: np.ndarray) -> np.ndarray:
        """`sum_k y_k G_k` `(n, n)`."""
        weights = self.sharing.T @ y
        half = (weights[:, None] * self.rows[self.left]).T @ self.rows[self.right]
        return (half + half.T) / 2

    def paired(self, matrix: np.ndarray) -> np.ndarray:
        """`<G_k, M>` `(K,)` for a symmetric matrix."""
        return self.sharing @ np.sum((self.rows @ matrix)[self.left] * self.rows[self.right], 1)

    def schur(self, X: np.ndarray, W: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`<G_k, X>` and `<G_k, W>` `(K,)`, and `<G_k, X G_l W>` `(K, K)`, for symmetric `X`, `W`.

        With the Gram matrices `A = F X F'` and `B = F W F'` of the rows, two pairs `(l, r)` and
        `(p, q)` have

            <sym(l' r), X sym(p' q) W>  =  (A_lp B_rq + A_lq B_rp + A_rp B_lq + A_rq B_lp) / 4.
        """
        left, right = self.left, self.right
        A, B = self.rows @ X @ self.rows.T, self.rows @ W @ self.rows.T
        A_left, A_right, B_left, B_right = A[:, left], A[:, right], B[:, left], B[:, right]
        shared = np.zeros((self.size, len(self.left)))
        for first in range(0, len(left), CHUNK):
            clock().require()
            here = slice(first, first + CHUNK)
            p, q = left[here], right[here]
            crossed = A_left[p] * B_right[q]
            crossed += A_right[p] * B_left[q]
            crossed += A_left[q] * B_right[p]
            crossed += A_right[q] * B_left[p]
            shared += self.sharing[:, here] @ crossed
        paired, paired_W = (self.sharing @ gram[left, right] for gram in (A, B))
        return paired, paired_W, (self.sharing @ shared.T) / 4

    def below(self, others: Generators) -> Generators:
        """The matrices `-G_k`, and then those of others, which may have more columns."""
        m, n = self.rows.shape
        rows = np.zeros((m + len(others.rows), others.rows.shape[1]))
        rows[:m, :n], rows[m:] = self.rows, others.rows
        return Generators(
            rows=rows,
            left=np.r_[self.left, m + others.left],
            right=np.r_[self.right, m + others.right],
            sharing=sp.csr_array(sp.block_diag([-self.sharing, others.sharing])),
        )

    def scaled(self, weights: np.ndarray) -> Generators:
        """Each matrix times a weight."""
        sharing = self.sharing.copy()
        sharing.data *= np.repeat(weights, np.diff(sharing.indptr))
        return self._replace(sharing=sharing)

    def columns(self) -> sp.csc_array:
        """The flattened matrices, sparse `(n * n, K)`."""
        n, blocks = self.rows.shape[1], []
        for first in range(0, len(self.left) or 1, CHUNK):
            clock().require()
            here = slice(first, first + CHUNK)
            outer = self.rows[self.left[here], :, None] * self.rows[self.right[here], None, :]
            symmetric = (outer + outer.transpose(0, 2, 1)) / 2
            blocks.append(sp.csr_array(symmetric.reshape(-1, n * n)))
        return sp.csc_array((self.sharing @ sp.vstack(blocks, format="csr")).T)
