"""Sets of a template by affine forms, without any program: around the states of each step, and
around all states between two samples.

**Derivatives.** A bound is that of a form over the cell that decides it. Ends of cells move with
the box around the initial set; where facets of the set itself decide, they have the multipliers of
a linear program.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.loops import ClosedLoop
from reachjax.loops.delays import DelayedPlant
from reachjax.loops.scenarios import Scenarios
from reachjax.loops.units import UnboundedError
from reachjax.methods.cell_tree import Node
from reachjax.methods.problem import AbstractMethod, Problem, ReachSet, at
from reachjax.methods.steps import boxed, overflow
from reachjax.numerics.checks import is_concrete
from reachjax.numerics.derivatives import moved_by
from reachjax.numerics.host import in_numpy
from reachjax.numerics.rounding import namespace
from reachjax.programs.held import Attained, Facets, Source, held_bounds, sources
from reachjax.programs.horizon import Horizon
from reachjax.programs.moving import HeldBounds, Moving, moving
from reachjax.programs.unrolled import ByForms, unrolled, unrolled_at_once
from reachjax.proofs.by_forms import LinearCertificate
from reachjax.proofs.proposal import SolverStatus
from reachjax.sets import AbstractSet, AbstractTemplate, Box, PolyhedralSet, Polytope, Template

LOOSE = 1e-6
"""By which part of its longest side a cell is larger for the programs of its multipliers."""


def moving_cell(problem: Problem, node: Node) -> tuple[AbstractSet, Box]:
    """A cell that moves with the box around the initial set, and the box that it lies in."""
    X0, box = problem.X0, problem.box
    lower, upper = (np.asarray(jax.lax.stop_gradient(end)) for end in (box.lower, box.upper))
    sides = np.where(upper > lower, upper - lower, 1.0)
    shares = ((end - lower) / sides for end in node.ends)
    around = Box(*(box.lower + share * (box.upper - box.lower) for share in shares))
    flat = _programmed(X0)
    return around if flat is None else flat.cut(around), around


def _programmed(X0: AbstractSet) -> PolyhedralSet | None:
    """The set, if forms over it are bounded by linear programs; None of a box."""
    flat, ball = X0.parts
    return flat if flat is not None and ball is None and flat.needs_programs else None


def moving_offsets(
    problem: Problem, deciding: Mapping[int, Node], k: int
) -> dict[int, Float[Array, ""]]:
    """Numbers with the derivatives of what forms over the deciding cells prove.

    Args:
        problem: the problem, of a box or a polytope.
        deciding: for some facets after `k + 1` steps, the cell in which the bound is largest.
        k: the number of the step.
    """
    offsets, known, directions = dict[int, Array](), dict[int, Array](), problem.directions
    fixed = jax.lax.stop_gradient((problem.loop, problem.X0, directions))
    loop, region, rows = jax.device_get(fixed)
    everywhere = jnp.zeros((len(rows), 2, rows.shape[2]))
    for facet, node in deciding.items():
        if id(node) not in known:
            held = _held(loop, region, rows, node, k, problem.start)
            part, around = moving_cell(problem, node.source)
            parts = Moving(problem.loop, part, around, directions[k], everywhere)
            known[id(node)] = moving(parts, held, k + 1, problem.start)
        offsets[facet] = known[id(node)][facet]
    return offsets


def moving_forms(
    loop: ClosedLoop, X0: AbstractSet, box: Box, directions: Float[Array, "N f n_x"], start: int
) -> Iterator[Float[Array, " f"]]:
    """Numbers with the derivatives of what forms over a set prove, one step after the other.

    Args:
        loop: the closed loop.
        X0: the initial set, cut by a polytope.
        box: around it.
        directions: of the facets of all steps.
        start: the time of the initial set.
    """
    fixed = jax.lax.stop_gradient((loop, X0, box, directions))
    on_host, begun, around, rows = jax.device_get(fixed)
    horizon = Horizon(on_host, begun, around, start)
    everywhere = jnp.zeros((len(rows), 2, loop.states))
    facets = None if horizon.start.cut is None else horizon.start.cut.facets
    for k in range(len(rows)):
        horizon.advance()
        held = _held_forms(horizon, rows, facets)
        yield moving(Moving(loop, X0, box, directions[k], everywhere), held, k + 1, start)


def _held(
    loop: ClosedLoop,
    X0: AbstractSet,
    directions: Float[np.ndarray, "N f n_x"],
    cell: Node,
    k: int,
    start: int,
) -> HeldBounds:
    """What bounds over a cell rest on: forms, and what the initial set and its box are cut by.

    What a box is cut by decides where programs bound a form better than its norms do. The box is a
    little larger for them, so that where the initial set has a corner, its own facets decide.
    """
    source = cell.source
    loop, part, box = jax.device_get((loop, source.part, source.box))
    horizon, facets = Horizon(loop, part, box, start), None
    for _ in range(k + 1):
        horizon.advance()
    if cell.height:
        bounds = _of_part(horizon, directions[k], cell.box)
        return held_bounds(horizon, bounds, len(directions))
    if (flat := _programmed(X0)) is not None:
        room = LOOSE * np.max(box.upper - box.lower)
        facets = flat.cut(Box(box.lower - room, box.upper + room)).facets
    return _held_forms(horizon, directions, facets)


def _of_part(horizon: Horizon, directions: Float[np.ndarray, "f n_x"], box: Box) -> list[Source]:
    """What bounds of the last states of a horizon over a part of the initial box rest on."""
    part, forms = horizon.start.over_part(box), directions @ horizon.state
    rows = forms.of_first(horizon.start).over_part(part)
    found = list[Source]()
    for row, source in zip(
        forms.columns, sources(part.start, rows, rows.ends(part.start)[1], None), strict=True
    ):
        if source is not None:
            first = part.columns_of(source.columns[None])[0]
            source = Attained(np.append(first, np.sign(row[len(first) :])))
        found.append(source)
    return found


def _held_forms(
    horizon: Horizon, directions: Float[np.ndarray, "N f n_x"], facets: Facets | None
) -> HeldBounds:
    """What bounds of the last states of a horizon rest on.

    Args:
        horizon: over some of the steps.
        directions: of all steps.
        facets: of the polytope that the initial set is cut by, if it is.
    """
    forms = directions[len(horizon.steps) - 1] @ horizon.state
    _, upper = forms.ends(horizon.start, cut=facets is not None)
    bounds = sources(horizon.start, forms, upper, facets)
    return held_bounds(horizon, bounds, len(directions), facets)


SMALLER = 1e-3
"""A set is smaller than forms say if along a row it is, by this part of the width of the box around
it: less is not worth a period's flow."""


def spans_by_forms(
    loop: ClosedLoop, sets: Sequence[AbstractSet], template: AbstractTemplate, start: int
) -> tuple[Polytope, ...]:
    """The smallest sets that affine forms show to hold the states of each period.

    Bounds are those of forms of the initial set and, where another method found a smaller set at
    the sample that a period begins with, of the box around that set. Traced numbers have the first
    alone: whether a set is smaller is not known, and one call is compiled.

    Of a plant whose inputs are late they hold the sample that a period begins with, too: its inputs
    on their way jump there.

    Args:
        loop: the closed loop, whose plant is a differential equation.
        sets: the initial set, and what is proved of each sample after it.
        template: of facets; of another one the axes are taken.
        start: the time of the initial set.

    Raises:
        UnboundedError: no form of a period has bounds.
    """
    facets, X0 = template.alone or Template.box(loop.states), sets[0]
    shapes = [facets.at(k) for k in range(1, len(sets))]
    directions = jnp.stack([each.directions for each in shapes])
    if is_concrete((loop, sets, directions)):
        found = [*_spans(in_numpy(loop), sets, np.asarray(directions), start)]
    else:
        box = boxed(X0, "X0")
        given = X0.closed_form(box), box, directions, start
        steps = unrolled_at_once(loop, *given, between=1)
        assert steps.between is not None  # they were asked for
        found = [*jnp.max(steps.between, axis=1)]
    if isinstance(loop.plant, DelayedPlant):  # at a sample inputs on their way have yet to move up
        begun = (region.support(rows) for region, rows in zip(sets[:-1], directions, strict=True))
        found = [jnp.maximum(*each) for each in zip(found, begun, strict=True)]
    pairs = zip(shapes, found, strict=True)
    return tuple(shape.polytope(offsets) for shape, offsets in pairs)


def _spans(
    loop: ClosedLoop,
    sets: Sequence[AbstractSet],
    directions: Float[np.ndarray, "N f n_x"],
    start: int,
) -> Iterator[Float[np.ndarray, " f"]]:
    """Offsets of each period, from forms of the first set and from smaller sets in between."""
    whole = unrolled(loop, sets[0], boxed(sets[0], "X0"), directions, start, between=1)
    before = np.zeros(0)
    for k, rows in enumerate(directions):
        found, lost = list[ByForms](), None
        try:
            found += itertools.islice(whole, 1)
        except UnboundedError as error:  # it is at its end
            lost = error
        begun = [*found]
        if k and not (begun and _holds_all(sets[k], directions[k - 1], before)):
            box = boxed(sets[k], f"the set at t = {start + k}")
            given = loop, sets[k].closed_form(box), box, rows[None], start + k
            try:
                found += unrolled(*given, between=1)
            except UnboundedError as error:
                lost = error
        if not found:
            assert lost is not None
            raise lost
        if begun:
            before = np.asarray(begun[0].offsets)
        yield np.fmin.reduce([np.max(np.asarray(step.between), axis=0) for step in found])


def _holds_all(
    region: AbstractSet, rows: Float[np.ndarray, "f n_x"], bounds: Float[np.ndarray, " f"]
) -> bool:
    """Whether a set is hardly smaller, along all rows, than bounds of these say."""
    room = SMALLER * (abs(rows) @ np.asarray(region.bounding_box().widths))
    upper = np.asarray(region.bounds_along(jnp.asarray(rows)))
    return bool((upper >= bounds - room).all())  # not where there is no bound


ENDS = SolverStatus.AFFINE_FORM, SolverStatus.FAILED
"""How a form ends that has a bound, and one that has none."""


@dataclasses.dataclass(frozen=True)
class AffineForms(AbstractMethod):
    """Affine forms over the whole horizon (`programs.affine`): `LinearBounds`, as a method.

    Concrete numbers are propagated in numpy as the sets are asked for, traced ones all at once.

    Attributes:
        programs: whether linear programs over the facets of a polytope make bounds tighter.
    """

    programs: bool = True

    def sets(self, problem: Problem, known: Sequence[ReachSet] = ()) -> Iterator[ReachSet]:
        """The smallest sets that affine forms show to hold the states.

        Raises:
            TypeError: the template has no facets.
            ValueError: states overflow.
        """
        return itertools.islice(self._from_the_first(problem), len(known), None)

    def adds_to_forms(self, loop: ClosedLoop) -> bool:
        """Whether it says more than forms do: it is forms itself."""
        return False

    def _from_the_first(self, problem: Problem) -> Iterator[ReachSet]:
        (loop, X0, _), horizon, start = problem.parts, problem.horizon, problem.start
        box = problem.box
        held = X0 if self.programs else X0.closed_form(box)
        directions, scenarios = problem.directions, None
        if loop.is_disturbed and is_concrete(loop, X0):
            scenarios = Scenarios.of(loop, X0, horizon, start)
        given = loop, held, box, directions
        fixed: tuple[Any, Any, Any, Any] = jax.lax.stop_gradient(given)
        cut = held.parts[0]
        if is_concrete(given):
            steps = _timed(unrolled(*fixed, start), start)
        elif (
            cut is not None and cut.needs_programs and is_concrete(fixed)
        ):  # compiled code would have none
            steps = _moved(_timed(unrolled(*fixed, start), start), moving_forms(*given, start))
        else:
            steps = _at_once(unrolled_at_once(*given, start))
        for k, (step, seconds) in enumerate(steps, start=1):
            shaped, facets = problem.facets.at(k), len(problem.facets)
            bounded = abs(step.offsets) < np.inf
            proof = LinearCertificate(
                loop=loop,
                X0=held,
                directions=shaped.directions,
                slopes=step.slopes,
                corners=step.corners,
                codes=namespace(bounded).where(bounded, *ENDS),
                bounds=step.offsets,
                witnesses=np.full(facets, np.nan),
                witness_states=np.full((facets, 0), np.nan),
                seconds=np.full(facets, seconds / facets),
                k=k,
                start=start,
            )
            region = shaped.polytope(step.offsets)
            states = np.asarray(step.corners) if is_concrete(step.corners) else np.zeros((0, 0))
            if scenarios is not None:
                states = scenarios.of_units(states, step.drawn)
            yield ReachSet(region, proof, at(k), states)


def _timed(steps: Iterator[ByForms], start: int) -> Iterator[tuple[ByForms, float]]:
    """Each step with the slopes of all up to it, and the seconds that it took.

    Raises:
        ValueError: states overflow.
    """
    slopes, began = [], time.perf_counter()
    for t, step in enumerate(steps, start=start + 1):
        if not np.isfinite(step.offsets).all():
            raise overflow(t)
        slopes.append(step.slopes)
        seconds = time.perf_counter() - began
        yield step._replace(slopes=np.stack(slopes)), seconds
        began = time.perf_counter()


def _moved(
    steps: Iterator[tuple[ByForms, float]], slopes: Iterator[Float[Array, " f"]]
) -> Iterator[tuple[ByForms, float]]:
    """Each step, with derivatives of its offsets."""
    for (step, seconds), slope in zip(steps, slopes, strict=True):
        yield step._replace(offsets=moved_by(step.offsets, slope)), seconds


def _at_once(found: ByForms) -> Iterator[tuple[ByForms, float]]:
    """Each step of traced numbers, of which nobody knows how long they take."""
    slopes, corners = jax.lax.stop_gradient((found.slopes, found.corners))
    offsets = jnp.where(jnp.isfinite(found.offsets), found.offsets, jnp.nan)
    for k in range(len(offsets)):
        yield ByForms(offsets[k], slopes[: k + 1], corners[k]), 0.0
