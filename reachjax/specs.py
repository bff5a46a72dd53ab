"""Reach-avoid specifications, decided from a tube (the paper's equations (reach_avoid)).

A verdict has three values. *Proved*: every state is surely where it must be, and the margins say by
how much. *Refuted*: a simulated trajectory breaks the specification, and is given. *Unknown*: the
sets are too large to prove it, and no trajectory breaks it; margins of both kinds say how far apart
they are. Margins are distances in the units of the state.
"""

from __future__ import annotations

import dataclasses
import enum

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from reachjax.bounds import successor_box
from reachjax.checks import whole_number
from reachjax.reach import ReachTube
from reachjax.requirements import AvoidSets, Requirement, of_tube
from reachjax.rounding import gamma
from reachjax.sets import Box, PolyhedralSet
from reachjax.solvers import SolverStatus

SUSPECTS = 5
"""So many of the worst trajectories of each requirement are examined with their rounding."""


class VerdictStatus(enum.Enum):
    """What is known of a specification."""

    PROVED = "proved"
    REFUTED = "refuted"
    UNKNOWN = "unknown"


@dataclasses.dataclass(frozen=True)
class Counterexample:
    """A simulated trajectory that breaks a specification.

    Attributes:
        requirement: which part it breaks: `goal`, `safe` or `avoid[i]`.
        time: when.
        violation: by how much, in the units of the state.
        states: `(horizon + 1, n_x)`, the whole trajectory.
        inputs: `(horizon, n_u)`.
    """

    requirement: str
    time: int
    violation: float
    states: Float[np.ndarray, "h+1 n_x"]
    inputs: Float[np.ndarray, "h n_u"]


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What is known of a specification, part by part.

    Attributes:
        status: proved, refuted or unknown.
        margins: for each requirement `(horizon + 1,)`, the certified margin at each time; NaN where
            nothing is required. Negative: not proved.
        simulated: the same for the sampled trajectories. Negative: broken.
        counterexample: the trajectory, when refuted.
        unsolved: how many of the tube's facets the solver did not solve to its tolerance: their
            bounds hold, but may be loose.
    """

    status: VerdictStatus
    margins: dict[str, Float[np.ndarray, " h+1"]]
    simulated: dict[str, Float[np.ndarray, " h+1"]]
    counterexample: Counterexample | None = None
    unsolved: int = 0

    def __bool__(self) -> bool:
        raise TypeError("a verdict has three values: compare verdict.status with VerdictStatus")

    def __str__(self) -> str:
        lines = [self.status.name]
        for name, margins in self.margins.items():
            t = int(np.nanargmin(margins))
            simulated = float(np.nanmin(self.simulated[name]))
            lines.append(
                f"  {name}: certified margin {margins[t]:+.4g} (smallest, at t = {t}), "
                f"simulated margin {simulated:+.4g}"
            )
        if self.counterexample is not None:
            e = self.counterexample
            lines.append(
                f"  counterexample: from {np.round(e.states[0], 4).tolist()} it breaks "
                f"{e.requirement} at t = {e.time} by {e.violation:.4g}"
            )
        if self.unsolved:
            lines.append(
                f"  {self.unsolved} programs were not solved to tolerance: their bounds hold, but "
                "may be loose (see certificate.statuses)"
            )
        return "\n".join(lines)

    __repr__ = __str__


def verify(
    tube: ReachTube,
    goal: PolyhedralSet | None = None,
    avoid: AvoidSets | None = None,
    safe: PolyhedralSet | None = None,
    *,
    samples: int = 10_000,
    seed: int = 0,
) -> Verdict:
    """Decide a reach-avoid specification from a tube.

    Args:
        tube: certified sets for `t = 0 .. horizon`.
        goal: where every state must be at the horizon.
        avoid: closed sets in which no state may be: a sequence for all times, or a mapping from a
            time to a sequence.
        safe: where every state must be at all times (its complement is avoided).
        samples: how many trajectories are simulated in search of a counterexample, besides those
            from corners and witnesses.
        seed: of the samples.

    Raises:
        TypeError: a set is of a kind without facets.
        ValueError: nothing is required, dimensions disagree, or a time is beyond the horizon.

    Source: equations (reach_avoid) and (reach_avoid_approx) of the paper.

    Example:
        >>> from reachjax import MLP, AffinePlant, Box, ClosedLoop, Template, reach
        >>> net = MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
        >>> loop = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net, Box([-1.0], [1.0]))
        >>> tube = reach(loop, Box([1.0], [2.0]), 3, Template.box(1))
        >>> verify(tube, goal=Box([0.0], [0.5]), safe=Box([0.0], [2.0])).status.name
        'PROVED'
        >>> verify(tube, goal=Box([0.0], [0.4])).counterexample.states.ravel().round(3).tolist()
        [2.0, 1.2, 0.72, 0.432]
    """
    required = of_tube(tube, goal, avoid, safe)
    whole_number("samples", samples, 1)
    whole_number("seed", seed, 0)
    proofs = [tube.proof(t) for t in range(1, tube.horizon + 1)]
    unsolved = sum(s is not SolverStatus.SOLVED for proof in proofs for s in proof.statuses)
    states = jnp.concatenate([proof.witness_states for proof in proofs])
    witnessed = tube.loop.simulate(states, tube.horizon, tube.start)
    trajectories = np.concatenate([witnessed, tube.simulate(samples, seed)])
    margins: dict[str, np.ndarray] = {}
    simulated: dict[str, np.ndarray] = {}
    proved, suspects = True, []
    for item in required:
        blank = np.full(tube.horizon + 1, np.nan)
        margin, rooms = float(item.margins(tube).min()), item.simulated(trajectories)
        margins.setdefault(item.name, blank.copy())[item.time] = margin
        simulated.setdefault(item.name, blank.copy())[item.time] = rooms.min()
        proved = proved and item.proved(margin)
        worst = np.argsort(rooms)[:SUSPECTS]
        suspects += [(rooms[k], item, trajectories[k]) for k in worst if rooms[k] <= 0]
    for room, item, states in sorted(suspects, key=lambda suspect: suspect[0]):
        if _surely_broken(tube, item, states[0]):
            if proved:
                raise RuntimeError("a proved specification is broken: please report this defect")
            example = _counterexample(tube, room, item, states)
            return Verdict(VerdictStatus.REFUTED, margins, simulated, example, unsolved)
    status = VerdictStatus.PROVED if proved else VerdictStatus.UNKNOWN
    return Verdict(status, margins, simulated, None, unsolved)


def _surely_broken(tube: ReachTube, item: Requirement, x0: np.ndarray) -> bool:
    """Whether the exact trajectory from `x0` breaks a requirement, rounding accounted for."""
    if not tube.sets[0].surely_contains(x0):
        return False
    reached = Box(x0, x0)
    for t in range(item.time):
        reached = successor_box(tube.loop, reached, tube.start + t)
    x, spread = np.asarray(reached.center), np.asarray(reached.widths)
    C, d = (np.asarray(part) for part in item.region.facets)
    error = abs(C) @ spread + gamma(len(x)) * (abs(C) @ abs(x) + abs(d))
    if item.inside:
        return bool(np.any(d - C @ x + error < 0))
    return bool(np.all(d - C @ x - error >= 0))


def _counterexample(
    tube: ReachTube, room: float, item: Requirement, states: np.ndarray
) -> Counterexample:
    inputs = [tube.loop.input(jnp.asarray(x), tube.start + t) for t, x in enumerate(states[:-1])]
    return Counterexample(item.name, item.time, -float(room), states, np.stack(inputs))
