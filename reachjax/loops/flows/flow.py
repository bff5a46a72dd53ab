"""The flow of a differential equation over one period, for any kind of number."""

from __future__ import annotations

import dataclasses
from typing import Any

from reachjax.loops.flows.integration import integrated
from reachjax.loops.flows.series import Tape
from reachjax.loops.flows.steps import Flowed, Settings, flowed
from reachjax.loops.flows.taylor_models import TaylorModels, joined
from reachjax.loops.functions import Function
from reachjax.loops.units import AtUnit
from reachjax.numerics.rounding import Ball


@dataclasses.dataclass(frozen=True, eq=False)
class Flow:
    """What a state is led to within a period, under an input that is held.

    Attributes:
        f: the right-hand side, of a state, an input and perhaps disturbances.
        tape: of `f`.
        settings: how a period is done.
    """

    f: Function
    tape: Tape
    settings: Settings

    def simulated(self, given: tuple[Any, ...], unit: AtUnit) -> Any:
        """The state afterwards, of numbers that nothing is proved of."""
        x, *others = given

        def rate(x: Any) -> Any:
            return self.f.propagate((x, *others), unit)

        return integrated(rate, x, self.settings.period, max(2, self.settings.steps))

    def enclosed(self, given: tuple[Ball, ...], between: bool = False) -> Flowed:
        """What intervals lead to, as Taylor models of them.

        Raises:
            UnboundedError: solutions escape, leave a domain, or are too fast, in numpy.
        """
        models, first, parts = TaylorModels.of(joined([*given])), 0, list[TaylorModels]()
        for each in given:
            parts.append(models[first : first + len(each.mid)])
            first += len(each.mid)
        return self.followed(parts, given[0], between)

    def followed(self, given: list[TaylorModels], box: Ball, between: bool = False) -> Flowed:
        """What Taylor models lead to.

        Args:
            given: the state, the input, and disturbances if there are any.
            box: what else is known of the state.
            between: whether control points are asked for.

        Raises:
            UnboundedError: solutions escape, leave a domain, or are too fast, in numpy.
        """
        x, *others = given
        return flowed(self.tape, x, others, box, self.settings, between)
