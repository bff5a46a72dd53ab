"""Decision procedures: the library's two, and what a user would pick instead.

Bounds prove and trajectories refute. The library has both; affine forms can only prove, and samples
only refute.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import reachjax as rj
from experiments.benchmark.cases import Settings
from experiments.benchmark.rivals.affine_forms import affine_bounds
from experiments.task import Task


@dataclass(frozen=True)
class Decision:
    """What a procedure decides.

    Attributes:
        verdict: proved, refuted, or unknown.
        programs: how many linear programs it took; None if it does not tell.
    """

    verdict: rj.VerdictStatus
    programs: int | None = None


Procedure = Callable[[Task, Settings], Decision]


def by_decide(task: Task, _: Settings) -> Decision:
    """`rj.decide`; its programs are those of its proofs, and none where a sample refutes."""
    verdict = rj.decide(task.loop, task.X0, task.horizon, **task.required)
    proofs = verdict.certificates.values()
    programs = sum(int(np.sum(p.nodes)) for p in proofs if isinstance(p, rj.BranchCertificate))
    bounded = any(np.isfinite(margins[1:]).any() for margins in verdict.margins.values())
    told = verdict.status is rj.VerdictStatus.PROVED or not bounded
    return Decision(verdict.status, programs if told else None)


def by_tube(task: Task, _: Settings) -> Decision:
    """`rj.verify` on the tube of `rj.LinearBounds`."""
    tube = rj.reach(task.loop, task.X0, task.horizon, task.template, rj.LinearBounds())
    return Decision(rj.verify(tube, **task.required).status)


def by_numpy(task: Task, _: Settings) -> Decision:
    """Affine forms of the safe set's facets; corners tell what the initial set has of them."""
    assert task.safe is not None
    A, b = map(np.asarray, task.safe.facets)
    at_first = (task.X0.vertices() @ A.T).max(axis=0)
    bounds = np.vstack([at_first, affine_bounds(task.loop, task.X0, task.horizon, A)])
    proved = np.all(bounds <= b)
    return Decision(rj.VerdictStatus.PROVED if proved else rj.VerdictStatus.UNKNOWN, programs=0)


def by_samples(task: Task, settings: Settings) -> Decision:
    """Trajectories from corners and samples."""
    broken = task.margin(task.simulated(settings.simulations, settings.seed)) < 0
    return Decision(rj.VerdictStatus.REFUTED if broken else rj.VerdictStatus.UNKNOWN, programs=0)


PROCEDURES: dict[str, Procedure] = {
    "decide": by_decide,
    "verify": by_tube,
    "numpy": by_numpy,
    "samples": by_samples,
}
"""By the names that tables have, the library first."""
