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
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from reachjax.loops import ClosedLoop
from reachjax.loops.units import AbstractUnit, Mark
from reachjax.numerics.rounding import Ball
from reachjax.programs.affine import AffineForms, joined
from reachjax.programs.affine_steps import PartColumns, UnitForms, states_facts, step_forms
from reachjax.programs.flows import Between
from reachjax.programs.initial import Ends, InitialColumns, met, product_facts
from reachjax.sets import AbstractSet, Box

OF_SET, OF_PRODUCTS = -1, -2
"""In the place of a step: facts of the initial set, and of products of its columns."""

ASIDE = 1e-7
"""A move away from ties, as a part of half of a set's width: more than programs leave open."""

Multipliers = Callable[
    [AffineForms], tuple[Float[np.ndarray, "k m"], Float[np.ndarray, "k n"]] | None
]
"""Multipliers of the facts so far that bound each of these forms from above, and the columns where
it is attained then, NaN where they are not known; None if none do."""


class RangeEnd(NamedTuple):
    """An end of the range of a unit's input that multipliers of facts proved.

    Attributes:
        step: of the horizon.
        layer: of the step.
        unit: of the layer.
        side: 0 for the lower end, 1 for the upper one.
        multipliers: `(m,)`, of the facts so far.
        columns: `(n,)`, where it is attained.
    """

    step: int
    layer: int
    unit: int
    side: int
    multipliers: Float[np.ndarray, " m"]
    columns: Float[np.ndarray, " n"]


class Horizon:
    """Affine forms of the state and all facts, step after step.

    Args:
        loop: of numpy arrays.
        X0: the initial set, of numpy arrays.
        box: around it.
        t: the time of the initial set.
        between: whether what is in between the samples is wanted too, of a differential equation.

    Attributes:
        loop: of numpy arrays.
        spans: from each sample to the next one, what is in between, if that is wanted.
        start: what the first columns are.
        state: forms of the state after the steps so far.
        steps: the forms of the units of each step, layer by layer.
        columns: `(p,)`, of the unit of each pair of facts whose product is zero.
        free: columns of disturbances.
        enclosed: those that facts bound by themselves.
        gaps: `(p,)`, how much of its column a unit's value has.
        origins: `(m, 3)`, of each fact the step, the unit's number among those of a step, and which
            of its facts it is; `OF_SET` or `OF_PRODUCTS` for what is of no unit.
        merged: of each step, what smooth parts leave out.
        states: forms of the states after each step, with intervals of the step's own arithmetic.
        ends: bounds of the states after each step, the best that are known.
        better: ends of ranges that are better known than by forms and intervals.
        tightened: multipliers `(2 k, m)` by which ranges of the last step's units were bounded, for
            each time that they were asked for; none of no forms where there were none.

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

    def __init__(
        self, loop: ClosedLoop, X0: AbstractSet, box: Box, t: int = 0, between: bool = False
    ):
        self.loop, self._t = loop, t
        self.spans: list[Between] | None = [] if between else None
        self.start = InitialColumns.of(X0, box, loop.curved)
        self.state = AffineForms.beginning(self.start)
        self.steps: list[tuple[UnitForms, ...]] = []
        self.merged: list[tuple[PartColumns, ...]] = []
        self.states: list[AffineForms] = []
        self.ends: list[Ends] = []
        self.better: list[RangeEnd] = []
        self.tightened: list[np.ndarray] = []
        self._varying = np.zeros(0, dtype=int)
        self._width = self.start.count
        self._facts: list[AffineForms] = []
        self._zero: list[np.ndarray] = [np.zeros((0, 2), dtype=int)]
        self.columns, self.gaps = np.zeros(0, dtype=int), np.zeros(0)
        self.origins = np.zeros((0, 3), dtype=int)
        self.free = self.enclosed = np.zeros(0, dtype=int)
        self._count = self._stated = 0
        if self.start.cut is not None:
            A, b = (np.asarray(part) for part in self.start.cut.facets)
            self._add(b - A @ self.state, np.full((len(b), 3), OF_SET))
        products = AffineForms(*product_facts(self.start))
        self._add(products, np.full((len(products.rows), 3), OF_PRODUCTS))

    @property
    def facts(self) -> AffineForms:
        """Rows `(m, n)` that are never negative: those of the initial set, then those of units."""
        widths = [part.rows.shape[1] - 2 for part in (self.state, *self._facts)]
        width = self._width = max(self._width, *widths)
        if len(widths) != 2 or widths[1] != width:
            none = AffineForms(np.zeros((0, width + 2)), np.zeros((0, 2)))
            self._facts = [joined([none, *(part.padded(width) for part in self._facts)])]
        return self._facts[0]

    @property
    def width(self) -> int:
        """How many columns there are."""
        return self.facts.rows.shape[1] - 2

    @property
    def zero(self) -> Int[np.ndarray, "p 2"]:
        """Pairs of facts, one of which is zero at each state."""
        return np.concatenate(self._zero)

    @property
    def varying(self) -> Int[np.ndarray, " v"]:
        """Columns of the initial state and of units, as they came; not those of rounding errors."""
        return np.concatenate([np.arange(self.start.count), self._varying])

    def advance(self, multipliers: Multipliers | None = None) -> None:
        """One step more.

        Args:
            multipliers: what better bounds of the inputs of units rest on; None for those of forms.
        """

        def ranges(
            unit: AbstractUnit | None, y: AffineForms, ends: Ends, found: Sequence[UnitForms]
        ) -> Ends:
            self._state_facts(found)
            if unit is None:
                self.states.append(y)
                return ends
            self._width = max(self._width, y.rows.shape[1] - 2)
            if unit.curved:  # its range is that of its form, but for little
                return ends
            switching = np.flatnonzero(unit.open(*ends))
            if multipliers is None or unit.free or not (len(switching) and self._count):
                return ends
            inputs = y[switching]
            both = joined([inputs, -inputs])
            given = multipliers(both)
            weights = np.zeros((0, self._count)) if given is None else given[0]
            self.tightened.append(weights)
            if given is None:
                return ends
            lower, upper = (np.array(end) for end in ends)
            most, least = np.split(self.bounds(both, weights), 2)
            better = np.stack([most < upper[switching], -least > lower[switching]])
            for number in np.flatnonzero(better):
                side, place = divmod(int(number), len(switching))
                proof = (part[number] for part in given)
                self.better.append(
                    RangeEnd(len(self.steps), len(found), int(switching[place]), 1 - side, *proof)
                )
            known = lower[switching], upper[switching]
            lower[switching], upper[switching] = met(known, (-least, most))
            return lower, upper

        t = self._t + len(self.steps)
        self._stated, self.tightened = 0, []
        with np.errstate(all="ignore"):  # what overflows ends as infinity or NaN, which is no bound
            self.state, units, merged = step_forms(
                self.loop,
                self.state,
                t,
                self.start,
                ranges=ranges,
                before=len(self.steps),
                spans=self.spans,
            )
            self._state_facts(units)
        self.ends.append(self.state.ends_by_interval())
        self.steps.append(units)
        self.merged.append(merged)
        # those of units of smooth parts are summed up in the merged ones
        summed = _summed(merged)
        own = (layer for number, layer in enumerate(units) if number not in summed)
        for each in (*own, *merged):
            if each.curved:
                self._varying = np.append(self._varying, each.places[each.places >= 0])

    def columns_at(
        self,
        state: Float[np.ndarray, " n_x"],
        drawn: Sequence[Float[np.ndarray, " m"]] | None = None,
    ) -> Float[np.ndarray, " n"]:
        """The columns of the trajectory from an initial state.

        Args:
            state: the initial state.
            drawn: the values of the disturbances of each step, in `[-1, 1]`; None for zeros.
        """
        found = np.zeros(self.width)
        first = self.start.back @ (state - self.start.center)
        found[: len(first)] = first
        i, j = self.start.pairs
        found[len(first) : self.start.count] = np.where(
            i == j, 2 * first[i] * first[j] - 1, first[i] * first[j]
        )
        x, values = state, itertools.chain(*(drawn or ()))
        for k in range(len(self.steps)):
            x = self._followed(x, k, found, values)
        return found

    def _followed(
        self,
        x: Float[np.ndarray, " n_x"],
        k: int,
        found: Float[np.ndarray, " n"],
        values: Iterator[float],
    ) -> Float[np.ndarray, " n_x"]:
        """The state after one step more of a trajectory, whose columns are set."""
        (layers, merged), loop, t = (self.steps[k], self.merged[k]), self.loop, self._t + k
        summed, count = _summed(merged), 0

        def apply(unit: AbstractUnit, *y: Any) -> Any:
            nonlocal count
            (number, count), z = (count, count + 1), unit(*y)
            if unit.free:
                z = z + np.array([next(values, 0.0) for _ in range(len(z))])
            if number not in summed:
                layer = layers[number]
                _fill(found, layer.outputs, layer.gap, layer.places, z)
            return z

        def part(run: Callable[..., Any], *given: Any) -> Any:
            """The outputs of a part of the loop, whose columns are set."""
            first, z = count, run(*given)
            for each in merged:
                if each.layers == range(first, count):
                    _fill(found, each.outputs, each.gap, each.places, z)
            return z

        u = part(loop.controller.propagate, loop.measured(x, t, apply), apply)
        u, w = loop.projected(u, t, apply), loop.pushed(x, t, apply)
        return part(loop.plant.propagate, x, u, t, apply, *w)

    def drawn_at(self, columns: Float[np.ndarray, "c n"]) -> list[Float[np.ndarray, "c m"]]:
        """The values of the disturbances of each step, in the order in which they are drawn."""
        none = np.zeros((len(columns), 0))
        return [
            np.concatenate(
                [none, *(columns[:, each.places] * each.gap for each in layers if each.unit.free)],
                axis=1,
            )
            for layers in self.steps
        ]

    def settled(self, columns: Float[np.ndarray, "c n"]) -> Float[np.ndarray, "c n"]:
        """Columns beside these, where what is chosen wins by a little more.

        Programs end at ties, where what is computed may choose otherwise. Initial states and what
        is drawn move to where all that is tied is won by as much, what units add being constant.
        """
        moving = np.append(np.arange(self.start.spread.shape[1]), self.free)
        moved = columns.copy()
        for number, slopes in enumerate(map(self._tied, columns)):
            own = slopes[:, moving]
            size = abs(own).max(axis=1, initial=0.0, keepdims=True)
            own = own[size[:, 0] > 0] / size[size > 0][:, None]
            aside = ASIDE * np.linalg.pinv(own).sum(axis=1)
            moved[number, moving] = np.clip(columns[number, moving] + aside, -1.0, 1.0)
        return moved

    def _tied(self, columns: Float[np.ndarray, " n"]) -> Float[np.ndarray, "k n"]:
        """The slopes of what is no more than nearly zero where something wins."""
        found = [np.zeros((0, self.width))]
        deciding = (each for step in self.steps for each in step if each.unit.jumps)
        with np.errstate(all="ignore"):
            for layer in deciding:
                y, z = (
                    np.asarray(part.rows[:, 0] + part.columns @ columns[: part.columns.shape[1]])
                    for part in (layer.inputs, layer.outputs)
                )
                won = layer.unit.won(z)
                slopes = won @ layer.inputs.padded(self.width).columns
                size = abs(slopes).sum(axis=1)
                found.append(slopes[(won @ y <= 2 * ASIDE * size) & (size < np.inf)])
        return np.concatenate(found)

    @property
    def kinds(self) -> int:
        """How many facts a unit may have."""
        return int(self.origins[:, 2].max(initial=0)) + 1

    def of_units(
        self, multipliers: Float[np.ndarray, "k m"], steps: int
    ) -> Float[np.ndarray, "k N b units"]:
        """Multipliers of all facts by step, fact and unit, zero of those that there are not."""
        step, unit, which = self.origins.T
        units = sum(len(layer.places) for layer in self.steps[0])
        found = np.zeros((len(multipliers), steps, self.kinds, units))
        there = np.flatnonzero(step >= 0)
        found[:, step[there], which[there], unit[there]] = multipliers[:, there]
        return found

    def of_set(self, multipliers: Float[np.ndarray, "k m"]) -> Float[np.ndarray, "k r"]:
        """Multipliers of the facets of what the initial set is cut by."""
        return multipliers[:, self.origins[:, 0] == OF_SET]

    def narrow(self, lower: Float[np.ndarray, " n_x"], upper: Float[np.ndarray, " n_x"]) -> None:
        """Meet the state with bounds that surely hold it."""
        self.ends[-1] = ends = met(self.state.ends(self.start), (lower, upper))
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
            switching = np.flatnonzero((layer.places >= 0) | layer.unit.stated)
            if layer.unit.closed:
                self.enclosed = np.append(self.enclosed, found[number - 1].places)
            if layer.unit.free:
                self.free = np.append(self.free, layer.places)
                self._varying = np.append(self._varying, layer.places)
            elif states_facts(layer.unit) and len(switching):
                first = sum(len(before.places) for before in found[:number])
                self._add_units(layer, switching, first)
        self._stated = len(found)

    def _add_units(self, layer: UnitForms, switching: np.ndarray, before: int) -> None:
        width = layer.outputs.rows.shape[1] - 2
        # a layer that is not separable states its facts as a whole
        stated = switching if layer.unit.separable else np.arange(len(layer.places))
        y, z = layer.inputs[stated].padded(width), layer.outputs[stated]
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
        places = layer.places[switching]
        self.columns = np.append(self.columns, np.tile(places, len(pairs)))
        self._varying = np.append(self._varying, places[places >= 0])
        self.gaps = np.append(self.gaps, np.tile(layer.gap[switching], len(pairs)))

    def _add(self, rows: AffineForms, origins: Int[np.ndarray, "k 3"]) -> None:
        self._facts.append(rows)
        self.origins = np.concatenate([self.origins, origins])
        self._count += len(rows.rows)


def _summed(merged: Sequence[PartColumns]) -> set[int]:
    """The layers of a step that are summed up."""
    return {number for part in merged for number in part.layers}


def _fill(
    found: Float[np.ndarray, " n"],
    outputs: AffineForms,
    gap: Any,
    places: Any,
    values: Any,
) -> None:
    """Set the columns that numbers have of their own, from their values and all other columns."""
    here = np.flatnonzero(places >= 0)
    width = outputs.columns.shape[1]
    rest = values[here] - outputs.rows[here, 0] - outputs.columns[here] @ found[:width]
    found[places[here]] = rest / gap[here]


def upper_bounds(
    forms: AffineForms,
    facts: AffineForms,
    multipliers: Float[np.ndarray, "k m"],
    start: InitialColumns,
) -> Float[np.ndarray, " k"]:
    """Upper bounds of forms, by multipliers of facts that are of the right signs; NaN is none."""
    width = max(forms.rows.shape[1], facts.rows.shape[1]) - 2
    with np.errstate(all="ignore"):
        used = np.flatnonzero(np.any(multipliers != 0, axis=0))  # few are, of wide networks
        weighed = forms.padded(width) + multipliers[:, used] @ facts[used].padded(width)
        return weighed.ends(start)[1]
