"""The loop: a plant under a network whose output is projected onto an input box.

The projection is two more layers of units (the paper's equation (proj_NN)); onto a polytope it is
one layer. Disturbances of the plant and noise of what the network measures are new at each step and
known to lie in sets: they are units of the step too (`draws`), noise the first ones and
disturbances the last ones. Which units there are, and in which order, the loop's own forward pass
tells.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from reachjax.loops.draws import drawn
from reachjax.loops.input_polytope import InputPolytope, input_set
from reachjax.loops.networks import AbstractNetwork
from reachjax.loops.plants import AbstractPlant
from reachjax.loops.tracing.functions import Compiled
from reachjax.loops.tracing.traces import description
from reachjax.loops.units import AbstractUnit, AtUnit, clipped, evaluate, projected
from reachjax.numerics.checks import (
    Numbers,
    is_concrete,
    require_kind,
    same_size,
    whole_number,
)
from reachjax.numerics.host import in_numpy
from reachjax.numerics.pytrees import (
    Replaceable,
    converted,
    is_own,
    overrides,
    pytree,
    written_elsewhere,
)
from reachjax.numerics.seals import AbstractSealed
from reachjax.sets import AbstractSet, Box
from reachjax.sets.unusable import ThinSetError


class UnitLayer(NamedTuple):
    """A layer of units of one kind, how many they are, and how many inputs they have together."""

    unit: AbstractUnit
    size: int
    inputs: int


class Scenario(NamedTuple):
    """What a trajectory is a function of.

    Attributes:
        states: `(*batch, n_x)`, initial states.
        disturbances: `(*batch, h, n_w)`, those of each step; None of loops without.
        noises: `(*batch, h, n_x)`; None of loops without.
    """

    states: Any
    disturbances: Any
    noises: Any


PLANT = "a plant such as reachjax.AffinePlant"

NETWORK = (
    "a network such as reachjax.MLP, which MLP.from_flax makes of a flax network, and "
    "MLP.from_layers of the pairs (W, b) of any other, or reachjax.Network(f, inputs, outputs) of "
    "a function"
)


@pytree
class ClosedLoop(Replaceable, AbstractSealed):
    """`x[t+1] = A_t x[t] + B_t proj(pi(x[t] + v[t])) + c_t + E_t w[t]`, for all `w` and `v`.

    Sizes are checked here, once.

    Args:
        plant: the plant.
        controller: the network `pi`.
        input_box: what inputs are projected onto, constant or time-varying; `None`: no projection.
            A `Polytope` of numbers is kept as an `InputPolytope`, and takes one layer of units.
        disturbance: the set of `w[t]`, of a plant that has disturbances: a `Box`, which may vary in
            time, a `Polytope`, an `Ellipsoid` or an `Intersection`.
        noise: the set of `v[t]`, of the same kinds; `None`: states are measured exactly.

    Raises:
        TypeError: an argument is of another kind, or normals of an input polytope are traced; a
            plant in continuous time of a user's class defines `propagate`, or a box of disturbances
            or noise defines `at`.
        ValueError: numbers of states, inputs, disturbances or time steps disagree; a plant has
            disturbances, but there is no set of them; a set is empty or unbounded; or an input
            polytope has too many facets.

    Example:
        >>> from reachjax import MLP, AffinePlant
        >>> plant = AffinePlant([[1.0]], [[1.0]])
        >>> net = MLP.from_layers([([[-2.0]], [0.0])])
        >>> loop = ClosedLoop(plant, net, input_box=Box([-1.0], [1.0]))
        >>> loop.simulate(jnp.array([2.5]), 3)[:, 0].tolist()
        [2.5, 1.5, 0.5, -0.5]
        >>> pushed = ClosedLoop(
        ...     plant.replace(E=[[1.0]]), net, loop.input_box, disturbance=Box([-0.1], [0.1])
        ... )
        >>> pushed.simulate(jnp.array([2.5]), 1, disturbances=[[-0.1]])[:, 0].tolist()
        [2.5, 1.4]
    """

    plant: AbstractPlant
    controller: AbstractNetwork
    input_box: Box | InputPolytope | None = converted(converter=input_set, default=None)
    disturbance: AbstractSet | None = None
    noise: AbstractSet | None = None

    def __post_init__(self):
        require_kind("ClosedLoop.plant", self.plant, AbstractPlant, PLANT)
        require_kind("ClosedLoop.controller", self.controller, AbstractNetwork, NETWORK)
        plant, net = self.plant, self.controller
        if plant.continuous and not is_own(type(plant).propagate.__module__):
            raise TypeError(
                f"ClosedLoop.plant must step by its flow alone, but {type(plant).__name__}, in "
                "continuous time, defines propagate, of which nothing is known in between samples: "
                "give a SampledPlant, or its samples alone by a NonlinearPlant"
            )
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
        self._check_draws()
        times = [(name, part.steps) for name, part in self._parts() if part.steps is not None]
        for name, steps in times[1:]:
            same_size(
                f"{times[0][0]} number of time steps is", f"that of {name} is", (times[0][1], steps)
            )

    def _parts(self) -> list[tuple[str, Any]]:
        """What may vary in time, and how errors call it."""
        given = ("the plant's", self.plant), ("input_box", self.input_box)
        drawn_from = ("disturbance", self.disturbance), ("noise", self.noise)
        return [(name, part) for name, part in (*given, *drawn_from) if part is not None]

    def _check_draws(self) -> None:
        """Raise an error unless disturbances and noise are such as the loop can have."""
        plant = self.plant
        for name in ("disturbance", "noise"):
            W = getattr(self, name)
            if W is None:
                continue
            expected = "a set such as Box(lower, upper), Polytope(A, b) or Ellipsoid(center, shape)"
            require_kind(f"ClosedLoop.{name}", W, AbstractSet, expected)
            at = getattr(type(W), "at", None)
            if W.intervals is not None and callable(at) and not is_own(at.__module__):
                raise TypeError(
                    f"ClosedLoop.{name} must have the at of Box, but {type(W).__name__} defines "
                    "its own, which nobody asks who draws from it: give Box(lower, upper) of "
                    "arrays (N, n)"
                )
            if is_concrete(W) and W.steps is None:
                try:
                    W.bounding_box()
                except (ValueError, ThinSetError) as error:
                    raise ValueError(f"ClosedLoop.{name} cannot be used: {error}") from None
        if self.disturbance is None and plant.disturbances:
            raise ValueError(
                f"the plant has {plant.disturbances} disturbances, but ClosedLoop.disturbance is "
                "None: give the set that they are in"
            )
        if self.disturbance is not None and not plant.disturbances:
            raise ValueError(
                "ClosedLoop.disturbance is a set of dimension "
                f"{self.disturbance.dimension}, but the plant has no disturbances: say how they "
                "enter, by E of an AffinePlant"
            )
        if self.disturbance is not None:
            same_size(
                "the plant's number of disturbances is",
                "the dimension of disturbance is",
                (plant.disturbances, self.disturbance.dimension),
            )
        if self.noise is not None:
            same_size(
                "the plant's number of states is",
                "the dimension of noise is",
                (plant.states, self.noise.dimension),
            )

    @property
    def states(self) -> int:
        """The number `n_x` of states."""
        return self.plant.states

    @property
    def unit_layers(self) -> tuple[UnitLayer, ...]:
        """The layers of units in the order of the forward pass, the projection's last."""
        return _layers(self)

    @property
    def controller_layers(self) -> tuple[UnitLayer, ...]:
        """The layers of units of the controller, which come after those of noise."""
        return _layers(self.controller)

    @property
    def plant_layers(self) -> tuple[UnitLayer, ...]:
        """The layers of units of the plant, which come last."""
        return _layers(self.plant)

    @property
    def curved(self) -> bool:
        """Whether the plant bends smoothly, or any unit does."""
        return self.plant.bends or any(layer.unit.curved for layer in self.unit_layers)

    @property
    def jumps(self) -> bool:
        """Whether a decision changes at once what follows."""
        return any(layer.unit.jumps for layer in self.unit_layers)

    @property
    def units(self) -> int:
        """The number of units of one step."""
        return sum(layer.size for layer in self.unit_layers)

    def require_units(self, units: int | None = None, inputs: int | None = None) -> None:
        """Raise an error if a step has more units, or inputs of units, than were counted before.

        A function that chooses by a parameter has the units of its choice, but those of all
        choices where the parameter is traced.

        Raises:
            TypeError: it has more.
        """
        counts = (self.units, units), (self.unit_inputs, inputs)
        if any(known is not None and found > known for found, known in counts):
            raise TypeError(
                "a function of the loop chooses by a parameter: where it is known, as for bounds, "
                "a step has fewer units than where it is traced, as in derivatives and programs. "
                "Let the function close over the number that it chooses by, or choose in Python, "
                "outside of it; or give relaxation=LinearBounds()"
            )

    @property
    def unit_inputs(self) -> int:
        """The number of inputs of the units of one step, of which some have two."""
        return sum(layer.inputs for layer in self.unit_layers)

    @property
    def steps(self) -> int | None:
        """How many steps a time-varying loop is given for; `None` when it is time-invariant."""
        return next((part.steps for _, part in self._parts() if part.steps is not None), None)

    @property
    def varies(self) -> bool:
        """Whether a step may depend on its time.

        A loop or a set of a class of a user's that changes anything of ours may.
        """
        sets = (part for _, part in self._parts() if part is not self.plant)
        return (
            self.steps is not None
            or self.plant.varies
            or overrides(type(self), "varies")
            or any(overrides(type(part), "steps") for part in sets)
        )

    @property
    def is_disturbed(self) -> bool:
        """Whether an initial state leaves open what follows."""
        return self.disturbance is not None or self.noise is not None

    def measured(
        self, x: Any, t: int | jax.Array = 0, unit: AtUnit = evaluate, v: Any = None
    ) -> Any:
        """What the controller sees of a state, for any kind of number.

        Args:
            x: the state.
            t: the time.
            unit: what is done at each layer of units.
            v: the noise; None for any that there may be, or with plain numbers the middle.
        """
        if self.noise is None:
            return x
        return x + (drawn(self.noise, x, self.states, t, unit) if v is None else v)

    def projected(self, u: Any, t: int | jax.Array = 0, unit: AtUnit = evaluate) -> Any:
        """What the controller gives, projected onto the input box or polytope."""
        box = self.input_box
        if box is None:
            return u
        if isinstance(box, InputPolytope):
            return projected(u, box.normals, box.offsets, unit)
        box = box.at(t)
        return clipped(u, box.lower, box.upper, unit)

    @final
    def input(self, x: Any, t: int | jax.Array = 0, unit: AtUnit = evaluate, v: Any = None) -> Any:
        """The projected input, for any kind of number; arguments are those of `measured`."""
        u = self.controller.propagate(self.measured(x, t, unit, v), unit)
        return self.projected(u, t, unit)

    @final
    def moved(
        self, x: Any, u: Any, t: int | jax.Array = 0, unit: AtUnit = evaluate, w: Any = None
    ) -> Any:
        """What follows a state under a projected input, for any kind of number.

        Args:
            x: the state.
            u: the input.
            t: the time.
            unit: what is done at each layer of units.
            w: the disturbances; None for any that there may be, or with plain numbers the middle.
        """
        return self.plant.propagate(x, u, t, unit, *self.pushed(x, t, unit, w))

    def pushed(
        self, x: Any, t: int | jax.Array = 0, unit: AtUnit = evaluate, w: Any = None
    ) -> tuple[Any, ...]:
        """The disturbances as an argument of the plant; none of a loop without."""
        if self.disturbance is None:
            return ()
        return (drawn(self.disturbance, x, self.states, t, unit) if w is None else w,)

    @final
    def step(
        self,
        x: Any,
        t: int | jax.Array = 0,
        unit: AtUnit = evaluate,
        w: Any = None,
        v: Any = None,
    ) -> Any:
        """The state at `t + 1`, for any kind of number; arguments as of `measured` and `moved`."""
        return self.moved(x, self.input(x, t, unit, v), t, unit, w)

    def equations(self) -> str:
        """What JAX traces of a step in which a class of a user has a part; nothing of others.

        The name of such a class does not say what it computes. Of a user's set of disturbances or
        noise it is the box around it.
        """
        sets = [each for each in (self.disturbance, self.noise) if written_elsewhere(each)]
        boxes = [each.bounding_box() for each in sets if each is not None]
        ends = [end for box in boxes for end in (box.lower, box.upper) if is_concrete(end)]
        told = "".join(np.asarray(end).tobytes().hex() for end in ends)
        parts = self.plant, self.controller, self.input_box
        if is_own(type(self).__module__) and not written_elsewhere(parts):
            return told

        def step(loop: ClosedLoop, x: Array, t: Array, w: Array | None, v: Array | None) -> Any:
            return loop.step(x, t, w=w, v=v)

        def drawn_from(W: AbstractSet | None) -> Any:
            return None if W is None else jax.ShapeDtypeStruct((W.dimension,), float)

        x, t = jax.ShapeDtypeStruct((self.states,), float), jax.ShapeDtypeStruct((), int)
        draws = map(drawn_from, (self.disturbance, self.noise))
        return str(description(jax.make_jaxpr(step)(self, x, t, *draws))) + told

    def simulate(
        self,
        x0: Float[ArrayLike, "*batch n"],
        horizon: int,
        start: int = 0,
        *,
        disturbances: Float[ArrayLike, "*batch horizon n_w"] | None = None,
        noises: Float[ArrayLike, "*batch horizon n"] | None = None,
        parts: int = 1,
    ) -> Float[Array, "*batch horizon*parts+1 n"]:
        """Trajectories from one initial state `(n,)` or from many `(batch, n)`, `x0` included.

        Args:
            x0: the initial states.
            horizon: how many steps are simulated.
            start: the time of the initial states.
            disturbances: those of each step, and of each initial state or of all; None for the
                middle of their set.
            noises: the same of what is measured.
            parts: how many states of each period are given, in equal distances, of a plant in
                continuous time; 1 for those at samples.

        Raises:
            ValueError: `x0` has another dimension, or a time-varying loop ends before the horizon;
                there are not as many disturbances or noises, or the loop has none; or states in
                between samples are asked for that there are not.
        """
        x0 = Numbers("(n_x,)", "(batch, n_x)")(x0, "x0")
        same_size(
            "the loop's number of states is", "the dimension of x0 is", (self.states, x0.shape[-1])
        )
        self.check_horizon(horizon, start)
        if whole_number("parts", parts, 1) > 1 and not self.plant.continuous:
            raise ValueError(
                f"parts must be 1 of a plant in discrete time, which has no states in between "
                f"samples, but {parts} arrived"
            )
        w = self._given("disturbances", self.disturbance, disturbances, x0, horizon)
        v = self._given("noises", self.noise, noises, x0, horizon)
        return _simulate(self, x0, w, v, horizon, start, parts)

    def _after_parts(self, x: Any, t: Any, parts: int, w: Any, v: Any) -> list[Any]:
        """The states after each part of a period, the last of which is the next sample's."""
        plant: Any = self.plant
        u, drawn = self.input(x, t, v=v), self.pushed(x, t, w=w)
        earlier = (plant.shortened(k / parts) for k in range(1, parts))
        return [each.propagate(x, u, t, evaluate, *drawn) for each in (*earlier, plant)]

    def _given(
        self, name: str, W: AbstractSet | None, given: Any, x0: Array, horizon: int
    ) -> Array | None:
        """What users say is drawn at each step.

        Raises:
            ValueError: it has another shape, or the loop has nothing that is drawn.
        """
        if given is None:
            return None
        if W is None:
            raise ValueError(f"{name} arrived, but the loop has none")
        given = Numbers("(horizon, n)", "(batch, horizon, n)")(given, name)
        expected = (horizon, W.dimension)
        if given.shape not in (expected, (*x0.shape[:-1], *expected)):
            raise ValueError(
                f"{name} must have shape {expected}, or that after the batch of x0, "
                f"{x0.shape[:-1]}, but one of shape {given.shape} arrived"
            )
        return given

    def split(self, scenarios: Float[ArrayLike, "*batch s"]) -> Scenario:
        """The parts of scenarios, such as the `witness_states` of a certificate of this loop.

        Args:
            scenarios: initial states, behind each the disturbances and the noise of one step after
                the other, if the loop has any.

        Example:
            >>> from reachjax import MLP, AffinePlant
            >>> plant, net = AffinePlant([[0]], [[1]], E=[[1]]), MLP.from_layers([([[0]], [0])])
            >>> loop = ClosedLoop(plant, net, disturbance=Box([-1.0], [1.0]))
            >>> loop.split(jnp.array([5.0, 0.1, 0.2])).disturbances.tolist()
            [[0.1], [0.2]]
        """
        sets = self.disturbance, self.noise
        return split(scenarios, self.states, *(0 if W is None else W.dimension for W in sets))

    def check_horizon(self, horizon: int, start: int = 0) -> None:
        """Raise an error unless the loop is given for all of `start .. start + horizon`."""
        horizon, start = whole_number("horizon", horizon, 1), whole_number("start", start, 0)
        if self.steps is not None and start + horizon > self.steps:
            raise ValueError(
                f"the loop is given for {self.steps} time steps (t = 0 .. {self.steps - 1}), "
                f"but start {start} and horizon {horizon} ask for t = {start} .. "
                f"{start + horizon - 1}"
            )


def split(scenarios: Any, n_x: int, n_w: int, n_v: int) -> Scenario:
    """The parts of scenarios, of these sizes."""
    states, rest = scenarios[..., :n_x], scenarios[..., n_x:]
    if n_w + n_v == 0:
        return Scenario(states, None, None)
    steps = rest.shape[-1] // (n_w + n_v)  # of no scenarios too
    drawn = rest.reshape(*rest.shape[:-1], steps, n_w + n_v)
    w, v = drawn[..., :n_w], drawn[..., n_w:]
    return Scenario(states, w if n_w else None, v if n_v else None)


MOST_KNOWN = 256
"""The layers of so many loops, and parts of them, are kept."""

_KNOWN: dict[Any, tuple[UnitLayer, ...]] = {}


def _layers(tree: Any) -> tuple[UnitLayer, ...]:
    """The layers of units that the forward pass of a loop, or of a part of it, meets.

    They depend on its structure, on the shapes and kinds of what is traced, and on all numbers that
    are known: a function that chooses by a known parameter meets the units of its choice alone. So
    does the pass over numbers of any kind, with the same known numbers.
    """
    leaves, structure = jax.tree.flatten(tree)
    key = structure, tuple(map(_told, leaves))
    found = _KNOWN.get(key)
    if found is None:
        if is_concrete(tree):  # traces nothing
            with np.errstate(all="ignore"):
                found = _met(in_numpy(tree), np.zeros)
        else:
            found = _traced(leaves, structure)
        if len(_KNOWN) >= MOST_KNOWN:
            _KNOWN.clear()
        _KNOWN[key] = found
    return found


def _told(leaf: Any) -> tuple[Any, ...]:
    """What layers may depend on of a leaf: its shape, its kind, and its numbers if known."""
    shape, kind = jnp.shape(leaf), jnp.result_type(leaf)
    if not is_concrete(leaf):
        return shape, kind
    numbers = jax.random.key_data(leaf) if jnp.issubdtype(kind, jax.dtypes.prng_key) else leaf
    return shape, kind, np.asarray(numbers).tobytes()


def _traced(leaves: Sequence[Any], structure: Any) -> tuple[UnitLayer, ...]:
    """The layers of a tree some of whose leaves are traced, of which shapes and kinds are known."""
    found = []
    open_ones = {k: leaf for k, leaf in enumerate(leaves) if not is_concrete(leaf)}
    shapes = [jax.ShapeDtypeStruct(*_told(leaf)) for leaf in open_ones.values()]

    def meet(given: Sequence[Any]) -> None:
        filled = dict(enumerate(leaves)) | dict(zip(open_ones, given, strict=True))
        found.append(_met(jax.tree.unflatten(structure, filled.values()), jnp.zeros))

    jax.eval_shape(meet, shapes)
    return found[0]


def _met(tree: Any, zeros: Callable[[int], Any]) -> tuple[UnitLayer, ...]:
    """The layers that a forward pass meets from such vectors."""
    layers = []

    def record(unit: AbstractUnit, *y: Array) -> Array:
        z = unit(*y)
        layers.append(UnitLayer(unit.kind, len(z), sum(map(len, y))))
        return z

    if isinstance(tree, ClosedLoop):
        tree.step(zeros(tree.states), 0, record)
    elif isinstance(tree, AbstractPlant):
        drawn = [zeros(tree.disturbances)] if tree.disturbances else []
        tree.propagate(zeros(tree.states), zeros(tree.inputs), 0, record, *drawn)
    else:
        tree.propagate(zeros(tree.inputs), record)
    return tuple(layers)


@partial(Compiled, static_argnames=("horizon", "parts"))
def _simulate(
    loop: ClosedLoop,
    x0: Array,
    w: Array | None,
    v: Array | None,
    horizon: int,
    start: int,
    parts: int = 1,
) -> Array:
    def trajectory(x, w, v):
        def advance(x, given):
            t, w, v = given
            found = loop._after_parts(x, t, parts, w, v)
            return found[-1], jnp.stack(found)

        _, states = jax.lax.scan(advance, x, (start + jnp.arange(horizon), w, v))
        return jnp.concatenate([x[None], states.reshape(-1, len(x))])

    if x0.ndim == 1:
        return trajectory(x0, w, v)
    of_each = (None if part is None or part.ndim == 2 else 0 for part in (w, v))
    return jax.vmap(trajectory, in_axes=(0, *of_each))(x0, w, v)
