"""Penalties on what a loop can reach: the size of its sets and missed specifications.

Two penalties on one tube need not solve for it twice: with `tube = reach(...)`, they are
`log_volume(tube) / tube.horizon` and `shortfall(tube, ...)`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from reachjax.loops import ClosedLoop
from reachjax.numerics.checks import described, whole_number
from reachjax.programs.relaxations import LocalBounds
from reachjax.sets import AbstractSet, AbstractTemplate, PolyhedralSet
from reachjax.tubes.reach import reach
from reachjax.tubes.requirements import AvoidSets, check_margin, requirements, shortfall
from reachjax.tubes.sizes import log_volume

STEPWISE = {"relaxation": LocalBounds(), "window": 1}
"""What penalties ask of `reach`: small programs of one size, compiled once."""


def volume_penalty(
    loop: ClosedLoop,
    X0: AbstractSet,
    horizon: int,
    template: AbstractTemplate,
    *,
    measure: Callable[[AbstractSet], Float[Array, ""]] = log_volume,
    **options: Any,
) -> Float[Array, ""]:
    """The mean size of the certified sets at times `1 .. horizon`.

    Differentiable in the loop and the initial set, also inside `jax.jit`, `vmap` and `scan`.

    Args:
        loop: the closed loop.
        X0: the set of initial states.
        horizon: the number of steps.
        template: what every set looks like: facet directions, ellipsoids, or both.
        measure: the size of one set. Logarithms weigh all steps alike, and are -inf for a flat set;
            `volume` is in the units of the states and weighs large sets most.
        options: keyword arguments of `reach`, such as `solver`; the relaxation is `LocalBounds()`
            and the window 1 unless they say otherwise.

    Raises:
        RuntimeError, TypeError, ValueError: as `reach` does; `measure` gives no number.

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
    tube = reach(loop, X0, horizon, template, **STEPWISE | options)
    sizes = [measure(region) for region in tube.sets[1:]]
    if sizes[0] is None or jnp.shape(sizes[0]) != ():
        arrived = "None" if sizes[0] is None else f"an array of shape {jnp.shape(sizes[0])}"
        raise ValueError(f"measure must give one number for a set, but {arrived} arrived")
    return sum(sizes, start=jnp.zeros(())) / horizon


def specification_penalty(
    loop: ClosedLoop,
    X0: AbstractSet,
    horizon: int,
    template: AbstractTemplate,
    goal: PolyhedralSet | None = None,
    avoid: AvoidSets | None = None,
    safe: PolyhedralSet | None = None,
    *,
    margin: float = 0.0,
    **options: Any,
) -> Float[Array, ""]:
    """By how much the certified sets miss a reach-avoid specification: zero once it is proved.

    A hinge on the distance to the goal, the avoided sets and the boundary of the safe set, summed
    over facets and times (see `shortfall`). Differentiable as `volume_penalty` is.

    Args:
        loop: the closed loop.
        X0: the set of initial states.
        horizon: the number of steps.
        template: what every set looks like: facet directions, ellipsoids, or both.
        goal: where every state must be at the horizon.
        avoid: closed sets in which no state may be: a sequence for all times, or a mapping from a
            time to a sequence.
        safe: where every state must be at all times.
        margin: how far the sets should be from breaking a requirement, in the units of the state; a
            little more than zero keeps the proof when the weights move on.
        options: keyword arguments of `reach`, such as `solver`; the relaxation is `LocalBounds()`
            and the window 1 unless they say otherwise.

    Raises:
        RuntimeError, TypeError, ValueError: as `reach` and `verify` do.

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
    if isinstance(loop, ClosedLoop):  # mistakes are named before anything is solved
        requirements(loop.states, whole_number("horizon", horizon, 1), goal, avoid, safe)
    tube = reach(loop, X0, horizon, template, **STEPWISE | options)
    return shortfall(tube, goal, avoid, safe, margin=margin)
