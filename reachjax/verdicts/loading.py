"""Tubes and verdicts from files, rechecked where what they rest on may have changed."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import Executor

from reachjax.loops import ClosedLoop
from reachjax.methods.searches import Bar
from reachjax.numerics.archives import UnreadableError, existing_file
from reachjax.numerics.checks import (
    owned,
    require_bar,
    require_double_precision,
    require_executor,
    require_kind,
)
from reachjax.numerics.flags import lenient
from reachjax.numerics.logs import logged
from reachjax.numerics.storage import read
from reachjax.sets import AbstractSet
from reachjax.tubes.loading import rechecked as rechecked_tube
from reachjax.tubes.loading import sealed as tube_of
from reachjax.tubes.partitions import PartitionedTube
from reachjax.tubes.reach import ReachTube
from reachjax.tubes.saving import Kept
from reachjax.verdicts.rechecks import rechecked as rechecked_verdict
from reachjax.verdicts.specification import asked_again, period_of
from reachjax.verdicts.verdict import KeptVerdict, Verdict

MISSING = (
    "was written without its loop, whose functions cannot be stored: give the loop again, "
    "load(path, loop=...), or --loop MODULE:NAME of python -m reachjax recheck"
)


LONGEST = 10**6
"""Steps of any verdict: a file that names more would fill memory with margins."""


@logged
@lenient
def load(
    path: str | os.PathLike[str],
    loop: ClosedLoop | None = None,
    *,
    recheck: bool = False,
    progress: Bar | None = None,
    executor: Executor | None = None,
) -> ReachTube | PartitionedTube | Verdict:
    """A tube, or a verdict, from the file that `tube.save(path)` or `verdict.save(path)` wrote.

    Args:
        path: of the file.
        loop: needed if the loop has functions that a user wrote, which no file can keep. It must be
            the one that was left out, in every equation that JAX traces of it and in every number.
        recheck: whether everything that the tube says of its loop is proved anew, which takes about
            as long as it took to compute, or less. The file is believed in nothing: of the loop,
            the initial set, template and start that it has, all else follows; how searches ended
            and what they took is not said any more. Of a verdict all is proved anew, from what it
            is about, without a search; without `recheck` its status is what the file says.
        progress: wraps the iteration over steps, or over cells of a verdict, that are rechecked,
            such as `tqdm.tqdm`.
        executor: rechecks the cells of a verdict, as that of `decide`. None: one after the other,
            here, as a single cell and the steps of a tube always are.

    Raises:
        FileNotFoundError: there is no such file.
        RuntimeError: JAX's 64-bit floats are off.
        TypeError: an argument is of another kind, or the executor's processes cannot be sent the
            loop.
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
    require_executor(executor)
    if loop is not None:
        require_kind("loop", loop, ClosedLoop, "a ClosedLoop")
    found = existing_file("path", path)
    kept = read(found, owned(loop), MISSING)
    if loop is not None and isinstance(kept, Kept):
        _require_own(kept, path, [loop])
    try:
        require_kind("it", kept, Kept, "something with the seal of its loop")
        tube = _verdict(kept) if isinstance(kept.tube, KeptVerdict) else tube_of(kept)
    except Exception as error:  # whoever wrote it may have written anything
        message = f"{path} must hold a tube or a verdict, but something else arrived: {error}"
        raise UnreadableError(message) from error
    if loop is not None:
        _require_own(kept, path, _loops(tube))
    if not recheck:
        return tube
    if isinstance(tube, Verdict):
        return rechecked_verdict(tube, progress, executor)
    return rechecked_tube(tube, progress)


def _require_own(kept: Kept, path: str | os.PathLike[str], loops: Sequence[ClosedLoop]) -> None:
    """Raise an error for loops that are not the one whose seal a file has.

    Raises:
        ValueError: one is another.
    """
    if not all(map(kept.is_of, loops)):
        raise ValueError(
            f"loop must be that of the tube or verdict in {path}, with the same equations and "
            "numbers, but another one arrived (or another version of JAX, which writes its "
            "equations otherwise)"
        )


def _loops(tube: ReachTube | PartitionedTube | Verdict) -> list[ClosedLoop]:
    """The loops that something is said of, whatever seal it came with."""
    if isinstance(tube, Verdict):
        return [] if tube.asked is None else [tube.asked.loop]
    return [each.loop for each in (tube.tubes if isinstance(tube, PartitionedTube) else (tube,))]


def _verdict(file: Kept) -> Verdict:
    """The verdict that was read, what it is about being a question that there can be.

    Raises:
        Exception: of any kind: it is something else.
    """
    kept: KeptVerdict = file.tube
    asked = kept.asked
    require_kind("it", asked.loop, ClosedLoop, "a verdict of a loop")
    require_kind("it", asked.X0, AbstractSet, "a verdict of an initial set")
    if asked.X0.dimension != asked.loop.states:
        raise ValueError("the initial set is not of the loop's states")
    asked.loop.check_horizon(asked.horizon, asked.start)
    if asked.horizon > LONGEST:
        raise ValueError(f"its horizon is {asked.horizon}, more than {LONGEST} steps")
    period = period_of(asked.loop)
    required = asked_again(asked.required, asked.loop.states, asked.horizon, period)
    return kept._replace(asked=asked._replace(required=required)).verdict
