"""The first claim: no state of the loop is outside of its tube.

States of sampled trajectories, and of those that climb to the sets' facets and surfaces. Longdouble
finds suspects; only fractions convict.
"""

from dataclasses import dataclass, field

import numpy as np

from tests.campaign.oracle import UNIT, WIDE, Loop, Region, exact
from tests.campaign.random_regions import Initial

DRAWS = 60
CLIMBS = 2
STEPS = np.array([0.25, 0.5, 0.75, 0.9375, 1.0], dtype=WIDE)
MOST_EXACT = 2
"""So many doubtful points are simulated exactly for each facet and time."""


@dataclass
class Found:
    """What a search among a tube's trajectories found.

    Attributes:
        starts: `(k, n)` initial states in longdouble.
        states: for each time, states `(k, n)` in longdouble and their errors.
        checked: how many states were compared with sets.
        exactly: how many of them in fractions.
        outside: sentences on states outside of the tube, with their initial states.
    """

    starts: np.ndarray
    states: list
    checked: int = 0
    exactly: int = 0
    outside: list[str] = field(default_factory=list)


def searched(loop: Loop, initial: Initial, sets: list[Region], rng: np.random.Generator) -> Found:
    """Compare simulated and ascended states with sets, one for each time from 0 on."""
    horizon = len(sets) - 1
    if initial.inner is None:
        return Found(np.empty((0, initial.region.dimension), WIDE), [])
    corners = len(initial.corners)
    starts = initial.starts(rng, DRAWS)
    for t in [*range(1, horizon + 1)] * CLIMBS:
        starts = np.vstack([starts, _climbed(loop, initial, sets[t], starts, t)])
    error = np.zeros_like(starts)
    error[:corners] = 2 * UNIT * abs(starts[:corners])
    found = Found(starts, loop.simulate_wide(starts, error, horizon))
    for t, region in enumerate(sets):
        compared_with(loop, initial, region, found, t)
    return found


def compared_with(loop: Loop, initial: Initial, region: Region, found: Found, t: int) -> None:
    """Compare the states at time `t` with a set."""
    room, off = region.room_wide(*found.states[t])
    found.checked += len(room)
    for column in range(room.shape[1]):
        _judge(loop, initial, region, found, (t, column), room[:, column], off[:, column])


def start_of(initial: Initial, found: Found, k: int) -> np.ndarray:
    """An initial state in fractions: a corner as it is, another point as it is in longdouble."""
    return initial.corners[k] if k < len(initial.corners) else exact(found.starts[k])


def _judge(loop, initial, region, found: Found, where, room, off) -> None:
    """Look at the least rooms of one facet at one time, in fractions."""
    t, column = where
    for k in np.argsort(room, kind="stable")[:MOST_EXACT]:
        if room[k] > off[k]:
            return
        x0 = start_of(initial, found, k)
        found.exactly += 1
        if k >= len(initial.corners) and not initial.region.holds(x0):
            continue
        state = loop.simulate(x0[None], t)[t, 0]
        left = region.room(state)[column]
        if left < 0:
            found.outside.append(
                f"at t = {t}, column {column}: the room is {float(left):.3g} at the state "
                f"{[float(v) for v in state]} reached from {_text(x0)}"
            )
            return


def _text(x: np.ndarray) -> str:
    return "[" + ", ".join(str(v) if v.denominator > 1 else str(v.numerator) for v in x) + "]"


def _climbed(
    loop: Loop, initial: Initial, region: Region, starts: np.ndarray, t: int
) -> np.ndarray:
    """Initial states from which what a set bounds at time `t` is larger: one linear step each."""
    states = loop.simulate_wide(starts, np.zeros_like(starts), t)[t][0]
    room, _ = region.room_wide(states, np.zeros_like(states))
    best = np.argmin(room, axis=0)
    slopes = loop.slopes(starts[best], t)[t]
    rows = np.zeros((len(best), starts.shape[1]), WIDE)
    count = 0 if region.A is None else len(region.A)
    rows[:count] = region.A if count else 0
    if region.center is not None:
        away = (states[best[-1]] - region.center).astype(WIDE)
        widths = np.sqrt(np.diag(region.shape))
        scaled = region.shape / np.outer(widths, widths)
        rows[-1] = np.linalg.solve(scaled, (away / widths).astype(float)) / widths
    directions = np.einsum("ki,kij->kj", rows, slopes)
    ends = initial.extreme(directions)
    points = starts[best] + STEPS[:, None, None, None] * (ends - starts[best])
    return initial.pulled(points.reshape(-1, starts.shape[1]))
