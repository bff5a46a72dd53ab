"""Cholesky factors where rounding may have cost a matrix its definiteness, in JAX."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

LEAF = 192
"""Triangular matrices up to this size are inverted in one piece."""

REGULAR = 1e-14
"""What is added to the unit diagonal of the scaled Schur matrix at first."""

REFINEMENTS = 3
"""Steps of iterative refinement; conjugate gradients in their place blew up flat directions."""


def inverse_cholesky(
    matrix: Float[Array, "n n"],
) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """The inverse of the Cholesky factor, and the matrix, shifted if rounding asks for it."""
    unit = 1e-16 * jnp.trace(matrix) / len(matrix)
    factor, shift = _factor(matrix, unit, 0.0)
    return inverse_factor(factor), matrix + shift * jnp.eye(len(matrix))


def refined_solver(schur: Float[Array, "K K"]):
    """Solves with the Schur matrix: scaled to a unit diagonal, regularised, refined."""
    scale = 1 / jnp.sqrt(jnp.diagonal(schur))
    matrix = schur * scale[:, None] * scale
    # products with the inverse cost a tenth of triangular solves, which copy their factor each time
    inverse = inverse_factor(_factor(matrix, 1e-12, REGULAR)[0])

    def solve(vector):
        vector = scale * vector
        enough = 1e-15 * jnp.linalg.norm(vector)

        def improving(state):
            _, _, least, gained, count = state
            return gained & (least > enough) & (count <= REFINEMENTS)

        def refine(state):
            solution, residual, least, _, count = state
            candidate = solution + inverse.T @ (inverse @ residual)
            left = vector - matrix @ candidate
            size = jnp.linalg.norm(left)
            better = size < least
            kept = jnp.where(better, candidate, solution), jnp.where(better, left, residual)
            return *kept, jnp.minimum(size, least), better, count + 1

        none = jnp.zeros_like(vector), vector, jnp.array(jnp.inf), jnp.array(True), 0
        return scale * jax.lax.while_loop(improving, refine, none)[0]

    return solve


def inverse_factor(factor: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse of a lower triangular matrix, by halves: LAPACK would not see the identity."""
    size = factor.shape[-1]
    if size <= LEAF:
        eye = jnp.eye(size, dtype=factor.dtype)
        return jax.lax.linalg.triangular_solve(factor, eye, left_side=True, lower=True)
    half = size // 2
    first, last = inverse_factor(factor[:half, :half]), inverse_factor(factor[half:, half:])
    below = -last @ (factor[half:, :half] @ first)
    return jnp.block([[first, jnp.zeros((half, size - half))], [below, last]])


def _factor(matrix: Array, unit: Array | float, first: float) -> tuple[Array, Array]:
    """The Cholesky factor of `matrix + shift I`, and the first `shift` for which it exists."""
    eye = jnp.eye(len(matrix))

    def attempt(shift):
        return jax.lax.linalg.cholesky(matrix + shift * eye, symmetrize_input=False)

    def failing(state):
        factor, _, tries = state
        return ~jnp.isfinite(factor[-1, -1]) & (tries < 12)

    def again(state):
        _, shift, tries = state
        shift = jnp.maximum(10 * shift, unit)
        return attempt(shift), shift, tries + 1

    factor, shift, _ = jax.lax.while_loop(
        failing, again, (attempt(first), jnp.asarray(first, dtype=float), 0)
    )
    return factor, shift
