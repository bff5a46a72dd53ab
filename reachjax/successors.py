"""One step: the smallest set of a template that surely holds the successors, and its proof."""

from __future__ import annotations

import dataclasses
from functools import cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.certificates import (
    AbstractCertificate,
    Certificate,
    EllipsoidCertificate,
    MixedCertificate,
)
from reachjax.checks import is_concrete
from reachjax.lmi import Program
from reachjax.relaxation import AbstractRelaxation, CuttingPlanes
from reachjax.rounding import Ball
from reachjax.sets import (
    AbstractSet,
    AbstractTemplate,
    Box,
    Ellipsoid,
    EllipsoidTemplate,
    Intersection,
    MixedTemplate,
    Polytope,
    Template,
)
from reachjax.solvers import (
    AbstractSolver,
    CentralPath,
    bounding_box,
    enveloped,
    proved_ellipsoid,
    proved_offsets,
    proved_size,
    solved_in_rounds,
    support,
    with_cuts,
)
from reachjax.systems import ClosedLoop
from reachjax.windows import Window
from reachjax.witnesses import Simulations


def boxed(X: AbstractSet, name: str) -> Box:
    """A box around a set; one that is too large for numbers may seem empty or unbounded.

    Raises:
        ValueError: the set, which the error calls by this name, is empty or unbounded.
    """
    try:
        return bounding_box(X)
    except (ValueError, RuntimeError) as error:
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
        compact: whether units that are affine take no columns of the basis.
        simulations: trajectories from the initial set; None where numbers are traced.
    """

    loop: ClosedLoop
    start: int
    relaxation: AbstractRelaxation
    solver: AbstractSolver
    limit: int | None
    compact: bool
    simulations: Simulations | None


@dataclasses.dataclass(frozen=True)
class Step:
    """One step of the loop.

    Attributes:
        setting: the tube's.
        X: the set of states.
        k: how many steps after the initial set.
        before: the steps that its window reaches back over, if it may have as many.
    """

    setting: Setting
    X: AbstractSet
    k: int
    before: tuple[Step, ...]

    @property
    def t(self) -> int:
        """The time of the set of states."""
        return self.setting.start + self.k

    def successors(self, template: AbstractTemplate) -> tuple[AbstractSet, AbstractCertificate]:
        """The smallest set of a template that surely holds the successors, and its proof.

        Raises:
            TypeError: the template is of an unknown kind.
            ValueError: the set of states is empty or unbounded, or states overflow.
        """
        successor = jnp.eye(self.setting.loop.states)
        if isinstance(template, Template):
            return self._polytope(template, self._program(template.directions))
        if isinstance(template, EllipsoidTemplate):
            return self._ellipsoid(template, self._program(successor))
        if isinstance(template, MixedTemplate):
            directions = jnp.concatenate([template.facets.directions, successor])
            return self._intersection(template, self._program(directions))
        raise TypeError(f"there is no step for templates of kind {type(template).__name__}")

    @cached_property
    def box(self) -> Box:
        """A box around the set; one that is too large for numbers may seem empty or unbounded.

        Raises:
            ValueError: the set is empty or unbounded.
        """
        return boxed(self.X, f"the certified set at t = {self.t}" if self.k else "X0")

    @cached_property
    def window(self) -> Window:
        """The window that this step ends: the longest one that stays in the limit."""
        first, limit = 0, self.setting.limit
        while True:
            window = self._reaching_back(self.before[first:])
            if limit is None or window.taken <= limit or len(window) == 1:
                return window
            first += 1

    def _reaching_back(self, before: tuple[Step, ...]) -> Window:
        """The window over these steps and this one."""
        if before and len(before[-1].window) == len(before):
            return self._added_to(before[-1].window)
        first, *others = (*before, self)
        setting = self.setting
        window = Window.beginning(
            setting.loop, first.X, first.box, first.t, setting.relaxation, setting.compact
        )
        for step in (first, *others):
            window = step._added_to(window)
        return window

    def _added_to(self, window: Window) -> Window:
        return window.extended(self.setting.loop, self.X, self.box, self.first_inputs)

    @cached_property
    def first_inputs(self) -> Ball | None:
        """The ranges of the first layer's inputs over the set; None where its box says as much."""
        layers = self.setting.loop.controller.layers
        if (
            not (self.setting.relaxation.linear_bounds and isinstance(self.X, Polytope))
            or len(layers) < 2
        ):
            return None
        W, b = layers[0]
        upper, below = support(self.X, W), support(self.X, -W)
        return Ball.between(-below, jnp.maximum(-below, upper)) + b

    def _require_finite(self, numbers) -> None:
        if is_concrete(numbers) and not np.isfinite(numbers).all():
            raise ValueError(
                f"the loop's states at t = {self.t + 1} overflow or are not numbers: check the "
                "weights of loop.controller and the entries of loop.plant"
            )

    def _program(self, directions: Float[Array, "f n_x"]) -> Program:
        """Theorem 1 with these directions of the successor for an objective."""
        return self.window.program(directions, self.setting.relaxation)

    def _polytope(self, template: Template, program: Program) -> tuple[Polytope, Certificate]:
        """Problem (sdp::poly): the smallest offset for each facet."""
        if isinstance(self.setting.relaxation, CuttingPlanes):
            program, offsets, solution = self._with_cuts(template, program)
        else:
            offsets, solution = proved_offsets(program, self.setting.solver)
        self._require_finite(offsets)
        certificate = Certificate.from_solution(program, offsets, solution)
        return template.polytope(offsets), certificate

    def _with_cuts(self, template: Template, program: Program):
        """Offsets with products added in rounds, and the program with these products."""
        fixed = jax.lax.stop_gradient(program)
        if not is_concrete(fixed):
            program = with_cuts(
                program, self.window.layout, self.setting.solver, self.setting.relaxation
            )
            return program, *proved_offsets(program, self.setting.solver)
        witness = None
        if self.setting.simulations is not None:
            witness = partial(self._attained, self.setting.simulations, template)
        rounds = solved_in_rounds(
            jax.device_get(fixed),
            self.window.layout,
            self.setting.solver.for_rounds,
            self.setting.relaxation,
            witness,
        )
        program = program.replace(products=jax.tree.map(jnp.asarray, rounds.products))
        if isinstance(self.setting.solver, CentralPath):
            return program, *proved_offsets(program, self.setting.solver)
        return program, *enveloped(program, rounds.judged)

    def _attained(
        self,
        simulations: Simulations,
        template: Template,
        facet: int,
        column: Float[np.ndarray, " n"],
    ) -> float:
        """What simulations attain of a facet, among them ascents from a proposed initial state."""
        facets, n = len(template), self.setting.loop.states
        region = template.polytope(jnp.zeros(facets))
        starts = simulations.best(self.k + 1, region, facet, facets)
        if len(self.window) == self.k + 1:
            starts[-1] = column[:n]
        simulations.climb(self.k + 1, region, np.full(facets, facet), starts)
        return float(simulations.attained(self.k + 1, region)[0][facet])

    def _ellipsoid(
        self, template: EllipsoidTemplate, program: Program
    ) -> tuple[Ellipsoid, EllipsoidCertificate]:
        """Problem (sdp::ellips): the minimum volume, or the smallest size of a given shape."""
        if template.shape is None:
            region, enclosure = proved_ellipsoid(program, self.setting.solver)
        else:
            X = self.X
            middle = X.center if isinstance(X, Ellipsoid) else self.box.center
            given = Ellipsoid(self.setting.loop.step(middle, self.t), template.shape).normal_form
            region, enclosure = proved_size(program, given, self.setting.solver)
        self._require_finite(region.shape)
        return region, EllipsoidCertificate.from_enclosure(program, region, enclosure)

    def _intersection(
        self, template: MixedTemplate, program: Program
    ) -> tuple[Intersection, MixedCertificate]:
        """Both problems, over the same facts."""
        m = len(template.facets)
        polytope, first = self._polytope(template.facets, program.seeking(slice(m)))
        ellipsoid, second = self._ellipsoid(template.ellipsoid, program.seeking(slice(m, None)))
        region = Intersection(polytope, ellipsoid)
        return region, MixedCertificate.joining(program, first, second)
