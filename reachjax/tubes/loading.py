"""Tubes from files, sealed again, and rechecked where what they rest on may have changed."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from reachjax.loops import ClosedLoop
from reachjax.methods.problem import Problem
from reachjax.methods.propagation import Options, check_problem
from reachjax.methods.searches import Bar
from reachjax.numerics.archives import UnreadableError, existing_file
from reachjax.numerics.checks import (
    owned,
    require_bar,
    require_double_precision,
    require_kind,
    wrapped,
)
from reachjax.numerics.flags import lenient
from reachjax.numerics.logs import logged
from reachjax.numerics.storage import read
from reachjax.tubes.partitions import PartitionedTube
from reachjax.tubes.reach import ReachTube
from reachjax.tubes.rechecks import Recheck, require_partition
from reachjax.tubes.saving import Kept

MISSING = (
    "was written without its loop, whose functions cannot be stored: give the loop again, "
    "load(path, loop=...)"
)


@logged
@lenient
def load(
    path: str | os.PathLike[str],
    loop: ClosedLoop | None = None,
    *,
    recheck: bool = False,
    progress: Bar | None = None,
) -> ReachTube | PartitionedTube:
    """A tube from the file that `tube.save(path)` wrote.

    Args:
        path: of the file.
        loop: needed if the loop has functions that a user wrote, which no file can keep. It must be
            the one that was left out, in every equation that JAX traces of it and in every number.
        recheck: whether everything that the tube says of its loop is proved anew, which takes about
            as long as it took to compute, or less. The file is believed in nothing: of the loop,
            the initial set, template and start that it has, all else follows.
        progress: wraps the iteration over steps that are rechecked, such as `tqdm.tqdm`.

    Raises:
        FileNotFoundError: there is no such file.
        RuntimeError: JAX's 64-bit floats are off.
        TypeError: an argument is of another kind.
        DisagreementError: a recheck does not prove what the file says.
        UnreadableError: the file is none of reachjax, of another version, broken or changed, or a
            loop is needed.
        ValueError: the loop is another one, or the progress bar leaves out steps.

    Example:
        >>> import pathlib, tempfile
        >>> from reachjax import MLP, AffinePlant, Box, Template, reach
        >>> loop = ClosedLoop(AffinePlant([[0.5]], [[1.0]]), MLP.from_layers([([[0]], [0])]))
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "tube.reach"
        >>> reach(loop, Box([1.0], [2.0]), 3, Template.box(1)).save(path)
        >>> load(path, recheck=True)
        ReachTube(horizon=3, facets=2, states=1)
    """
    require_double_precision()
    require_bar(progress)
    if loop is not None:
        require_kind("loop", loop, ClosedLoop, "a ClosedLoop")
    found = existing_file("path", path)
    kept = read(found, owned(loop), MISSING)
    try:
        tube = _sealed(kept)
    except Exception as error:  # whoever wrote it may have written anything
        message = f"{path} must hold a tube, but something else arrived: {error}"
        raise UnreadableError(message) from error
    if loop is not None and not kept.is_of(loop):
        raise ValueError(
            f"loop must be that of the tube in {path}, with the same equations and numbers, but "
            "another one arrived (or another version of JAX, which writes its equations otherwise)"
        )
    return _rechecked(tube, progress) if recheck else tube


def _rechecked(tube: ReachTube | PartitionedTube, progress: Bar | None) -> Any:
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


def _sealed(kept: Any) -> ReachTube | PartitionedTube:
    """The tube that was read, its parts being what a tube has, with the seal of what was read.

    Raises:
        Exception: of any kind: they are something else.
    """
    require_kind("it", kept, Kept, "a tube with the seal of its loop")
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
