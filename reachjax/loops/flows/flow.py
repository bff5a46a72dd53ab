"""The flow of a differential equation over one period, for any kind of number."""

from __future__ import annotations

import abc
import dataclasses
from typing import Any

from reachjax.loops.flows.integration import integrated
from reachjax.loops.flows.series import Tape
from reachjax.loops.flows.steps import Flowed, Settings, flowed
from reachjax.loops.flows.taylor_models import TaylorModels, joined
from reachjax.loops.tracing.functions import Function
from reachjax.loops.units import AtUnit, evaluate
from reachjax.numerics.numbers import AbstractNumber
from reachjax.numerics.rounding import Ball

LEAST_STEPS = 2
"""Simulations do a period in so many steps, at least."""


class AbstractFlow(abc.ABC):
    """What a state is led to within a period, under an input that is held."""

    def __call__(self, given: tuple[Any, ...], unit: AtUnit) -> Any:
        """The state afterwards, of any kind of number; arguments as of `rate`."""
        x = given[0]
        if isinstance(x, AbstractNumber):
            return x.flowed(self, given, unit)
        return self.simulated(given, evaluate)  # units of the equation are none of the loop

    @abc.abstractmethod
    def rate(self, given: tuple[Any, ...], unit: AtUnit) -> Any:
        """The derivative of the state, of any kind of number.

        Args:
            given: the state, the input, and disturbances if there are any.
            unit: what is done at a layer of units.
        """

    @abc.abstractmethod
    def simulated(self, given: tuple[Any, ...], unit: AtUnit) -> Any:
        """The state afterwards, of numbers that nothing is proved of; arguments as of `rate`."""

    @abc.abstractmethod
    def followed(self, given: list[TaylorModels], box: Ball, between: bool = False) -> Flowed:
        """What Taylor models lead to.

        Args:
            given: the state, the input, and disturbances if there are any.
            box: what else is known of the state.
            between: whether control points are asked for.

        Raises:
            UnboundedError: solutions escape, leave a domain, or are too fast, in numpy.
        """

    def prepared(self) -> AbstractFlow:
        """The flow with what all periods have in common computed: itself, if that is nothing."""
        return self

    def enclosed(self, given: tuple[Ball, ...]) -> Ball:
        """What intervals lead to.

        Raises:
            UnboundedError: solutions escape, leave a domain, or are too fast, in numpy.
        """
        models, first, parts = TaylorModels.of(joined([*given])), 0, list[TaylorModels]()
        for each in given:
            parts.append(models[first : first + len(each)])
            first += len(each)
        return self.followed(parts, given[0]).state.ball


@dataclasses.dataclass(frozen=True, eq=False)
class Flow(AbstractFlow):
    """The flow of any function, by Taylor models.

    Attributes:
        f: the right-hand side, of a state, an input and perhaps disturbances.
        tape: of `f`.
        settings: how a period is done.
    """

    f: Function
    tape: Tape
    settings: Settings

    def rate(self, given: tuple[Any, ...], unit: AtUnit) -> Any:
        """The function itself."""
        return self.f.propagate(given, unit)

    def simulated(self, given: tuple[Any, ...], unit: AtUnit) -> Any:
        """The state afterwards, by extrapolation."""
        x, *others = given
        steps = max(LEAST_STEPS, self.settings.steps)
        return integrated(lambda x: self.rate((x, *others), unit), x, self.settings.period, steps)

    def followed(self, given: list[TaylorModels], box: Ball, between: bool = False) -> Flowed:
        """What Taylor models lead to, step by step."""
        x, *others = given
        return flowed(self.tape, x, others, box, self.settings, between)
