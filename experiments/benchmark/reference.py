"""Reach-SDP as printed: the paper's propositions, one semidefinite program per facet.

Written from Hu, Fazlyab, Morari, Pappas, "Reach-SDP" (CDC 2020) alone, in numpy and cvxpy, so that
the library can be compared with it and timed against it. For one step of

    x+ = A x + B u + c,    u = min(max(pi(x), u_lower), u_upper),    set_A x <= set_b

it stacks the paper's basis xi = [x^0, x^1, ..., x^l, x^{l+1}, x^{l+2} = u, 1] (eq. seq_basis) and
finds, for each direction a, the smallest b for which Theorem 1 proves a . x+ <= b:

    minimise b   over P (proposition 1) and Q (lemma 1)
    subject to   E_in' P E_in + E_mid' Q E_mid + E_out' S(a, b) E_out  <=  0.

Without an input box the two projection layers go: the basis ends with [x^l, 1], and
u = W^l x^l + b^l enters E_out. `layers` is [(W^0, b^0), ..., (W^l, b^l)] with W^k of shape
(n_{k+1}, n_k). Boxes are given as two vectors, or None for both.

Three slips of the print, corrected here: S_i has size n_x + 1, M has size n_x + n_n + 2 n_u + 1,
and T need not be positive semidefinite, since lambda_i is free (each z_i (z_i - y_i) is zero).
"""

import time

import cvxpy as cp
import numpy as np

# Aim at 1e-9. Where Clarabel stalls before that (programs without an interior), its status is
# "optimal_inaccurate" if the reduced tolerances hold: 1e-7 here, in place of its default 5e-5.
CLARABEL_TIGHT = {
    "solver": cp.CLARABEL,
    **{f"tol_{name}": 1e-9 for name in ("gap_abs", "gap_rel", "feas")},
    **{f"reduced_tol_{name}": 1e-7 for name in ("gap_abs", "gap_rel", "feas")},
}
UNITS = (1.0, 8.0, 0.125)
"""Units of the objective, tried in turn where the solver breaks down."""


def basis_sizes(layers, boxed):
    """Lengths of the blocks x^0, x^1, ... of the basis (eq. seq_basis), without the final 1."""
    n_u = layers[-1][0].shape[0]
    return [W.shape[1] for W, _ in layers] + [n_u, n_u] * boxed


def paper_E_in(layers, boxed):  # noqa: N802
    """Proposition 3: E_in xi = [x^0, 1], of shape (n_x + 1, N)."""
    n_x, N = layers[0][0].shape[1], sum(basis_sizes(layers, boxed)) + 1
    E = np.zeros((n_x + 1, N))
    E[:n_x, :n_x] = np.eye(n_x)
    E[-1, -1] = 1.0
    return E


def paper_E_mid(layers, u_lower, u_upper):  # noqa: N802
    """Proposition 5: E_mid xi = [y, z, 1] with z = max(y, 0), of shape (2 d + 1, N).

    y = A x + a and z = B x + b are the two sides of the appendix's B x + b = phi(A x + a), with d
    units: the hidden neurons, then (with an input box) n_u for each of the two projection layers.
    """
    hidden, (W_last, b_last) = layers[:-1], layers[-1]
    n_x, n_u = layers[0][0].shape[1], W_last.shape[0]
    A_blocks, a = [W for W, _ in hidden], [bias for _, bias in hidden]
    B_blocks, b = [np.eye(len(bias)) for bias in a], [np.zeros(len(bias)) for bias in a]
    if u_lower is not None:
        A_blocks += [W_last, -np.eye(n_u)]
        B_blocks += [np.eye(n_u), -np.eye(n_u)]
        a += [b_last - u_lower, u_upper]
        b += [-u_lower, u_upper]
    if not A_blocks:
        raise ValueError("layers has no hidden layer and there is no input box: the loop is affine")
    A, B, a, b = _block_diagonal(A_blocks), _block_diagonal(B_blocks), np.hstack(a), np.hstack(b)
    d, N = len(a), n_x + len(a) + 1
    E = np.zeros((2 * d + 1, N))
    E[:d, : A.shape[1]] = A  # no unit reads the last block: its columns stay zero
    E[d:-1, n_x:-1] = B  # no unit outputs x^0
    E[:d, -1], E[d:-1, -1], E[-1, -1] = a, b, 1.0
    return E


def paper_E_out(layers, A, B, c, boxed):  # noqa: N802
    """Proposition 4: E_out xi = [x+, 1], of shape (n_x + 1, N)."""
    sizes = basis_sizes(layers, boxed)
    n_x, last = sizes[0], sizes[-1]
    W_last, b_last = layers[-1]
    E = np.zeros((n_x + 1, sum(sizes) + 1))
    E[:n_x, :n_x] = A
    E[:n_x, -1 - last : -1] += B if boxed else B @ W_last
    E[:n_x, -1] = c if boxed else c + B @ b_last
    E[-1, -1] = 1.0
    return E


def polytope_qc(A, b, Gamma):
    """Proposition 1: P = [A' Gamma A, -A' Gamma b; -b' Gamma A, b' Gamma b], basis [x, 1].

    [x, 1]' P [x, 1] = (A x - b)' Gamma (A x - b), nonnegative on {A x <= b} for Gamma >= 0.
    Gamma (m, m) is an array or a cvxpy expression, and so is the result (n_x + 1, n_x + 1).
    """
    facets = np.column_stack([A, -b])
    return facets.T @ Gamma @ facets


def relu_qc(lam, nu, eta, lam_ij=None):
    """Lemma 1: Q = [0, T, -nu; T, -2T, nu + eta; -nu', nu' + eta', 0], basis [y, max(y, 0), 1].

        T = sum_i lam_i e_i e_i' + sum_{i<j} lam_ij (e_i - e_j)(e_i - e_j)'

    lam, nu, eta have shape (d,): lam free, nu and eta >= 0. lam_ij (d, d) holds the repeated-slope
    multipliers, symmetric and >= 0 (its diagonal drops out); None stands for zero. Returns a cvxpy
    expression; a constant one, with its array in `.value`, when the multipliers are arrays.
    """
    T = cp.diag(lam)
    if lam_ij is not None:
        # The sum over pairs is the Laplacian of the graph with weights lam_ij.
        T = T + cp.diag(cp.sum(lam_ij, axis=1)) - lam_ij
    d = lam.shape[0]
    nu = cp.reshape(nu, (d, 1), order="C")
    eta = cp.reshape(eta, (d, 1), order="C")
    return cp.bmat(
        [
            [np.zeros((d, d)), T, -nu],
            [T, -2 * T, nu + eta],
            [-nu.T, (nu + eta).T, np.zeros((1, 1))],
        ]
    )


def facet_matrix(a, b):
    """Equation QI::reach_set_poly: S = [0, a; a', -2b], so [x, 1]' S [x, 1] = 2 (a . x - b)."""
    a = np.reshape(a, (-1, 1))
    return cp.bmat([[np.zeros((len(a), len(a))), a], [a.T, cp.reshape(-2 * b, (1, 1), order="C")]])


def paper_step(
    layers, A, B, c, u_lower, u_upper, set_A, set_b, directions, repeated=False, options=None
):
    """One step of eq. seq_SDP: the smallest offset that Theorem 1 proves, for each direction.

    A (n_x, n_x), B (n_x, n_u), c (n_x,) at this time; u_lower, u_upper (n_u,) or both None;
    set_A (p, n_x), set_b (p,); directions (m, n_x). With `repeated`, every pair of units in the
    stacked [y, z] has a lambda_ij, the projection layers included. `options` goes to
    `cvxpy.Problem.solve`, CLARABEL_TIGHT by default; an inaccurate optimum counts as an answer, so
    other options decide how inaccurate it may be.

    Returns (offsets, seconds), each (m,): a facet's seconds are those of building and solving its
    program, which is built anew from the paper's matrices.
    """
    offsets, seconds = np.zeros(len(directions)), np.zeros(len(directions))
    for i, a in enumerate(directions):
        start = time.perf_counter()
        b = cp.Variable()
        M, constraints = paper_lmi(layers, A, B, c, u_lower, u_upper, set_A, set_b, a, b, repeated)
        status = "unsolved"
        for unit in UNITS:
            problem = cp.Problem(cp.Minimize(unit * b), [M << 0, *constraints])
            try:
                problem.solve(**(CLARABEL_TIGHT if options is None else options))
                status = problem.status
            except cp.SolverError:
                status = "solver_error"
            if status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
                break
        else:
            raise RuntimeError(f"facet {i}: expected status 'optimal', got '{status}'")
        seconds[i] = time.perf_counter() - start
        offsets[i] = b.value
    return offsets, seconds


def paper_lmi(layers, A, B, c, u_lower, u_upper, set_A, set_b, a, b, repeated):
    """Theorem 1: the left-hand side M_in(P) + M_mid(Q) + M_out(S), and its multipliers' signs."""
    boxed = u_lower is not None
    E_in = paper_E_in(layers, boxed)
    E_mid = paper_E_mid(layers, u_lower, u_upper)
    E_out = paper_E_out(layers, A, B, c, boxed)

    facets, units = len(set_b), (len(E_mid) - 1) // 2
    # A diagonal entry of Gamma adds a positive semidefinite term and never helps: none is kept.
    Gamma = cp.Variable((facets, facets), symmetric=True)
    lam, nu, eta = cp.Variable(units), cp.Variable(units), cp.Variable(units)
    signs = [Gamma >= 0, cp.diag(Gamma) == 0, nu >= 0, eta >= 0]
    lam_ij = None
    if repeated:
        lam_ij = cp.Variable((units, units), symmetric=True)
        signs += [lam_ij >= 0, cp.diag(lam_ij) == 0]

    M_in = E_in.T @ polytope_qc(set_A, set_b, Gamma) @ E_in
    M_mid = E_mid.T @ relu_qc(lam, nu, eta, lam_ij) @ E_mid
    M_out = E_out.T @ facet_matrix(a, b) @ E_out
    return M_in + M_mid + M_out, signs


def _block_diagonal(blocks):
    """The block-diagonal matrix of `blocks`."""
    rows, columns = (sum(block.shape[axis] for block in blocks) for axis in (0, 1))
    out, i, j = np.zeros((rows, columns)), 0, 0
    for block in blocks:
        out[i : i + block.shape[0], j : j + block.shape[1]] = block
        i, j = i + block.shape[0], j + block.shape[1]
    return out
