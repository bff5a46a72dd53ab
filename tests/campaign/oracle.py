"""An oracle that shares no code with the library: loops and sets as plain arrays.

Trajectories are simulated in longdouble with a running bound of their rounding, and in fractions,
which round nothing. Sets are `A x <= b`, `(x - center)' shape^-1 (x - center) <= 1`, or both.
"""

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

WIDE = np.longdouble
UNIT = WIDE(2) ** -63
"""The unit roundoff of an 80-bit longdouble; where it is wider, it is a cautious one."""


def exact(values) -> np.ndarray:
    """An array of fractions, equal to the numbers given.

    Example:
        >>> exact([0.5, 3.0]).tolist()
        [Fraction(1, 2), Fraction(3, 1)]
    """
    values = np.asarray(values)
    if values.dtype == object:
        return values
    flat = [Fraction(*value.as_integer_ratio()) for value in values.ravel()]
    result = np.empty(len(flat), dtype=object)
    result[:] = flat
    return result.reshape(values.shape)


def rounded(values: np.ndarray) -> np.ndarray:
    """Fractions as the longdouble numbers next to them, off by two units at most."""
    high = np.array([float(v) for v in values.ravel()])
    low = [float(v - Fraction(h)) for v, h in zip(values.ravel(), high.tolist(), strict=True)]
    return (high.astype(WIDE) + np.array(low, dtype=WIDE)).reshape(values.shape)


@dataclass(frozen=True)
class Loop:
    """`x+ = A x + B clip(pi(x), lower, upper) + c`; all but the layers may have a time axis.

    Example:
        >>> halving = Loop([(np.zeros((1, 1)), np.zeros(1))], *np.array([[[0.5]], [[1.0]]]), [1.0])
        >>> halving.simulate(exact([[1.0]]), 2)[:, 0, 0].tolist()
        [Fraction(1, 1), Fraction(3, 2), Fraction(7, 4)]
    """

    layers: list
    A: np.ndarray
    B: np.ndarray
    c: np.ndarray
    lower: np.ndarray | None = None
    upper: np.ndarray | None = None
    start: int = 0

    def at(self, t: int) -> list:
        """`A`, `B`, `c`, `lower`, `upper` of step `t`, counted from the start."""
        parts = ((self.A, 2), (self.B, 2), (self.c, 1), (self.lower, 1), (self.upper, 1))
        arrays = [(None if v is None else np.asarray(v), n) for v, n in parts]
        return [v[self.start + t] if v is not None and v.ndim > n else v for v, n in arrays]

    def simulate(self, x: np.ndarray, horizon: int) -> np.ndarray:
        """Trajectories `(horizon + 1, k, n)` of points `(k, n)`, in fractions."""
        states = [x]
        for t in range(horizon):
            A, B, c, lower, upper = (None if v is None else exact(v) for v in self.at(t))
            y = x
            for W, b in self.layers[:-1]:
                y = np.maximum(y @ exact(W).T + exact(b), Fraction(0))
            W, b = self.layers[-1]
            u = y @ exact(W).T + exact(b)
            if lower is not None:
                u = np.minimum(np.maximum(u, lower), upper)
            x = x @ A.T + u @ B.T + c
            states.append(x)
        return np.stack(states)

    def simulate_wide(self, x: np.ndarray, error: np.ndarray, horizon: int) -> list:
        """Trajectories in longdouble of points known up to an error: pairs (states, errors)."""
        found = [(x, error)]
        for t in range(horizon):
            A, B, c, lower, upper = self.at(t)
            y = x, error
            for W, b in self.layers[:-1]:
                values, e = affine(y, W, b)
                y = np.maximum(values, 0), e
            values, e = affine(y, *self.layers[-1])
            u = (values if lower is None else np.clip(values, lower, upper)), e
            both = np.hstack([x, u[0]]), np.hstack([error, u[1]])
            x, error = affine(both, np.hstack([A, B]), c)
            found.append((x, error))
        return found

    def slopes(self, x: np.ndarray, horizon: int) -> list[np.ndarray]:
        """The Jacobians `(k, n, n)` of the states at each time in the points `(k, n)`."""
        J = np.broadcast_to(np.eye(x.shape[1]), (len(x), x.shape[1], x.shape[1])).astype(WIDE)
        found = [J]
        for t in range(horizon):
            A, B, c, lower, upper = self.at(t)
            y, D = x, J
            for W, b in self.layers[:-1]:
                y = y @ W.T + b
                D = (y > 0)[:, :, None] * (W @ D)
                y = np.maximum(y, 0)
            W, b = self.layers[-1]
            u, D = y @ W.T + b, W @ D
            if lower is not None:
                D = ((u > lower) & (u < upper))[:, :, None] * D
                u = np.clip(u, lower, upper)
            x, J = x @ A.T + u @ B.T + c, A @ J + B @ D
            found.append(J)
        return found


def affine(ball: tuple, W: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`W x + b` for rows `x` known up to an error, and how far off it can be."""
    x, error = ball
    W, b = np.asarray(W, dtype=WIDE), np.asarray(b, dtype=WIDE)
    g = (x.shape[-1] + 4) * UNIT
    size = abs(x) @ abs(W).T + abs(b)
    return x @ W.T + b, (error @ abs(W).T + g * size) * (1 + 8 * g)


@dataclass(frozen=True)
class Region:
    """A set as plain arrays: facets, a ball, or both; `None` where it has none."""

    A: np.ndarray | None = None
    b: np.ndarray | None = None
    center: np.ndarray | None = None
    shape: np.ndarray | None = None

    @property
    def dimension(self) -> int:
        """The number of coordinates."""
        return self.A.shape[1] if self.A is not None else len(self.center)

    def holds(self, x: np.ndarray) -> bool:
        """Whether a point of fractions is in the set."""
        return min(self.room(x)) >= 0

    def room(self, x: np.ndarray) -> list[Fraction]:
        """`b - A x` of each facet, then `1 - (x - q)' Q^-1 (x - q)`, in fractions."""
        found = []
        if self.A is not None:
            found += list(exact(self.b) - exact(self.A) @ x)
        if self.center is not None:
            away = x - exact(self.center)
            found.append(1 - away @ solved(exact(self.shape), away))
        return found

    def room_wide(self, x: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`room` of points `(k, n)` in longdouble, and how far off each number can be."""
        rooms, errors = [], []
        if self.A is not None:
            value, e = affine((x, error), -self.A, self.b)
            rooms.append(value)
            errors.append(e)
        if self.center is not None:
            value, e = self._ball(x, error)
            rooms.append(value[:, None])
            errors.append(e[:, None])
        return np.hstack(rooms), np.hstack(errors)

    def _ball(self, x: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`1 - |L^-1 (x - q)|^2`, `L` a Cholesky factor, which scaling of axes does not change."""
        q, n = np.asarray(self.center, dtype=WIDE), len(self.center)
        inverse, condition = inverse_factor(self.shape)
        away = x - q
        y = away @ inverse.T
        sizes = np.sqrt((y**2).sum(axis=1))
        spread = (error + 2 * UNIT * (abs(x) + abs(q))) @ abs(inverse).T
        off = np.sqrt((spread**2).sum(axis=1)) + 64 * n**3 * UNIT * condition * sizes
        return 1 - sizes**2, 2 * sizes * off + off**2 + 8 * n * UNIT * (1 + sizes**2)


def inverse_factor(shape: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`L^-1` with `L L' = shape` in longdouble, and the condition of the scaled matrix."""
    Q = np.asarray(shape, dtype=WIDE)
    widths = np.sqrt(np.diag(Q))
    C, n = Q / np.outer(widths, widths), len(Q)
    L, inverse = np.zeros_like(C), np.zeros_like(C)
    for i in range(n):
        for j in range(i):
            L[i, j] = (C[i, j] - L[i, :j] @ L[j, :j]) / L[j, j]
        L[i, i] = np.sqrt(np.maximum(C[i, i] - L[i, :i] @ L[i, :i], UNIT))
        inverse[i, i] = 1 / L[i, i]
        inverse[i, :i] = -(L[i, :i] @ inverse[:i, :i]) / L[i, i]
    values = np.linalg.eigvalsh(C.astype(float))
    return inverse / widths, np.array(values[-1] / max(values[0], 1e-16), dtype=WIDE)


def solved(M: np.ndarray, v: np.ndarray) -> np.ndarray | None:
    """The solution of `M y = v` in fractions; None if the matrix is singular.

    Example:
        >>> solved(exact([[2.0, 1.0], [1.0, 1.0]]), exact([3.0, 2.0])).tolist()
        [Fraction(1, 1), Fraction(1, 1)]
    """
    rows, n = [[*row, right] for row, right in zip(M, v, strict=True)], len(v)
    for i in range(n):
        pivot = next((k for k in range(i, n) if rows[k][i] != 0), None)
        if pivot is None:
            return None
        rows[i], rows[pivot] = rows[pivot], rows[i]
        for k in range(n):
            factor = rows[k][i] / rows[i][i]
            if k != i and factor != 0:
                rows[k] = [a - factor * b for a, b in zip(rows[k], rows[i], strict=True)]
    found = np.empty(n, dtype=object)
    found[:] = [rows[i][n] / rows[i][i] for i in range(n)]
    return found
