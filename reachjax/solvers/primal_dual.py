"""An infeasible-start primal-dual method for the offset of a facet, in numpy.

    minimise b   over b, y   with   S = b e' e - C - sum_k y_k G_k >= 0,   y_k >= 0 unless free,
    maximise <C, X>          with   X >= 0,  X_ee = 1,  <G_k, X> = z_k >= 0 (0 where free).

Any pencil of one unknown is of this kind, with a matrix of its own in the place of `-e' e`.

Cones of general conic solvers hold a dense block of `n (n + 1) / 2` rows for a matrix inequality of
size `n`. Here a multiplier's matrix is a sum of products of two rows, so Gram matrices of rows are
enough (`Generators.schur`), and an iteration costs `O(n^3)` for as many multipliers as columns.

The offset counts as a last, free multiplier with generator `-e' e`. The direction is that of
Helmberg, Rendl, Vanderbei and Wolkowicz (HKM), with Mehrotra's predictor and corrector: with
`W = S^-1`,

    dX = s mu W - X - sym(X dS W),    y_k dz_k + z_k dy_k = s mu - y_k z_k.

Every equation of `X` is relaxed by `kappa mu y_k`: where `X` has no interior (dead neurons, flat
sets, products that others imply), the multipliers of the central path would grow without bound.
What this adds to the objective vanishes with `mu`. Runs that stall go again with less of it.

**Where it starts.** Always at the same point: 16 to 25 iterations on programs that grew by 60
products a round. Runs from an iterate of the round before, moved inwards, stalled.

**When it stalls.** The iterate with the smallest residuals is kept. It is reported as inaccurate,
its multipliers are nonnegative and finite, and what they prove is what counts (`recheck`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky, solve_triangular

from reachjax.numerics.budget import TimeOverError, clock
from reachjax.programs.presolve import Generators
from reachjax.proofs.proposal import SolverStatus

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


DAMPING = 1e-4
"""`kappa` of this module's docstring. Measured on degenerate programs: at 1e-3 some stall at the
start, without it some multipliers grow to 1e7 and six digits are lost."""

LESS = 1e-6
"""`kappa` of a second run. Of 400 facets of degenerate programs 8 stall in the first, 4 in both."""

LEAST_TARGET = 0.05
"""The target is no smaller a part of `mu`: faster falls cost `X` its last digits."""

FURTHER = 1e-3
"""Iterates go on to this part of the tolerance, as long as they gain."""

PATIENCE = 12
"""Iterations without a better iterate after which a run has stalled."""

SHORT_STEP = 1e-4
"""So have runs whose steps stay below this length."""


class Point(NamedTuple):
    """An iterate.

    Attributes:
        X: `(n, n)`, positive definite.
        S: `(n, n)`, positive definite.
        y: `(K,)`, multipliers, the offset last.
        z: `(K,)`, their slacks; 0 where free.
    """

    X: np.ndarray
    S: np.ndarray
    y: np.ndarray
    z: np.ndarray


class Residuals(NamedTuple):
    """What an iterate misses.

    Attributes:
        primal: `(K,)`, `target - <G_k, X> + z_k`.
        dual: `(n, n)`, `-C - sum_k y_k G_k - S`.
        complementarity: `mu`, the mean of the products that should vanish.
        merit: the largest of both residuals and of the gap, relative.
    """

    primal: np.ndarray
    dual: np.ndarray
    complementarity: float
    merit: float


class Optimum(NamedTuple):
    """What a run found for one program, in the scaling of its generators.

    Attributes:
        offset: the unknown, NaN where there is none.
        multipliers: `(K,)`, without it.
        moment: `(n, n)`, NaN where there is none.
        status: how the run ended.
        merit: the largest relative residual or gap.
        iterations: how many.
    """

    offset: float
    multipliers: np.ndarray
    moment: np.ndarray
    status: SolverStatus
    merit: float
    iterations: int


class Instance(NamedTuple):
    """A program of one unknown.

    Attributes:
        generators: of unit size, the unknown's the last.
        free: `(K,)`, multipliers of either sign, the unknown among them.
        cost: `(n, n)`, `C`.
        target: what the product of `X` with the unknown's matrix is: `-1` for an offset.
    """

    generators: Generators
    free: np.ndarray
    cost: np.ndarray
    target: float


class Iteration:
    """The equations of a program and its steps.

    Args:
        given: the program.
        damping: `kappa` of this module's docstring.
    """

    def __init__(self, given: Instance, damping: float):
        self.generators, free, self.cost, target = given
        self.signed = ~free
        # what is sought has no part in the damping: its equation holds the scale of X
        last = np.arange(len(free)) == len(free) - 1
        self.target, self.damped = np.where(last, target, 0.0), np.where(last, 0.0, damping)
        self.degree = len(self.cost) + int(self.signed.sum())

    def start(self) -> Point:
        """`X = I`, `S = 10 I`, and multipliers of the same size; free ones are zero."""
        eye, signed = np.eye(len(self.cost)), 1.0 * self.signed
        return Point(eye, 10.0 * eye, signed, signed.copy())

    def residuals(self, point: Point, paired: np.ndarray) -> Residuals:
        """What an iterate misses, given `<G_k, X>`."""
        X, S, y, z = point
        primal = self.target - paired + z
        dual = -self.cost - self.generators.weighted(y) - S
        products = float(np.sum(X * S) + y @ z)
        # the difference of both values alone may vanish before either is optimal
        value = -self.target[-1] * y[-1]
        gap = max(abs(value - np.sum(self.cost * X)), products) / (1 + abs(value))
        missed = abs(primal).max() / max(1.0, float(np.linalg.norm(X)))
        merit = float(np.max([missed, abs(dual).max(), gap]))
        return Residuals(primal, dual, products / self.degree, merit)

    def step(self, point: Point) -> tuple[Point, Residuals, float]:
        """The next iterate, what this one misses, and the shorter of the two step lengths."""
        generators, signed = self.generators, self.signed
        X_inverse, X = inverse_cholesky(point.X)
        S_inverse, S = inverse_cholesky(point.S)
        y, z = point.y, point.z
        W = S_inverse.T @ S_inverse
        paired, paired_W, schur = generators.schur(X, W)
        missed = self.residuals(Point(X, S, y, z), paired)
        mu = missed.complementarity
        inverse_y = np.zeros(len(y))
        inverse_y[signed] = 1 / y[signed]
        ratio = z * inverse_y
        damping = self.damped * mu
        schur[np.diag_indices(len(y))] += ratio + damping
        solve = refined_solver(schur)
        constant = missed.primal + paired - damping * y - z
        constant += generators.paired(symmetric(X @ missed.dual @ W))

        # predictor, then corrector: what a direction and its steps leave decides the next target
        target, share, cross, cross_z = 0.0, 1.0, np.zeros_like(X), np.zeros(len(y))
        for corrector in (False, True):
            pushed = (target - cross_z) * inverse_y
            dy = solve(constant - target * paired_W + generators.paired(cross) + pushed)
            dS = missed.dual - generators.weighted(dy)
            dX = target * W - X - symmetric(X @ dS @ W) - cross
            dz = pushed - z - ratio * dy
            a = min(1.0, share * min(_to_boundary(X_inverse, dX), _to_zero(z, dz)))
            b = min(1.0, share * min(_to_boundary(S_inverse, dS), _to_zero(y[signed], dy[signed])))
            if corrector:
                break
            left = np.sum((X + a * dX) * (S + b * dS)) + (y + b * dy)[signed] @ (z + a * dz)[signed]
            part = float(np.clip(left / (mu * self.degree), 0.0, 1.0))
            both = min(a, b)
            part **= max(1.0, 3 * both**2)
            target = mu * max(part, 0.5 if both < 0.1 else LEAST_TARGET)
            cross, cross_z = symmetric(dX @ dS @ W), np.where(signed, dy * dz, 0.0)
            share = 0.9 + 0.09 * both
        following = Point(symmetric(X + a * dX), symmetric(S + b * dS), y + b * dy, z + a * dz)
        return following, missed, min(a, b)


def minimised(given: Instance, tolerance: float, most: int) -> Optimum:
    """Minimise what is sought, once more with less damping where that stalls.

    Args:
        given: the program.
        tolerance: relative, of residuals and gap.
        most: how many iterations there may be.
    """
    first = _run(Iteration(given, DAMPING), tolerance, most)
    if first.status not in (SolverStatus.INACCURATE, SolverStatus.FAILED):
        return first
    left = most - first.iterations
    second = _run(Iteration(given, LESS), tolerance, left)
    best = second if second.merit < first.merit else first
    return best._replace(iterations=first.iterations + second.iterations)


def _run(program: Iteration, tolerance: float, most: int) -> Optimum:
    """Iterate from the start to an optimum, or until that stalls."""
    point = best = program.start()
    least, iterations, idle, short, over = np.inf, 0, 0, 0, False
    with np.errstate(all="ignore"):  # what overflows ends the run
        while not over and iterations < most and not clock().late:
            try:
                following, missed, length = program.step(point)
            except TimeOverError:
                break
            except np.linalg.LinAlgError:  # no factor for any shift: an iterate that is lost
                over = True
                break
            better = missed.merit < least
            idle, short = (0 if better else idle + 1), (short + 1 if length < SHORT_STEP else 0)
            if better:
                best, least = point, missed.merit
            lost = not np.isfinite(missed.merit) or idle > PATIENCE or short > 3
            enough = least <= FURTHER * tolerance or (least <= tolerance and idle > 2)
            point, over, iterations = following, lost or enough, iterations + 1
    if not (np.isfinite(least) and all(np.isfinite(part).all() for part in best)):
        blank = np.zeros(len(best.y) - 1), np.full_like(best.X, np.nan)
        failed = SolverStatus.LIMIT if clock().late else SolverStatus.FAILED
        return Optimum(np.nan, *blank, failed, least, iterations)
    ended = SolverStatus.INACCURATE if over else SolverStatus.LIMIT
    status = SolverStatus.SOLVED if least <= tolerance else ended
    return Optimum(best.y[-1], best.y[:-1], best.X, status, least, iterations)


def symmetric(matrix: np.ndarray) -> np.ndarray:
    """The symmetric part."""
    return (matrix + matrix.T) / 2


def _to_boundary(inverse: np.ndarray, move: np.ndarray) -> float:
    """The longest step that keeps `M + t dM` semidefinite, given the inverse of `M`'s factor."""
    least = float(np.linalg.eigvalsh(inverse @ move @ inverse.T)[0])
    return -1 / least if least < 0 else np.inf


def _to_zero(value: np.ndarray, move: np.ndarray) -> float:
    """The longest step that keeps a vector nonnegative."""
    falling = move < 0
    return float(np.min(-value[falling] / move[falling], initial=np.inf))
