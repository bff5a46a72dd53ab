"""Verdicts proved anew, from what was asked and from nothing else that they say.

Of a proof the tree of cells, ranges and multipliers are taken, none of which has to be right: cells
are made again from the initial set, forms from the loop, and multipliers of a sign that proves
nothing are zero. Of a counterexample the initial state, the disturbances and the noise are taken:
its trajectory is enclosed again. Nothing is searched.

Of a set that states come into halfway, and may come back to, the set, the step and the period are
taken: both questions are asked again as they follow from these.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import closing
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from reachjax.loops.scenarios import Runs, Scenarios
from reachjax.methods.cell_tree import CellTree, Node
from reachjax.methods.ladder import Ladder
from reachjax.methods.searches import Bar, CellJobs, UnsentError
from reachjax.methods.steps import boxed
from reachjax.numerics.budget import ENDLESS
from reachjax.numerics.checks import wrapped
from reachjax.numerics.flags import lenient
from reachjax.numerics.host import in_numpy
from reachjax.programs.affine import AffineForms, joined
from reachjax.proofs.branches import Branches, bounds_of, leaf_bounds
from reachjax.sets import AbstractSet
from reachjax.tubes.repeats import DisagreementError
from reachjax.verdicts.cell_decisions import sifted
from reachjax.verdicts.cell_tasks import CellTask, outcome_of
from reachjax.verdicts.findings import Findings
from reachjax.verdicts.grounds import Asked, Climb, Closing, Grounds, Key, Leaves
from reachjax.verdicts.halfway import Halfway, Proof
from reachjax.verdicts.sieve import TOGETHER, Outcome
from reachjax.verdicts.specification import Requirement
from reachjax.verdicts.targets import values_of
from reachjax.verdicts.verdict import Verdict, VerdictStatus

AHEAD = 4
"""Cells that an executor is given for each of its workers."""

MarginsByKey = dict[Key, tuple[float, bool]]
"""The least margin of each requirement that is known, and whether it surely holds."""


def rechecked(
    verdict: Verdict, progress: Bar | None = None, executor: Executor | None = None
) -> Verdict:
    """The verdict as it is proved anew; of one that is unknown nothing is claimed.

    Args:
        verdict: with what was asked, whose parts have the kinds that they should have.
        progress: wraps the iteration over cells.
        executor: runs the cells, where there are several; None: here.

    Raises:
        DisagreementError: it says what is not proved.
        UnsentError: the executor's processes cannot be sent the loop.
        ValueError: the progress bar leaves out cells.
    """
    assert verdict.asked is not None
    asked = verdict.asked._replace(loop=in_numpy(verdict.asked.loop))
    findings = Findings(asked.loop, asked.X0, asked.horizon, asked.start, asked.required)
    more: dict[str, Any] = {"asked": verdict.asked}
    left_out = 0
    try:
        if verdict.status is VerdictStatus.REFUTED:
            _refute(verdict, asked, findings)
        elif verdict.status is VerdictStatus.PROVED:
            grounds = verdict.grounds or Grounds()
            proof = _proved(asked, grounds, progress, executor)
            for item in asked.required:
                findings.prove(item, *proof.margins[item.name, item.time])
            left_out = proof.left_out
            more |= {"grounds": grounds, "recurrence": proof.recurrence}
    except (DisagreementError, UnsentError):
        raise
    except Exception as error:  # what is read may be of any shape and size
        raise DisagreementError(f"the recheck of the verdict proves nothing: {error}") from error
    if left_out:
        raise ValueError(f"progress must pass on each cell, but {left_out} did not arrive")
    found = findings.verdict(**more)
    if found.status is not verdict.status:
        left = ", ".join(f"{name} at t = {time}" for name, time in list(findings.open)[:3])
        raise DisagreementError(
            f"the verdict is said to be {verdict.status.name}, but its recheck does not bear that "
            f"out{f': {left}' if left else ''}. It was made for another loop, initial set or "
            "specification, or by another version, or it was changed"
        )
    return found


def _refute(verdict: Verdict, asked: Asked, findings: Findings) -> None:
    """Note the counterexample, if its scenario surely breaks what it is said to.

    Raises:
        DisagreementError: there is none, or it breaks no requirement of that name and time.
    """
    example = verdict.counterexample
    if example is None:
        raise DisagreementError("the verdict is said to be REFUTED, but without a counterexample")
    loop, X0 = asked.loop, in_numpy(asked.X0)
    scenarios = Scenarios.of(loop, X0, asked.horizon, asked.start)
    drawn = (example.disturbances, example.noises)
    scenario = np.asarray(scenarios.joined(np.asarray(example.states)[0], *drawn), float)[None]
    if scenario.shape[1] != len(scenarios.middle(np.asarray(boxed(X0, "X0").center))):
        raise DisagreementError("the counterexample has not as many numbers as a scenario")
    runs = Runs(scenario, scenarios.runs(loop, scenario, asked.horizon, asked.start))
    key = example.requirement, example.time
    broken = [item for item in asked.required if (item.name, item.time) == key]
    findings.simulate(runs, broken)


def _proved(
    asked: Asked, grounds: Grounds | Closing, progress: Bar | None, executor: Executor | None
) -> Proof:
    """What grounds prove of a question, in two parts where there is a set halfway.

    Raises:
        ValueError: they are of another question.
    """
    if isinstance(grounds, Grounds):
        return _over_cells(asked, grounds, progress, executor)
    halfway = Halfway(asked, grounds.step, grounds.region, grounds.period)
    before = _proved(halfway.before, grounds.before, progress, executor)
    after = _proved(halfway.after, grounds.after, progress, executor)
    return halfway.joined(before, after)


def _over_cells(
    asked: Asked, grounds: Grounds, progress: Bar | None, executor: Executor | None
) -> Proof:
    """The least margin of each requirement over all cells, and whether it holds over each.

    Raises:
        ValueError: the tree is none of the initial set's, or there are not as many climbs as cells.
    """
    cells = _cells(asked.X0, grounds)
    if not cells or len(cells) != len(grounds.climbs):
        raise ValueError(f"it has {len(cells)} cells, but {len(grounds.climbs)} proofs")
    found = {(item.name, item.time): (np.inf, True) for item in asked.required}
    left = len(cells)
    with closing(_of_cells(asked, cells, grounds, executor)) as given:
        for _ in wrapped(progress, list(range(len(cells)))):  # whatever a bar passes on
            if not left:
                break
            margins = next(given)
            left -= 1
            for key, (least, holds) in found.items():
                margin, right = margins.get(key, (-np.inf, False))
                found[key] = min(least, margin), holds and right
    return Proof(found, left)


def _cells(X0: AbstractSet, grounds: Grounds) -> list[Node]:
    """The cells that a tree leaves, which cover the initial set.

    Raises:
        ValueError: it is none of the set's.
    """
    tree = CellTree.over(X0, grounds.counts) if grounds.counts else CellTree.whole(X0)
    if len(tree.roots) != len(grounds.axes):
        raise ValueError(f"there are {len(tree.roots)} cells at first, not {len(grounds.axes)}")
    for root, axes in zip(tree.roots, grounds.axes, strict=True):
        left = [root]
        for axis in axes:
            if not left or not -1 <= axis < X0.dimension:
                raise ValueError("the tree of cells has other axes than the initial set")
            node = left.pop()
            if axis >= 0:
                tree.replace(node, tree.halved(node, axis), axis)
                left += node.halves[::-1]
        if left:
            raise ValueError("the tree of cells ends too early")
    return tree.leaves


def _of_cells(
    asked: Asked, cells: Sequence[Node], grounds: Grounds, executor: Executor | None
) -> Generator[MarginsByKey, None, None]:
    """The margins of all cells as they come, by forms in compiled calls of many where that pays."""
    if len(cells) == 1:  # a process takes longer to begin than most cells to prove
        executor = None
    jobs = CellJobs[None](executor, AHEAD)
    try:
        for number, outcome in _by_many(asked, cells, grounds.climbs):
            if outcome is not None and outcome.proved:
                yield _margins(asked, outcome)
                continue
            part = jax.device_get(cells[number].part)
            jobs.submit(None, _of_cell, asked, part, grounds.climbs[number])
            if len(jobs) >= jobs.most:
                yield from (margins for _, margins in jobs.finished())
        while len(jobs):
            yield from (margins for _, margins in jobs.finished())
    finally:
        jobs.cancelled()


def _by_many(
    asked: Asked, cells: Sequence[Node], climbs: Sequence[Sequence[Climb]]
) -> Iterator[tuple[int, Outcome | None]]:
    """The places of all cells, with what compiled calls say of those that rest on forms alone.

    The others come first, so that an executor is busy with them meanwhile.
    """
    formed = [number for number, some in enumerate(climbs) if not some]
    if len(formed) < TOGETHER or not all(cell.is_box for cell in cells):
        formed = []
    yield from ((number, None) for number in sorted(set(range(len(cells))).difference(formed)))
    for first in range(0, len(formed), TOGETHER):
        some, calls = formed[first : first + TOGETHER], (len(formed) - first) / TOGETHER
        outcomes = sifted(_task(asked), [cells[each].ends for each in some], ENDLESS, calls)
        yield from zip(some, outcomes, strict=True)


@lenient
def _of_cell(asked: Asked, part: AbstractSet, climbs: Sequence[Climb]) -> MarginsByKey:
    """The margins over one cell, wherever it runs."""
    with jax.enable_x64(True):
        along = None if climbs else _along_ways(asked, part)
        return _over(asked, part, climbs or (Climb(),)) if along is None else along


def _along_ways(asked: Asked, part: AbstractSet) -> MarginsByKey | None:
    """The margins along all ways of decisions, of a smooth loop that jumps; None if none."""
    task = _task(asked)
    outcome = outcome_of(task, part, ENDLESS) if task.follows else None
    return None if outcome is None or not outcome.proved else _margins(asked, outcome)


def _task(asked: Asked) -> CellTask:
    """What is to be proved of a cell, without programs."""
    return CellTask(asked.loop, asked.horizon, asked.start, asked.required, 0)


def _margins(asked: Asked, outcome: Outcome) -> MarginsByKey:
    """The margins of a cell that is proved."""
    return {
        (item.name, item.time): (float(outcome.margins[item.name][item.time]), True)
        for item in asked.required
    }


def _over(asked: Asked, part: AbstractSet, climbs: Sequence[Climb]) -> MarginsByKey:
    """The margins over a part of the initial set, by all of the climbs."""
    loop, found = asked.loop, MarginsByKey()
    around = jax.device_get(boxed(jax.device_put(part), "X0"))
    scenarios = Scenarios.of(loop, part, asked.horizon, asked.start)
    between = any(item.throughout for item in asked.required)
    for item in asked.required:
        if item.time == 0:
            compared = item.compared_with(jax.device_put(part))
            found[item.name, 0] = compared.least_margin, item.proved(compared)
    for climb in climbs:
        given = loop, part, around, scenarios, asked.start, 1, ENDLESS
        ladder = Ladder(*given, between=between)
        leaves = {(each.name, each.time): each for each in climb.leaves}
        for k in range(1, asked.horizon + 1):
            known = climb.ranges[k - 1] if k <= len(climb.ranges) else ()
            ladder.repeat_ranges(each.matrix for each in known)
            for item in asked.required:
                key = item.name, item.time
                if item.time == k and not found.get(key, (0.0, False))[1]:
                    found[key] = _bounded(item, ladder, leaves.get(key))
            if all(found.get((item.name, item.time), (0.0, False))[1] for item in asked.required):
                return found
            if climb.ranges and k >= len(climb.ranges):
                break
    return found


def _bounded(item: Requirement, ladder: Ladder, leaves: Leaves | None) -> tuple[float, bool]:
    """The margin of a requirement where the ladder has come to, and whether it surely holds."""
    forms, units = values_of(item, ladder)
    bounds = np.array([rows.ends(ladder.horizon.start)[1].min() for rows in forms])
    if leaves is not None:
        bounds = np.fmin(bounds, _by_branches(forms, ladder, leaves.branches))
    bounds = np.where(np.isnan(bounds), np.inf, bounds)
    right = bool(np.all(bounds <= 0 if item.inside else bounds < 0))
    return float(np.min(-bounds / units)), right


def _by_branches(
    forms: Sequence[AffineForms], ladder: Ladder, said: Branches
) -> Float[np.ndarray, " g"]:
    """Bounds of the least of each group of forms, by branches; weights of other groups are zero."""
    sizes = [len(rows.rows) for rows in forms]
    about = ladder.about(joined([rows.padded(ladder.width) for rows in forms]))
    owner = np.asarray(said.owner)
    if np.any((owner < 0) | (owner >= len(forms))) or np.any(np.asarray(said.phases) > 1):
        raise ValueError("its branches are of other bounds")
    group = np.repeat(np.arange(len(forms)), sizes)
    multipliers = np.asarray(said.multipliers)
    own = said.replace(
        weights=np.where(group == owner[:, None], np.asarray(said.weights), 0.0),
        multipliers=np.where(np.isfinite(multipliers), multipliers, 0.0),
    )
    return bounds_of(own, leaf_bounds(about, own), len(forms))
