"""Plants that are differential equations, whose inputs are held over each period."""

from __future__ import annotations

import abc
import dataclasses
from typing import Any, Self, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.loops.flows.clock import ClockedFlow, rate_with_clock, timed
from reachjax.loops.flows.flow import LEAST_STEPS, AbstractFlow, Flow
from reachjax.loops.flows.linear import LinearFlow
from reachjax.loops.flows.series import Tape
from reachjax.loops.flows.steps import Settings
from reachjax.loops.plants import AbstractPlant, AffinePlant
from reachjax.loops.tracing.functions import Function, require_own_sizes
from reachjax.loops.tracing.values import UnsupportedError, Value
from reachjax.loops.units import AtUnit, UnboundedError, evaluate
from reachjax.numerics.checks import Numbers, is_concrete, real_number, require_kind, whole_number
from reachjax.numerics.pytrees import converted, pytree, static, unchecked
from reachjax.numerics.rounding import is_counted, namespace

NAME = "SampledPlant"


def _period(value: Any, name: str = f"{NAME}.period") -> Any:
    """The time between two samples.

    Raises:
        TypeError: it is no number.
        ValueError: it is not above zero.
    """
    if is_concrete(value) and real_number(name, value, 0) == 0:
        raise ValueError(f"{name} must be above 0, but {float(value)} arrived")
    return jnp.asarray(value, float)


class AbstractSampledPlant(AbstractPlant):
    """A plant in continuous time, whose input is held over each period.

    The states of a loop are those at its samples.
    """

    period: Float[Array | np.ndarray, ""]

    @property
    def clock(self) -> bool:
        """Whether its equation has the time among its arguments; not here."""
        return False

    @property
    @abc.abstractmethod
    def flow(self) -> AbstractFlow:
        """Its flow over one period."""

    def flow_at(self, t: int | jax.Array) -> AbstractFlow:
        """Its flow over the period that begins at a sample; of an equation without clock any."""
        return self.flow

    @final
    def beginning(self, x: Any, u: Any) -> tuple[Any, Any]:
        """What a period begins with, the state and the input that acts: these, if none is late."""
        return x, u

    def shortened(self, part: float) -> AbstractSampledPlant:
        """The plant of a part of each period: what follows a sample after so much of it."""
        return self.replace(period=part * self.period)

    @property
    def finer(self) -> AbstractSampledPlant:
        """The plant as it is simulated in twice as many steps."""
        return self

    @property
    def steps(self) -> int | None:
        """No number of steps: the differential equation is one of any time, if it knows it."""
        return None

    @property
    def continuous(self) -> bool:
        """Whether there are states in between samples: there are."""
        return True

    @property
    def bends(self) -> bool:
        """Whether its successors bend smoothly, whatever its units are."""
        return True

    @final
    def propagate(
        self, x: Any, u: Any, t: int | jax.Array = 0, unit: AtUnit = evaluate, w: Any = None
    ) -> Any:
        """The state a period after `x` under input `u` and disturbances `w`.

        Of plain numbers it is integrated; what other kinds of number make of it they say.

        Raises:
            TypeError: they are rows over a basis.
            UnboundedError: solutions escape, leave a domain, or are too fast, in numpy.
        """
        if self.disturbances and w is None:
            w = np.zeros((self.disturbances, self.states)) @ x
        given = (x, u) if w is None else (x, u, w)
        try:
            with np.errstate(all="ignore"):  # what overflows has no bounds
                return self.flow_at(t)(given, unit)
        except UnboundedError as error:
            unit_of, _, lower, upper = error.given
            raise UnboundedError(unit_of, int(t), lower, upper, line=error.line) from None


@pytree
class SampledAffinePlant(AbstractSampledPlant):
    """The affine differential equation `dx/dt = A x + B u + c + E w`, input held over each period.

    It is sampled exactly, by an enclosed matrix exponential, however fast it is. It comes from
    `SampledPlant.affine`.

    Args:
        A: `(n_x, n_x)`, per unit of time.
        B: `(n_x, n_u)`.
        c: `(n_x,)`; zero when left out.
        period: the time between two samples.
        E: `(n_x, n_w)`, how disturbances enter; none when left out.
        held: whether disturbances are constant over each period.
        fewest: steps in between samples, in compiled code.

    Raises:
        TypeError: an argument is not numeric.
        ValueError: shapes disagree, an entry is not finite, or the period is not above zero.
    """

    A: Float[Array, "n n"] = converted(converter=Numbers("(n_x, n_x)"))
    B: Float[Array, "n m"] = converted(converter=Numbers("(n_x, n_u)"))
    c: Float[Array, " n"] = converted(converter=Numbers("(n_x,)"))
    period: Float[Array | np.ndarray, ""] = converted(converter=_period)
    E: Float[Array, "n w"] | None = converted(converter=Numbers("(n_x, n_w)"), default=None)
    held: bool = static(default=False)
    fewest: int = static(default=1)

    def __post_init__(self):
        AffinePlant(self.A, self.B, self.c, self.E)  # its errors name what is wrong

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
    def flow(self) -> LinearFlow:
        """Its flow over one period: that of a plant that is prepared, else kept of numpy.

        A flow keeps what it computes. So one that proofs use is never given where rounding is not
        counted: nothing that is computed there must be kept for a proof.
        """
        if (prepared := self.__dict__.get("_prepared")) is not None:
            return prepared
        of_numpy = all(isinstance(each, np.ndarray) for each in jax.tree.leaves(self))
        if not (of_numpy and is_counted()):
            return self._new_flow()
        if (kept := self.__dict__.get("_flow")) is None:
            kept = self._new_flow()
            object.__setattr__(self, "_flow", kept)
        return kept

    def prepared(self) -> SampledAffinePlant:
        """A copy that has the exponentials of its flow."""
        found = self.replace()
        object.__setattr__(found, "_prepared", self._new_flow().prepared())
        return found

    def _new_flow(self) -> LinearFlow:
        parts = [self.A, self.B, *([] if self.E is None else [self.E]), self.c[:, None]]
        matrix = namespace(self.A).concatenate(parts, axis=1)
        return LinearFlow(matrix, Settings(self.period, None, self.fewest, self.held))


@pytree
class SampledPlant(AbstractSampledPlant):
    """A differential equation `dx/dt = f(x, u, w)`, whose input is held over each period.

    The states of a loop are those at its samples. They are enclosed by Taylor models, rounding and
    remainders included (`loops.flows`).

    Args:
        f: of a state `(states,)`, an input `(inputs,)` and, if there are any, disturbances
            `(disturbances,)`, with the derivative of the state for a result. It is traced as that
            of a `NonlinearPlant` is, and has to be smooth where solutions are.
        states: how many there are.
        inputs: how many there are.
        period: the time between two samples, in the plant's units of time.
        disturbances: how many there are; of none `f` takes two arguments. What they may be the
            `disturbance` of a `ClosedLoop` says.
        order: of the Taylor polynomials; None to choose it by what the remainder is worth.
        steps: how many a period is done in, at least; None for one. Where nothing is compiled,
            steps are halved as often as it takes.
        held: whether disturbances are constant over each period; if not, they are any measurable
            signal in their set. What is constant for all time is a state whose derivative is zero.
        clock: whether `f` has a last argument more, the time, in the plant's units: that of the
            sample `t = 0` is zero.

    Raises:
        TypeError: `f` is no function, or contains what has no bounds or no derivatives; the error
            names the line.
        ValueError: `f` cannot be called so, its result has another shape, or the period is not
            above zero.

    Example:
        >>> def pendulum(x, u):
        ...     return jnp.array([x[1], jnp.sin(x[0]) + u[0]])
        >>> plant = SampledPlant(pendulum, states=2, inputs=1, period=0.1)
        >>> plant.propagate(jnp.array([0.0, 1.0]), jnp.array([-2.0])).round(4)
        Array([0.0902, 0.8047], dtype=float64)
    """

    f: Function
    period: Float[Array | np.ndarray, ""]
    order: int | None = static(default=None)
    fewest: int = static(default=1)
    held: bool = static(default=False)
    clock: bool = static(default=False)  # type: ignore[override]
    part: float = static(default=1.0)

    def __init__(
        self,
        f: Any,
        states: int | None = None,
        inputs: int | None = None,
        period: Any = None,
        disturbances: int = 0,
        order: int | None = None,
        steps: int | None = None,
        held: bool = False,
        clock: bool = False,
    ):
        require_kind(f"{NAME}.clock", clock, bool, "True or False")
        if not isinstance(f, Function):
            n = whole_number(f"{NAME}.states", states, 1)
            m = whole_number(f"{NAME}.inputs", inputs, 1)
            d = whole_number(f"{NAME}.disturbances", disturbances, 0)
            if clock and callable(f):
                f = timed(f, rate_with_clock)
            sizes = (n + clock, m, *([d] if d else []))
            f = Function.of(f, sizes, n + clock, f"{NAME}.f")
        order = None if order is None else whole_number(f"{NAME}.order", order, 1)
        steps = 1 if steps is None else whole_number(f"{NAME}.steps", steps, 1)
        self._set(f=f, period=_period(period), order=order, held=bool(held), clock=clock, part=1.0)
        require_own_sizes(self, states=states, inputs=inputs, disturbances=disturbances or None)
        self._set(fewest=1 << (steps - 1).bit_length())  # parts of a period are exact
        try:
            jax.eval_shape(lambda plant: plant.period * len(plant.flow.tape.nodes), self)
        except UnsupportedError as error:
            raise TypeError(f"{NAME}.f has no Taylor series: {error}") from None

    def replace(self, **changes: Any) -> Self:
        """A copy, of the same class, with some of the constructor's arguments changed.

        Raises:
            TypeError: as the constructor.
            ValueError: as the constructor; or numbers or the clock would be others without `f`.
        """
        names = "states", "inputs", "disturbances", "f", "period", "order", "held", "clock"
        given = {name: getattr(self, name) for name in names}
        found = SampledPlant(**{**given, "steps": self.fewest, **changes})
        fields = dataclasses.fields(SampledPlant)
        return self._copied(**{field.name: getattr(found, field.name) for field in fields})

    def __repr__(self) -> str:
        more = f", disturbances={self.disturbances}" if self.disturbances else ""
        period = f"{float(self.period):g}" if is_concrete(self.period) else "traced"
        return f"{NAME}(states={self.states}, inputs={self.inputs}{more}, period={period})"

    @property
    def states(self) -> int:
        """The number `n_x` of states."""
        return self.f.structure.inputs[0] - self.clock

    @property
    def inputs(self) -> int:
        """The number `n_u` of inputs."""
        return self.f.structure.inputs[1]

    @property
    def disturbances(self) -> int:
        """The number `n_w` of disturbances."""
        return sum(self.f.structure.inputs[2:])

    def shortened(self, part: float) -> Self:
        """The plant of a part of each period, whose clock goes on by whole ones."""
        return self._copied(period=_period(part * self.period), part=part * self.part)

    @property
    def finer(self) -> Self:
        """The plant as it is simulated in twice as many steps."""
        return self._copied(fewest=2 * max(self.fewest, LEAST_STEPS))

    def _copied(self, **changes: Any) -> Self:
        """A copy of whatever class, with some fields changed that need no check."""
        held = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return unchecked(type(self), **{**held, **changes})

    def flow_at(self, t: int | jax.Array) -> AbstractFlow:
        """Its flow over the period that begins at a sample."""
        if not self.clock:
            return self.flow
        return ClockedFlow(self.flow, t * (self.period / self.part), self.states)

    @property
    def flow(self) -> Flow:
        """Its flow over one period, of the state and the time if it knows that; kept of numpy."""
        on_host = all(isinstance(each, np.ndarray) for each in jax.tree.leaves(self))
        kept = self.__dict__.get("_flow") if on_host else None
        if kept is None:
            settings = Settings(self.period, self.order, self.fewest, self.held)
            kept = Flow(self.f, _taped(self.f), settings)
            if on_host:
                object.__setattr__(self, "_flow", kept)
        return kept

    @staticmethod
    def affine(
        A: Any, B: Any, c: Any = None, *, period: Any, E: Any = None, held: bool = False
    ) -> SampledAffinePlant:
        """The plant `dx/dt = A x + B u + c + E w`, sampled exactly.

        Args:
            A: `(n_x, n_x)`, per unit of time.
            B: `(n_x, n_u)`.
            c: `(n_x,)`; zero when left out.
            period: the time between two samples.
            E: `(n_x, n_w)`, how disturbances enter; none when left out.
            held: whether disturbances are constant over each period.

        Raises:
            TypeError: an argument is not numeric.
            ValueError: shapes disagree, an entry is not finite, or the period is not above zero.

        Example:
            >>> plant = SampledPlant.affine([[0, 1], [0, 0]], [[0], [1]], period=0.5)
            >>> plant.propagate(jnp.array([1.0, 0.0]), jnp.array([1.0])).round(6).tolist()
            [1.125, 0.5]
        """
        A = Numbers("(n_x, n_x)")(A, "SampledPlant.affine's A")
        c = jnp.zeros(len(A)) if c is None else c
        return SampledAffinePlant(A, B, c, period, E, bool(held))


def _taped(f: Function) -> Tape:
    """What a function's series are made of."""
    recorder, wanted = f.recorded()
    if isinstance(wanted, Value):
        return Tape(recorder, wanted)
    size = f.structure.inputs[0]
    constant = recorder.mapped(recorder.inputs[0], np.zeros((np.size(wanted), size)), (size,))
    return Tape(recorder, recorder.shifted(constant, wanted))
