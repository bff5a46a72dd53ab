"""Rules of the exact reader for systems of linear equations, which elimination solves exactly."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np

from tests.oracles.exact.varying import UndefinedError, Varying

if TYPE_CHECKING:
    from tests.oracles.exact.exact_reader import Reader


def eliminated(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The solution of `matrix y = right`, in fractions: `(n, n)` and `(n, m)`.

    Raises:
        UndefinedError: the matrix is singular.

    Example:
        >>> one = Fraction(1)
        >>> eliminated(np.array([[2 * one, one], [one, one]]), np.array([[3 * one], [2 * one]]))
        array([[Fraction(1, 1)],
               [Fraction(1, 1)]], dtype=object)
    """
    rows, size = np.hstack([matrix, right]), len(matrix)
    for k in range(size):
        pivot = next((i for i in range(k, size) if rows[i, k] != 0), None)
        if pivot is None:
            raise UndefinedError("a matrix is singular")
        rows[[k, pivot]] = rows[[pivot, k]]
        rows[k] = rows[k] / rows[k, k]
        for i in range(size):
            if i != k:
                rows[i] = rows[i] - rows[i, k] * rows[k]
    return rows[:, size:]


def solved(reader: Reader, equation: Any, operands: Sequence[Any]) -> Varying:
    """A solver of one's own, by the equations that it solves, whatever it does for that."""
    params = equation.params
    count = params["const_lengths"].matvec
    right = reader.of(operands[-1])
    size = len(right.numbers)
    columns = []
    for one in np.eye(size, dtype=int):
        unit = np.repeat(np.array([Fraction(int(k)) for k in one])[:, None], reader.points, axis=1)
        given = Varying(unit, right.shape)
        (found,) = reader.walk(params["jaxprs"].matvec, [*operands[:count], given])
        columns.append(reader.of(found).numbers)
    matrices = np.stack(columns, axis=1)
    at = [
        eliminated(matrices[..., k], right.numbers[:, k : k + 1])[:, 0]
        for k in range(reader.points)
    ]
    return Varying(np.stack(at, axis=-1), right.shape)


def _each(rule: Callable[..., np.ndarray]) -> Callable[..., Varying]:
    """A function of matrices, at each point and for each matrix of a batch."""

    def every(reader: Reader, equation: Any, operands: Sequence[Any]) -> Varying:
        given = [reader.of(each).array for each in operands]
        found = np.empty((*equation.outvars[0].aval.shape, reader.points), object)
        for at in np.ndindex(found.shape[:-3]):
            for k in range(reader.points):
                found[(*at, ..., k)] = rule(equation.params, *(g[(*at, ..., k)] for g in given))
        return Varying(found, equation.outvars[0].aval.shape)

    return every


def _triangular(params: dict[str, Any], matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Half of a matrix is one."""
    matrix = (np.tril if params["lower"] else np.triu)(matrix)
    if params["unit_diagonal"]:
        np.fill_diagonal(matrix, Fraction(1))
    matrix = matrix.T if params["transpose_a"] else matrix
    return eliminated(matrix, right) if params["left_side"] else eliminated(matrix.T, right.T).T


LINEAR: dict[str, Callable[..., Any]] = {
    "custom_linear_solve": solved,
    "triangular_solve": _each(_triangular),
}
