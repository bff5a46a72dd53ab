"""What every method of bounding reachable sets is given, and what it gives.

A method is an object that yields the sets of a problem, one after the other, within a budget. It
may be given wherever a relaxation may (`reach(..., relaxation=Cells(...))`); one of a user's own is
a class with `sets`.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.loops import ClosedLoop
from reachjax.methods.steps import boxed
from reachjax.methods.witnesses import Simulations
from reachjax.numerics.budget import ENDLESS, Budget
from reachjax.numerics.checks import is_concrete
from reachjax.proofs.certificates import AbstractProof
from reachjax.proofs.proposal import AS_ASKED, SolverStatus
from reachjax.sets import AbstractSet, AbstractTemplate, Box, Template


class Span(NamedTuple):
    """Times from a first to a last one, in steps after the initial set; at samples one alone."""

    first: float
    last: float


class ReachSet(NamedTuple):
    """A set that surely holds all states of a span of time.

    Attributes:
        region: the set.
        proof: of that.
        span: of the time.
        worst: `(c, s)`, scenarios, or initial states, that the proof thinks of as the worst.
        ascend: whether ascents begin at them, one for each value that the set bounds.
    """

    region: AbstractSet
    proof: AbstractProof
    span: Span
    worst: Float[np.ndarray, "c s"] = np.zeros((0, 0))
    ascend: bool = False

    @property
    def status(self) -> SolverStatus:
        """How the search for its bounds ended: of those that are not as asked, the first."""
        ends = self.proof.statuses
        return next((end for end in ends if end not in AS_ASKED), ends[0])


def at(k: int) -> Span:
    """The span that is one sample, `k` steps after the initial set."""
    return Span(k, k)


@dataclasses.dataclass(frozen=True)
class Problem:
    """What sets are bounded of, and what that may take.

    Attributes:
        loop: the closed loop.
        X0: the set of initial states.
        template: what every set looks like.
        horizon: the number of steps.
        start: the time of `X0`.
        simulations: trajectories from the initial set; None where numbers are traced.
        levels: `(horizon, f)`, bounds below which nothing is gained; None if all gaps are to be
            closed.
        gap: what may stay open of a facet, as a part of its range.
        budget: of the time and the work.
        note: is told what happens within a step.
    """

    loop: ClosedLoop
    X0: AbstractSet
    template: AbstractTemplate
    horizon: int
    start: int = 0
    simulations: Simulations | None = None
    levels: Float[np.ndarray, "N f"] | None = None
    gap: float = 1e-4
    budget: Budget = ENDLESS
    note: Callable[[str], None] = lambda note: None

    @property
    def box(self) -> Box:
        """A box around the initial set.

        Raises:
            ValueError: it is empty or unbounded.
        """
        return boxed(self.X0, "X0")

    @property
    def parts(self) -> tuple[ClosedLoop, AbstractSet, AbstractTemplate]:
        """What may be differentiated."""
        return self.loop, self.X0, self.template

    @property
    def fixed(self) -> tuple[ClosedLoop, AbstractSet, AbstractTemplate]:
        """The parts without derivatives."""
        return jax.lax.stop_gradient(self.parts)

    @property
    def of_numbers(self) -> bool:
        """Whether all numbers are known, with or without derivatives."""
        return is_concrete(self.fixed)

    @property
    def directions(self) -> Float[Array, "N f n_x"]:
        """The facets of each step."""
        rows = self.facets.directions
        if self.facets.steps is None:
            return jnp.broadcast_to(rows, (self.horizon, *rows.shape))
        return rows[: self.horizon]

    @property
    def facets(self) -> Template:
        """The template, of facets alone.

        Raises:
            TypeError: it has none, or more than these.
        """
        if (facets := self.template.alone) is None:
            raise TypeError(
                "LinearBounds() bounds facets, as branches and cells do, but the template is of "
                f"kind {type(self.template).__name__}: give a Template, or for ellipsoids another "
                "relaxation, such as CuttingPlanes() or LocalBounds()"
            )
        return facets

    def require_numbers(self) -> None:
        """Raise an error where a method needs numbers.

        Raises:
            ValueError: some are traced inside `jax.jit`.
        """
        if not self.of_numbers:
            raise ValueError(
                "window=None is chosen from numbers: inside jax.jit, vmap or scan give a number, "
                "such as window=1"
            )

    def over(self, part: AbstractSet, levels: Float[np.ndarray, "N f"], budget: Budget) -> Problem:
        """The problem of a part of the initial set, whose bounds need not be below some levels."""
        return dataclasses.replace(
            self, X0=part, levels=levels, budget=budget, simulations=None, note=_unheard
        )


def _unheard(note: str) -> None:
    """Where there is no bar that shows notes."""


class AbstractMethod(abc.ABC):
    """A way to bound the states of a loop."""

    @abc.abstractmethod
    def sets(self, problem: Problem, known: Sequence[ReachSet] = ()) -> Iterator[ReachSet]:
        """The sets of a problem after those that are known, step after step.

        Args:
            problem: the problem.
            known: the first sets.

        Raises:
            TypeError: the template is of a kind that the method has no sets of.
            ValueError: states overflow, or numbers are traced that must be known.
        """

    def adds_to_forms(self, loop: ClosedLoop) -> bool:
        """Whether its bounds may be tighter than those of affine forms."""
        return True
