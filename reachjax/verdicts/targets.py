"""What a ladder must bound for a requirement to be proved."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from reachjax.methods.ladder import Ladder, Target
from reachjax.methods.witnesses import Simulated, Simulations
from reachjax.programs.affine import AffineForms
from reachjax.verdicts.specification import Requirement

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
    facet that is the same for all of them, as their hull is then too.

    Returns:
        The groups, and what a distance of 1 in the units of the state changes their values by.
    """
    C, d, norms = _facets(item)
    horizon = ladder.horizon
    states = [horizon.state]
    if item.throughout:
        assert horizon.spans  # they were asked for
        states = [point.padded(horizon.width) for point in horizon.spans[-1].states]
    if item.inside:
        every = [C @ state + (-d) for state in states]
        return [rows[i : i + 1] for rows in every for i in range(len(d))], np.tile(
            norms, len(every)
        )
    every = [(1 / norms) * (d - C @ state) for state in states]
    if item.throughout:
        uppers = np.max([rows.ends(horizon.start)[1] for rows in every], axis=0)
        best = int(np.argmin(np.nan_to_num(uppers, nan=np.inf)))
        every = [rows[best : best + 1] for rows in every]
    return every, np.ones(len(every))


def _facets(item: Requirement) -> list[np.ndarray]:
    return [np.asarray(part) for part in item.region.facets_in_units(inner=item.inside)]
