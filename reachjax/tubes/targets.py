"""What a ladder must bound for a requirement to be proved."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from reachjax.programs.affine import AffineForms
from reachjax.proofs.witnesses import Simulated, Simulations
from reachjax.tubes.ladder import Ladder, Target
from reachjax.tubes.requirements import Requirement

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
    rows, units = values_of(item, ladder)
    forms = [rows[i : i + 1] for i in range(len(d))] if item.inside else [rows]

    def values(after: np.ndarray) -> np.ndarray:
        excess = after @ C.T - d
        return excess if item.inside else (-excess / norms).min(axis=1, keepdims=True)

    lower, upper = rows.ends(ladder.horizon.start)
    sizes = upper - lower if item.inside else [np.max(upper - lower)]

    def enough(number: int, bound: float, attained: float) -> bool:
        return bound <= -BELOW * sizes[number] or attained > 0

    if simulations is None:
        known = Simulated.nothing(middle, len(forms))
    else:
        known = simulations.known(values(simulations.runs.states[:, len(ladder.horizon.steps)]))
    return Target(forms, values, enough, known), units


def values_of(item: Requirement, ladder: Ladder) -> tuple[AffineForms, Float[np.ndarray, " k"]]:
    """Forms of which all must be below zero, or if states must be outside, one at each state.

    Returns:
        The forms, and what a distance of 1 in the units of the state changes them by.
    """
    C, d, norms = _facets(item)
    state = ladder.horizon.state
    if item.inside:
        return C @ state + (-d), norms
    return (1 / norms) * (d - C @ state), np.ones(1)


def _facets(item: Requirement) -> list[np.ndarray]:
    return [np.asarray(part) for part in item.region.facets_in_units(inner=item.inside)]
