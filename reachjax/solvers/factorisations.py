"""Cholesky factors where rounding may have cost a matrix its definiteness."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky, solve_triangular

REGULAR = 1e-14
"""What is added to the unit diagonal of a scaled Schur matrix at first."""

REFINEMENTS = 3
"""Steps of iterative refinement; conjugate gradients in their place blew up flat directions."""

SHIFTS = 12
"""How often a shift is tried, each ten times the one before."""


def inverse_cholesky(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The inverse of the lower Cholesky factor, and the matrix, shifted if rounding asks for it.

    Raises:
        numpy.linalg.LinAlgError: no shift makes it definite.
    """
    unit = 1e-16 * np.trace(matrix) / len(matrix)
    factor, shift = _factor(matrix, unit, 0.0)
    inverse = solve_triangular(factor, np.eye(len(matrix)), lower=True, check_finite=False)
    return inverse, matrix + shift * np.eye(len(matrix)) if shift else matrix


def refined_solver(schur: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Solves with a positive definite matrix: scaled to a unit diagonal, regularised, refined.

    Raises:
        numpy.linalg.LinAlgError: no shift makes it definite.
    """
    scale = 1 / np.sqrt(np.diagonal(schur))
    matrix = schur * scale[:, None] * scale
    factor, _ = _factor(matrix, 1e-12, REGULAR)

    def solve(vector: np.ndarray) -> np.ndarray:
        residual = vector = scale * vector
        solution, least = np.zeros_like(vector), np.inf
        enough = 1e-15 * np.linalg.norm(vector)
        for _ in range(1 + REFINEMENTS):
            candidate = solution + cho_solve((factor, True), residual, check_finite=False)
            left = vector - matrix @ candidate
            size = float(np.linalg.norm(left))
            if not size < least:
                break
            solution, residual, least = candidate, left, size
            if size <= enough:
                break
        return scale * solution

    return solve


def _factor(matrix: np.ndarray, unit: float, first: float) -> tuple[np.ndarray, float]:
    """The lower Cholesky factor of `matrix + shift I`, and the first `shift` with one."""
    shift, eye = first, np.eye(len(matrix))
    for _ in range(SHIFTS):
        shifted = matrix + shift * eye if shift else matrix
        try:
            factor = cholesky(shifted, lower=True, check_finite=False)
        except LinAlgError:
            factor = None
        if factor is not None and np.isfinite(factor[-1, -1]):
            return factor, shift
        shift = max(10 * shift, unit)
    raise LinAlgError("a matrix is not definite for any shift")
