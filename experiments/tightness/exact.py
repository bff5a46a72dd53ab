"""What a loop can exactly reach: the largest value of a direction, by mixed-integer programming.

An unrolled loop of ReLUs is a mixed-integer linear program (Tjeng, Xiao, Tedrake, Evaluating
Robustness of Neural Networks with Mixed Integer Programming, ICLR 2019): a unit `z = max(y, 0)`
whose input can have either sign is

    z >= 0,   z >= y,   z <= u d,   z - y <= -l (1 - d),   d in {0, 1},   l <= y <= u,

and the others are affine. Written from the definition of the loop, weights, plant and sets, and
with nothing of what certifies it, this says how tight a certificate is. It takes seconds for some
tens of units that switch, and may take forever for hundreds. Tolerances of HiGHS are absolute: it
is for sets and weights of order one.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float
from numpy import ndarray
from scipy.optimize import OptimizeResult, linprog, milp

import reachjax as rj

SHARP = 1e-5
"""How far apart the value and HiGHS's bound of it may be, as a part of the direction's range.

HiGHS takes 1e-6 from a whole number for a whole number, in each unit."""

SPARE = 1e-6
"""By which part of its size the range of a unit's input is enlarged: ten times what a linear
program may be off by."""


def exact_maximum(
    loop: rj.ClosedLoop, X0: rj.Box | rj.Polytope, k: int, direction: ArrayLike, start: int = 0
) -> tuple[float, Float[ndarray, " n_x"]]:
    """The largest value of a direction of the states after `k` steps.

    Args:
        loop: the closed loop, of ReLUs.
        X0: the set of initial states.
        k: after how many steps.
        direction: `(n_x,)`, whose product with the state is sought.
        start: the time of the initial set, for time-varying loops.

    Returns:
        The value, which is simulated, and the initial state that attains it. No other state has a
        larger value by more than `SHARP` times the range of the direction.

    Raises:
        TypeError: `X0` is no box and no polytope, or the network is not of ReLUs.
        ValueError: sizes disagree, or `X0` is empty or unbounded.
        RuntimeError: HiGHS did not find the maximum.

    Example:
        >>> plant = rj.AffinePlant([[1.0]], [[1.0]])
        >>> net = rj.MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.5, -0.5]], [0.0])])
        >>> loop = rj.ClosedLoop(plant, net)  # x+ = x - |x| / 2
        >>> value, state = exact_maximum(loop, rj.Box([-1.0], [2.0]), 1, [1.0])
        >>> round(value, 6), state.round(6).tolist()
        (1.0, [2.0])
    """
    rows = np.asarray(direction, float)[None]
    values, states = exact_maxima(loop, X0, k, rows, start)
    return float(values[0]), states[0]


def exact_maxima(
    loop: rj.ClosedLoop, X0: rj.Box | rj.Polytope, k: int, directions: ArrayLike, start: int = 0
) -> tuple[Float[ndarray, " m"], Float[ndarray, "m n_x"]]:
    """`exact_maximum` of several directions `(m, n_x)`: values, and initial states.

    The loop is unrolled once for all of them.
    """
    if not isinstance(X0, rj.PolyhedralSet):
        raise TypeError(f"X0 must be a Box or a Polytope, but {type(X0).__name__} arrived")
    activation = getattr(loop.controller, "activation", None)
    if not (isinstance(loop.controller, rj.MLP) and isinstance(activation, rj.ReLU)):
        kind = type(loop.controller).__name__
        raise TypeError(
            f"loop.controller must be an MLP, a network of ReLUs, but is {kind} of {activation}"
        )
    loop.check_horizon(k, start)
    rows = np.asarray(directions, float)
    if rows.ndim != 2 or not loop.states == X0.dimension == rows.shape[1]:
        raise ValueError(
            f"X0 and directions must be of the loop's {loop.states} states, but a set of dimension "
            f"{X0.dimension} and directions of shape {rows.shape} arrived"
        )
    program = _Program(X0, loop.units * k)
    state = program.state()
    for t in range(start, start + k):
        state = _successor(loop, program, state, t)
    found = [program.largest(row) for row in rows @ state]
    states, bounds, ranges = map(np.array, zip(*found, strict=True))
    if isinstance(X0, rj.Box):
        states = np.clip(states, X0.lower, X0.upper)
    ends = np.asarray(loop.simulate(jnp.asarray(states), k, start))[:, -1]
    values = np.einsum("ij,ij->i", rows, ends)
    # a single point has no range, but rounding
    allowed = SHARP * np.maximum(ranges, SPARE * (1 + abs(values)))
    if np.any(apart := abs(bounds - values) > allowed):
        raise RuntimeError(
            f"HiGHS is not sharp: {values[apart]} are attained, but {bounds[apart]} not excluded"
        )
    return values, states


def _affine(W: ArrayLike, rows: Float[ndarray, "n size"], b: ArrayLike) -> ndarray:
    """`W x + b`, the last column being that of the constant."""
    result = np.asarray(W) @ rows
    result[:, -1] += np.asarray(b)
    return result


def _successor(loop: rj.ClosedLoop, program: "_Program", state: ndarray, t: int) -> ndarray:
    """Rows of the state one step later."""
    net = loop.controller
    assert isinstance(net, rj.MLP)
    *hidden, (W, b) = net.layers
    z = state
    for V, a in hidden:
        z = program.relu(_affine(V, z, a))
    u = _affine(W, z, b)
    if loop.input_box is not None:
        box, eye = loop.input_box.at(t), np.eye(len(u))
        above = program.relu(_affine(eye, u, -box.lower))
        below = program.relu(_affine(-eye, above, box.upper - box.lower))
        u = _affine(-eye, below, box.upper)
    A, B, c = loop.plant.at(t)
    return _affine(A, state, c) + _affine(B, u, np.zeros(len(state)))


class _Program:
    """Variables, and what is known of them: `G v <= h`, intervals, and which are whole numbers.

    Rows over the variables have a last entry for the constant.

    Args:
        X0: what the first variables are in.
        units: how many there may be.
    """

    def __init__(self, X0: rj.PolyhedralSet, units: int):
        A, b = map(np.asarray, X0.facets)
        n = X0.dimension
        self._states, self._taken, self._size = n, n, n + 2 * units + 1
        self._G = np.hstack([A, np.zeros((len(A), self._size - n))])
        self._G[:, -1] = -b
        self._lower, self._upper = np.full(self._size - 1, -np.inf), np.full(self._size - 1, np.inf)
        self._whole = np.zeros(self._size - 1, dtype=bool)

    def state(self) -> Float[ndarray, "n_x size"]:
        """Rows of the first variables."""
        return np.eye(self._states, self._size)

    def relu(self, rows: Float[ndarray, "k size"]) -> Float[ndarray, "k size"]:
        """Rows of the outputs of units, given those of their inputs."""
        return np.array([self._unit(row) for row in rows]).reshape(-1, self._size)

    def _unit(self, y: Float[ndarray, " size"]) -> Float[ndarray, " size"]:
        lower, upper = -self._relaxed(-y), self._relaxed(y)
        spare = SPARE * (1 + max(abs(lower), abs(upper)))
        lower, upper = lower - spare, upper + spare
        if lower >= 0:
            return y
        if upper <= 0:
            return np.zeros_like(y)
        z, d, one = np.eye(self._size)[[self._taken, self._taken + 1, -1]]
        self._G = np.vstack([self._G, y - z, z - upper * d, z - y + lower * (one - d)])
        here = slice(self._taken, self._taken + 2)
        self._lower[here], self._upper[here] = 0.0, [upper, 1.0]
        self._whole[self._taken + 1] = True
        self._taken += 2
        return z

    def _parts(self) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        """`G`, `h` and intervals, of the variables that there are."""
        here = slice(0, self._taken)
        return self._G[:, here], -self._G[:, -1], self._lower[here], self._upper[here]

    def _relaxed(self, row: Float[ndarray, " size"]) -> float:
        """The largest value of a row where no variable need be whole."""
        G, h, lower, upper = self._parts()
        found = linprog(-row[: self._taken], G, h, bounds=np.stack([lower, upper], axis=1))
        if found.status in (2, 3):
            raise ValueError(f"X0 must be neither empty nor unbounded, but HiGHS: {found.message}")
        _require_optimal(found)
        return row[-1] - found.fun

    def largest(self, row: ndarray) -> tuple[Float[ndarray, " n_x"], float, float]:
        """The first variables where a row is largest, a bound of it, and the range it is within.

        Solved again with whole numbers held fast, as the first solution may be off by 1e-6.
        """
        G, h, lower, upper = self._parts()
        spread = self._relaxed(row) + self._relaxed(-row)
        scale = 1 / spread if spread > 0 else 1.0  # HiGHS's tolerances are absolute
        objective, whole = -scale * row[: self._taken], self._whole[: self._taken]
        found = milp(
            objective,
            integrality=whole,
            bounds=(lower, upper),
            constraints=(G, np.full(len(h), -np.inf), h),
            options={"mip_rel_gap": 0.0},
        )
        _require_optimal(found)
        bound = found.fun if found.mip_dual_bound is None else found.mip_dual_bound
        held = np.stack([np.where(whole, np.round(found.x), end) for end in (lower, upper)], axis=1)
        again = linprog(objective, G, h, bounds=held)
        state = (again if again.status == 0 else found).x[: self._states]
        return state, row[-1] - bound / scale, spread


def _require_optimal(found: OptimizeResult) -> None:
    if found.status != 0:
        raise RuntimeError(f"HiGHS did not find the maximum: {found.message}")
