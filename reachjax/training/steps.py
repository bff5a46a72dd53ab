"""One step of training, compiled once for all weights and cells of the same shapes."""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from reachjax.loops import ClosedLoop
from reachjax.numerics.checks import described
from reachjax.numerics.compilations import compiler_options
from reachjax.training.objectives import TrainingBatch
from reachjax.verdicts.specification import Requirement, bits_of

TaskLoss = Callable[[ClosedLoop, Array], Array]
"""One number from a loop under the controller as it is, and initial states `(b, n_x)`."""


@dataclasses.dataclass(frozen=True, eq=False)
class Specification:
    """What is required, as what compiled steps are told apart by.

    Attributes:
        horizon: the number of steps of the loop.
        start: the time of the initial states.
        required: the requirements.
        margin: how far they should be from failing.
    """

    horizon: int
    start: int
    required: tuple[Requirement, ...]
    margin: float

    @functools.cached_property
    def key(self) -> tuple[Any, ...]:
        """Plain data that say the same."""
        each = [
            (item.name, item.time, item.inside, item.throughout, bits_of(item.region))
            for item in self.required
        ]
        return self.horizon, self.start, self.margin, *each

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Specification) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


class Program(NamedTuple):
    """What a compiled step is made for.

    Attributes:
        spec: what is required.
        task_loss: of the user.
        objective: of the stage.
        optimizer: which skips failures.
        samples: how many states are drawn.
    """

    spec: Specification
    task_loss: TaskLoss
    objective: Any
    optimizer: Any
    samples: int


def weights_of(controller: Any) -> list[Array]:
    """The arrays of a controller that are trained."""
    leaves = map(jnp.asarray, jax.tree.leaves(controller))
    return [leaf for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)]


def under(loop: ClosedLoop, weights: Sequence[Array]) -> ClosedLoop:
    """The loop whose controller has these arrays."""
    leaves, structure = jax.tree.flatten(loop.controller)
    left = iter(weights)
    floating = (jnp.issubdtype(jnp.result_type(leaf), jnp.floating) for leaf in leaves)
    parts = zip(leaves, floating, strict=True)
    found = [next(left) if trained else leaf for leaf, trained in parts]
    return loop.replace(controller=jax.tree.unflatten(structure, found))


@functools.cache
def compiled_step() -> Callable[..., Any]:
    """The step as it is compiled for the default device."""
    return jax.jit(_advanced, static_argnames="program", compiler_options=compiler_options())


@functools.cache
def compiled_loss() -> Callable[..., Any]:
    """The task's loss of a loop under weights, as it is compiled for the default device."""

    def loss(
        task_loss: TaskLoss, loop: ClosedLoop, weights: list[Array], states: Float[Array, "b n_x"]
    ) -> Array:
        return _one_number("task_loss", task_loss(under(loop, weights), states))

    return jax.jit(loss, static_argnames="task_loss", compiler_options=compiler_options())


def _advanced(
    program: Program,
    loop: ClosedLoop,
    weights: list[Array],
    state: Any,
    key: Array,
    lower: Float[Array, "c n_x"],
    upper: Float[Array, "c n_x"],
    examples: Float[Array, "e n_x"],
    weight: Array,
) -> tuple[list[Array], Any, Array, Array]:
    """One step: new weights, the optimizer's state, the task's loss and the objective before it.

    Every second state that is drawn is a corner of its cell.
    """
    import optax

    spec, (at, inside) = program.spec, jax.random.split(key)
    which = jax.random.randint(at, (program.samples,), 0, len(lower))
    part = jax.random.uniform(inside, (program.samples, lower.shape[1]))
    part = jnp.where(jnp.arange(program.samples)[:, None] % 2 == 0, jnp.round(part), part)
    states = lower[which] + part * (upper - lower)[which]
    states = jnp.concatenate([states, examples])

    def loss(weights: list[Array]) -> tuple[Array, tuple[Array, Array]]:
        trained = under(loop, weights)
        task = _one_number("task_loss", program.task_loss(trained, states))
        given = spec.horizon, spec.start, spec.required, spec.margin
        asked = TrainingBatch(trained, lower, upper, states, *given)
        missed = _one_number("a stage's objective", program.objective(asked))
        return task + weight * missed, (task, missed)

    (_, losses), slopes = jax.value_and_grad(loss, has_aux=True)(weights)
    updates, state = program.optimizer.update(slopes, state, weights)
    moved: Any = optax.apply_updates(weights, updates)
    return moved, state, *losses


def require_loss(task_loss: TaskLoss) -> None:
    """Raise an error for what cannot be called with a loop and initial states.

    Raises:
        TypeError: it is that.
    """
    expected = "task_loss must be a function of a loop and initial states"
    if not callable(task_loss):
        raise TypeError(f"{expected}, but {described(task_loss)} arrived")
    try:
        signature = inspect.signature(task_loss)
    except (TypeError, ValueError):  # of what has no signature nothing is known
        return
    try:
        signature.bind(None, None)
    except TypeError as error:
        raise TypeError(f"{expected}, but one of {signature} arrived: {error}") from error


def _one_number(name: str, value: Any) -> Array:
    """A loss, if it is one.

    Raises:
        ValueError: it is not.
    """
    if value is None or jnp.shape(value) != ():
        arrived = "None" if value is None else f"an array of shape {jnp.shape(value)}"
        raise ValueError(f"{name} must give one number, but {arrived} arrived")
    return jnp.asarray(value)


def hashable(function: Any) -> Callable[..., Any]:
    """A function as compiled steps are told apart by; one that cannot be is another one each time.

    Such as a `jax.tree_util.Partial` of arrays.
    """
    try:
        hash(function)
    except TypeError:
        return functools.partial(function)
    return function
