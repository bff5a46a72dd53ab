"""What is proved of one cell of an initial set, wherever it runs.

By forms, and where rectifiers switch by linear programs, left at the first requirement that is not
proved: what comes later would only be worse. A cell on which a unit has no bounds, as a square root
over negative numbers, is not proved; its halves may be.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from reachjax.loops import ClosedLoop
from reachjax.loops.scenarios import Scenarios
from reachjax.loops.units import UnboundedError
from reachjax.methods.cells import WAYS
from reachjax.methods.ladder import WORK, Ladder
from reachjax.methods.steps import boxed
from reachjax.methods.witnesses import Simulations
from reachjax.numerics.budget import Budget
from reachjax.numerics.flags import lenient
from reachjax.programs.affine import AffineForms
from reachjax.programs.affine_steps import UnitForms
from reachjax.programs.initial import InitialColumns
from reachjax.proofs.branches import Branches
from reachjax.sets import AbstractSet
from reachjax.sets.balance import balanced
from reachjax.verdicts.grounds import Leaves
from reachjax.verdicts.sieve import Margins, Outcome, Sieve, Unbounded, no_margins
from reachjax.verdicts.specification import Requirement
from reachjax.verdicts.targets import target_of, values_of

FAR = 30.0
"""Bounds of smooth loops that are so many times as wide as all that is simulated, or as that is
large, grow on: nothing comes of them but ever dearer steps."""

FLAT = 1e-9
"""Coordinates that are so small a part of the largest, such as advisories that no trajectory has,
say nothing of how far bounds may be."""

HALVED = 0.4
"""What smooth functions leave out on account of a coordinate falls to less than this part of it
where it is halved: to a quarter of what is of degree two, to an eighth of degree three."""


class CellTask(NamedTuple):
    """What is decided of every cell.

    Attributes:
        loop: of numpy arrays.
        horizon: the number of steps.
        start: the time of the initial set.
        required: the requirements.
        nodes: how many linear programs a bound may take.
        beyond: `(2, n_x)`, ends of a box around all that is simulated, so large that a cell whose
            bounds leave it is given up; None where nothing is.
    """

    loop: ClosedLoop
    horizon: int
    start: int
    required: tuple[Requirement, ...]
    nodes: int
    beyond: Float[np.ndarray, "2 n_x"] | None = None

    @property
    def by_programs(self) -> bool:
        """Whether linear programs may prove what forms do not."""
        layers = self.loop.unit_layers
        return self.nodes > 0 and not all(each.unit.curved for each in layers)

    @property
    def follows(self) -> bool:
        """Whether forms along the ways of decisions may prove what forms do not."""
        return self.loop.curved and self.loop.jumps and not self.by_programs


@lenient
def outcome_of(
    task: CellTask,
    part: AbstractSet,
    budget: Budget,
    known: Margins | None = None,
    broken: Sequence[bool] = (),
) -> Outcome:
    """What is found of one cell, wherever it runs.

    Args:
        task: what is decided.
        part: of the initial set, of numpy arrays.
        budget: of the call.
        known: the margins by forms over the cell's box, which do not prove all; None if unknown.
        broken: which requirements all simulated trajectories from it break, so that one may fail
            from every state; none if not given.
    """
    begun = known or no_margins(task.required, task.horizon)
    margins = {name: row.copy() for name, row in begun.items()}
    with jax.enable_x64(True):
        try:
            if task.follows and not any(broken):
                sieve = Sieve(task.loop, task.horizon, task.start, task.required)
                around = jax.device_get(boxed(jax.device_put(part), "X0"))
                return sieve.followed(part, around, WAYS, budget)
            return _climbed(task, part, budget, margins, known is not None, broken)
        except UnboundedError as error:
            return Outcome(False, margins, unbounded=Unbounded.of(error))


def _climbed(
    task: CellTask,
    part: AbstractSet,
    budget: Budget,
    margins: Margins,
    by_forms: bool,
    broken: Sequence[bool],
) -> Outcome:
    """What is found of a cell, step after step; margins are noted as they are found.

    Raises:
        UnboundedError: a unit has no bounds over it.
    """
    around = jax.device_get(boxed(jax.device_put(part), "X0"))
    scenarios = Scenarios.of(task.loop, part, task.horizon, task.start)
    limits = task.nodes, budget.with_work(WORK)
    between = any(item.throughout for item in task.required)
    ladder = Ladder(task.loop, part, around, scenarios, task.start, *limits, between=between)
    if by_forms and part.intervals is not None and not task.by_programs:
        ladder.advance(tighten=False)  # nothing but forms could be tried again
        axis, _ = _axes(ladder, _first_open(task.required, margins))
        return Outcome(False, margins, axis=axis)
    middle, failing = scenarios.middle(np.asarray(around.center)), any(broken)
    proved, axes, leaves = not failing, (-1, -1), list[Leaves]()
    for k in range(task.horizon + 1):
        early = 2 * k < task.horizon
        if k:
            try:
                ladder.advance(tighten=False)
            except UnboundedError as error:
                if proved and k > 1:
                    axes = _axes(ladder, _first_open(task.required, margins), early)
                (axis, then), lost = axes, Unbounded.of(error)
                return Outcome(False, margins, axis=axis, then=then, unbounded=lost)
            if not failing and is_beyond(ladder, task.beyond):
                axis, then = _axes(ladder, _first_open(task.required, margins), early)
                return Outcome(False, margins, axis=axis, then=then)
        if budget.overdue:
            return Outcome(False, margins)
        for number, item in enumerate(task.required):
            if item.time != k:
                continue
            if failing and broken[number] and fails_everywhere(item, ladder):
                return Outcome(False, margins, refuted=True)
            if proved:
                proved, margin, branches = bounded(item, ladder, part, middle)
                leaves += [Leaves(item.name, k, branches)] if proved and branches else []
                margins[item.name][k] = np.fmax(margins[item.name][k], margin)
                axes = axes if proved else _axes(ladder, item, early)
        if not (proved or failing):
            break
    axis, then = axes
    return Outcome(proved, margins, axis=axis, leaves=tuple(leaves), then=then)


def far_from(simulations: Simulations | None) -> Float[np.ndarray, "2 n_x"] | None:
    """A box around all simulated states, `FAR` times as wide; None where there are none.

    It has no ends where states are flat.
    """
    if simulations is None:
        return None
    states = simulations.runs.states.reshape(-1, simulations.runs.states.shape[-1])
    states = states[np.isfinite(states).all(axis=1)]
    if not len(states):
        return None
    ends = np.array([states.min(axis=0), states.max(axis=0)])
    size = np.maximum(np.ptp(ends, axis=0), abs(ends).max(axis=0))
    size = np.where(size > FLAT * size.max(), size, np.inf)
    return ends + FAR * np.array([[-1.0], [1.0]]) * size


def is_beyond(ladder: Ladder, beyond: Float[np.ndarray, "2 n_x"] | None) -> bool:
    """Whether bounds of the states where a ladder has come to leave a box."""
    if beyond is None:
        return False
    lower, upper = ladder.horizon.ends[-1]
    return bool(np.any(lower < beyond[0]) or np.any(upper > beyond[1]))


def _first_open(required: Sequence[Requirement], margins: Margins) -> Requirement:
    """The first requirement that is not proved, in time."""
    broken = [item for item in required if not margins[item.name][item.time] > 0]
    return min(broken or required, key=lambda item: item.time)


def bounded(
    item: Requirement, ladder: Ladder, part: AbstractSet, middle: Float[np.ndarray, " s"]
) -> tuple[bool, float, Branches | None]:
    """Whether a requirement surely holds where the ladder has come to, its margin, and branches.

    There are none where forms alone prove it.
    """
    if item.time == 0:
        compared = item.compared_with(jax.device_put(part))
        return item.proved(compared), compared.least_margin, None
    forms, units = values_of(item, ladder)
    bounds = np.array([rows.ends(ladder.horizon.start)[1].min() for rows in forms])
    branches = None
    if not _all_right(item, bounds) and len(ladder.horizon.zero):
        climbed = ladder.bounds(target_of(item, ladder, None, middle)[0])
        bounds, branches = climbed.bounds, climbed.branches
    return _all_right(item, bounds), float(np.min(-bounds / units)), branches


def fails_everywhere(item: Requirement, ladder: Ladder) -> bool:
    """Whether every state surely breaks a requirement at the time that the ladder has come to."""
    facets = (np.asarray(part) for part in item.looser.facets)
    C, d = balanced(*facets, inner=not item.inside)
    lower, upper = (C @ ladder.horizon.state + (-d)).ends(ladder.horizon.start)
    return bool((lower > 0).any() if item.inside else (upper <= 0).all())


def _all_right(item: Requirement, bounds: Float[np.ndarray, " g"]) -> bool:
    return bool(np.all(bounds <= 0 if item.inside else bounds < 0))


def _axes(ladder: Ladder, item: Requirement, early: bool = False) -> tuple[int, int]:
    """The coordinate to halve a cell along, and the one to halve its halves along at once, or -1.

    A half gets at most about twice as far as its cell, so that of one that failed early none is
    proved.
    """
    start, size = ladder.horizon.start, _left_out(ladder, item)
    if not size.any():
        size = abs(np.asarray(item.region.facets[0]) @ start.spread).sum(axis=0)
    axis, then = int(size.argmax()), -1
    if early and start.curved:
        size[axis] *= HALVED
        then = int(size.argmax())
    return axis, then


def _left_out(ladder: Ladder, item: Requirement) -> Float[np.ndarray, " n"]:
    """What forms leave out of a requirement's values, by the coordinate that it is due to.

    What units leave out is due to the coordinates that move their inputs; what a flow leaves out is
    of third order, and due to those of which the state has large products.
    """
    horizon, C = ladder.horizon, np.asarray(item.region.facets[0])
    start, n = horizon.start, len(horizon.start.center)
    size, known = np.zeros(n), start.count
    left = abs((C @ horizon.state).columns).sum(axis=0)
    for layers, merged, state in zip(horizon.steps, horizon.merged, horizon.states, strict=True):
        summed = {number for part in merged for number in part.layers}
        own = [
            (layer.places, _moved(layer, n))
            for number, layer in enumerate(layers)
            if number not in summed
        ]
        for part in merged:
            moved = sum(_moved(layers[number], n).sum(axis=0) for number in part.layers)
            own.append((part.places, np.tile(moved, (len(part.places), 1))))
        for places, moved in own:
            there = places >= 0
            size += left[places[there]] @ _shares(moved[there])
            left[places[there]] = 0.0
        last = min(state.columns.shape[1], len(left))
        size += left[known:last].sum() * _shares(_bent(start, state)).mean(axis=0)
        known = max(known, last)
    return np.where(np.isfinite(size), size, 0.0)


def _moved(layer: UnitForms, n: int) -> Float[np.ndarray, "k n"]:
    """How far each of `n` coordinates moves the inputs of units; of all, where they share these."""
    rows, count = abs(np.asarray(layer.inputs.columns)[:, :n]), len(layer.places)
    if len(rows) == layer.unit.inputs * count:
        return rows.reshape(layer.unit.inputs, count, n).sum(axis=0)
    return np.tile(rows.sum(axis=0), (count, 1))


def _bent(start: InitialColumns, state: AffineForms) -> Float[np.ndarray, "n_x n"]:
    """What each state has of products of each of `n` coordinates, squares twice."""
    return start.by_coordinate(abs(np.asarray(state.columns)[:, len(start.center) : start.count]))


def _shares(rows: Float[np.ndarray, "k n"]) -> Float[np.ndarray, "k n"]:
    """The parts that rows have of their sums; none of zeros, or where nothing is known."""
    sums = rows.sum(axis=1, keepdims=True)
    known = (sums > 0) & (sums < np.inf)
    return np.where(known, rows / np.where(known, sums, 1.0), 0.0)
