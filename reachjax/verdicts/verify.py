"""Reach-avoid specifications, decided from a tube (the paper's equations (reach_avoid)).

Certified margins prove a requirement. Trajectories are simulated in search of a counterexample; one
of them refutes it only if it surely begins in the initial set and breaks it whatever rounding did.
"""

from __future__ import annotations

import contextlib
from collections import Counter

import jax
import numpy as np

from reachjax.loops.scenarios import Runs, Scenarios
from reachjax.methods.witnesses import initial_states
from reachjax.numerics.budget import Budget
from reachjax.numerics.checks import is_concrete, require_kind, whole_number
from reachjax.numerics.deprecations import once_positional
from reachjax.numerics.flags import lenient
from reachjax.numerics.logs import logged
from reachjax.sets import AbstractSet
from reachjax.sets.unusable import ThinSetError
from reachjax.tubes.partitions import BESIDE, PartitionedTube
from reachjax.tubes.reach import ReachTube
from reachjax.verdicts.findings import Findings
from reachjax.verdicts.invariance import for_ever
from reachjax.verdicts.soundness import require_unbroken
from reachjax.verdicts.specification import AvoidSets, Region, Requirement, Timed, of_tube
from reachjax.verdicts.verdict import Verdict, of_cells


@once_positional("goal", "avoid", "safe")
@logged
@lenient
def verify(
    tube: ReachTube | PartitionedTube,
    *,
    goal: Timed | None = None,
    safe: Region | None = None,
    avoid: AvoidSets | None = None,
    samples: int = 10_000,
    seed: int = 0,
    forever: bool = False,
    time_limit: float | None = None,
) -> Verdict:
    """Decide a reach-avoid specification from a tube.

    Args:
        tube: certified sets for `t = 0 .. horizon`; of a partitioned tube, those of every cell.
        goal: where every state must be at the horizon; or a mapping from times, or from ranges of
            times, to where it must be then.
        safe: where every state must be at all times (its complement is avoided).
        avoid: closed sets in which no state may be: a sequence for all times, or a mapping from
            times, or from ranges of times, to sequences.
        samples: how many trajectories are simulated in search of a counterexample, besides those
            from corners and witnesses; so many from each cell.
        seed: of the samples.
        forever: whether `safe` and `avoid` must hold beyond the horizon, at all times: proved if
            the sets return into the initial set, or into another one that does (`Recurrence`).
        time_limit: with `forever`, seconds from the beginning of the call after which no such set
            is looked for any more; None: until a few are tried.

    Raises:
        TypeError: a set is no Box, Polytope or Ellipsoid.
        ValueError: nothing is required, dimensions disagree, a time is beyond the horizon, a part
            of the tube was exchanged for another one, or the tube is traced inside `jax.jit`; or
            something is required for ever of a loop that varies in time, or at given times only.
        UnsoundError: JAX runs the loop otherwise than it was proved or refuted: a defect to be
            reported.

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
        >>> verify(tube, safe=Box([-1.0], [2.0]), forever=True).status.name
        'PROVED'
    """
    budget = Budget.of(time_limit)
    whole_number("samples", samples, 1)
    whole_number("seed", seed, 0)
    require_kind("forever", forever, (bool, np.bool_), "True or False")
    if isinstance(tube, PartitionedTube):
        tube.require_sealed()
        tubes, X0 = tube.tubes, tube.X0
        cells = [(each, of_tube(each, goal=goal, safe=safe, avoid=avoid)) for each in tubes]
        verdict = of_cells([_decided(*cell, samples, seed, X0) for cell in cells])
    else:
        required = of_tube(tube, goal=goal, safe=safe, avoid=avoid)
        tubes, X0 = (tube,), tube.sets[0]
        verdict = _decided(tube, required, samples, seed, X0)
    if not forever:
        return verdict
    return for_ever(verdict, tubes, X0, safe, avoid, seed, budget)


def _decided(
    tube: ReachTube, required: list[Requirement], samples: int, seed: int, X0: AbstractSet
) -> Verdict:
    """What a tube proves, or a trajectory from `X0` refutes."""
    if not (is_concrete(tube) or is_concrete(jax.lax.stop_gradient(tube))):
        raise ValueError(
            "tube holds traced numbers, and a verdict is decided on known ones: call verify "
            "outside of jax.jit, or rj.shortfall inside"
        )
    proofs = [tube.proof(t) for t in range(1, tube.horizon + 1)]
    ends = dict(sum((Counter(proof.ends) for proof in proofs), Counter()))
    runs = _runs(tube, samples, seed)
    if X0 is not tube.sets[0]:  # a cell may hold points beside the initial set
        runs = runs.some(np.asarray(X0.contains(runs.states[:, 0], BESIDE)))
    findings = Findings(tube.loop, X0, tube.horizon, tube.start, required)
    findings.simulate(runs)
    for item in required:
        compared = item.compared(tube)
        findings.prove(item, compared.least_margin, item.proved(compared))
    begun = Scenarios.of(tube.loop, tube.sets[0], tube.horizon, tube.start)
    require_unbroken(tube.loop, begun, tube.start, runs, findings.claims)
    return findings.verdict(ends)


def _runs(tube: ReachTube, samples: int, seed: int) -> Runs:
    """Trajectories from witnesses, corners and samples, as far as there are any."""
    scenarios = Scenarios.of(tube.loop, tube.sets[0], tube.horizon, tube.start)
    given = [np.zeros((0, len(scenarios.middle(np.zeros(tube.loop.states)))))]
    found = [np.asarray(tube.proof(t).witness_states) for t in range(1, tube.horizon + 1)]
    if found[0].shape[1]:  # a tube from a thin set, or of jax.jit, has none
        given += found
    with contextlib.suppress(ThinSetError):  # a set that is too thin to be sampled
        given.append(scenarios.drawn(initial_states(tube.sets[0], samples, seed), seed))
    every = np.concatenate(given)
    if not len(every):
        return Runs(every, np.zeros((0, tube.horizon + 1, tube.loop.states)))
    states, disturbances, noises = tube.loop.split(every)
    drawn = {"disturbances": disturbances, "noises": noises}
    runs = Runs(every, np.asarray(tube.loop.simulate(states, tube.horizon, tube.start, **drawn)))
    return runs.some(np.isfinite(runs.states).all(axis=(1, 2)))
