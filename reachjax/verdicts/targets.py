"""What a ladder must bound for a requirement to be proved."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from reachjax.methods.ladder import Ladder, Target
from reachjax.methods.witnesses import Simulated, Simulations
from reachjax.numerics.numbers import split
from reachjax.programs.affine import AffineForms
from reachjax.programs.horizon import Horizon
from reachjax.verdicts.specification import PARTS, Requirement

FINEST = 64
"""Into so many parts steps are cut at last, for states that pass very close by a corner."""

BELOW = 1e-9
"""How far below zero a linear program should be, as a part of its form's range, to prove that."""


def target_of(
    item: Requirement, ladder: Ladder, simulations: Simulations | None, middle: np.ndarray
) -> tuple[Target, np.ndarray]:
    """What must be below zero: the excess over each facet, or the depth in the set.

    Args:
        item: the requirement, at the time that the ladder has come to.
        ladder: over whose forms it is stated.
        simulations: trajectories whose values are known; None if there are none.
        middle: `(s,)`, some scenario.

    Returns:
        The target, and what a distance of 1 in the units of the state changes its values by.
    """
    C, d, norms = _facets(item)
    forms, units = values_of(item, ladder)
    unknown = len(forms) - (len(d) if item.inside else 1)  # those in between samples

    def values(after: np.ndarray) -> np.ndarray:
        excess = after @ C.T - d
        found = excess if item.inside else (-excess / norms).min(axis=1, keepdims=True)
        return np.concatenate([np.full((len(found), unknown), -np.inf), found], axis=1)

    ends = [rows.ends(ladder.horizon.start) for rows in forms]
    sizes = [np.max(upper - lower) for lower, upper in ends]

    def enough(number: int, bound: float, attained: float) -> bool:
        return bound <= -BELOW * sizes[number] or attained > 0

    if simulations is None:
        known = Simulated.nothing(middle, len(forms))
    else:
        known = simulations.known(values(simulations.runs.states[:, len(ladder.horizon.steps)]))
    return Target(forms, values, enough, known), units


def values_of(
    item: Requirement, ladder: Ladder
) -> tuple[list[AffineForms], Float[np.ndarray, " g"]]:
    """Groups of forms: in each, one must be below zero at each state.

    In between samples all control points must be on the right side: of a set to be avoided, of one
    facet that is the same for all four of a part of the period, as their hull is then too. Periods
    are cut where that proves it.

    Returns:
        The groups, and what a distance of 1 in the units of the state changes their values by.
    """
    (C, d, norms), horizon = _facets(item), ladder.horizon
    if not item.throughout:
        rows = C @ horizon.state
        if item.inside:
            return split(rows + (-d), len(d)), norms
        return [(1 / norms) * (d - rows)], np.ones(1)
    assert horizon.spans  # they were asked for
    between = horizon.spans[-1]
    if item.inside:
        rows = between.values(C).padded(horizon.width)
        count = len(rows) // len(d)
        return split(rows + np.tile(-d, count), len(rows)), np.tile(norms, count)
    tried = (
        _apart(between.values(C, parts).padded(horizon.width), d, norms, horizon)
        for parts in (1, PARTS, FINEST)
    )
    whole, proved = next(tried)
    found = whole if proved else next((cut for cut, proves in tried if proves), whole)
    return found, np.ones(len(found))


def _apart(
    rows: AffineForms,
    d: Float[np.ndarray, " m"],
    norms: Float[np.ndarray, " m"],
    horizon: Horizon,
) -> tuple[list[AffineForms], bool]:
    """Depths in a set at control points, of each part's best facet; whether they prove it."""
    count = len(rows) // len(d)
    depths = np.tile(1 / norms, count) * (np.tile(d, count) - rows)
    ends = depths.ends(horizon.start)[1].reshape(-1, 4, len(d)).max(axis=1)
    best = np.nan_to_num(ends, nan=np.inf).argmin(axis=1)
    places = np.arange(count) * len(d) + np.repeat(best, 4)
    proved = bool((np.take_along_axis(ends, best[:, None], axis=1) < 0).all())
    return split(depths[places], len(places)), proved


def _facets(item: Requirement) -> list[np.ndarray]:
    return [np.asarray(part) for part in item.region.facets_in_units(inner=item.inside)]
