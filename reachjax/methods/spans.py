"""Sets between samples: polytopes that hold all states from one sample to the next one."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from reachjax.loops import ClosedLoop
from reachjax.methods.steps import boxed
from reachjax.numerics.checks import is_concrete, owned
from reachjax.programs.unrolled import unrolled, unrolled_at_once
from reachjax.sets import AbstractSet, AbstractTemplate, Polytope, Template


def spans_by_forms(
    loop: ClosedLoop, X0: AbstractSet, template: AbstractTemplate, horizon: int, start: int
) -> tuple[Polytope, ...]:
    """The smallest sets that affine forms show to hold the states of each period.

    Args:
        loop: the closed loop, whose plant is a differential equation.
        X0: the initial set.
        template: of facets; of another one the axes are taken.
        horizon: the number of periods.
        start: the time of the initial set.
    """
    facets = template if isinstance(template, Template) else Template.box(loop.states)
    shapes, box = [facets.at(k) for k in range(1, horizon + 1)], boxed(X0, "X0")
    directions = jnp.stack([each.directions for each in shapes])
    given = loop, X0, box, directions
    if is_concrete(given):
        found = [
            step.between
            for step in unrolled(loop, X0, box, np.asarray(directions), start, between=True)
        ]
    else:
        between = unrolled_at_once(loop, X0.closed_form(box), box, directions, start, between=True)
        assert between.between is not None  # they were asked for
        found = [*between.between]
    pairs = zip(shapes, found, strict=True)
    return tuple(shape.polytope(owned(offsets)) for shape, offsets in pairs)
