"""Sets that nothing proves: what affine forms say if rounding is not counted.

A penalty needs no proof. Its sets are those of `LinearBounds` but for rounding, take a fraction of
its operations, and are no tube: nothing is decided from them. Of a differential equation Taylor
polynomials, and cubics in between samples, count as its solutions: what they leave out is not
enclosed (`loops.flows`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.loops import ClosedLoop
from reachjax.methods.problem import Problem
from reachjax.numerics.checks import is_concrete
from reachjax.numerics.derivatives import first_order
from reachjax.programs.unrolled import unrolled_at_once
from reachjax.sets import AbstractSet, Polytope, Template


@dataclasses.dataclass(frozen=True)
class Sketch:
    """Sets of a loop's states at each time, up to rounding; of a flow, up to remainders too.

    Attributes:
        loop: the closed loop.
        X0: the initial set.
        facets: of all later sets.
        offsets: `(N, f)`, of the sets after 1, ..., N steps.
        between: `(N, f)`, of the sets of the states since the sample before; None in discrete time,
            and where they were not asked for.
    """

    loop: ClosedLoop
    X0: AbstractSet
    facets: Template
    offsets: Float[Array, "N f"]
    between: Float[Array, "N f"] | None = None

    @property
    def horizon(self) -> int:
        """The number of steps."""
        return len(self.offsets)

    @property
    def sets(self) -> tuple[AbstractSet, ...]:
        """`sets[t]` for `t = 0 .. horizon`; `sets[0]` is the initial set."""
        return self.X0, *self._regions(self.offsets)

    @property
    def spans(self) -> tuple[Polytope, ...]:
        """Sets of the states from each sample to the next one; none where they are not known."""
        return () if self.between is None else self._regions(self.between)

    def _regions(self, offsets: Float[Array, "N f"]) -> tuple[Polytope, ...]:
        return tuple(self._region(offsets, t) for t in range(1, len(offsets) + 1))

    def _region(self, offsets: Float[Array, "N f"], t: int) -> Polytope:
        return self.facets.at(t).polytope(offsets[t - 1])

    def of_each(
        self, value: Callable[[AbstractSet], Array], times: Sequence[int], throughout: bool
    ) -> list[Array]:
        """Values of the sets at some times, in one array or several.

        All sets with the same known normals are one batch. Other sets may need programs.

        Args:
            value: of one of them.
            times: which, all after the initial set, or that of this alone.
            throughout: whether of the states since the sample before.

        Raises:
            ValueError: sets in between samples were not asked for.
        """
        offsets = self.between if throughout else self.offsets
        if offsets is None:
            raise ValueError("sets in between samples must be asked for, but none were")
        if 0 in times:
            return [value(self.X0)] * len(times)
        if self.facets.steps is not None or not is_concrete(self.facets):
            return [value(self._region(offsets, t)) for t in times]
        every = list(times) == list(range(1, len(offsets) + 1))
        some = offsets if every else offsets[np.array(times) - 1]
        return [jax.vmap(lambda each: value(self.facets.polytope(each)))(some)]


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

    inner = None if found.between is None else _finite(jnp.max(found.between, axis=1))
    return Sketch(problem.loop, problem.X0, facets, _finite(found.offsets), inner)


def _finite(offsets: Float[Array, "N f"]) -> Float[Array, "N f"]:
    """Offsets, NaN where there is none."""
    return jnp.where(jnp.isfinite(offsets), offsets, jnp.nan)
