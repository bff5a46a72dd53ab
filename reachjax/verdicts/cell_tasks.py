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
from reachjax.numerics.budget import Budget
from reachjax.numerics.flags import lenient
from reachjax.proofs.branches import Branches
from reachjax.sets import AbstractSet
from reachjax.sets.balance import balanced
from reachjax.verdicts.grounds import Leaves
from reachjax.verdicts.sieve import Margins, Outcome, Sieve, Unbounded, no_margins
from reachjax.verdicts.specification import Requirement
from reachjax.verdicts.targets import target_of, values_of


class CellTask(NamedTuple):
    """What is decided of every cell.

    Attributes:
        loop: of numpy arrays.
        horizon: the number of steps.
        start: the time of the initial set.
        required: the requirements.
        nodes: how many linear programs a bound may take.
    """

    loop: ClosedLoop
    horizon: int
    start: int
    required: tuple[Requirement, ...]
    nodes: int

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
        axis = _axis(ladder, _first_open(task.required, margins))
        return Outcome(False, margins, axis=axis)
    middle, failing = scenarios.middle(np.asarray(around.center)), any(broken)
    proved, axis, leaves = not failing, 0, list[Leaves]()
    for k in range(task.horizon + 1):
        if k:
            ladder.advance(tighten=False)
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
                axis = axis if proved else _axis(ladder, item)
        if not (proved or failing):
            break
    return Outcome(proved, margins, axis=axis, leaves=tuple(leaves))


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
        return item.proved(compared), float(compared.margins.min()), None
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


def _axis(ladder: Ladder, item: Requirement) -> int:
    """The coordinate that moves the inputs of the first step's units most, or what is required."""
    horizon = ladder.horizon
    n = len(horizon.start.center)
    size = np.zeros(n)
    for layer in horizon.steps[0] if horizon.steps else ():
        bent = slice(None) if layer.unit.curved else layer.places >= 0
        size += abs(layer.inputs.columns[:, :n])[bent].sum(axis=0)
    if not size.any():
        C = np.asarray(item.region.facets[0])
        size = abs(C @ horizon.start.spread).sum(axis=0)
    return int(size.argmax())
