"""Inputs that act some periods after the measurement that they come from.

The inputs on their way are states of the loop, `[x, u_1, ..., u_k]`, of which `u_1` acts next. At a
sample they move up, and the controller's input is the last one; until the next sample they rest.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from reachjax.loops.closed_loop import ClosedLoop
from reachjax.loops.networks import AbstractNetwork
from reachjax.loops.plants import AbstractPlant, AffinePlant, NonlinearPlant
from reachjax.loops.sampled import AbstractSampledPlant, SampledAffinePlant, SampledPlant
from reachjax.loops.units import AtUnit, evaluate
from reachjax.numerics.checks import Numbers, described, require_kind, whole_number
from reachjax.numerics.flags import lenient
from reachjax.numerics.pytrees import is_own, pytree, static
from reachjax.sets import AbstractSet, Box, PolyhedralSet, Polytope


@pytree
class DelayedPlant(AbstractPlant):
    """A plant whose inputs act later, as `delayed` makes it.

    Attributes:
        plant: of the state and the inputs on their way, which it leaves as they are.
        own: how many of its states are the state.
    """

    plant: AbstractPlant
    own: int = static()

    @property
    def states(self) -> int:
        """The number of states, inputs on their way among them."""
        return self.plant.states

    @property
    def inputs(self) -> int:
        """The number `n_u` of inputs."""
        return self.plant.inputs

    @property
    def disturbances(self) -> int:
        """The number `n_w` of disturbances."""
        return self.plant.disturbances

    @property
    def continuous(self) -> bool:
        """Whether there are states in between samples."""
        return self.plant.continuous

    @property
    def bends(self) -> bool:
        """Whether its successors bend smoothly, whatever its units are."""
        return self.plant.bends

    @property
    def steps(self) -> int | None:
        """The number of times its plant is given for; `None` of one that does not vary in time."""
        return self.plant.steps

    @property
    def clock(self) -> bool:
        """Whether its plant is a function of the time, whatever that is."""
        return self.plant.clock

    @property
    def varies(self) -> bool:
        """Whether a step of its plant may depend on the time."""
        return self.plant.varies

    @property
    def period(self) -> Any:
        """The time between two samples, of a plant in continuous time."""
        return self._sampled.period

    @property
    def finer(self) -> DelayedPlant:
        """The plant as it is simulated in twice as many steps."""
        return self.replace(plant=self._sampled.finer)

    @property
    def _sampled(self) -> AbstractSampledPlant:
        assert isinstance(self.plant, AbstractSampledPlant)  # nobody asks of others
        return self.plant

    def flow_at(self, t: int | jax.Array) -> Any:
        """The flow of the plant from what a period begins with."""
        return self._sampled.flow_at(t)

    def shortened(self, part: float) -> DelayedPlant:
        """The plant of a part of each period."""
        return self.replace(plant=self._sampled.shortened(part))

    def prepared(self) -> DelayedPlant:
        """The plant with what all its steps have in common computed."""
        return self.replace(plant=self.plant.prepared())

    def beginning(self, x: Any, u: Any) -> tuple[Any, Any]:
        """What a period begins with: inputs that have moved up, and the one that acts."""
        n, N, m = self.own, self.states, self.inputs
        up = np.eye(N)
        up[n:] = np.eye(N - n, N, n + m)
        return up @ x + np.eye(N, m, m - N) @ u, np.eye(m, N, n) @ x

    def propagate(
        self, x: Any, u: Any, t: int | jax.Array = 0, unit: AtUnit = evaluate, w: Any = None
    ) -> Any:
        """The successor of `x` under input `u` and disturbances `w`, for any kind of number."""
        return self.plant.propagate(*self.beginning(x, u), t, unit, w)


@pytree
class _OfTheState(AbstractNetwork):
    """A controller that does not look at the inputs on their way.

    Attributes:
        network: of the state.
        size: how many numbers arrive.
    """

    network: AbstractNetwork
    size: int = static()

    @property
    def inputs(self) -> int:
        """How many numbers arrive."""
        return self.size

    @property
    def outputs(self) -> int:
        """The number of outputs."""
        return self.network.outputs

    def propagate(self, x: Any, unit: AtUnit) -> Any:
        """The forward pass of the state alone."""
        return self.network.propagate(np.eye(self.network.inputs, self.size) @ x, unit)


@lenient
def delayed(loop: ClosedLoop, periods: int = 1) -> ClosedLoop:
    """The loop whose inputs act so many periods after the measurement that they come from.

    Its states are those of the loop, and behind them the inputs on their way, of which the first
    acts next. `with_inputs` puts these beside sets. They move up when a period begins, so that what
    is required of one period by its number (`avoid={k: ...}`) is meant after that, and at its end.

    Args:
        loop: without noise, that does not vary in time.
        periods: how many.

    Raises:
        TypeError: the plant is of a kind that is not delayed, or it or the loop is of a user's
            class, whose own steps would be lost.
        ValueError: the loop varies in time, or has noise.

    Example:
        >>> from reachjax import MLP
        >>> net = MLP.from_layers([([[-0.5]], [0.0])])
        >>> late = delayed(ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net))
        >>> late.simulate(jnp.array([1.0, 0.0]), 3)[:, 0].tolist()  # the first input is zero
        [1.0, 1.0, 0.5, 0.0]
    """
    require_kind("loop", loop, ClosedLoop, "a ClosedLoop")
    periods = whole_number("periods", periods, 1)
    if loop.varies or loop.noise is not None:
        raise ValueError("loop must not vary in time, nor have noise, for its inputs to be late")
    for name, part in (("loop", loop), ("loop.plant", loop.plant)):
        if not is_own(type(part).__module__):
            raise TypeError(
                f"{name} must be of a class of reachjax for its inputs to be late, but "
                f"{described(part)} arrived, whose own steps would be lost: make the inputs on "
                "their way states of a plant of your own"
            )
    more = periods * loop.plant.inputs
    return ClosedLoop(
        DelayedPlant(_with_rest(loop.plant, more), loop.states),
        _OfTheState(loop.controller, loop.states + more),
        loop.input_box,
        disturbance=loop.disturbance,
    )


def with_inputs(region: AbstractSet, first: Float[ArrayLike, " k"] | int) -> AbstractSet:
    """A set of states, and beside them inputs on their way.

    Args:
        region: a box or a polytope of states.
        first: the inputs, the one that acts first in front, for an initial set; or how many there
            are, of which any will do, for a set that is required or avoided.

    Raises:
        TypeError: the set is of another kind.

    Example:
        >>> with_inputs(Box([1.0], [2.0]), [0.0]).upper.tolist()
        [2.0, 0.0]
        >>> with_inputs(Box([1.0], [2.0]), 1).contains([1.5, 99.0]).item()
        True
    """
    if isinstance(first, int):
        require_kind("region", region, PolyhedralSet, "a Box or a Polytope")
        A, b = region.facets
        return Polytope(jnp.hstack([A, jnp.zeros((len(b), whole_number("first", first, 1)))]), b)
    box, rest = require_kind("region", region, Box, "a Box"), Numbers("(k,)")(first, "first")
    return Box(*(jnp.concatenate([end, rest]) for end in (box.lower, box.upper)))


def _with_rest(plant: AbstractPlant, more: int) -> AbstractPlant:
    """The plant with so many states behind its own that stay as they are."""
    n, m, d = plant.states, plant.inputs, plant.disturbances

    def below(matrix: Any) -> Any:
        return (
            None if matrix is None else jnp.pad(matrix, ((0, more), *[(0, 0)] * (matrix.ndim - 1)))
        )

    def beside(f: Any, x: Any, *given: Any) -> Any:
        rest = jnp.zeros(more) if plant.continuous else x[n:]
        return jnp.concatenate([f(x[:n], *given), rest])

    if isinstance(plant, AffinePlant):
        A = jnp.pad(plant.A, (0, more)).at[n:, n:].set(jnp.eye(more))
        return AffinePlant(A, below(plant.B), below(plant.c), below(plant.E))
    if isinstance(plant, SampledAffinePlant):
        rows = jnp.pad(plant.A, (0, more)), below(plant.B), below(plant.c)
        kept = {"E": below(plant.E), "held": plant.held}
        return SampledPlant.affine(*rows, period=plant.period, **kept)
    if not isinstance(plant, NonlinearPlant | SampledPlant):
        raise TypeError(f"the inputs of {described(plant)} cannot be late")
    f = jax.tree_util.Partial(beside, plant.f)
    if isinstance(plant, NonlinearPlant):
        return NonlinearPlant(f, n + more, m, d)
    settings = {"order": plant.order, "steps": plant.fewest, "held": plant.held}
    return SampledPlant(f, n + more, m, plant.period, d, **settings)
