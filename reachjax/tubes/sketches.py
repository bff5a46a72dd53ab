"""Sets that nothing proves: what affine forms say if rounding is not counted.

A penalty needs no proof. Its sets are those of `LinearBounds` but for rounding, take a fraction of
its operations, and are no tube: nothing is decided from them.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from reachjax.loops import ClosedLoop
from reachjax.methods.problem import Problem
from reachjax.numerics.derivatives import first_order
from reachjax.programs.unrolled import unrolled_at_once
from reachjax.sets import AbstractSet, Polytope


@dataclasses.dataclass(frozen=True)
class Sketch:
    """Sets of a loop's states at each time, up to rounding.

    Attributes:
        loop: the closed loop.
        sets: `sets[t]` for `t = 0 .. horizon`; `sets[0]` is the initial set.
    """

    loop: ClosedLoop
    sets: tuple[AbstractSet, ...]

    @property
    def horizon(self) -> int:
        """The number of steps."""
        return len(self.sets) - 1

    @property
    def spans(self) -> tuple[Polytope, ...]:
        """No sets between samples.

        Raises:
            TypeError: they were asked for.
        """
        raise TypeError("a sketch has no sets between samples: take the tube of reach(...)")


def sketched(problem: Problem) -> Sketch:
    """The sets of a problem, whose arguments have been checked.

    Raises:
        TypeError: the template has no facets.
        ValueError: the initial set is empty or unbounded.
    """
    problem = dataclasses.replace(
        problem, **dict(zip(("loop", "X0", "template"), first_order(problem.parts), strict=True))
    )
    box, facets = problem.box, problem.facets
    given = problem.loop, problem.X0.closed_form(box), box, problem.directions
    offsets = unrolled_at_once(*given, problem.start, counted=False).offsets
    offsets = jnp.where(jnp.isfinite(offsets), offsets, jnp.nan)
    regions = (facets.at(k).polytope(each) for k, each in enumerate(offsets, start=1))
    return Sketch(problem.loop, (problem.X0, *regions))
