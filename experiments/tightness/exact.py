"""What a loop can exactly reach: the largest value of a direction, by mixed-integer programming.

An unrolled loop of ReLUs is a mixed-integer linear program (Tjeng, Xiao, Tedrake, Evaluating
Robustness of Neural Networks with Mixed Integer Programming, ICLR 2019). Written from the
definition of the loop, weights, plant and sets, and with nothing of what certifies it, this says
how tight a certificate is. Disturbances and noise in boxes are variables too. It takes seconds for
some tens of units that switch, and may take forever for hundreds.
"""

import contextlib
from collections.abc import Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Bool, Float
from numpy import ndarray

import reachjax as rj
from experiments.tightness.program import SPARE, Largest, Limits, Program
from reachjax.loops.input_polytope import InputPolytope

SHARP = 1e-5
"""How far apart the value and HiGHS's bound of it may be, as a part of the direction's range.

HiGHS takes 1e-6 from a whole number for a whole number, in each unit."""


class Maxima(NamedTuple):
    """The largest values of directions after each of several steps, as far as they were found.

    Attributes:
        values: `(k, m)`, which are simulated; NaN where time ran out.
        states: `(k, m, n_x)`, the initial states that attain them.
        bounds: `(k, m)`, which no value exceeds, up to HiGHS's tolerances; NaN where time ran out.
        spreads: `(k, m)`, ranges that the directions are surely within; NaN where time ran out.
    """

    values: Float[ndarray, "k m"]
    states: Float[ndarray, "k m n_x"]
    bounds: Float[ndarray, "k m"]
    spreads: Float[ndarray, "k m"]

    def within(self, part: float) -> Bool[ndarray, "k m"]:
        """Whether no other state has a larger value by more than this part of the range."""
        # a single point has no range, but rounding
        allowed = part * np.maximum(self.spreads, SPARE * (1 + abs(self.values)))
        return abs(self.bounds - self.values) <= allowed

    def require_sharp(self) -> None:
        """Raise an error unless all are within `SHARP`.

        Raises:
            RuntimeError: HiGHS did not find a maximum.
        """
        if np.any(apart := ~self.within(SHARP)):
            values, bounds = self.values[apart], self.bounds[apart]
            raise RuntimeError(
                f"HiGHS is not sharp: {values} are attained, but {bounds} not excluded"
            )


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
    rows = _checked(loop, X0, k, directions, start)
    *_, (program, state) = _unrolled(loop, X0, k, start, Limits())
    last = [program.largest(row) for row in rows @ state]
    found = _simulated(loop, X0, rows, {k: last}, start)
    found.require_sharp()
    return found.values[0], found.states[0]


def exact_tube(
    loop: rj.ClosedLoop,
    X0: rj.Box | rj.Polytope,
    horizon: int,
    directions: ArrayLike,
    start: int = 0,
    limits: Limits | None = None,
) -> Maxima:
    """The largest values of directions `(m, n_x)` after each of `horizon` steps.

    The loop is unrolled once for all steps and directions. With limits of time, what was found by
    then is returned. Arguments and errors are as in `exact_maximum`, but sharpness is left to
    `Maxima.require_sharp`.
    """
    rows = _checked(loop, X0, horizon, directions, start)
    unknown = Largest(np.full(loop.states, np.nan), np.nan, np.nan, np.zeros(0))
    found = {k: [unknown] * len(rows) for k in range(1, horizon + 1)}
    with contextlib.suppress(TimeoutError):
        steps = _unrolled(loop, X0, horizon, start, limits or Limits())
        for k, (program, state) in enumerate(steps, start=1):
            for i, row in enumerate(rows @ state):
                found[k][i] = program.largest(row)
    return _simulated(loop, X0, rows, found, start)


def _checked(
    loop: rj.ClosedLoop, X0: rj.AbstractSet, horizon: int, directions: ArrayLike, start: int
) -> Float[ndarray, "m n_x"]:
    """The directions, if all arguments are such as they must be."""
    if not isinstance(X0, rj.PolyhedralSet):
        raise TypeError(f"X0 must be a Box or a Polytope, but {type(X0).__name__} arrived")
    activation = getattr(loop.controller, "activation", None)
    if not (isinstance(loop.controller, rj.MLP) and isinstance(activation, rj.ReLU)):
        kind = type(loop.controller).__name__
        raise TypeError(
            f"loop.controller must be an MLP, a network of ReLUs, but is {kind} of {activation}"
        )
    for name, W in (("disturbance", loop.disturbance), ("noise", loop.noise)):
        if not isinstance(W, rj.Box | None):
            raise TypeError(f"loop.{name} must be a Box, but {type(W).__name__} arrived")
    loop.check_horizon(horizon, start)
    rows = np.asarray(directions, float)
    if rows.ndim != 2 or not loop.states == X0.dimension == rows.shape[1]:
        raise ValueError(
            f"X0 and directions must be of the loop's {loop.states} states, but a set of dimension "
            f"{X0.dimension} and directions of shape {rows.shape} arrived"
        )
    return rows


def _unrolled(
    loop: rj.ClosedLoop, X0: rj.PolyhedralSet, horizon: int, start: int, limits: Limits
) -> Iterator[tuple[Program, Float[ndarray, "n_x size"]]]:
    """The program of the first steps, and rows of the state after them, for each of `horizon`."""
    program = Program(X0, limits)
    state = program.state()
    for t in range(start, start + horizon):
        state = _successor(loop, program, state, t)
        yield program, state


def _successor(loop: rj.ClosedLoop, program: Program, state: ndarray, t: int) -> ndarray:
    """Rows of the state one step later."""
    net = loop.controller
    assert isinstance(net, rj.MLP)
    assert isinstance(loop.plant, rj.AffinePlant)
    *hidden, (W, b) = net.layers
    measured = program.padded(state)
    if isinstance(loop.noise, rj.Box):
        noise = program.draw(loop.noise.at(t))
        measured = program.padded(state) + noise
    z = measured
    for V, a in hidden:
        z = program.relu(_affine(V, z, a))
    u = _affine(W, z, b)
    if isinstance(loop.input_box, InputPolytope):
        C = np.array(loop.input_box.normals)
        m = program.multipliers(C, _affine(C, u, -np.asarray(loop.input_box.offsets)))
        u = program.padded(u) - C.T @ m
    elif loop.input_box is not None:
        box, eye = loop.input_box.at(t), np.eye(len(u))
        above = program.relu(_affine(eye, u, -box.lower))
        below = program.relu(_affine(-eye, above, box.upper - box.lower))
        u = _affine(-eye, below, box.upper)
    plant = loop.plant
    assert isinstance(plant, rj.AffinePlant)
    A, B, c = plant.at(t)
    following = program.padded(_affine(B, u, c))
    if isinstance(loop.disturbance, rj.Box):
        entering = np.asarray(plant.entering(t)) @ program.draw(loop.disturbance.at(t))
        following = program.padded(following) + entering
    return following + _affine(A, program.padded(state), np.zeros(len(state)))


def _affine(W: ArrayLike, rows: Float[ndarray, "n size"], b: ArrayLike) -> Float[ndarray, "k size"]:
    """`W x + b`, the first column being that of the constant."""
    result = np.asarray(W) @ rows
    result[:, 0] += np.asarray(b)
    return result


def _simulated(
    loop: rj.ClosedLoop,
    X0: rj.PolyhedralSet,
    rows: Float[ndarray, "m n_x"],
    found: dict[int, list[Largest]],
    start: int,
) -> Maxima:
    """What was found after some numbers of steps, with the values that are attained."""
    states, bounds, spreads = (
        np.array([[getattr(each, name) for each in facets] for facets in found.values()])
        for name in ("state", "bound", "spread")
    )
    if isinstance(X0, rj.Box):
        states = np.clip(states, X0.lower, X0.upper)
    values = np.full(bounds.shape, np.nan)
    for row, begun, (k, facets) in zip(values, states, found.items(), strict=True):
        there = np.flatnonzero(~np.isnan(begun).any(axis=1))
        if len(there):
            ends = _ends(loop, begun[there], [facets[i] for i in there], k, start)
            row[there] = np.sum(rows[there] * ends, axis=1)
    return Maxima(values, states, bounds, spreads)


def _ends(
    loop: rj.ClosedLoop, states: Float[ndarray, "c n_x"], found: list[Largest], k: int, start: int
) -> Float[ndarray, "c n_x"]:
    """The states after `k` steps, in which what was drawn is brought into its boxes."""
    given = {}
    if loop.is_disturbed:
        drawn = np.array([each.drawn for each in found]).reshape(len(found), k, -1)
        n_v = 0 if loop.noise is None else loop.states
        parts = (
            ("noises", loop.noise, drawn[..., :n_v]),
            ("disturbances", loop.disturbance, drawn[..., n_v:]),
        )
        for name, W, values in parts:
            if isinstance(W, rj.Box):
                boxes = [W.at(start + t) for t in range(k)]
                lower, upper = (
                    np.array([getattr(box, end) for box in boxes]) for end in ("lower", "upper")
                )
                given[name] = np.clip(values, lower, upper)
    return np.asarray(loop.simulate(jnp.asarray(states), k, start, **given))[:, k]
