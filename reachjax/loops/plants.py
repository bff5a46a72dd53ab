"""Plants: what follows a state under an input.

The affine one, time-invariant or time-varying, is `x[t+1] = A_t x[t] + B_t u[t] + c_t + E_t w[t]`.

A continuous one, `dx/dt = A x + B u + c`, is sampled with a constant input in between. With `M = [A
B c; 0 0 0]` the state and the input after a time `h` are `exp(h M) [x, u, 1]`. The zero-order hold
is exact; one step of the classical Runge-Kutta method is its Taylor polynomial of degree four.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import expm
from jaxtyping import Array, ArrayLike, Float

from reachjax.loops.flows.clock import successor_at, timed
from reachjax.loops.tracing.functions import Function, require_own_sizes
from reachjax.loops.units import AtUnit, evaluate
from reachjax.numerics.checks import (
    Numbers,
    is_concrete,
    real_number,
    whole_number,
    within_time_axis,
)
from reachjax.numerics.flags import lenient
from reachjax.numerics.pytrees import Replaceable, converted, overrides, pytree


class AbstractPlant(Replaceable, abc.ABC):
    """What a loop needs of its plant: sizes, and its step over any kind of number."""

    @property
    @abc.abstractmethod
    def states(self) -> int:
        """The number `n_x` of states."""

    @property
    @abc.abstractmethod
    def inputs(self) -> int:
        """The number `n_u` of inputs."""

    @property
    def disturbances(self) -> int:
        """The number `n_w` of disturbances that enter it; none here."""
        return 0

    @property
    def continuous(self) -> bool:
        """Whether there are states in between samples; not of a plant in discrete time."""
        return False

    @property
    def bends(self) -> bool:
        """Whether its successors bend smoothly by more than the units it has; not here."""
        return False

    @property
    def clock(self) -> bool:
        """Whether `propagate` may depend on `t`: it may, unless a plant says that it does not."""
        return True

    @property
    def varies(self) -> bool:
        """Whether a step may depend on its time.

        What a class says of its clock is not believed of one that is derived from it and changes
        anything else of what it is.
        """
        return self.steps is not None or self.clock or overrides(type(self), "clock")

    @property
    @abc.abstractmethod
    def steps(self) -> int | None:
        """The number of times a time-varying plant is given for; `None` when time-invariant."""

    def prepared(self) -> AbstractPlant:
        """The plant with what all steps have in common computed: itself, if that is nothing."""
        return self

    @abc.abstractmethod
    def propagate(
        self, x: Any, u: Any, t: int | jax.Array = 0, unit: AtUnit = evaluate, w: Any = None
    ) -> Any:
        """The successor of `x` under input `u`, for any kind of number.

        Args:
            x: the state.
            u: the input.
            t: the time.
            unit: what is done at each layer of units, of which an affine plant has none.
            w: the disturbances; None of a plant that has none, or where they are zero.
        """


def _one_array(constant: str, varying: str) -> Callable[..., Array]:
    """A converter that refuses a tuple of matrices: it may be meant as an interval."""
    numbers, ndim = Numbers(constant, varying), constant.count(",") + (not constant.endswith(",)"))

    def convert(value: Any, name: str = "value") -> Array:
        if isinstance(value, tuple | list) and any(
            (isinstance(value, tuple) or hasattr(entry, "dtype")) and _depth(entry) >= ndim
            for entry in value
        ):
            kind = type(value).__name__
            raise TypeError(
                f"{name} must be one array of shape {constant} or {varying}, but a {kind} of "
                f"{len(value)} arrays arrived: for a plant that varies in time give one array with "
                "a leading time axis, such as jnp.stack of them; what is only known to lie between "
                "two values needs a disturbance"
            )
        return numbers(value, name)

    return convert


def _depth(value: Any) -> int:
    """The number of axes of an array, or of numbers in nested sequences."""
    if isinstance(value, tuple | list):
        return 1 + max(map(_depth, value), default=0)
    return np.ndim(value)


@pytree
class AffinePlant(AbstractPlant):
    """The paper's system (LTV), and disturbances. A leading time axis makes it time-varying.

    Args:
        A: `(n_x, n_x)` or `(time, n_x, n_x)`.
        B: `(n_x, n_u)` or `(time, n_x, n_u)`.
        c: `(n_x,)` or `(time, n_x)`, in the units of the state; zero when left out.
        E: `(n_x, n_w)` or `(time, n_x, n_w)`, how disturbances enter, which `ClosedLoop` has a set
            of; none when left out.

    Raises:
        TypeError: a tuple or a list of arrays arrived, of which nobody knows what they are: the
            matrices of several times, or the ends of an interval.
        ValueError: shapes disagree, time axes differ in length, or an entry is not finite.

    Example:
        >>> plant = AffinePlant([[1.0, 1.0], [0.0, 1.0]], [[0.5], [1.0]])
        >>> plant.propagate(jnp.array([1.0, 1.0]), jnp.array([-1.0])).tolist()
        [1.5, 0.0]
    """

    A: Float[Array, "*times_of_A n n"] = converted(
        converter=_one_array("(n_x, n_x)", "(time, n_x, n_x)")
    )
    B: Float[Array, "*times_of_B n m"] = converted(
        converter=_one_array("(n_x, n_u)", "(time, n_x, n_u)")
    )
    c: Float[Array, "*times_of_c n"] = converted(
        converter=_one_array("(n_x,)", "(time, n_x)"), default=None
    )
    E: Float[Array, "*times_of_E n w"] | None = converted(
        converter=_one_array("(n_x, n_w)", "(time, n_x, n_w)"), default=None
    )

    def __post_init__(self):
        n = self.A.shape[-1]
        if self.c is None:
            self._set(c=jnp.zeros(n))
        rows = {"A": -2, "B": -2, "c": -1} | ({} if self.E is None else {"E": -2})
        for name, axis in rows.items():
            shape = getattr(self, name).shape
            if shape[axis] != n:
                raise ValueError(
                    f"AffinePlant.{name} must have {n} rows, one for each of the states that "
                    f"A's columns stand for, but its shape is {shape}"
                )
        times = {name: array.shape[0] for name, array in self._varying().items()}
        if len(set(times.values())) > 1:
            raise ValueError(
                f"the time axes of AffinePlant must have one length, but these arrived: {times}"
            )

    def _varies(self, name: str) -> bool:
        array, constant = getattr(self, name), 1 if name == "c" else 2
        return array is not None and array.ndim > constant

    def _varying(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in "ABcE" if self._varies(name)}

    @property
    def states(self) -> int:
        """The number `n_x` of states."""
        return self.A.shape[-1]

    @property
    def inputs(self) -> int:
        """The number `n_u` of inputs."""
        return self.B.shape[-1]

    @property
    def disturbances(self) -> int:
        """The number `n_w` of disturbances."""
        return 0 if self.E is None else self.E.shape[-1]

    @property
    def steps(self) -> int | None:
        """The number of times a time-varying plant is given for; `None` when time-invariant."""
        return next((array.shape[0] for array in self._varying().values()), None)

    @property
    def clock(self) -> bool:
        """False: at each time its matrices are those that it is given."""
        return False

    def at(self, t: int | jax.Array) -> tuple[Array, Array, Array]:
        """`(A_t, B_t, c_t)`.

        Raises:
            ValueError: the plant is not given for this time (where the time is a plain number).
        """
        if self.steps is not None:
            within_time_axis("AffinePlant", t, self.steps)
        return self._at("A", t), self._at("B", t), self._at("c", t)

    def entering(self, t: int | jax.Array) -> Array:
        """`E_t`.

        Raises:
            ValueError: there is none, or not for this time (where the time is a plain number).
        """
        if self.E is None:
            raise ValueError("the plant has no disturbances: AffinePlant.E was left out")
        if self.steps is not None:
            within_time_axis("AffinePlant", t, self.steps)
        return self._at("E", t)

    def _at(self, name: str, t: int | jax.Array) -> Array:
        array = getattr(self, name)
        return array[t] if self._varies(name) else array

    def propagate(
        self, x: Any, u: Any, t: int | jax.Array = 0, unit: AtUnit = evaluate, w: Any = None
    ) -> Any:
        """The successor of `x` under input `u` and disturbances `w`, for any kind of number."""
        A, B, c = self.at(t)
        following = A @ x + B @ u + c
        return following if w is None else following + self.entering(t) @ w


@pytree
class NonlinearPlant(AbstractPlant):
    """Any JAX function as a plant, `x[t+1] = f(x[t], u[t], w[t])`, traced as a `Network` is.

    Args:
        f: of a state `(states,)`, an input `(inputs,)` and, if there are any, disturbances
            `(disturbances,)`, with the successor for a result.
        states: how many there are.
        inputs: how many there are.
        disturbances: how many there are; of none `f` takes two arguments. What they may be the
            `disturbance` of a `ClosedLoop` says.

    Raises:
        TypeError: `f` is no function, or contains a primitive that has no bounds, whose line the
            error names.
        ValueError: `f` cannot be called so, or its result has another shape.

    Example:
        >>> def pendulum(x, u):
        ...     return jnp.array([x[0] + 0.1 * x[1], x[1] + 0.1 * (jnp.sin(x[0]) + u[0])])
        >>> plant = NonlinearPlant(pendulum, states=2, inputs=1)
        >>> plant.propagate(jnp.array([0.0, 1.0]), jnp.array([-2.0])).tolist()
        [0.1, 0.8]
    """

    f: Function

    def __init__(
        self, f: Any, states: int | None = None, inputs: int | None = None, disturbances: int = 0
    ):
        if not isinstance(f, Function):
            name = "NonlinearPlant"
            n = whole_number(f"{name}.states", states, 1)
            m = whole_number(f"{name}.inputs", inputs, 1)
            d = whole_number(f"{name}.disturbances", disturbances, 0)
            f = Function.of(*self._traced(f, (n, m, d) if d else (n, m)), n, f"{name}.f")
        self._set(f=f)
        require_own_sizes(self, states=states, inputs=inputs, disturbances=disturbances or None)

    def _traced(self, f: Any, sizes: tuple[int, ...]) -> tuple[Any, tuple[int, ...]]:
        """What is traced, and with vectors of which sizes."""
        return f, sizes

    @staticmethod
    def timed(f: Any, states: int, inputs: int, disturbances: int = 0) -> TimedPlant:
        """The plant `x[t+1] = f(x[t], u[t], t)`, or `f(x[t], u[t], w[t], t)`, that knows the time.

        Args:
            f: of a state, an input, disturbances if there are any, and the number of the step.
            states: how many there are.
            inputs: how many there are.
            disturbances: how many there are.

        Raises:
            TypeError: `f` is no function, or contains a primitive that has no bounds.
            ValueError: `f` cannot be called so, or its result has another shape.

        Example:
            >>> plant = NonlinearPlant.timed(lambda x, u, t: x + t * u, states=1, inputs=1)
            >>> plant.propagate(jnp.array([1.0]), jnp.array([0.5]), 3).tolist()
            [2.5]
        """
        return TimedPlant(f, states, inputs, disturbances)

    def __repr__(self) -> str:
        more = f", disturbances={self.disturbances}" if self.disturbances else ""
        return f"NonlinearPlant(states={self.states}, inputs={self.inputs}{more})"

    @property
    def states(self) -> int:
        """The number `n_x` of states."""
        return self.f.structure.inputs[0]

    @property
    def inputs(self) -> int:
        """The number `n_u` of inputs."""
        return self.f.structure.inputs[1]

    @property
    def disturbances(self) -> int:
        """The number `n_w` of disturbances."""
        return sum(self.f.structure.inputs[2:]) - self.clock

    @property
    def steps(self) -> int | None:
        """No number of steps: the function is one of any time, if it knows it."""
        return None

    @property
    def clock(self) -> bool:
        """False: the function has no time among its arguments."""
        return False

    def propagate(
        self, x: Any, u: Any, t: int | jax.Array = 0, unit: AtUnit = evaluate, w: Any = None
    ) -> Any:
        """The successor of `x` under input `u` and disturbances `w`, for any kind of number."""
        given = [x, u]
        if self.disturbances:
            given.append(np.zeros((self.disturbances, self.states)) @ x if w is None else w)
        if self.clock:
            xp = jnp if isinstance(t, jax.Array) else np
            given.append(np.zeros((1, self.states)) @ x + xp.asarray([t], float))
        return self.f.propagate(tuple(given), unit)


@pytree
class TimedPlant(NonlinearPlant):
    """A plant that knows the number of the step, as `NonlinearPlant.timed` makes it."""

    __init__ = NonlinearPlant.__init__

    def __repr__(self) -> str:
        return super().__repr__().replace("NonlinearPlant(", "NonlinearPlant.timed(")

    @property
    def clock(self) -> bool:
        """Whether it is a function of the time: it is."""
        return True

    def _traced(self, f: Any, sizes: tuple[int, ...]) -> tuple[Any, tuple[int, ...]]:
        """The function of a vector of one in place of the time."""
        return (timed(f, successor_at) if callable(f) else f), (*sizes, 1)


RUNGE_KUTTA_DEGREE = 4


@lenient
def zero_order_hold(
    A: Float[ArrayLike, "n n"],
    B: Float[ArrayLike, "n m"],
    c: Float[ArrayLike, " n"] | None = None,
    *,
    period: float,
) -> AffinePlant:
    """The sampled plant, exactly (the matrix exponential); differentiable in A, B and c.

    Args:
        A: `(n_x, n_x)`, per unit of time.
        B: `(n_x, n_u)`, per unit of time.
        c: `(n_x,)`, per unit of time; zero when left out.
        period: the sampling period, in units of time.

    Raises:
        TypeError: an argument is not numeric.
        ValueError: shapes disagree, an entry is not finite, the period is not above 0, or the
            sampled plant overflows.

    Example:
        >>> plant = zero_order_hold([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], period=0.5)
        >>> plant.A.tolist(), plant.B.tolist()
        ([[1.0, 0.5], [0.0, 1.0]], [[0.125], [0.5]])
    """
    continuous = _continuous(A, B, c, period)
    return _sampled(continuous, expm(period * _generator(continuous)))


@lenient
def runge_kutta(
    A: Float[ArrayLike, "n n"],
    B: Float[ArrayLike, "n m"],
    c: Float[ArrayLike, " n"] | None = None,
    *,
    period: float,
) -> AffinePlant:
    """The plant sampled by one classical Runge-Kutta step; differentiable in A, B and c.

    Args:
        A: `(n_x, n_x)`, per unit of time.
        B: `(n_x, n_u)`, per unit of time.
        c: `(n_x,)`, per unit of time; zero when left out.
        period: the sampling period, in units of time.

    Raises:
        TypeError: an argument is not numeric.
        ValueError: shapes disagree, an entry is not finite, the period is not above 0, or the
            sampled plant overflows.

    Example:
        >>> plant = runge_kutta([[-1.0]], [[1.0]], period=1.0)
        >>> round(float(plant.A[0, 0]), 6)  # 1 - 1 + 1/2 - 1/6 + 1/24
        0.375
    """
    continuous = _continuous(A, B, c, period)
    step = period * _generator(continuous)
    term = total = jnp.eye(len(step))
    for k in range(1, RUNGE_KUTTA_DEGREE + 1):
        term = term @ step / k
        total = total + term
    return _sampled(continuous, total)


def _continuous(A: Any, B: Any, c: Any, period: float) -> AffinePlant:
    """The three matrices, checked as those of a plant are."""
    plant = AffinePlant(A, B, c)
    if plant.steps is not None:
        raise ValueError("A, B and c must be constant to be sampled, but a time axis arrived")
    if real_number("period", period, 0.0) == 0:
        raise ValueError("period must be above 0, but 0 arrived")
    return plant


def _generator(plant: AffinePlant) -> Float[Array, "k k"]:
    size = plant.states + plant.inputs + 1
    rows = jnp.hstack([plant.A, plant.B, plant.c[:, None]])
    return jnp.zeros((size, size)).at[: plant.states].set(rows)


def _sampled(plant: AffinePlant, transition: Float[Array, "k k"]) -> AffinePlant:
    n, m = plant.states, plant.inputs
    if is_concrete(transition) and not jnp.isfinite(transition).all():
        raise ValueError("the sampled plant overflows: A times the period is too large")
    return AffinePlant(transition[:n, :n], transition[:n, n : n + m], transition[:n, -1])
