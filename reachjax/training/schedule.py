"""When a training loop computes a penalty, and what it weighs."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.numerics.checks import (
    described,
    is_concrete,
    real_number,
    require_kind,
    whole_number,
)
from reachjax.numerics.pytrees import Replaceable
from reachjax.programs.relaxations import AbstractRelaxation


@dataclasses.dataclass(frozen=True)
class PenaltySchedule(Replaceable):
    """At which training steps a penalty is computed, and what it weighs there.

    Semidefinite programs cost much more than a pass over a batch, so a penalty may be computed
    every few steps only; the weight is that of the steps at which it is. It may begin with a cheap
    relaxation, and be sharpened by another one once that has done its part.

    Args:
        weight: once the ramp is over.
        every: the penalty is computed at one step in so many.
        warmup: steps before the first penalty, to train without.
        ramp: steps after the warm-up over which the weight grows linearly.
        relaxations: from which step on the penalty gets which `relaxation`, as a keyword; empty if
            it gets none. The first is that of the steps before it too.

    Raises:
        TypeError, ValueError: a number is of another kind, or too small; a relaxation is none.

    Example:
        >>> schedule = PenaltySchedule(weight=2.0, every=5, warmup=10, ramp=20)
        >>> [float(schedule(step)) for step in (0, 10, 11, 15, 30)]
        [0.0, 0.1, 0.0, 0.6, 2.0]
        >>> from reachjax import LinearBounds, LocalBounds
        >>> stages = {0: LinearBounds(), 1000: LocalBounds()}
        >>> PenaltySchedule(weight=2.0, relaxations=stages).relaxation(1500)
        LocalBounds(repeated=True, remove_stable=True)
    """

    weight: float
    every: int = 1
    warmup: int = 0
    ramp: int = 0
    relaxations: Mapping[int, AbstractRelaxation] = dataclasses.field(
        default_factory=dict, hash=False
    )

    def __post_init__(self):
        self._set(
            weight=real_number("PenaltySchedule.weight", self.weight, least=0.0),
            every=whole_number("PenaltySchedule.every", self.every, 1),
            warmup=whole_number("PenaltySchedule.warmup", self.warmup, 0),
            ramp=whole_number("PenaltySchedule.ramp", self.ramp, 0),
            relaxations=_stages(self.relaxations),
        )

    def __call__(self, step: int | Array) -> Float[Array, ""]:
        """The weight at a training step, counted from 0; zero where nothing is computed.

        Raises:
            TypeError: the step is no whole number.
            ValueError: it is negative.
        """
        if not jnp.issubdtype(jnp.result_type(step), jnp.integer):
            raise TypeError(f"step must be a whole number, but {described(step)} arrived")
        if is_concrete(step) and np.min(step) < 0:
            raise ValueError(f"step must be at least 0, but {step} arrived")
        since = jnp.asarray(step) - self.warmup
        computed = (since >= 0) & (since % self.every == 0)
        grown = jnp.minimum(1.0, (since + 1) / max(self.ramp, 1))
        return jnp.where(computed, self.weight * grown, 0.0)

    def relaxation(self, step: int) -> AbstractRelaxation | None:
        """The penalty's relaxation at a training step, which is no traced number; None without one.

        Raises:
            TypeError, ValueError: the step is no whole number, or negative.
        """
        stage = sum(first <= whole_number("step", step, 0) for first in list(self.relaxations)[1:])
        return next(itertools.islice(self.relaxations.values(), stage, None), None)

    def apply(
        self, step: int | Array, penalty: Callable[..., Float[Array, ""]], *arguments: Any
    ) -> Float[Array, ""]:
        """`weight * penalty(*arguments)` at the steps that have a weight, zero at the others.

        At the others nothing is solved, also inside `jax.jit`, where the step may be traced.

        Args:
            step: the training step, counted from 0.
            penalty: a function that gives one number.
            arguments: what it is called with; where the schedule has relaxations, it gets that of
                the step as well, as the keyword `relaxation`.

        Raises:
            TypeError: the step is no whole number, or the penalty is no function.
            ValueError: the step is no single number, or the penalty gives none.

        Example:
            >>> schedule = PenaltySchedule(weight=2.0, every=5)
            >>> [float(schedule.apply(step, lambda x: x**2, 3.0)) for step in (0, 1, 5)]
            [18.0, 0.0, 18.0]
        """
        if not callable(penalty):
            raise TypeError(f"penalty must be a function, but {described(penalty)} arrived")
        weight = self(step)
        if weight.shape != ():
            raise ValueError(f"step must be one number, but one of shape {weight.shape} arrived")

        def weighed(*arguments, **relaxation):
            given = penalty(*arguments, **relaxation)
            expected = "penalty must give one real number"
            try:
                value = jnp.asarray(given)
            except (TypeError, ValueError):
                raise TypeError(f"{expected}, but {described(given)} arrived") from None
            if value.shape != () or jnp.iscomplexobj(value):
                kind = f"an array of shape {value.shape} and kind {value.dtype}"
                raise ValueError(f"{expected}, but {kind} arrived")
            return (weight * value).astype(weight.dtype)

        def nothing(*_):
            return jnp.zeros_like(weight)

        ways = [partial(weighed, relaxation=each) for each in self.relaxations.values()]
        begun = jnp.asarray([*self.relaxations][1:], int) <= step
        way = jnp.where(weight > 0, 1 + begun.sum(), 0)
        choices = [nothing, *(ways or [weighed])]
        if is_concrete(weight):
            return choices[int(way)](*arguments)
        return jax.lax.switch(way, choices, *arguments)


def _stages(given: Any) -> Mapping[int, AbstractRelaxation]:
    """Relaxations by the step that they begin at, in order."""
    name = "PenaltySchedule.relaxations"
    if not isinstance(given, Mapping):
        raise TypeError(
            f"{name} must be a mapping from steps to relaxations, such as {{0: LinearBounds()}}, "
            f"but {described(given)} arrived"
        )
    stages = {}
    for first in sorted(whole_number(f"a step of {name}", step, 0) for step in given):
        require_kind(f"{name}[{first}]", given[first], AbstractRelaxation, "a relaxation object")
        stages[first] = given[first]
    return stages
