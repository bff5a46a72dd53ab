"""The flow of an equation that knows the time: a clock is a state of it, which nobody else sees.

Within a period that begins at the time `s`, the equation `dx/dt = f(x, u, w, t)` is one of the
state `[x, t]` with `dt/dt = 1`, from `t = s`. What comes of it is of `x` alone.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from reachjax.loops.flows.flow import AbstractFlow
from reachjax.loops.flows.steps import Control, Flowed
from reachjax.loops.flows.taylor_models import Symbols, TaylorModels, joined
from reachjax.loops.units import AtUnit
from reachjax.numerics.numbers import size
from reachjax.numerics.rounding import TINY, Ball, gamma, namespace


def timed(f: Callable[..., Any], with_clock: Callable[..., Any]) -> Callable[..., Any]:
    """A function of other arguments made of `f`, whose parameters it keeps.

    Args:
        f: a function, or one that is a pytree, such as a `jax.tree_util.Partial`.
        with_clock: of `f` and the arguments.
    """
    is_leaf = jax.tree.structure(f) == jax.tree.structure(0)
    return (functools.partial if is_leaf else jax.tree_util.Partial)(with_clock, f)


def rate_with_clock(f: Callable[..., Any], x: Any, *others: Any) -> Any:
    """The derivative of a state and the time."""
    rate = jnp.asarray(f(x[:-1], *others, x[-1]))
    if rate.shape != (len(x) - 1,):
        raise ValueError(f"it must return shape ({len(x) - 1},), but {rate.shape} arrived")
    return jnp.concatenate([rate, jnp.ones(1, rate.dtype)])


def successor_at(f: Callable[..., Any], *given: Any) -> Any:
    """A function whose last argument is the time, as one of a vector of one."""
    return f(*given[:-1], given[-1][0])


def appended(x: Any, now: Any) -> Any:
    """The numbers, and a constant behind them, of any kind of number."""
    n = size(x)
    xp = namespace(now) if isinstance(now, jax.Array) else np
    place = np.eye(n + 1, n)
    return place @ x + xp.concatenate([xp.zeros(n), xp.reshape(xp.asarray(now, float), (1,))])


@dataclasses.dataclass(frozen=True, eq=False)
class ClockedFlow(AbstractFlow):
    """The flow of the state alone, over a period that begins at a time.

    Attributes:
        flow: of the state and the time.
        now: the time at the beginning, up to rounding.
        states: how many there are without the time.
    """

    flow: AbstractFlow
    now: Any
    states: int

    @property
    def _error(self) -> Any:
        """By how much the time may be rounded: a product, and a part of a period."""
        return gamma(8) * abs(self.now) + TINY

    def rate(self, given: tuple[Any, ...], unit: AtUnit) -> Any:
        """The derivative of the state at the beginning."""
        x, *others = given
        return self.flow.rate((appended(x, self.now), *others), unit)[: self.states]

    def simulated(self, given: tuple[Any, ...], unit: AtUnit) -> Any:
        """The state afterwards, of numbers that nothing is proved of."""
        x, *others = given
        return self.flow.simulated((appended(x, self.now), *others), unit)[: self.states]

    def followed(self, given: list[TaylorModels], box: Ball, between: bool = False) -> Flowed:
        """What Taylor models lead to; the symbol of the clock is put behind those of states."""
        x, *others = given
        n, (initial, curved, radii, _) = self.states, x.symbols
        xp, place = namespace(x.rows), 1 + x.symbols.own + n
        error = xp.asarray(self._error)[None]
        symbols = Symbols(initial, curved, xp.concatenate([radii[:n], error, radii[n:]]))

        def widened(model: TaylorModels) -> TaylorModels:
            rows = model.rows
            zero = xp.zeros((len(rows), 1))
            rows = xp.concatenate([rows[:, :place], zero, rows[:, place:]], axis=1)
            return TaylorModels(rows, model.radii, symbols)

        def narrowed(model: TaylorModels) -> TaylorModels:
            rows, more = model.rows[:n], abs(model.rows[:n, place]) * error[0]
            rows = xp.concatenate([rows[:, :place], rows[:, place + 1 :]], axis=1)
            return TaylorModels(rows, (model.radii[:n] + more) * (1 + gamma(4)), x.symbols)

        first = xp.reshape(xp.asarray(self.now, float), (1, 1))
        width = 1 + symbols.own + len(symbols.radii)
        own = xp.asarray(np.eye(1, width, place)) + first * np.eye(1, width, 0)
        clock = TaylorModels(own, xp.zeros(1), symbols)
        state = joined([widened(x), clock])
        bounds = Ball(
            xp.concatenate([box.mid, first[0]]), xp.concatenate([box.rad, 2 * error + TINY])
        )
        found = self.flow.followed([state, *map(widened, others)], bounds, between)
        controls = tuple(
            Control(tuple(map(narrowed, each.points)), each.part) for each in found.controls
        )
        return Flowed(narrowed(found.state), controls)
