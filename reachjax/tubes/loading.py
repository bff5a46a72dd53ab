"""Tubes from files, sealed again, and rechecked where what they rest on may have changed."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from reachjax.loops import ClosedLoop
from reachjax.numerics.checks import (
    owned,
    require_bar,
    require_double_precision,
    require_kind,
    wrapped,
)
from reachjax.numerics.files import existing_file
from reachjax.numerics.flags import lenient
from reachjax.numerics.storage import read
from reachjax.tubes.kept import Kept
from reachjax.tubes.partitions import Bar, PartitionedTube
from reachjax.tubes.reach import ReachTube

ROUNDING = 1e-9
"""Of a bound's size: what a recheck may differ by on another machine."""

MISSING = (
    "was written without its loop, whose functions cannot be stored: give the loop again, "
    "load(path, loop=...)"
)


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
        recheck: whether all bounds are proved anew from their certificates.
        progress: wraps the iteration over steps that are rechecked, such as `tqdm.tqdm`.

    Raises:
        FileNotFoundError: there is no such file.
        RuntimeError: JAX's 64-bit floats are off.
        TypeError: an argument is of another kind.
        ValueError: the file is none of reachjax, of another version, broken or changed; a loop is
            needed or is another one; or a recheck does not prove a bound.

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
    kept = read(existing_file("path", path), owned(loop), MISSING)
    if not isinstance(kept, Kept) or not isinstance(kept.tube, ReachTube | PartitionedTube):
        raise ValueError(f"{path} must hold a tube, but something else arrived")
    tube = _sealed(kept.tube)
    tubes = tube.tubes if isinstance(tube, PartitionedTube) else (tube,)
    if loop is not None and not kept.is_of(loop):
        raise ValueError(
            f"loop must be that of the tube in {path}, with the same equations and numbers, but "
            "another one arrived (or another version of JAX, which writes its equations otherwise)"
        )
    if recheck:
        steps = [(each, t) for each in tubes for t in range(1, each.horizon + 1)]
        for each, t in wrapped(progress, steps):
            _require_proved(each, t)
    return tube


def _sealed(tube: Any) -> ReachTube | PartitionedTube:
    """The same, with the seal of what was read."""
    if isinstance(tube, PartitionedTube):
        return PartitionedTube.sealed(tube.X0, tuple(map(_sealed, tube.tubes)))  # type: ignore[arg-type]
    return ReachTube.sealed(tube.loop, tube.template, tube.sets, tube.certificates, tube.start)


def _require_proved(tube: ReachTube, t: int) -> None:
    proof = tube.proof(t)
    bounds, again = np.asarray(proof.bounds), np.asarray(proof.recheck())
    size = np.fmax(abs(bounds), abs(np.asarray(proof.gaps)))
    missing = ~(again <= bounds + ROUNDING * size) & np.isfinite(bounds)
    if np.any(missing):
        facet = int(np.flatnonzero(missing)[0])
        raise ValueError(
            f"the recheck of step {t} proves {again[facet]:g} for facet {facet}, but the tube says "
            f"{bounds[facet]:g}: it was computed for another loop, or by another version"
        )
