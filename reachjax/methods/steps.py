"""One step of the loop: its set of states, and the window of earlier steps that it ends."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from reachjax.loops import ClosedLoop
from reachjax.methods.witnesses import Simulations
from reachjax.numerics.budget import ENDLESS, Budget, clock
from reachjax.numerics.rounding import Ball
from reachjax.programs.lmi import Program
from reachjax.programs.preactivations import first_inputs, first_rows
from reachjax.programs.relaxations import AbstractRelaxation, CuttingPlanes
from reachjax.programs.windows import Window
from reachjax.proofs.certificates import AbstractCertificate
from reachjax.sets import AbstractSet, Box, Polytope
from reachjax.sets.unusable import ThinSetError
from reachjax.solvers import AbstractSolver
from reachjax.solvers.cutting_planes import NONE


def boxed(X: AbstractSet, name: str) -> Box:
    """A box around a set; one that is too large for numbers may seem empty or unbounded.

    Raises:
        ValueError: the set, which the error calls by this name, is empty or unbounded.
    """
    try:
        return X.bounding_box()
    except (ValueError, ThinSetError) as error:
        raise ValueError(f"{name} cannot be used: {error}") from None


@dataclasses.dataclass(frozen=True)
class Setting:
    """What all steps of a tube have in common.

    Attributes:
        loop: the closed loop.
        start: the time of the initial set.
        relaxation: which products of facts are used.
        solver: what solves the semidefinite programs.
        limit: how many columns a window of more than one step may have; None if any number.
        drop_columns: whether units that are affine take no columns of the basis.
        simulations: trajectories from the initial set; None where numbers are traced.
        gap: what is left open, as a part of a facet's range.
        budget: of the time.
        note: is told what happens within a step.
    """

    loop: ClosedLoop
    start: int
    relaxation: AbstractRelaxation
    solver: AbstractSolver
    limit: int | None
    drop_columns: bool
    simulations: Simulations | None
    gap: float = 1e-4
    budget: Budget = ENDLESS
    note: Callable[[str], None] = lambda note: None

    @property
    def cuts(self) -> CuttingPlanes | None:
        """By which rounds products are added; None if a program has all of them at once."""
        cuts = self.relaxation.cuts
        if cuts is None or cuts.gap is not None:
            return cuts
        return dataclasses.replace(cuts, gap=self.gap)


@dataclasses.dataclass(frozen=True)
class Step:
    """One step of the loop.

    Attributes:
        setting: the tube's.
        X: the set of states.
        k: how many steps after the initial set.
        before: the steps that its window reaches back over, if it may have as many.
        proof: of the set of states; None of the initial set.
    """

    setting: Setting
    X: AbstractSet
    k: int
    before: tuple[Step, ...]
    proof: AbstractCertificate | None = None

    @property
    def t(self) -> int:
        """The time of the set of states."""
        return self.setting.start + self.k

    @cached_property
    def box(self) -> Box:
        """A box around the set; one that is too large for numbers may seem empty or unbounded.

        Raises:
            ValueError: the set is empty or unbounded.
        """
        if not self.k:
            return boxed(self.X, "X0")
        return boxed(self.X, f"the certified set at t = {self.t}, of what X0 reaches,")

    @cached_property
    def window(self) -> Window:
        """The window that this step ends: the longest one that stays in the limit."""
        limit = self.setting.limit
        # a window that had to be shorter a step ago has to be now
        first = max(0, len(self.before) - len(self.before[-1].window)) if self.before else 0
        if limit is not None and self.before and self.before[-1].window.taken > limit:
            first = len(self.before)  # that window is of one step, and too large even so
        while True:
            window = self._reaching_back(self.before[first:])
            if limit is None or window.taken <= limit or len(window) == 1:
                return window
            first += 1

    def _reaching_back(self, before: tuple[Step, ...]) -> Window:
        """The window over these steps and this one."""
        if before and len(before[-1].window) == len(before):
            return self.added_to(before[-1].window)
        first, *others = (*before, self)
        setting = self.setting
        window = Window.beginning(
            setting.loop, first.X, first.box, first.t, setting.relaxation, setting.drop_columns
        )
        for step in (first, *others):
            window = step.added_to(window)
        return window

    def added_to(self, window: Window) -> Window:
        """A window that ends at the step's set of states, and this step.

        Raises:
            TimeOverError: the time in force is over.
        """
        clock().require()
        return window.extended(self.setting.loop, self.X, self.box, self.first_inputs)

    @cached_property
    def first_inputs(self) -> Ball | None:
        """The ranges of the first layer's inputs over the set; None where its box says as much."""
        if not (self.setting.relaxation.linear_bounds and self.X.needs_programs):
            return None
        rows = first_rows(self.setting.loop)
        if rows is None:
            return None
        return first_inputs(rows, *self.X.row_ranges(rows.mid[:, :-1]), self.box)

    @property
    def warm_start(self) -> Int[np.ndarray, "p 2"]:
        """Products that prove the set of states, where this window begins with the same facts."""
        grown = bool(self.before) and len(self.window) == len(self.before[-1].window) + 1
        return self.proof.products_in_use if grown and self.proof is not None else NONE

    def program(self, directions: Float[Array, "f n_x"]) -> Program:
        """Theorem 1 with these directions of the successor for an objective.

        Raises:
            TimeOverError: the time in force is over.
        """
        window = self.window
        clock().require()
        program = window.program(directions, self.setting.relaxation)
        clock().require()
        return program

    def attained(
        self, directions: Float[Array, "f n_x"], facet: int, column: Float[np.ndarray, " n"]
    ) -> float:
        """What simulations attain of a facet of the successors.

        Among them are ascents from the best ones and, where the window begins at the initial set,
        from the state that a moment's last column holds.
        """
        simulations = self.setting.simulations
        assert simulations is not None
        facets, n, k = len(directions), self.setting.loop.states, self.k + 1
        region = jax.lax.stop_gradient(Polytope(directions, jnp.zeros(facets)))
        starts = simulations.best(k, region, facet, facets)
        if len(self.window) == k:
            starts[-1, :n] = column[:n]
        simulations.climb(k, region, np.full(facets, facet), starts)
        return float(simulations.attained(k, region)[0][facet])


def overflow(t: int, halved: bool = False) -> ValueError:
    """The error that bounds of states at a time are no numbers, whether or not the states are.

    Args:
        t: the time.
        halved: whether cells of the initial set were tried.
    """
    parts = (
        "a smaller X0, or more time or cells for it"
        if halved
        else "smaller cells of X0 (reach_partitioned, or decide(..., cells=...))"
    )
    return ValueError(
        f"bounds of the loop's states at t = {t} overflow or are not numbers: check the weights of "
        "loop.controller and the entries of loop.plant; where simulated states are small, take a "
        f"shorter step of integration in the plant's function, or {parts}"
    )
