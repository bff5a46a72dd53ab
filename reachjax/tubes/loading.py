"""Tubes as files have them, sealed again, and rechecked."""

from __future__ import annotations

from typing import Any

import numpy as np

from reachjax.methods.problem import Problem
from reachjax.methods.propagation import Options, check_problem
from reachjax.methods.searches import Bar
from reachjax.numerics.checks import require_kind, wrapped
from reachjax.tubes.partitions import PartitionedTube
from reachjax.tubes.reach import ReachTube
from reachjax.tubes.rechecks import Recheck, require_partition
from reachjax.tubes.saving import Kept


def rechecked(tube: ReachTube | PartitionedTube, progress: Bar | None) -> Any:
    """The tube as it is proved anew.

    Raises:
        DisagreementError: it says what is not proved.
        ValueError: the progress bar leaves out steps.
    """
    parts = tube.tubes if isinstance(tube, PartitionedTube) else (tube,)
    if isinstance(tube, PartitionedTube):
        require_partition(tube)
    steps = [each for each in map(Recheck, parts) for _ in range(each.left)]
    for each in wrapped(progress, steps):
        each.advance()
    done = {id(each): each for each in steps}
    found = tuple(each.finished() for each in done.values())
    if isinstance(tube, PartitionedTube):
        return PartitionedTube.sealed(tube.X0, found)
    return found[0]


def sealed(kept: Kept) -> ReachTube | PartitionedTube:
    """The tube that was read, its parts being what a tube has, with the seal of what was read.

    Raises:
        Exception: of any kind: they are something else.
    """
    if isinstance(kept.tube, PartitionedTube):
        parts = tuple(map(_whole, kept.tube.tubes))
        if not parts:
            raise ValueError("it has no cells")
        return PartitionedTube.sealed(kept.tube.X0, parts)
    return _whole(kept.tube)


def _whole(tube: Any) -> ReachTube:
    """A tube whose sets and proofs are as many and as large as they should be."""
    require_kind("it", tube, ReachTube, "a tube")
    given = tube.loop, tube.sets[0], tube.template, tube.horizon, tube.start
    check_problem(Problem(*given), Options())
    if len(tube.certificates) != len(tube.sets) or tube.certificates[0] is not None:
        raise ValueError(f"it has {len(tube.sets)} sets, but {len(tube.certificates)} certificates")
    for k in range(1, tube.horizon + 1):
        region, proof = tube.sets[k], tube.proof(k)
        bounds = np.asarray(proof.bounds)
        if region.dimension != tube.loop.states or bounds.shape != region.limits.shape:
            raise ValueError(f"sets[{k}] is not of the loop's states, or not of its certificate")
        if not np.isfinite(bounds).all():
            raise ValueError(f"certificates[{k}] has bounds that are no numbers")
        if len(proof.statuses) != len(bounds):
            raise ValueError(f"certificates[{k}] has not as many statuses as bounds")
    return ReachTube.sealed(tube.loop, tube.template, tube.sets, tube.certificates, tube.start)
