"""A nonlinear model predictive controller of the quadrotor, the teacher of the learned one.

At the measured state `x_0` solve, with pitch, roll and thrust `(theta, phi, tau)_k` held over each
period,

    minimise    sum_{k < N} (x_k' Q x_k + d_k' R d_k),   d_k = (theta, phi, tau - g)_k,
    subject to  x_{k+1} = f(x_k, theta_k, phi_k, tau_k)    (Runge-Kutta of order four),   x_N = 0,
                |theta_k|, |phi_k| <= angle limit,   0 <= tau_k <= thrust limit,
                |p_k| <= position limit,   |v_k| <= velocity limit    for k = 1 .. N-1,

and apply `(theta, phi, tau)_0`. Thrust is penalised by its deviation from hover: a penalty on `tau`
itself would let the quadrotor fall first. `x_0` is measured and not constrained.

In the coordinates `u = (tan(theta), tan(phi), tau)` the dynamics are affine and the limits are
boxes. The cost is convex in `u` too where `|theta|, |phi| < 0.65` rad, as the square of `atan(s)`
is convex while `s atan(s) <= 1/2`. So the optimum is unique, what the interior-point method finds
is global, and no start but hover is needed. Where it finds nothing, a linear program decides
whether there is a plan at all.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.sparse
from jaxtyping import Float
from numpy import ndarray
from rich.progress import track
from scipy.optimize import linprog

from experiments.double_integrator.mpc import as_array, positive_definite
from experiments.quadrotor.model import ANGLE_LIMIT, GRAVITY, PERIOD

MOST_ITERATIONS = 200
"""Of IPOPT; where there is a plan, it needs some 20."""
INTERRUPTED = "NonIpopt_Exception_Thrown"
"""What IPOPT makes of Ctrl-C, which it swallows."""
STEEPEST = 0.65
"""Angles, in radians, up to which the program is convex."""


@dataclass(frozen=True, eq=False)
class QuadrotorMPC:
    """The controller of the module's docstring; its inputs are `(tan(theta), tan(phi), tau)`."""

    horizon: int = 30
    period: float = PERIOD
    """Seconds."""
    Q: Float[ndarray, "6 6"] = field(default_factory=lambda: np.eye(6))
    R: Float[ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    angle_limit: float = ANGLE_LIMIT
    thrust_limit: float = 2 * GRAVITY
    position_limit: float = 5.0
    velocity_limit: float = np.inf

    def __post_init__(self):
        """Keep read-only copies of the matrices, and say which argument is wrong."""
        for name, size in (("Q", 6), ("R", 3)):
            object.__setattr__(self, name, as_array(name, getattr(self, name), (size, size)))
            positive_definite(name, getattr(self, name), semi=name == "Q")
        if not isinstance(self.horizon, int) or self.horizon < 2:
            raise ValueError(
                f"horizon must be an integer >= 2 (6 states, 3 inputs), got {self.horizon!r}"
            )
        for name in ("period", "position_limit", "velocity_limit"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be above 0, got {getattr(self, name)!r}")
        if not np.isfinite(self.period):
            raise ValueError(f"period must be finite, got {self.period!r}")
        if not 0 < self.angle_limit <= STEEPEST:
            raise ValueError(
                f"angle_limit must be in (0, {STEEPEST}] rad, where the program is convex, "
                f"got {self.angle_limit!r}"
            )
        if not self.thrust_limit > GRAVITY:
            raise ValueError(
                f"thrust_limit must be above {GRAVITY}, what hovering takes, "
                f"got {self.thrust_limit!r}"
            )

    def __call__(self, x: Float[ndarray, " 6"]) -> Float[ndarray, " 3"]:
        """The first input of the optimal plan, NaN where no plan satisfies the constraints."""
        plan = self.plan(x)
        return np.full(3, np.nan) if plan is None else plan[0]

    def plan(self, x: Float[ndarray, " 6"]) -> Float[ndarray, "N 3"] | None:
        """All `N` inputs of the optimal plan from `x`, or None where there is none."""
        x = as_array("x", x, (6,))
        solver, arguments = self._program
        solution = solver(p=x, **arguments)
        status = solver.stats()["return_status"]
        if status == "Solve_Succeeded":
            angles_and_thrust = np.array(solution["x"])[: 3 * self.horizon].reshape(-1, 3)
            return np.hstack([np.tan(angles_and_thrust[:, :2]), angles_and_thrust[:, 2:]])
        if status == INTERRUPTED:
            raise KeyboardInterrupt
        if not self._has_plan(x):
            return None
        raise RuntimeError(f"the MPC program at x = {x} has a plan, but IPOPT ended with {status}")

    def batch(self, states: Float[ndarray, "count 6"], progress=False) -> Float[ndarray, "count 3"]:
        """The input for each row, NaN where infeasible; `progress` shows a bar."""
        rows = as_array("states", states, (len(states), 6))
        inputs = [self(x) for x in track(rows, "solving the MPC", disable=not progress)]
        return np.reshape(inputs, (-1, 3))

    def _has_plan(self, x):
        """Whether a plan satisfies the constraints, with `(tan(theta), tan(phi), tau)_k` and
        `x_1 .. x_N` as variables.
        """
        N, h = self.horizon, self.period
        push = np.diag([GRAVITY, -GRAVITY, 1])
        A, B = np.eye(6) + h * np.eye(6, k=3), np.vstack([h**2 / 2 * push, h * push])
        steps = scipy.sparse.hstack(
            [
                scipy.sparse.kron(scipy.sparse.eye(N), B),
                scipy.sparse.kron(scipy.sparse.eye(N, k=-1), A) - scipy.sparse.eye(6 * N),
            ]
        )
        fall = np.tile(GRAVITY * B[:, 2], N)
        fall[:6] -= A @ x
        lower, upper = self._bounds(np.tan(self.angle_limit))
        rest = np.zeros(6)
        bounds = np.column_stack([np.append(lower, rest), np.append(upper, rest)])
        answer = linprog(np.zeros(len(bounds)), A_eq=steps, b_eq=fall, bounds=bounds)
        if answer.status not in (0, 2):  # found, infeasible
            raise RuntimeError(f"whether x = {x} has a plan is undecided: {answer.message}")
        return answer.status == 0

    def _bounds(self, steepest):
        """Limits of all inputs, then of `x_1 .. x_{N-1}`; `steepest` is that of the angles."""
        inputs = [steepest, steepest, self.thrust_limit]
        states = [self.position_limit] * 3 + [self.velocity_limit] * 3
        upper = np.concatenate([np.tile(inputs, self.horizon), np.tile(states, self.horizon - 1)])
        lower = -upper
        lower[2 : 3 * self.horizon : 3] = 0
        return lower, upper

    @cached_property
    def _program(self):
        """IPOPT with exact derivatives, set up once: only the parameter `x_0` changes.

        The variables are all `(theta, phi, tau)_k`, then `x_1 .. x_{N-1}` (multiple shooting).
        """
        ca = _casadi()
        N = self.horizon
        x0, U, X = ca.SX.sym("x0", 6), ca.SX.sym("U", 3, N), ca.SX.sym("X", 6, N - 1)
        cost, defects = 0, []
        for k in range(N):
            x, u = (x0 if k == 0 else X[:, k - 1]), U[:, k]
            deviation = u - ca.vertcat(0, 0, GRAVITY)
            cost += ca.bilin(ca.DM(self.Q), x, x) + ca.bilin(ca.DM(self.R), deviation, deviation)
            target = X[:, k] if k < N - 1 else ca.DM.zeros(6)
            defects.append(self._successor(ca, x, u) - target)
        lower, upper = self._bounds(self.angle_limit)
        hover = np.zeros(len(upper))
        hover[2 : 3 * N : 3] = GRAVITY
        program = {
            "x": ca.vertcat(ca.vec(U), ca.vec(X)),
            "p": x0,
            "f": cost,
            "g": ca.vertcat(*defects),
        }
        options = {
            "print_time": False,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "ipopt.tol": 1e-9,
            "ipopt.max_iter": MOST_ITERATIONS,
            "ipopt.honor_original_bounds": "yes",
        }
        solver = ca.nlpsol("quadrotor_mpc", "ipopt", program, options)
        return solver, {"x0": hover, "lbx": lower, "ubx": upper, "lbg": 0, "ubg": 0}

    def _successor(self, ca, x, u):
        """One step of the classical Runge-Kutta method."""

        def rate(x):
            turn = GRAVITY * ca.tan(u[0]), -GRAVITY * ca.tan(u[1]), u[2] - GRAVITY
            return ca.vertcat(x[3:], *turn)

        h = self.period
        k1 = rate(x)
        k2 = rate(x + h / 2 * k1)
        k3 = rate(x + h / 2 * k2)
        k4 = rate(x + h * k3)
        return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def _casadi():
    """CasADi, imported when needed: it belongs to the extra `experiments` alone."""
    try:
        import casadi
    except ImportError:
        raise ImportError(
            "the quadrotor's MPC needs casadi: pip install 'reachjax[experiments]'"
        ) from None
    return casadi
