"""Penalties for a training loop: reachable-set volume and missed specifications.

A loop adds them to its own loss, as often and as heavily as a schedule says. Where a semidefinite
program was not solved the gradient is NaN; an optimiser wrapped by `skip_failures` leaves weights
and state as they are at such a step, and counts it.

Two penalties on one tube need not solve for it twice: `log_volume(tube)` and `shortfall(tube, ...)`
are what these functions compute from `reach(...)`.
"""

from __future__ import annotations

import dataclasses
import math
import numbers
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from reachjax.checks import is_concrete, whole_number
from reachjax.reach import ReachTube, reach
from reachjax.requirements import AvoidSets, shortfall
from reachjax.sets import AbstractSet, PolyhedralSet, Template
from reachjax.sizes import log_volume
from reachjax.systems import ClosedLoop

if TYPE_CHECKING:
    import optax

FOREVER = 2**31 - 1
"""So many failed steps in a row are skipped: all of them (optax counts in 32 bits)."""


def volume_penalty(
    loop: ClosedLoop,
    X0: AbstractSet,
    horizon: int,
    template: Template,
    *,
    measure: Callable[[AbstractSet], Float[Array, ""]] = log_volume,
    **options: Any,
) -> Float[Array, ""]:
    """The mean size of the certified sets at times `1 .. horizon`.

    Differentiable in the loop and the initial set, also inside `jax.jit`, `vmap` and `scan`.

    Args:
        loop: the closed loop.
        X0: the set of initial states.
        horizon: the number of steps.
        template: the facet directions of every set.
        measure: the size of one set. Logarithms weigh all steps alike, and are -inf for a flat set;
            `volume` is in the units of the states and weighs large sets most.
        options: keyword arguments of `reach`, such as `relaxation` and `solver`.

    Raises:
        RuntimeError, TypeError, ValueError: as `reach` does.

    Example:
        >>> from reachjax import MLP, AffinePlant, Box
        >>> X0, template = Box([1.0], [2.0]), Template.box(1)
        >>> def penalty(gain):
        ...     net = MLP.from_layers([([[gain]], [0.0])])
        ...     loop = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net)
        ...     return volume_penalty(loop, X0, 2, template)  # widths 1 + gain, (1 + gain)^2
        >>> round(float(jax.grad(penalty)(-0.5)), 5)  # of 3/2 log(1 + gain)
        3.0
    """
    tube = reach(loop, X0, horizon, template, **options)
    return sum((measure(region) for region in tube.sets[1:]), start=jnp.zeros(())) / horizon


def specification_penalty(
    loop: ClosedLoop,
    X0: AbstractSet,
    horizon: int,
    template: Template,
    goal: PolyhedralSet | None = None,
    avoid: AvoidSets | None = None,
    safe: PolyhedralSet | None = None,
    *,
    margin: float = 0.0,
    **options: Any,
) -> Float[Array, ""]:
    """By how much the certified sets miss a reach-avoid specification: zero once it is proved.

    A hinge on the distance to the goal, the avoided sets and the boundary of the safe set, summed
    over facets and times (see `shortfall`). Differentiable as `volume_penalty` is.

    Args:
        loop: the closed loop.
        X0: the set of initial states.
        horizon: the number of steps.
        template: the facet directions of every set.
        goal: where every state must be at the horizon.
        avoid: closed sets in which no state may be: a sequence for all times, or a mapping from a
            time to a sequence.
        safe: where every state must be at all times.
        margin: how far the sets should be from breaking a requirement, in the units of the state; a
            little more than zero keeps the proof when the weights move on.
        options: keyword arguments of `reach`, such as `relaxation` and `solver`.

    Raises:
        RuntimeError, TypeError, ValueError: as `reach` and `verify` do.

    Example:
        >>> from reachjax import MLP, AffinePlant, Box
        >>> net = MLP.from_layers([([[-0.5]], [0.0])])
        >>> loop = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net)  # x+ = x / 2
        >>> penalty = specification_penalty(
        ...     loop, Box([1.0], [2.0]), 1, Template.box(1), goal=Box([0.0], [0.9])
        ... )
        >>> round(float(penalty), 6)
        0.1
    """
    tube: ReachTube = reach(loop, X0, horizon, template, **options)
    return shortfall(tube, goal, avoid, safe, margin=margin)


@dataclasses.dataclass(frozen=True)
class PenaltySchedule:
    """At which training steps a penalty is computed, and what it weighs there.

    Semidefinite programs cost much more than a pass over a batch, so a penalty may be computed
    every few steps only; the weight is that of the steps at which it is.

    Args:
        weight: once the ramp is over.
        every: the penalty is computed at one step in so many.
        warmup: steps before the first penalty, to train without.
        ramp: steps after the warm-up over which the weight grows linearly.

    Raises:
        TypeError, ValueError: a number is of another kind, or too small.

    Example:
        >>> schedule = PenaltySchedule(weight=2.0, every=5, warmup=10, ramp=20)
        >>> [float(schedule(step)) for step in (0, 10, 11, 15, 30)]
        [0.0, 0.1, 0.0, 0.6, 2.0]
    """

    weight: float
    every: int = 1
    warmup: int = 0
    ramp: int = 0

    def __post_init__(self):
        if not isinstance(self.weight, numbers.Real) or isinstance(self.weight, bool):
            raise TypeError(f"PenaltySchedule.weight must be a number, but {self.weight!r} arrived")
        if not (math.isfinite(self.weight) and self.weight >= 0):
            raise ValueError(
                f"PenaltySchedule.weight must be at least 0, but {self.weight} arrived"
            )
        whole_number("PenaltySchedule.every", self.every, 1)
        whole_number("PenaltySchedule.warmup", self.warmup, 0)
        whole_number("PenaltySchedule.ramp", self.ramp, 0)

    def __call__(self, step: int | Array) -> Float[Array, ""]:
        """The weight at a training step, counted from 0; zero where nothing is computed."""
        since = jnp.asarray(step) - self.warmup
        computed = (since >= 0) & (since % self.every == 0)
        grown = jnp.minimum(1.0, (since + 1) / max(self.ramp, 1))
        return jnp.where(computed, self.weight * grown, 0.0)

    def apply(
        self, step: int | Array, penalty: Callable[..., Float[Array, ""]], *arguments: Any
    ) -> Float[Array, ""]:
        """`weight * penalty(*arguments)` at the steps that have a weight, zero at the others.

        At the others nothing is solved, also inside `jax.jit`, where the step may be traced.

        Example:
            >>> schedule = PenaltySchedule(weight=2.0, every=5)
            >>> [float(schedule.apply(step, lambda x: x**2, 3.0)) for step in (0, 1, 5)]
            [18.0, 0.0, 18.0]
        """
        weight = self(step)

        def weighed(*arguments):
            return weight * penalty(*arguments)

        def nothing(*_):
            return jnp.zeros_like(weight)

        if is_concrete(weight):
            return (weighed if weight > 0 else nothing)(*arguments)
        return jax.lax.cond(weight > 0, weighed, nothing, *arguments)


def skip_failures(
    optimizer: optax.GradientTransformation,
) -> optax.GradientTransformation:
    """An optimiser that skips, and counts, the steps whose gradient is not finite.

    At such a step weights and optimiser state stay as they are. `failures(state)` is the count.

    Args:
        optimizer: any optax optimiser.

    Raises:
        ImportError: optax is not installed.

    Example:
        >>> import optax
        >>> optimizer = skip_failures(optax.sgd(0.1))
        >>> state = optimizer.init(jnp.zeros(2))
        >>> updates, state = optimizer.update(jnp.array([1.0, jnp.nan]), state)
        >>> updates.tolist(), failures(state)
        ([0.0, 0.0], 1)
    """
    try:
        import optax
    except ImportError:
        raise ImportError(
            'skip_failures wraps optax optimisers: pip install "reachjax[training]"'
        ) from None
    return optax.apply_if_finite(optimizer, max_consecutive_errors=FOREVER)


def failures(state: Any) -> int:
    """How many steps an optimiser wrapped by `skip_failures` has skipped.

    Args:
        state: the optimiser's state, alone or inside another one's.

    Raises:
        ValueError: the state is not that of such an optimiser.
    """
    from optax import tree_utils

    count = tree_utils.tree_get(state, "total_notfinite")
    if count is None:
        raise ValueError(
            "state must be that of an optimiser wrapped by skip_failures, "
            f"but a {type(state).__name__} without a count arrived"
        )
    return int(count)
