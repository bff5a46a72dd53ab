"""A linear model predictive controller, the teacher of the learned one.

At the measured state `x_0` solve (Borrelli, Bemporad, Morari, *Predictive Control*, ch. 12)

    minimise    sum_{k < N} (x_k' Q x_k + u_k' R u_k)  +  x_N' P x_N
    subject to  x_{k+1} = A x_k + B u_k,   u_k in U,
                x_k in X  for k = 1 .. N-1,   x_N in O_inf,

and apply `u_0`. `P` solves the discrete Riccati equation and `O_inf` is the largest set in which
its feedback `u = -K x` keeps every later state in `X` and every later input in `U`; `O_inf` lies in
`X`, so all of `x_1 .. x_N` do. `x_0` itself is measured, not decided, and is not constrained: from
a state outside `X` the controller returns to `X` in one step, or says that it cannot.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
import scipy.sparse
from clarabel import DefaultSettings, DefaultSolver, NonnegativeConeT  # type: ignore[attr-defined]
from jaxtyping import Float
from numpy import ndarray
from rich.progress import track
from scipy.optimize import linprog

# A point counts as inside a half-space `r . x <= 1` up to this much: the accuracy of HiGHS.
TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class LinearMPC:
    """The controller of the module's docstring, for boxes `X` and `U` with the origin inside."""

    A: Float[ndarray, "n n"]
    B: Float[ndarray, "n m"]
    Q: Float[ndarray, "n n"]
    R: Float[ndarray, "m m"]
    horizon: int
    state_lower: Float[ndarray, " n"]
    state_upper: Float[ndarray, " n"]
    input_lower: Float[ndarray, " m"]
    input_upper: Float[ndarray, " m"]

    def __post_init__(self):
        """Keep read-only copies of the arrays, and say which argument is wrong."""
        for name in ("A", "B"):
            shape = np.shape(getattr(self, name))
            if len(shape) != 2 or 0 in shape:
                raise ValueError(f"{name} must be a matrix, got shape {shape}")
        n, m = np.shape(self.A)[0], np.shape(self.B)[1]
        shapes = {"A": (n, n), "B": (n, m), "Q": (n, n), "R": (m, m)}
        shapes |= {
            "state_lower": (n,),
            "state_upper": (n,),
            "input_lower": (m,),
            "input_upper": (m,),
        }
        for name, shape in shapes.items():
            object.__setattr__(self, name, as_array(name, getattr(self, name), shape))
        if not isinstance(self.horizon, int) or self.horizon < 1:
            raise ValueError(f"horizon must be an integer >= 1, got {self.horizon!r}")
        positive_definite("Q", self.Q, semi=True)
        positive_definite("R", self.R)
        for name in ("state", "input"):
            lower, upper = getattr(self, f"{name}_lower"), getattr(self, f"{name}_upper")
            if not (np.all(lower < 0) and np.all(upper > 0)):
                raise ValueError(
                    f"{name}_lower and {name}_upper must have the origin strictly between them, "
                    f"got {lower} and {upper}"
                )

    @cached_property
    def terminal_weight(self) -> Float[ndarray, "n n"]:
        """`P`, the stabilising Riccati solution: the cost to go without constraints."""
        return scipy.linalg.solve_discrete_are(self.A, self.B, self.Q, self.R)

    @cached_property
    def gain(self) -> Float[ndarray, "m n"]:
        """`K`, the LQR feedback `u = -K x` that belongs to `P`."""
        BP = self.B.T @ self.terminal_weight
        return np.linalg.solve(self.R + BP @ self.B, BP @ self.A)

    @cached_property
    def terminal_rows(self) -> Float[ndarray, "rows n"]:
        """`F` with `O_inf = {x : F x <= 1}`, no row redundant."""
        states = _box_rows(self.state_lower, self.state_upper)
        inputs = _box_rows(self.input_lower, self.input_upper) @ -self.gain
        return maximal_invariant_set(self.A - self.B @ self.gain, np.vstack([states, inputs]))

    def input(self, x: Float[ndarray, " n"]) -> Float[ndarray, " m"] | None:
        """The first input of the optimal plan, or None where no plan satisfies the constraints."""
        plan = self.plan(x)
        return None if plan is None else plan[0]

    def plan(self, x: Float[ndarray, " n"]) -> Float[ndarray, "N m"] | None:
        """All `N` inputs of the optimal plan from `x`, or None where there is none."""
        x = as_array("x", x, (len(self.A),))
        solver, gradient, offset, slope = self._program
        solver.update(q=gradient @ x, b=offset - slope @ x)
        solution = solver.solve()
        status = str(solution.status)
        if status == "Solved":
            return np.array(solution.x).reshape(self.horizon, -1)
        if status in ("PrimalInfeasible", "AlmostPrimalInfeasible"):
            return None
        raise RuntimeError(
            f"the MPC program at x = {x} was neither solved nor infeasible: {status}"
        )

    def batch(self, states: Float[ndarray, "count n"], progress=False) -> Float[ndarray, "count m"]:
        """`input` for each row, NaN where infeasible; `progress` shows a bar."""
        shape = (len(states), len(self.A))
        inputs = np.full((shape[0], self.B.shape[1]), np.nan)
        rows = track(as_array("states", states, shape), "solving the MPC", disable=not progress)
        for row, x in enumerate(rows):
            u = self.input(x)
            if u is not None:
                inputs[row] = u
        return inputs

    @cached_property
    def _program(self):
        """The condensed program, set up once: only `q` and `b` depend on the state `x`.

        With `X = Phi x + G U` the cost is `U' H U / 2 + (gradient x) . U` up to a constant, and
        the constraints are `rows U <= offset - slope x`.
        """
        N, (n, m) = self.horizon, self.B.shape
        powers = [np.linalg.matrix_power(self.A, k) for k in range(N + 1)]
        Phi = np.vstack(powers[1:])
        zero = np.zeros((n, m))
        G = np.block(
            [[powers[k - j] @ self.B if j <= k else zero for j in range(N)] for k in range(N)]
        )
        weight = np.asarray(scipy.linalg.block_diag(*[self.Q] * (N - 1), self.terminal_weight))
        hessian = 2 * (G.T @ weight @ G + np.kron(np.eye(N), self.R))
        states = [_box_rows(self.state_lower, self.state_upper)] * (N - 1)
        on_states = np.asarray(scipy.linalg.block_diag(*states, self.terminal_rows))
        on_inputs = np.kron(np.eye(N), _box_rows(self.input_lower, self.input_upper))
        rows = np.vstack([on_states @ G, on_inputs])
        slope = np.vstack([on_states @ Phi, np.zeros((len(on_inputs), n))])
        offset = np.ones(len(rows))

        settings = DefaultSettings()
        settings.verbose = False
        settings.presolve_enable = False  # presolve may drop rows, and `update` would not know
        # Where a constraint is only just active the input's error is of the order of the root of
        # the gap: measured, 2e-6 with 1e-10 and 6e-8 with 1e-12.
        settings.tol_gap_abs = settings.tol_gap_rel = 1e-12
        settings.tol_feas = 1e-10
        solver = DefaultSolver(
            scipy.sparse.csc_matrix(np.triu(hessian)),
            np.zeros(N * m),
            scipy.sparse.csc_matrix(rows),
            offset,
            [NonnegativeConeT(len(rows))],
            settings,
        )
        return solver, 2 * G.T @ weight @ Phi, offset, slope


def maximal_invariant_set(
    A: Float[ndarray, "n n"], rows: Float[ndarray, "k n"], most_steps: int = 200
) -> Float[ndarray, "rows n"]:
    """`F` with `{x : F x <= 1} = {x : rows A^t x <= 1 for all t >= 0}` (Gilbert and Tan, 1991).

    Adds the constraints of one more step until a linear program per row shows that they follow
    from those already there. They do after finitely many steps when `A` is stable and
    `rows x <= 1` is bounded, with the origin inside.
    """
    F, later = rows, rows @ A
    for _ in range(most_steps):
        new = [row for row in later if _largest(row, F) > 1 + TOLERANCE]
        if not new:
            return _irredundant(F)
        F, later = np.vstack([F, new]), later @ A
    raise ValueError(f"no invariant set after {most_steps} steps; A must be stable, got\n{A}")


def _largest(row: ndarray, F: ndarray) -> float:
    """The maximum of `row . x` over `F x <= 1`."""
    answer = linprog(-row, A_ub=F, b_ub=np.ones(len(F)), bounds=(None, None), method="highs")
    if not answer.success:
        raise ValueError(f"rows must bound every direction; along {row}: {answer.message}")
    return -answer.fun


def _irredundant(F: ndarray) -> ndarray:
    """The rows of `F x <= 1` that do not follow from the others."""
    kept = np.full(len(F), True)
    for i, row in enumerate(F):
        kept[i] = False
        # The row itself, looser, keeps the program bounded.
        kept[i] = _largest(row, np.vstack([F[kept], row / 2])) > 1 + TOLERANCE
    return F[kept]


def _box_rows(lower: ndarray, upper: ndarray) -> ndarray:
    """`r` with `lower <= x <= upper` exactly when `r x <= 1`, the origin strictly inside."""
    return np.vstack([np.diag(1 / upper), np.diag(1 / lower)])


def positive_definite(name: str, matrix: ndarray, *, semi: bool = False) -> None:
    """Raise an error that names `matrix` unless it is symmetric and positive (semi)definite."""
    smallest = np.linalg.eigvalsh(matrix)[0] if np.allclose(matrix, matrix.T) else -np.inf
    if smallest < 0 or (smallest == 0 and not semi):
        kind = "semidefinite" if semi else "definite"
        raise ValueError(f"{name} must be symmetric positive {kind}, got\n{matrix}")


def as_array(name: str, value, shape: tuple[int, ...]) -> ndarray:
    """`value` as a read-only array of the given shape, or an error that names it."""
    array = np.array(value, float)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got shape {array.shape}")
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{name} must be finite, got {array}")
    array.flags.writeable = False
    return array
