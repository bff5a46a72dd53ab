"""The loop over its whole horizon in affine forms, with the facts that hold of their columns.

Affine forms hold every unit that switches between two parallel lines. What they leave out is a few
linear facts: those of the initial set, and those of each unit, such as `z >= 0` and `z - y >= 0` of
a ReLU, of which one is zero. All are rows over the columns `eta = [w, v]`, so with multipliers
`lambda` for the facts `p`

    c . eta  <=  (c + sum_i lambda_i p_i) . eta  <=  the largest value of that row,

for `lambda_i >= 0` where `p_i >= 0`, and for any `lambda_i` where `p_i` is known to be zero: the
triangle relaxation of the whole horizon (weak duality). It holds whatever found the multipliers.

Everything here is numpy on the host.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from reachjax.loops import ClosedLoop
from reachjax.loops.units import AbstractUnit, Mark
from reachjax.numerics.rounding import Ball
from reachjax.programs.affine import AffineForms, met
from reachjax.programs.affine_steps import UnitForms, step_forms
from reachjax.programs.initial import Ends, InitialColumns
from reachjax.sets import AbstractSet, Box

Multipliers = Callable[[AffineForms], Float[np.ndarray, "k m"]]
"""Multipliers of the facts so far that bound each of these forms from above."""


class Horizon:
    """Affine forms of the state and all facts, step after step.

    Args:
        loop: of numpy arrays.
        X0: the initial set, of numpy arrays.
        box: around it.
        t: the time of the initial set.

    Attributes:
        start: what the first columns are.
        state: forms of the state after the steps so far.
        steps: the forms of the units of each step, layer by layer.
        columns: `(p,)`, of the unit of each pair of facts whose product is zero.
        gaps: `(p,)`, how much of its column a unit's value has.
        origins: `(m, 3)`, of each fact the step, the unit's number among those of a step, and which
            of its facts it is; -1 of the initial set.

    Example:
        >>> import jax
        >>> from reachjax import MLP, AffinePlant
        >>> net = MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
        >>> loop, X0 = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net), Box([-1.0], [2.0])
        >>> loop, X0 = jax.device_get((loop, X0))
        >>> horizon = Horizon(loop, X0, X0)
        >>> horizon.advance()
        >>> len(horizon.facts.rows), horizon.zero.tolist()  # two units switch
        (4, [[0, 2], [1, 3]])
    """

    def __init__(self, loop: ClosedLoop, X0: AbstractSet, box: Box, t: int = 0):
        self._loop, self._t = loop, t
        self.start = InitialColumns.of(X0, box)
        self.state = AffineForms.beginning(self.start)
        self.steps: list[tuple[UnitForms, ...]] = []
        self._facts: list[AffineForms] = []
        self._zero: list[np.ndarray] = [np.zeros((0, 2), dtype=int)]
        self.columns, self.gaps = np.zeros(0, dtype=int), np.zeros(0)
        self.origins = np.zeros((0, 3), dtype=int)
        self._count = self._stated = 0
        if self.start.cut is not None:
            A, b = (np.asarray(part) for part in self.start.cut.facets)
            self._add(b - A @ self.state, np.full((len(b), 3), -1))

    @property
    def facts(self) -> AffineForms:
        """Rows `(m, n)` that are never negative: those of the initial set, then those of units."""
        width = max(part.columns.shape[1] for part in (self.state, *self._facts))
        if len(self._facts) != 1 or self._facts[0].columns.shape[1] != width:
            none = AffineForms(np.zeros((0, width + 2)), np.zeros((0, 2)))
            self._facts = [joined([none, *(part.widened(width) for part in self._facts)])]
        return self._facts[0]

    @property
    def zero(self) -> Int[np.ndarray, "p 2"]:
        """Pairs of facts, one of which is zero at each state."""
        return np.concatenate(self._zero)

    @property
    def varying(self) -> Int[np.ndarray, " v"]:
        """Columns of the initial state and of units, without those of rounding errors."""
        return np.concatenate([np.arange(self.start.spread.shape[1]), np.unique(self.columns)])

    def advance(self, multipliers: Multipliers | None = None) -> None:
        """One step more.

        Args:
            multipliers: what better bounds of the inputs of units rest on; None for those of forms.
        """

        def ranges(
            unit: AbstractUnit, y: AffineForms, ends: Ends, found: Sequence[UnitForms]
        ) -> Ends:
            self._state_facts(found)
            switching = np.flatnonzero(~unit.lines(*ends).affine)
            if multipliers is None or not (len(switching) and self._count):
                return ends
            lower, upper = (end.copy() for end in ends)
            inputs = y[switching]
            both = joined([inputs, -inputs])
            found_ends = self.bounds(both, multipliers(both))
            better = met(
                (lower[switching], upper[switching]),
                (-found_ends[len(switching) :], found_ends[: len(switching)]),
            )
            lower[switching], upper[switching] = better
            return lower, upper

        t = self._t + len(self.steps)
        self._stated = 0
        with np.errstate(all="ignore"):  # what overflows ends as infinity or NaN, which is no bound
            self.state, units = step_forms(self._loop, self.state, t, self.start, ranges=ranges)
            self._state_facts(units)
        self.steps.append(units)

    def columns_at(self, state: Float[np.ndarray, " n_x"]) -> Float[np.ndarray, " n"]:
        """The columns of the trajectory from an initial state."""
        found = np.zeros(self.facts.columns.shape[1])
        first = self.start.back @ (state - self.start.center)
        found[: len(first)] = first
        for layer in itertools.chain(*self.steps):
            here = np.flatnonzero(layer.places >= 0)
            inputs = layer.inputs
            y: Any = inputs.rows[:, 0] + inputs.columns @ found[: inputs.columns.shape[1]]
            rest = layer.unit(y) - layer.slope * y - layer.offset
            found[layer.places[here]] = rest[here] / layer.gap[here]
        return found

    def narrow(self, lower: Float[np.ndarray, " n_x"], upper: Float[np.ndarray, " n_x"]) -> None:
        """Meet the state with bounds that surely hold it."""
        ends = met(self.state.ends(self.start), (lower, upper))
        self.state = self.state.within(Ball.between(*ends))

    def bounds(
        self,
        forms: AffineForms,
        multipliers: Float[np.ndarray, "k m"],
    ) -> Float[np.ndarray, " k"]:
        """Upper bounds of forms by multipliers of facts that are of the right signs."""
        return upper_bounds(forms, self.facts, multipliers, self.start)

    def _state_facts(self, found: Sequence[UnitForms]) -> None:
        """Add the facts of the layers that are new."""
        for number, layer in enumerate(found[self._stated :], start=self._stated):
            switching = np.flatnonzero(layer.places >= 0)
            if len(switching):
                first = sum(len(before.places) for before in found[:number])
                self._add_units(layer, switching, first)
        self._stated = len(found)

    def _add_units(self, layer: UnitForms, switching: np.ndarray, before: int) -> None:
        width = layer.outputs.columns.shape[1]
        # a layer that is not separable states its facts as a whole
        stated = switching if layer.unit.separable else np.arange(len(layer.places))
        y, z = layer.inputs[stated].widened(width), layer.outputs[stated]
        ends: Any = layer.lower[stated], layer.upper[stated]
        kept = np.searchsorted(stated, switching)
        facts = layer.unit.facts(y, z, *ends).map(lambda block: block.rows[kept])
        first = {}
        sectors = (block for block in facts.blocks if block.mark is Mark.SECTOR)
        for which, block in enumerate(sectors):
            first[block.name] = self._count + np.arange(len(switching))
            own = (np.full(len(switching), number) for number in (len(self.steps), which))
            step, kind = own
            self._add(block.rows, np.stack([step, before + switching, kind], axis=1))
        pairs = [np.stack([first[one], first[other]], axis=1) for one, other in facts.zero]
        self._zero += pairs
        self.columns = np.append(self.columns, np.tile(layer.places[switching], len(pairs)))
        self.gaps = np.append(self.gaps, np.tile(layer.gap[switching], len(pairs)))

    def _add(self, rows: AffineForms, origins: Int[np.ndarray, "k 3"]) -> None:
        self._facts.append(rows)
        self.origins = np.concatenate([self.origins, origins])
        self._count += len(rows.rows)


def joined(parts: Sequence[AffineForms]) -> AffineForms:
    """All of these forms, which are over the same columns."""
    rows, radii = zip(*((part.rows, part.radii) for part in parts), strict=True)
    return AffineForms(np.concatenate(rows), np.concatenate(radii))


def upper_bounds(
    forms: AffineForms,
    facts: AffineForms,
    multipliers: Float[np.ndarray, "k m"],
    start: InitialColumns,
) -> Float[np.ndarray, " k"]:
    """Upper bounds of forms, by multipliers of facts that are of the right signs; NaN is none."""
    width = max(forms.columns.shape[1], facts.columns.shape[1])
    with np.errstate(all="ignore"):
        weighed = forms.widened(width) + multipliers @ facts.widened(width)
        return weighed.ends(start)[1]
