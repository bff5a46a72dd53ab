"""Sets of a template by affine forms, without any program: around the states of each step, and
around all states between two samples.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.loops import ClosedLoop
from reachjax.loops.scenarios import Scenarios
from reachjax.methods.gradients import moving_forms
from reachjax.methods.problem import AbstractMethod, Problem, ReachSet, at
from reachjax.methods.steps import boxed, overflow
from reachjax.numerics.checks import is_concrete, owned
from reachjax.numerics.derivatives import moved_by
from reachjax.programs.unrolled import ByForms, unrolled, unrolled_at_once
from reachjax.proofs.by_forms import LinearCertificate
from reachjax.proofs.proposal import SolverStatus
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
        """They are forms themselves."""
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
            proof = LinearCertificate(
                loop=loop,
                X0=X0,
                directions=shaped.directions,
                slopes=step.slopes,
                corners=step.corners,
                codes=jnp.where(jnp.isfinite(step.offsets), *ENDS),
                bounds=step.offsets,
                witnesses=np.full(facets, np.nan),
                witness_states=np.full((facets, 0), np.nan),
                seconds=np.full(facets, seconds / facets),
                k=k,
                start=start,
            )
            region = shaped.polytope(owned(step.offsets))
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
    for (step, seconds), moving in zip(steps, slopes, strict=True):
        yield step._replace(offsets=moved_by(step.offsets, moving)), seconds


def _at_once(found: ByForms) -> Iterator[tuple[ByForms, float]]:
    """Each step of traced numbers, of which nobody knows how long they take."""
    slopes, corners = jax.lax.stop_gradient((found.slopes, found.corners))
    offsets = jnp.where(jnp.isfinite(found.offsets), found.offsets, jnp.nan)
    for k in range(len(offsets)):
        yield ByForms(offsets[k], slopes[: k + 1], corners[k]), 0.0
