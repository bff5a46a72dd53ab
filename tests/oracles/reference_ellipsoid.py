"""Reach-SDP as printed, for ellipsoids: the smallest one that theorem 1 proves, in one program.

Written from Hu, Fazlyab, Morari, Pappas, "Reach-SDP" (CDC 2020) alone, in numpy and cvxpy, with the
matrices of `experiments.benchmark.reference`. The set of states is `|A x + b| <= 1` (proposition
2), and so is the successors' (eq. QI::reach_set_ellips), whose `A` and `b` are sought (problem
sdp::ellips):

    minimise  -log det A    subject to    M_in(P) + M_mid(Q) + M_out(S(A, b))  <=  0,

where M_out(S) = V' V - e e' with V = [A, b] E_out, and e picks the last 1. As V' V is not convex in
A, the Schur complement takes its place:

    [ e e' - M_in(P) - M_mid(Q)   V' ]
    [            V                I  ]  >=  0.

The program is solved in coordinates in which everything is of order one (a change of basis keeps
the matrix inequality what it is, and so the set): the state becomes that of the unit ball, neurons
are divided by the spread of their values over sampled states, and the sampled successors get
mean zero and the identity for covariance.
"""

import time
from typing import NamedTuple

import cvxpy as cp
import numpy as np

from experiments.benchmark.reference import (
    CLARABEL_TIGHT,
    paper_E_in,
    paper_E_mid,
    paper_E_out,
    relu_qc,
)

UNDECOMPOSED = CLARABEL_TIGHT | {"chordal_decomposition_enable": False}
"""Clarabel stalls more often where it splits the matrix into its cliques."""

SAMPLES = 2000
"""States that are simulated for the coordinates; these do not change what is proved."""
UNITS = (1.0, 8.0, 0.125, 64.0, 2.0, 0.5)
"""Units of the successor, in spreads of the samples, tried in turn while the solver stalls: what
theorem 1 proves may be far larger than what is sampled."""


class EllipsoidStep(NamedTuple):
    """`(x - center)' shape^-1 (x - center) <= 1`, the solver's status, and its seconds."""

    center: np.ndarray
    shape: np.ndarray
    status: str
    seconds: float


def ellipsoid_qc(A, b, mu):
    """Proposition 2: P = mu [-A' A, -A' b; -b' A, 1 - b' b], basis [x, 1]."""
    rows = np.column_stack([A, b])
    corner = np.zeros((len(b) + 1, len(b) + 1))
    corner[-1, -1] = 1.0
    return mu * (corner - rows.T @ rows)


def ellipsoid_rows(A, b, E_out):
    """`V = [A, b] E_out`: M_out(S) of eq. QI::reach_set_ellips is `V' V - e e'`."""
    return A @ E_out[:-1] + cp.reshape(b, (len(E_out) - 1, 1), order="C") @ E_out[-1:]


def basis_points(layers, u_lower, u_upper, x):
    """Equation proj_NN, layer by layer: a row [x^0, ..., x^l, (x^{l+1}, x^{l+2}), 1] for each x."""
    blocks = [x]
    for W, b in layers[:-1]:
        blocks.append(np.maximum(blocks[-1] @ W.T + b, 0.0))
    if u_lower is not None:
        W, b = layers[-1]
        blocks.append(np.maximum(blocks[-1] @ W.T + b - u_lower, 0.0) + u_lower)
        blocks.append(-np.maximum(u_upper - blocks[-1], 0.0) + u_upper)
    return np.hstack([*blocks, np.ones((len(x), 1))])


def paper_ellipsoid_step(
    layers, A, B, c, u_lower, u_upper, center, shape, repeated=True, options=None
):
    """One step of problem sdp::ellips, from the ellipsoid (center, shape).

    A (n_x, n_x), B (n_x, n_u), c (n_x,) at this time; u_lower, u_upper (n_u,) or both None;
    center (n_x,), shape (n_x, n_x) positive definite. With `repeated`, every pair of units has a
    lambda_ij. `options` goes to `cvxpy.Problem.solve`, UNDECOMPOSED by default. Without hidden
    layer and input box the loop is affine and there is no M_mid.

    Returns an EllipsoidStep; its numbers are NaN where the solver has none.
    """
    start = time.perf_counter()
    boxed, n_x = u_lower is not None, len(center)
    factor = np.linalg.cholesky(shape)
    xi = basis_points(layers, u_lower, u_upper, center + unit_ball(n_x, SAMPLES) @ factor.T)
    E_in, E_out = paper_E_in(layers, boxed), paper_E_out(layers, A, B, c, boxed)
    affine = not boxed and len(layers) == 1
    E_mid = np.eye(1, n_x + 1, n_x) if affine else paper_E_mid(layers, u_lower, u_upper)
    T = _coordinates(xi, E_mid, center, factor)
    whiten = np.linalg.inv(factor)
    mu = cp.Variable(nonneg=True)
    facts = mu * (T.T @ E_in.T @ ellipsoid_qc(whiten, -whiten @ center, 1.0) @ E_in @ T)
    signs = []
    if not affine:
        Q, signs = _relu_multipliers(E_mid @ T, repeated)
        facts = facts + (E_mid @ T).T @ Q @ (E_mid @ T)
    found = smallest_ellipsoid(facts, signs, E_out @ T, xi @ E_out[:-1].T, options)
    return found._replace(seconds=time.perf_counter() - start)


def smallest_ellipsoid(facts, signs, E_out, successors, options=None):
    """The Schur complement's problem in the units in which it is solved best.

    facts (n, n): an expression that is never negative on a trajectory; signs: its multipliers'
    constraints; E_out (n_x + 1, n): rows of the successor and of 1; successors (k, n_x): samples,
    for the units. `options` as in `paper_ellipsoid_step`. Returns an EllipsoidStep of 0 seconds.
    """
    n_x = len(E_out) - 1
    middle, spread = _whitening(successors)
    best = EllipsoidStep(np.full(n_x, np.nan), np.full((n_x, n_x), np.nan), "solver_error", 0.0)
    for unit in UNITS:
        root, offset, status = _smallest(facts, signs, E_out, middle, unit * spread, options)
        solved = status in cp.settings.SOLUTION_PRESENT
        if status == cp.OPTIMAL or (solved and best.status not in cp.settings.SOLUTION_PRESENT):
            best = EllipsoidStep(
                middle - np.asarray(root) @ np.asarray(offset), root @ root.T, status, 0.0
            )
        if status == cp.OPTIMAL:
            break
    return best


def _smallest(facts, signs, E_out, middle, spread, options):
    """The Schur complement's problem with outputs `w`, `x+ = middle + spread w`.

    Returns `inv(A)` in terms of x+, `b`, and the solver's status.
    """
    n_x, n = len(middle), E_out.shape[1]
    A, b = cp.Variable((n_x, n_x), PSD=True), cp.Variable(n_x)
    whitened = np.linalg.solve(spread, E_out[:-1] - np.outer(middle, E_out[-1]))
    V = ellipsoid_rows(A, b, np.vstack([whitened, E_out[-1]]))
    corner = np.zeros((n, n))
    corner[-1, -1] = 1.0
    schur = cp.bmat([[corner - facts, V.T], [V, np.eye(n_x)]])
    problem = cp.Problem(cp.Maximize(cp.log_det(A)), [(schur + schur.T) / 2 >> 0, *signs])
    try:
        problem.solve(**(UNDECOMPOSED if options is None else options))
    except cp.SolverError:
        return np.full((n_x, n_x), np.nan), np.full(n_x, np.nan), "solver_error"
    if A.value is None:
        return np.full((n_x, n_x), np.nan), np.full(n_x, np.nan), problem.status
    return spread @ np.linalg.inv(A.value), b.value, problem.status


def _relu_multipliers(E_mid, repeated):
    """Q of lemma 1, multipliers in units of the sizes of inputs and outputs, and their signs."""
    units = (len(E_mid) - 1) // 2
    lam, nu, eta = cp.Variable(units), cp.Variable(units), cp.Variable(units)
    signs, lam_ij = [nu >= 0, eta >= 0], None
    sizes = np.linalg.norm(E_mid[:units], axis=1) + np.linalg.norm(E_mid[units:-1], axis=1)
    sizes = np.where(sizes > 0, sizes, 1.0)
    if repeated:
        weights = cp.Variable((units, units), symmetric=True)
        signs += [weights >= 0, cp.diag(weights) == 0]
        lam_ij = cp.multiply(weights, 1 / np.outer(sizes, sizes))
    Q = relu_qc(cp.multiply(lam, 1 / sizes**2), nu / sizes, eta / sizes, lam_ij)
    return Q, signs


def _coordinates(xi, E_mid, center, factor):
    """`T` with `xi = T [y, z, 1]`: y the state in the unit ball, z the neurons in their spreads.

    A neuron that stays off has no spread: a tenth of its input's size stands in for it.
    """
    n_x, units = len(center), (len(E_mid) - 1) // 2
    neurons, size = xi[:, n_x:-1], abs(xi @ E_mid[:units].T).max(axis=0)
    middle = neurons.mean(axis=0)
    spread = abs(neurons - middle).max(axis=0)
    spread = np.where(spread > 1e-6 * size, spread, size / 10)
    T = np.eye(xi.shape[1])
    T[:n_x, :n_x], T[:n_x, -1] = factor, center
    T[n_x:-1, n_x:-1], T[n_x:-1, -1] = np.diag(spread), middle
    return T


def _whitening(points):
    """Mean, and `F` with `F F'` the covariance, of points (k, n); `F` is never quite singular."""
    middle = points.mean(axis=0)
    covariance = np.atleast_2d(np.cov(points.T))
    axes, squares = np.linalg.eigh(covariance)[::-1]
    return middle, axes * np.sqrt(np.maximum(squares, 1e-8 * squares.max()))


def unit_ball(n, count):
    """Points (count, n) of the unit ball, half of them on its surface."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(count, n))
    radii = np.minimum(1.0, 2.0 * rng.uniform(size=(count, 1)))
    return radii * points / np.linalg.norm(points, axis=1, keepdims=True)
