"""Penalties on what a loop can reach: the size of its sets and missed specifications.

Two penalties on one tube need not solve for it twice: with `tube = reach(...)`, they are
`log_volume(tube) / tube.horizon` and `shortfall(tube, ...)`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import singledispatch
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from reachjax.loops import ClosedLoop
from reachjax.methods.problem import AbstractMethod, Problem
from reachjax.methods.propagation import Options, check_problem, require_kinds, template_of
from reachjax.numerics.checks import described, is_concrete, whole_number
from reachjax.numerics.deprecations import once_positional
from reachjax.numerics.flags import lenient
from reachjax.numerics.logs import unlogged
from reachjax.programs.relaxations import BranchAndCut, LinearBounds, LocalBounds
from reachjax.sets import AbstractSet, AbstractTemplate, Box
from reachjax.sets.cells import grid_ends
from reachjax.tubes.reach import ReachTube, reach
from reachjax.tubes.sizes import log_volume
from reachjax.tubes.sketches import Sketch, sketched
from reachjax.verdicts.specification import (
    AvoidSets,
    Region,
    Requirement,
    Timed,
    check_margin,
    missing,
    period_of,
    requirements,
)


@unlogged
@lenient
def volume_penalty(
    loop: ClosedLoop,
    X0: AbstractSet,
    horizon: int,
    template: AbstractTemplate | None = None,
    *,
    measure: Callable[[AbstractSet], Float[Array, ""]] = log_volume,
    cells: Sequence[int] | None = None,
    **options: Any,
) -> Float[Array, ""]:
    """The mean size of the certified sets at times `1 .. horizon`.

    Differentiable in the loop and the initial set, also inside `jax.jit`, `vmap` (over initial sets
    or networks) and `scan`. A penalty needs no proof: where `LinearBounds()` is compiled or
    differentiated, the sets are the certified ones but for rounding, and of a differential equation
    but for the remainders of Taylor polynomials: as many steps a period are done as its plant's
    `steps` says, of its `order`, but of six at most, or of order four where none is given. Where
    states turn by a quarter of a round or more within such a step, remainders are large, and more
    `steps` are to be given. Affine equations are sampled exactly (`SampledPlant.affine`).

    Args:
        loop: the closed loop.
        X0: the set of initial states.
        horizon: the number of steps.
        template: what every set looks like: facet directions, ellipsoids, or both. None: octagons
            in two dimensions, boxes in others (`Template.default`).
        measure: the size of one set. Logarithms weigh all steps alike, and are -inf for a flat set;
            `volume` is in the units of the states and weighs large sets most.
        cells: into how many equal parts each coordinate of `X0`, a box, is cut; the penalty is the
            mean over the cells. None: it is not cut.
        options: keyword arguments of `reach`, such as `relaxation`. For a `Template` that is
            `LinearBounds()`, which takes milliseconds, unless they say otherwise; for ellipsoids,
            or where a `solver` or a `window` is given, `LocalBounds()`. The window is 1, but for
            `BranchAndCut()` outside of compiled code, which has none. With `LinearBounds()` an `X0`
            that is a polytope counts as the box around it, compiled or not.

    Raises:
        RuntimeError, TypeError, ValueError: as `reach` does; `measure` gives no number; `cells` are
            no positive numbers, one for each coordinate of a box.

    Example:
        >>> import jax
        >>> from reachjax import MLP, AffinePlant, Box, Template
        >>> X0, template = Box([1.0], [2.0]), Template.box(1)
        >>> def penalty(gain):
        ...     net = MLP.from_layers([([[gain]], [0.0])])
        ...     loop = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net)
        ...     return volume_penalty(loop, X0, 2, template)  # widths 1 + gain, (1 + gain)^2
        >>> round(float(jax.grad(penalty)(-0.5)), 5)  # of 3/2 log(1 + gain)
        3.0
    """
    if not callable(measure):
        raise TypeError(f"measure must be a function of a set, but {described(measure)} arrived")

    def size(tube: ReachTube | Sketch) -> Float[Array, ""]:
        sizes = [measure(region) for region in tube.sets[1:]]
        if sizes[0] is None or jnp.shape(sizes[0]) != ():
            arrived = "None" if sizes[0] is None else f"an array of shape {jnp.shape(sizes[0])}"
            raise ValueError(f"measure must give one number for a set, but {arrived} arrived")
        return sum(sizes, start=jnp.zeros(())) / horizon

    return _penalised(size, loop, X0, horizon, template, cells, options, False)


@once_positional("goal", "avoid", "safe")
@unlogged
@lenient
def specification_penalty(
    loop: ClosedLoop,
    X0: AbstractSet,
    horizon: int,
    template: AbstractTemplate | None = None,
    *,
    goal: Timed | None = None,
    safe: Region | None = None,
    avoid: AvoidSets | None = None,
    margin: float = 0.0,
    cells: Sequence[int] | None = None,
    **options: Any,
) -> Float[Array, ""]:
    """By how much the certified sets miss a reach-avoid specification: zero once it is proved.

    A hinge on the distance to the goal, the avoided sets and the boundary of the safe set, summed
    over facets and times (see `shortfall`); the mean over cells, if there are any. Differentiable
    as `volume_penalty` is, whose sets it has: in compiled code a zero is no proof.

    Args:
        loop: the closed loop.
        X0: the set of initial states.
        horizon: the number of steps.
        template: what every set looks like: facet directions, ellipsoids, or both. None: octagons
            in two dimensions, boxes in others (`Template.default`).
        goal: where every state must be at the horizon; or a mapping from times, or from ranges of
            times, to where it must be then.
        safe: where every state must be at all times.
        avoid: closed sets in which no state may be: a sequence for all times, or a mapping from
            times, or from ranges of times, to sequences.
        margin: how far the sets should be from breaking a requirement, in the units of the state; a
            little more than zero keeps the proof when the weights move on.
        cells: as of `volume_penalty`; what is proved of each cell is proved of `X0`.
        options: as of `volume_penalty`.

    Raises:
        RuntimeError, TypeError, ValueError: as `reach` and `verify` do; `cells` are no positive
            numbers, one for each coordinate of a box.

    Example:
        >>> from reachjax import MLP, AffinePlant, Box, ClosedLoop, Template
        >>> net = MLP.from_layers([([[-0.5]], [0.0])])
        >>> loop = ClosedLoop(AffinePlant([[1.0]], [[1.0]]), net)  # x+ = x / 2
        >>> penalty = specification_penalty(
        ...     loop, Box([1.0], [2.0]), 1, Template.box(1), goal=Box([0.0], [0.9])
        ... )
        >>> round(float(penalty), 6)
        0.1
    """
    check_margin(margin)
    required: list[Requirement] = []
    if isinstance(loop, ClosedLoop):  # mistakes are named before anything is solved
        steps = whole_number("horizon", horizon, 1)
        required = requirements(
            loop.states, steps, period_of(loop), goal=goal, safe=safe, avoid=avoid
        )

    def missed(tube: ReachTube | Sketch) -> Float[Array, ""]:
        return missing(required, tube, margin)

    between = any(item.throughout for item in required)
    return _penalised(missed, loop, X0, horizon, template, cells, options, between)


def _penalised(
    penalty: Callable[[ReachTube | Sketch], Float[Array, ""]],
    loop: ClosedLoop,
    X0: AbstractSet,
    horizon: int,
    template: AbstractTemplate | None,
    cells: Sequence[int] | None,
    options: dict[str, Any],
    between: bool,
) -> Float[Array, ""]:
    """The penalty of a tube, or its mean over those from the cells of an initial set.

    `between` says whether the penalty asks for sets in between samples.
    """
    template = template_of(loop, template)
    require_kinds(loop=loop, X0=X0, template=template)
    options = _completed(loop, X0, template, options)
    by_forms = isinstance(options["relaxation"], LinearBounds)

    def of(X0: AbstractSet) -> Float[Array, ""]:
        problem = Problem(loop, X0, template, horizon, options.get("start", 0))
        if not by_forms or is_concrete(problem.parts):
            return penalty(reach(loop, X0, horizon, template, **options))
        check_problem(problem, Options(**{k: v for k, v in options.items() if k != "start"}))
        return penalty(sketched(problem, between))

    if cells is None:
        return of(X0)
    if X0.intervals is None:
        raise TypeError(f"cells are of an X0 of type Box, but {described(X0)} arrived")
    lower, upper = grid_ends(X0.bounding_box(), cells)
    if options["window"] is None:  # on the host, one by one
        each = [of(Box(*ends)) for ends in zip(lower, upper, strict=True)]
        return sum(each, start=jnp.zeros(())) / len(each)
    return jnp.mean(jax.vmap(lambda lower, upper: of(Box(lower, upper)))(lower, upper))


def _completed(
    loop: ClosedLoop, X0: AbstractSet, template: AbstractTemplate, options: dict[str, Any]
) -> dict[str, Any]:
    """The options that are given, and what they leave open."""
    by_programs = template.alone is None or "solver" in options or "window" in options
    relaxation = options.get("relaxation", LocalBounds() if by_programs else LinearBounds())
    of_numbers = is_concrete(jax.lax.stop_gradient((loop, X0, template)))
    relaxation, window = _in_penalties(relaxation, of_numbers)
    return {"window": window} | options | {"relaxation": relaxation}


@singledispatch
def _in_penalties(relaxation: Any, of_numbers: bool) -> tuple[Any, int | None]:
    """The relaxation and the window of a penalty, the same function compiled or not."""
    return relaxation, None if isinstance(relaxation, AbstractMethod) else 1


@_in_penalties.register
def _(relaxation: LinearBounds, of_numbers: bool) -> tuple[Any, int | None]:
    return LinearBounds(programs=False), 1  # compiled code has none


@_in_penalties.register
def _(relaxation: BranchAndCut, of_numbers: bool) -> tuple[Any, int | None]:
    return relaxation, None if of_numbers else 1
