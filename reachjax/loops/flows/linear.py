"""The flow of an affine differential equation, by an enclosed matrix exponential.

With `M = [A B E c; 0 0 0 0]` the state and what is held are `exp(h M) z` after a time `h`, where
`z = [x, u, w, 1]`. The exponential of `M / 2^s` is its Taylor polynomial, with a bound on the rest,
and is squared `s` times (Higham, Functions of Matrices, chapter 10); every rounding is bounded.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from reachjax.loops.flows.flow import AbstractFlow
from reachjax.loops.flows.steps import Control, Flowed, Settings, drift
from reachjax.loops.flows.taylor_models import TaylorModels, joined
from reachjax.loops.units import AtUnit
from reachjax.numerics.numbers import size
from reachjax.numerics.rounding import TINY, Ball, constant, gamma, is_counted, larger, namespace

DEGREE = 16
"""The degree of the polynomial, of matrices whose norm is at most a half."""

SQUARINGS = 10
"""How often compiled code squares: the norm of `h M` may be up to 512."""

SMALL = 0.25
"""In between samples steps are so short that the norm of `h M` is at most this, on the host."""

PIECES = 64
"""Steps in between samples, at most."""


def exponential(M: Float[Array | np.ndarray, "k k"]) -> Ball:
    """An enclosure of `exp(M)`, infinite if `M` is too large; entries of `M` may be rounded."""
    xp, size = namespace(M), len(M)
    norm = constant(abs(M).sum(axis=1).max() * (1 + gamma(size)))
    count = SQUARINGS
    if xp is np:
        count = int(np.clip(np.ceil(np.log2(max(2 * norm, 1.0))), 0, 60)) if norm < 1e15 else 60
    part, norm = M * 2.0**-count, norm * 2.0**-count
    found, eye = xp.eye(size), xp.eye(size)
    if not is_counted():
        for k in range(DEGREE, 0, -1):
            found = eye + part @ found / k
        for _ in range(count):
            found = found @ found
        return Ball.exact(found)
    sizes = xp.eye(size)
    for k in range(DEGREE, 0, -1):
        found, sizes = eye + part @ found / k, eye + abs(part) @ sizes / k
    rest = xp.where(norm <= 0.5, 2 * 0.5 ** (DEGREE + 1) / math.factorial(DEGREE + 1), xp.inf)
    left = xp.full((size, size), rest)
    radii = constant(gamma(DEGREE * (size + 8)) * sizes + left + size * TINY)
    for _ in range(count):
        weights = abs(found)
        error = weights @ radii + radii @ weights + radii @ radii
        found = found @ found
        error = error + gamma(size) * (weights @ weights) + size * TINY
        radii = constant(error * (1 + gamma(size + 4)))
    return Ball(found, radii)


@dataclasses.dataclass(frozen=True, eq=False)
class LinearFlow(AbstractFlow):
    """The flow of an affine function, by an enclosed matrix exponential.

    Attributes:
        matrix: `(n, k)`, of the state, the input, disturbances and 1: the derivative of the state.
        settings: how a period is done.
    """

    matrix: Float[Array | np.ndarray, "n k"]
    settings: Settings

    def rate(self, given: tuple[Any, ...], unit: AtUnit) -> Any:
        """The derivative of the state, of any kind of number."""
        found, first = self.matrix[:, -1], 0
        for each in given:
            count = size(each)
            found = self.matrix[:, first : first + count] @ each + found
            first += count
        return found

    def simulated(self, given: tuple[Any, ...], unit: AtUnit) -> Any:
        """The state afterwards, of numbers that nothing is proved of."""
        n = len(self.matrix)
        T = exponential(self.settings.period * self._generator()).mid[:n]
        return LinearFlow(T, self.settings).rate(given, unit)

    def _generator(self) -> Any:
        xp, (n, k) = namespace(self.matrix), self.matrix.shape
        return xp.concatenate([self.matrix, xp.zeros((k - n, k))])

    @cached_property
    def _whole(self) -> Ball:
        """What a period makes of the state and what is held."""
        return self._after(1.0)

    @cached_property
    def _parts(self) -> tuple[Ball, ...]:
        """What steps in between samples make of these, up to the end of each but the last."""
        pieces = self._pieces(self.settings.period * self._generator())
        return tuple(self._after((k + 1) / pieces) for k in range(pieces - 1))

    @cached_property
    def _growth(self) -> Ball:
        """What the state and what is held grow to within a step: `|z(s)| <= exp(h |M|) |z|`."""
        pieces = len(self._parts) + 1
        return exponential(abs(self.settings.period / pieces * self._generator()))

    def _after(self, part: float) -> Ball:
        return exponential(self.settings.period * part * self._generator())[: len(self.matrix)]

    def prepared(self) -> LinearFlow:
        """The flow with its exponentials computed."""
        _ = self._whole, self._growth  # they are kept
        return self

    def followed(self, given: list[TaylorModels], box: Ball, between: bool = False) -> Flowed:
        """What Taylor models lead to, in one step; in between samples in short ones."""
        z, h = joined(given), self.settings.period

        def after(T: Ball) -> TaylorModels:
            found = T.mid[:, :-1] @ z + T.mid[:, -1]
            if not is_counted():
                return found
            size = larger(*map(abs, z.ends()))
            wide = (T.rad[:, :-1] @ size + T.rad[:, -1]) * (1 + gamma(self.matrix.shape[1]))
            return found.widened(wide)

        state, controls = after(self._whole), list[Control]()
        if between:
            states = [given[0], *map(after, self._parts), state]
            pieces = len(states) - 1
            for here, there in itertools.pairwise(states):
                controls.append(self._control(here, there, given[1:], h / pieces, 1 / pieces))
        end, within = self._drift(given)
        wide = tuple(
            each._replace(points=tuple(point.widened(within) for point in each.points))
            for each in controls
        )
        return Flowed(state.widened(end), wide)

    def _pieces(self, M: Any) -> int:
        """How many steps there are in between."""
        if namespace(M) is not np:
            return self.settings.steps
        norm = float(abs(M).sum(axis=1).max())
        count = max(norm / SMALL, self.settings.steps, 1.0)
        return 1 << min(int(np.ceil(np.log2(count))), PIECES.bit_length() - 1)

    def _control(
        self, here: TaylorModels, there: TaylorModels, others: list[TaylorModels], h: Any, part: Any
    ) -> Control:
        """The control points of one step."""
        rows, k, error = self.matrix, self.matrix.shape[1], 1 + gamma(4 * self.matrix.shape[1] + 8)
        rates = [h * (rows[:, :-1] @ joined([x, *others]) + rows[:, -1]) for x in (here, there)]
        size = abs(h * self._generator())
        ends = joined([here, *others]).ends()
        xp = namespace(rows, *ends)
        z = xp.concatenate([larger(*map(abs, ends)), xp.ones(1)])
        growth = self._growth
        z = (growth.mid + growth.rad) @ z * error
        for _ in range(4):
            z = size @ z * error
        fourth = z[: len(here)] + k * TINY
        inner = here + (1 / 3) * rates[0], there - (1 / 3) * rates[1]
        wide = (point.widened(fourth / 384) for point in (here, *inner, there))
        return Control(tuple(wide), part)

    def _drift(self, given: list[TaylorModels]) -> tuple[Any, Any]:
        """How far disturbances that vary can take states from where their means do."""
        if len(given) < 3 or self.settings.held:
            return 0.0, 0.0
        n, d = len(given[0]), len(given[-1])
        A, E = (Ball.exact(part) for part in (self.matrix[:, :n], self.matrix[:, -1 - d : -1]))
        return drift([(A, E)], given[-1].ball, self.settings.period)
