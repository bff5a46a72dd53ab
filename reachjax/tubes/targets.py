"""What a ladder must bound for a requirement to be proved."""

from __future__ import annotations

import numpy as np

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
    parts = item.region.facets_in_units(inner=item.inside)
    C, d, norms = (np.asarray(part) for part in parts)
    state, start = ladder.horizon.state, ladder.horizon.start
    if item.inside:
        excess = C @ state + (-d)
        forms = [excess[i : i + 1] for i in range(len(d))]
    else:
        forms = [(1 / norms) * (d - C @ state)]

    def values(after: np.ndarray) -> np.ndarray:
        excess = after @ C.T - d
        return excess if item.inside else (-excess / norms).min(axis=1, keepdims=True)

    sizes = [np.subtract(*form.ends(start)[::-1]).max() for form in forms]

    def enough(number: int, bound: float, attained: float) -> bool:
        return bound <= -BELOW * sizes[number] or attained > 0

    if simulations is None:
        known = Simulated.nothing(middle, len(forms))
    else:
        known = simulations.known(values(simulations.runs.states[:, len(ladder.horizon.steps)]))
    return Target(forms, values, enough, known), norms if item.inside else np.ones(1)
