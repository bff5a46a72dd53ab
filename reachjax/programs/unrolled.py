"""The whole horizon in affine forms: bounds of directions of every later state, over `X_0` alone.

On the host step by step in numpy, where nothing is compiled; for traced numbers as one `scan`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from reachjax.loops import ClosedLoop
from reachjax.loops.closed_loop import Scenario
from reachjax.loops.tracing.functions import Compiled
from reachjax.loops.units.smooth import EXTREMES
from reachjax.numerics.host import in_numpy
from reachjax.numerics.pytrees import unchecked
from reachjax.numerics.rounding import is_counted, rounding
from reachjax.programs.affine import AffineForms
from reachjax.programs.affine_steps import UnitForms, step_columns, step_forms
from reachjax.programs.flows import Between, Parts
from reachjax.programs.followed import NoStatesError, OpenDecision, Way, ways
from reachjax.programs.initial import InitialColumns, SubboxColumns, constant
from reachjax.programs.merging import merged_columns
from reachjax.sets import AbstractSet, Box


class ByForms(NamedTuple):
    """What affine forms say of the states of one step; or of `N` steps, with a leading axis.

    Attributes:
        offsets: `(m,)`, upper bounds of the directions.
        slopes: `(units,)`, of the lines that stand for the units of the step before.
        corners: `(m, n_x)`, initial states at which the forms are largest, but for their columns of
            units and what cuts the initial set.
        drawn: for each step so far the values `(m, d)` of disturbances there; nothing of compiled
            code.
        between: `(p, m)`, upper bounds at all times of each part of the period before, if they are
            asked for; infinite for directions of which they are not.
        open: decisions of the step that may go either way, none of compiled code.
        ways: along how many ways of decisions that is so.
        moved: `(n_x,)`, how far each coordinate of the initial set moves what decides between this
            way and others, all decisions together; empty where there is no other way.
        forms: of the directions over the columns of the initial box alone, on the host, where one
            way is followed from a set that has no round parts; None elsewhere.
    """

    offsets: Float[Array | np.ndarray, "*N m"]
    slopes: Float[Array | np.ndarray, "*N units"]
    corners: Float[Array | np.ndarray, "*N m n_x"]
    drawn: tuple[Float[np.ndarray, "m d"], ...] = ()
    between: Float[Array | np.ndarray, "*N p m"] | None = None
    open: tuple[OpenDecision, ...] = ()
    ways: int = 1
    moved: Float[np.ndarray, " n_x"] = np.zeros(0)
    forms: AffineForms | None = None

    def over_part(self, part: SubboxColumns) -> ByForms:
        """What the same forms say of the states that are reached from a part of the initial box.

        Infinite where there are no forms.
        """
        if self.forms is None:
            return self._replace(offsets=np.full(len(self.offsets), np.inf))
        with np.errstate(all="ignore"):
            forms = self.forms.over_part(part)
            offsets = np.fmin(forms.ends(part.start)[1], self.offsets)
            corners = part.start.farthest(forms.columns[:, : len(part.start.spread)])
        return self._replace(offsets=offsets, corners=corners, forms=None)


def subbox_columns(loop: ClosedLoop, X: AbstractSet, box: Box, part: Box) -> SubboxColumns:
    """The columns of a part of the box around an initial set, as `unrolled` has its columns."""
    X, box, part = map(in_numpy, (X, box, part))
    return InitialColumns.of(X, box, loop.curved).over_part(part)


def unrolled(
    loop: ClosedLoop,
    X0: AbstractSet,
    box: Box,
    directions: Float[np.ndarray, "N m n_x"],
    t: int = 0,
    slopes: Float[np.ndarray, "N units"] | None = None,
    known: Sequence[Box] | None = None,
    between: Parts = 0,
    most: int = 1,
    wanted: Float[np.ndarray, "N m"] | None = None,
) -> Iterator[ByForms]:
    """Bounds of directions of the states after 1, ..., N steps, one step after the other in numpy.

    Args:
        loop: of concrete numbers.
        X0: the initial set.
        box: around it.
        directions: one row a facet, for each step.
        t: the time of the initial set.
        slopes: of lines for the units of each step, of which any are sound; None for good ones.
        known: boxes that surely hold the states after each step, where they are known.
        between: into how many parts, a power of two, the steps of a differential equation are cut,
            in each of which bounds at all times are asked for; 0 if none are. Or for each
            direction: where it is 0 for one and not for all, the bounds are infinite.
        most: along how many ways of its decisions a loop that jumps is followed.
        wanted: for each step, bounds of the directions below which nothing is gained; None for
            bounds that are as good as they can be.

    Example:
        >>> from reachjax import MLP, AffinePlant
        >>> net = MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
        >>> loop, X0 = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net), Box([1.0], [2.0])
        >>> [step.offsets.round(6).tolist() for step in unrolled(loop, X0, X0, np.ones((2, 1, 1)))]
        [[1.2], [0.72]]
    """
    given = loop, X0, box, directions, t, slopes, known, between, most, wanted
    for found in along_ways(*given):
        yield _together(found)


def boxes_from_point(loop: ClosedLoop, scenario: Scenario, steps: int, t: int = 0) -> Iterator[Box]:
    """Boxes that surely hold the states of one trajectory after 1, ..., N steps, in numpy.

    What rounding and units leave open at a step is carried on by columns of its own, so it grows as
    the trajectory's own perturbations do: boxes of boxes grow by the size of the Jacobian's entries
    at each step, whatever the loop contracts.

    Args:
        loop: of concrete numbers.
        scenario: of the trajectory.
        steps: how many.
        t: the time of its initial state.

    Raises:
        UnboundedError: a unit has no bounds, or the flow of a differential equation escapes.

    Example:
        >>> from reachjax import MLP, AffinePlant
        >>> net = MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
        >>> loop = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net)
        >>> found = boxes_from_point(loop, Scenario(np.ones(1), None, None), 2)
        >>> [box.upper.round(6).tolist() for box in found]
        [[0.6], [0.36]]
    """
    loop, (x0, *drawn) = in_numpy(loop), scenario
    point = unchecked(Box, lower=np.asarray(x0), upper=np.asarray(x0))
    start = InitialColumns.of(point, point, loop.curved)
    if loop.is_disturbed:  # what else bounds units is of all that may be drawn
        start = start.replace(box=None)
    state = AffineForms.beginning(start)
    for k in range(steps):
        w, v = (None if part is None else AffineForms.exact(part[k]) for part in drawn)
        with np.errstate(all="ignore"):  # what overflows ends as infinity or NaN, which is no bound
            state = step_forms(loop, state, t + k, start, before=k, few=True, w=w, v=v).successor
            lower, upper = state.ends(start)
        yield unchecked(Box, lower=lower, upper=upper)


def along_ways(
    loop: ClosedLoop,
    X0: AbstractSet,
    box: Box,
    directions: Float[np.ndarray, "N m n_x"],
    t: int = 0,
    slopes: Float[np.ndarray, "N units"] | None = None,
    known: Sequence[Box] | None = None,
    between: Parts = 0,
    most: int = 1,
    wanted: Float[np.ndarray, "N m"] | None = None,
) -> Iterator[list[ByForms]]:
    """What `unrolled` says, of each way in which decisions go; arguments are the same.

    At least one way is given, which says minus infinity should there be no states at all.
    """
    loop, X0, box, directions = map(in_numpy, (loop, X0, box, directions))
    slopes, known = map(in_numpy, (slopes, known))
    with np.errstate(all="ignore"):  # what overflows ends as infinity or NaN, which is no bound
        start = InitialColumns.of(X0, box, loop.curved)
    given = loop, start, len(directions), t, most, bool(np.any(between)), slopes, known
    for k, found in enumerate(ways(*given)):
        rows = directions[k]
        enough = np.full(len(rows), -np.inf) if wanted is None else wanted[k]
        each = list[ByForms]()
        for way in found:
            with np.errstate(all="ignore"), contextlib.suppress(NoStatesError):
                each.append(_of_way(way, rows, start, enough, between))
        nowhere = np.tile(start.center, (len(rows), 1))
        yield each or [ByForms(np.full(len(rows), -np.inf), np.zeros(loop.units), nowhere)]


def _of_way(
    way: Way,
    rows: Float[np.ndarray, "m n_x"],
    start: InitialColumns,
    wanted: Float[np.ndarray, " m"],
    between: Parts,
) -> ByForms:
    """What one way says of the states after a step.

    Raises:
        NoStatesError: there are none on it.
    """
    found = _bounds(rows, way.state, way.units, start, way.spans, between)
    forms = rows @ way.state
    drawn = [np.sign(forms.columns[:, each]) for each in way.free]
    if len(way.facts):
        upper, at = way.bounds(forms, start, wanted)
        known, first = np.asarray(np.isfinite(at).all(axis=1)), start.spread.shape[1]
        corners = np.array(found.corners)
        corners[known] = start.center + at[known, :first] @ start.spread.T
        drawn = [
            np.where(known[:, None], at[:, each], one)
            for each, one in zip(way.free, drawn, strict=True)
        ]
        moved = _moved(np.asarray(way.facts.columns), start)
        found = found._replace(offsets=upper, corners=corners, moved=moved)
    elif not start.round:
        found = found._replace(forms=forms.of_first(start))
    return found._replace(drawn=tuple(drawn), open=way.open)


def _moved(columns: Float[np.ndarray, "k n"], start: InitialColumns) -> Float[np.ndarray, " n_x"]:
    """How far each coordinate of the initial set moves numbers, all together, by their columns."""
    sizes, first = abs(columns[:, : start.count]), start.spread.shape[1]
    found = (sizes[:, :first] + start.by_coordinate(sizes[:, first:])).sum(axis=0)
    if start.box is None or not start.round:
        return found
    return (found @ abs(start.back)) * np.asarray(start.box.upper - start.box.lower) / 2


def _together(each: Sequence[ByForms]) -> ByForms:
    """What all ways together say: of each direction the largest."""
    if len(each) == 1:
        return each[0]
    uppers = np.array([found.offsets for found in each])
    deciding = np.where(np.isnan(uppers), np.inf, uppers).argmax(axis=0)

    def of_deciding(values: Callable[[ByForms], Any]) -> Any:
        return np.array([values(each[number])[row] for row, number in enumerate(deciding)])

    drawn = tuple(of_deciding(lambda one, k=k: one.drawn[k]) for k in range(len(each[0].drawn)))
    between = None
    if each[0].between is not None:
        between = np.concatenate([np.asarray(one.between) for one in each])
    corners = of_deciding(lambda one: one.corners)
    decisions = tuple(dict.fromkeys(decision for one in each for decision in one.open))
    uppers = uppers.max(axis=0)
    return ByForms(uppers, each[0].slopes, corners, drawn, between, decisions, len(each))


FOUND = jax.checkpoint_policies.save_only_these_names(EXTREMES)
"""What is kept for derivatives, as it has none itself."""

COLUMNS, MEMORY = 32, 3
"""Where many cells are bounded so many columns are kept, or those of so many steps, where these are
more: old ones are merged."""


def _columns_kept(loop: ClosedLoop) -> int:
    """How many columns of earlier steps are kept where many cells are bounded."""
    return max(COLUMNS, MEMORY * step_columns(loop)[0])


@partial(Compiled, in_reverse=True, static_argnames=("t", "between", "counted", "columns"))
def unrolled_at_once(
    loop: ClosedLoop,
    X0: AbstractSet,
    box: Box,
    directions: Float[Array, "N m n_x"],
    t: int = 0,
    between: Parts = 0,
    counted: bool = True,
    columns: int | None = None,
) -> ByForms:
    """Bounds for all steps at once, compiled and differentiable, without a call to the host.

    A polytope counts as the box around it.

    Args:
        loop: the closed loop.
        X0: the initial set.
        box: around it.
        directions: one row a facet, for each step.
        t: the time of the initial set.
        between: as of `unrolled`.
        counted: whether rounding is, and what polynomials leave out of a flow: what is found
            without it is no bound, and takes a fraction of the time.
        columns: how many are kept of all steps before, into which old ones are merged; None for all
            that there are. Where rounding is not counted either, units of any kind get few.
    """
    with rounding(counted):
        return _at_once(loop, X0, box, directions, t, between, columns)


def _at_once(
    loop: ClosedLoop,
    X0: AbstractSet,
    box: Box,
    directions: Float[Array, "N m n_x"],
    t: int,
    between: Parts,
    columns: int | None,
) -> ByForms:
    """Bounds for all steps, as one scan."""
    loop = loop.replace(plant=loop.plant.prepared())
    start = InitialColumns.of(X0, box, loop.curved)
    few = columns is not None and not is_counted()
    (more, _), steps = step_columns(loop, few), len(directions)
    kept = (steps - 1) * more if columns is None else max(columns, 4 * loop.states)
    merges, first = kept < (steps - 1) * more, start.count
    end = first + (kept + more if merges else steps * more)

    # a derivative computes a step again: storing what it needs of it is most of what is compiled
    @partial(jax.checkpoint, prevent_cse=False, policy=FOUND)
    def advance(state: AffineForms, step: tuple[Array, Array]) -> tuple[AffineForms, ByForms]:
        k, rows = step
        place = first + (kept if merges else k * more)
        spans = [] if np.any(between) else None
        given = loop, state, t + k, start
        state, units, _ = step_forms(*given, place=place, spans=spans, few=few)
        found = _bounds(rows, state, units, start, spans, between)
        return merged_columns(state, first, kept, end) if merges else state, found

    state = AffineForms.beginning(start, end)
    return jax.lax.scan(advance, state, (jnp.arange(steps), directions))[1]


@partial(Compiled, static_argnames=("t", "columns", "between"))
def unrolled_from_boxes(
    loop: ClosedLoop,
    lower: Float[Array, "c n_x"],
    upper: Float[Array, "c n_x"],
    directions: Float[Array, "N m n_x"],
    whole: Bool[Array, "N m"] | None = None,
    t: int = 0,
    columns: int | None = None,
    between: Parts = 1,
) -> Float[Array, "c N p m"]:
    """Upper bounds of directions after 1, ..., N steps from each of many boxes, in one call.

    Args:
        loop: the closed loop.
        lower: ends of the boxes.
        upper: the same.
        directions: one row a facet, for each step.
        whole: which of them are bounded at all times since the sample before; None for none.
        t: the time of the boxes.
        columns: as of `unrolled_at_once`; None for as many as a dozen steps add.
        between: as of `unrolled`, where some are.

    Returns:
        The bounds in each part of a period; of what is bounded at samples the same in all.
    """
    most = columns or _columns_kept(loop)

    def one(lower: Float[Array, " n_x"], upper: Float[Array, " n_x"]) -> Float[Array, "N p m"]:
        box = Box(lower, upper)
        parts = 0 if whole is None else between
        found = unrolled_at_once(loop, box, box, directions, t, parts, columns=most)
        offsets = found.offsets[:, None]
        return offsets if whole is None else jnp.where(whole[:, None], found.between, offsets)

    return jax.vmap(one)(lower, upper)


def _bounds(
    directions: Float[Array | np.ndarray, "m n_x"],
    state: AffineForms,
    units: tuple[UnitForms, ...],
    start: InitialColumns,
    spans: Sequence[Between] | None,
    between: Parts,
) -> ByForms:
    rows = directions @ state
    xp = jnp if isinstance(rows.rows, jax.Array) else np
    slopes = xp.concatenate([layer.slope for layer in units] or [xp.zeros(0)])
    corners = start.farthest(constant(rows.columns[:, : len(start.spread)]))
    found = ByForms(rows.uppers(start, cut=True), slopes, corners)
    if not spans:
        return found
    return found._replace(between=spans[0].bounds(directions, start, between))
