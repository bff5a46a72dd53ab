"""The loop: a plant under a network whose output is projected onto an input box.

The projection is two more layers of units (the paper's equation (proj_NN)), the last ones of a
step; onto a polytope it is one layer. Which units there are, and in which order, the loop's own
forward pass tells.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from reachjax.loops.input_polytope import InputPolytope, input_set
from reachjax.loops.networks import AbstractNetwork
from reachjax.loops.plants import AbstractPlant
from reachjax.loops.units import AbstractUnit, AtUnit, clipped, evaluate, projected
from reachjax.numerics.checks import Numbers, require_kind, same_size, whole_number
from reachjax.numerics.pytrees import Replaceable, converted, pytree
from reachjax.sets import Box


class UnitLayer(NamedTuple):
    """A layer of units of one kind, and how many they are."""

    unit: AbstractUnit
    size: int


PLANT = "a plant such as reachjax.AffinePlant"

NETWORK = (
    "a network such as reachjax.MLP, which MLP.from_flax makes of a flax network, and "
    "MLP.from_layers of the pairs (W, b) of any other"
)


@pytree
class ClosedLoop(Replaceable):
    """`x[t+1] = A_t x[t] + B_t proj(pi(x[t])) + c_t`; sizes are checked here, once.

    Args:
        plant: the plant.
        controller: the network `pi`.
        input_box: what inputs are projected onto, constant or time-varying; `None`: no projection.
            A `Polytope` of numbers is kept as an `InputPolytope`, and takes one layer of units.

    Raises:
        TypeError: an argument is of another kind, or normals of a polytope are traced.
        ValueError: numbers of states, inputs or time steps disagree; or a polytope is empty, or has
            too many facets.

    Example:
        >>> from reachjax import MLP, AffinePlant
        >>> plant = AffinePlant([[1.0]], [[1.0]])
        >>> net = MLP.from_layers([([[-2.0]], [0.0])])
        >>> loop = ClosedLoop(plant, net, input_box=Box([-1.0], [1.0]))
        >>> loop.simulate(jnp.array([2.5]), 3)[:, 0].tolist()
        [2.5, 1.5, 0.5, -0.5]
    """

    plant: AbstractPlant
    controller: AbstractNetwork
    input_box: Box | InputPolytope | None = converted(converter=input_set, default=None)

    def __post_init__(self):
        require_kind("ClosedLoop.plant", self.plant, AbstractPlant, PLANT)
        require_kind("ClosedLoop.controller", self.controller, AbstractNetwork, NETWORK)
        plant, net = self.plant, self.controller
        same_size(
            "the plant's number of states is",
            "the controller's number of inputs is",
            (plant.states, net.inputs),
        )
        same_size(
            "the plant's number of inputs is",
            "the controller's number of outputs is",
            (plant.inputs, net.outputs),
        )
        if self.input_box is not None:
            same_size(
                "the plant's number of inputs is",
                "the dimension of input_box is",
                (plant.inputs, self.input_box.dimension),
            )
            if None not in (plant.steps, self.input_box.steps):
                same_size(
                    "the plant's number of time steps is",
                    "that of input_box is",
                    (plant.steps, self.input_box.steps),
                )

    @property
    def states(self) -> int:
        """The number `n_x` of states."""
        return self.plant.states

    @property
    def unit_layers(self) -> tuple[UnitLayer, ...]:
        """The layers of units in the order of the forward pass, the projection's last."""
        leaves, structure = jax.tree.flatten(self)
        return _recorded(structure, tuple(jnp.shape(leaf) for leaf in leaves))

    @property
    def units(self) -> int:
        """The number of units of one step."""
        return sum(layer.size for layer in self.unit_layers)

    @property
    def steps(self) -> int | None:
        """How many steps a time-varying loop is given for; `None` when it is time-invariant."""
        return self.plant.steps or (self.input_box.steps if self.input_box else None)

    def input(self, x: Any, t: int | jax.Array = 0, unit: AtUnit = evaluate) -> Any:
        """The projected input, for any kind of number and with `unit` at each layer of units."""
        return self.projected(self.controller.propagate(x, unit), t, unit)

    def projected(self, u: Any, t: int | jax.Array = 0, unit: AtUnit = evaluate) -> Any:
        """What the controller gives, projected onto the input box or polytope."""
        box = self.input_box
        if box is None:
            return u
        if isinstance(box, InputPolytope):
            return projected(u, box.normals, box.offsets, unit)
        box = box.at(t)
        return clipped(u, box.lower, box.upper, unit)

    def step(self, x: Any, t: int | jax.Array = 0, unit: AtUnit = evaluate) -> Any:
        """The state at `t + 1`, for any kind of number and with `unit` at each layer of units."""
        return self.plant.propagate(x, self.input(x, t, unit), t, unit)

    def simulate(
        self, x0: Float[ArrayLike, "*batch n"], horizon: int, start: int = 0
    ) -> Float[Array, "*batch horizon+1 n"]:
        """Trajectories from one initial state `(n,)` or from many `(batch, n)`, `x0` included.

        Raises:
            ValueError: `x0` has another dimension, or a time-varying loop ends before the horizon.
        """
        x0 = Numbers("(n_x,)", "(batch, n_x)")(x0, "x0")
        same_size(
            "the loop's number of states is", "the dimension of x0 is", (self.states, x0.shape[-1])
        )
        self.check_horizon(horizon, start)
        return _simulate(self, x0, horizon, start)

    def check_horizon(self, horizon: int, start: int = 0) -> None:
        """Raise an error unless the loop is given for all of `start .. start + horizon`."""
        horizon, start = whole_number("horizon", horizon, 1), whole_number("start", start, 0)
        if self.steps is not None and start + horizon > self.steps:
            raise ValueError(
                f"the loop is given for {self.steps} time steps (t = 0 .. {self.steps - 1}), "
                f"but start {start} and horizon {horizon} ask for t = {start} .. "
                f"{start + horizon - 1}"
            )


@lru_cache(maxsize=256)
def _recorded(structure: Any, shapes: tuple[tuple[int, ...], ...]) -> tuple[UnitLayer, ...]:
    """The layers of units that the forward pass of a loop of this structure meets.

    Args:
        structure: of the loop as a tree.
        shapes: of its leaves.
    """
    layers = []

    def record(unit: AbstractUnit, y: Array) -> Array:
        layers.append(UnitLayer(unit.kind, len(y)))
        return unit(y)

    leaves = [jax.ShapeDtypeStruct(shape, float) for shape in shapes]
    loop = jax.tree.unflatten(structure, leaves)
    state = jax.ShapeDtypeStruct((loop.states,), float)
    jax.eval_shape(lambda loop, x: loop.step(x, 0, record), loop, state)
    return tuple(layers)


@partial(jax.jit, static_argnames="horizon")
def _simulate(loop: ClosedLoop, x0: Array, horizon: int, start: int) -> Array:
    def trajectory(x):
        def advance(x, t):
            following = loop.step(x, t)
            return following, following

        _, states = jax.lax.scan(advance, x, start + jnp.arange(horizon))
        return jnp.concatenate([x[None], states])

    return trajectory(x0) if x0.ndim == 1 else jax.vmap(trajectory)(x0)
