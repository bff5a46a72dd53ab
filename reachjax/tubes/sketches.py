"""Sets that nothing proves: what affine forms say if rounding is not counted.

A penalty needs no proof. Its sets are those of `LinearBounds` but for rounding, take a fraction of
its operations, and are no tube: nothing is decided from them. Of a differential equation Taylor
polynomials, and cubics in between samples, count as its solutions: what they leave out is not
enclosed (`loops.flows`).
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from reachjax.loops import ClosedLoop
from reachjax.methods.problem import Problem
from reachjax.numerics.derivatives import first_order
from reachjax.programs.unrolled import unrolled_at_once
from reachjax.sets import AbstractSet, Polytope


@dataclasses.dataclass(frozen=True)
class Sketch:
    """Sets of a loop's states at each time, up to rounding; of a flow, up to remainders too.

    Attributes:
        loop: the closed loop.
        sets: `sets[t]` for `t = 0 .. horizon`; `sets[0]` is the initial set.
        spans: sets of the states from each sample to the next one; none in discrete time, nor where
            they were not asked for.
    """

    loop: ClosedLoop
    sets: tuple[AbstractSet, ...]
    spans: tuple[Polytope, ...] = ()

    @property
    def horizon(self) -> int:
        """The number of steps."""
        return len(self.sets) - 1


def sketched(problem: Problem, between: bool = False) -> Sketch:
    """The sets of a problem, whose arguments have been checked.

    Args:
        problem: the problem.
        between: whether sets in between the samples of a differential equation are asked for.

    Raises:
        TypeError: the template has no facets.
        ValueError: the initial set is empty or unbounded.
    """
    problem = dataclasses.replace(
        problem, **dict(zip(("loop", "X0", "template"), first_order(problem.parts), strict=True))
    )
    box, facets = problem.box, problem.facets
    given = problem.loop, problem.X0.closed_form(box), box, problem.directions
    found = unrolled_at_once(*given, problem.start, between=int(between), counted=False)

    def regions(offsets: Float[Array, "N f"]) -> tuple[Polytope, ...]:
        offsets = jnp.where(jnp.isfinite(offsets), offsets, jnp.nan)
        return tuple(facets.at(k).polytope(each) for k, each in enumerate(offsets, start=1))

    spans = () if found.between is None else regions(jnp.max(found.between, axis=1))
    return Sketch(problem.loop, (problem.X0, *regions(found.offsets)), spans)
