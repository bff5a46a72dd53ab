"""One step of equation (seq_SDP): the smallest set of a template that holds all successors.

**Theorem 1** (Hu, Fazlyab, Morari, Pappas, CDC 2020), over the basis `xi = [x; z; 1]` of the
window's states and units: `F xi >= 0` stacks the facts of the set (`E_in`) and of the units
(`E_mid`), `p xi = a . x+` is a row of the successor (`E_out`). If for some `Gamma` of the right
signs

    F' Gamma F  +  p e' + e p'  -  2 b e e'  <=  0,

then `a . x+ <= b` for every successor: multiplied from both sides by `xi`, it says
`2 (a . x+ - b) <= -(sum of products of facts) <= 0`. For an ellipsoid `|A x+ + b| <= 1` the last
terms are `V' V - e e'` with `V xi = A x+ + b`. The smallest `b`, or `-log det A`, is a semidefinite
program; whatever solves it only proposes `Gamma`, and the set is what that proves.

The recursion takes such steps one by one, each set being the next one's set of states.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from functools import partial, singledispatch
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.methods.affine_forms import AffineForms
from reachjax.methods.problem import AbstractMethod, Problem, ReachSet, at
from reachjax.methods.steps import Setting, Step, overflow
from reachjax.numerics.budget import ENDLESS, Budget, TimeOverError
from reachjax.numerics.checks import is_concrete
from reachjax.numerics.host import all_finite
from reachjax.programs.lmi import Program
from reachjax.programs.relaxations import AbstractRelaxation, LocalBounds
from reachjax.proofs.by_products import Certificate, MixedCertificate
from reachjax.proofs.certificates import AbstractCertificate, AbstractProof
from reachjax.proofs.proposal import SolverStatus
from reachjax.sets import (
    AbstractSet,
    AbstractTemplate,
    Ellipsoid,
    EllipsoidTemplate,
    Intersection,
    MixedTemplate,
    Template,
)
from reachjax.solvers import (
    AbstractGoal,
    AbstractSolver,
    Auto,
    Facets,
    GivenShape,
    LeastVolume,
    Rounds,
    proved,
)

T = TypeVar("T")


def successors(
    step: Step, template: AbstractTemplate, budget: Budget = ENDLESS
) -> tuple[AbstractSet, AbstractCertificate]:
    """The smallest set of a template that surely holds a step's successors, and its proof.

    Args:
        step: the step.
        template: what the set looks like.
        budget: of the time.

    Raises:
        TypeError: the template is of an unknown kind.
        ValueError: the set of states is empty or unbounded, or states overflow.
    """
    goals = goals_of(template, step)
    rows = [goal.rows(step.setting.loop.states) for goal in goals]
    program = _finite(step, step.program(jnp.concatenate(rows)))
    programs = (program.with_objective(where) for where in _slices(rows))
    parts = [_proved(step, goal, each, budget) for goal, each in zip(goals, programs, strict=True)]
    return _together(program, parts)


def facets_by_products(
    step: Step, directions: Float[Array, "f n_x"], budget: Budget
) -> tuple[Float[Array, " f"], Certificate]:
    """The smallest offsets of some facets of a step's successors, and their proof.

    Args:
        step: the step.
        directions: of the facets.
        budget: of the time.

    Raises:
        ValueError: the set of states is empty or unbounded, or states overflow.
    """
    program = _finite(step, step.program(directions))
    region, proof = _proved(step, Facets(directions), program, budget)
    assert isinstance(proof, Certificate)  # as facets have it
    return region.facets[1], proof


def _proved(
    step: Step, goal: AbstractGoal, program: Program, budget: Budget
) -> tuple[AbstractSet, AbstractCertificate]:
    """The set of one goal, and its proof."""
    cuts, witness, rounds = step.setting.cuts, None, None
    if cuts is not None:
        if step.setting.simulations is not None:
            witness = partial(step.attained, goal.rows(step.setting.loop.states))
        rounds = Rounds(step.window.layout, cuts, witness, step.warm_start, budget)
    with budget.in_force():
        program, value, proposal = proved(goal, program, step.setting.solver, rounds)
    region = goal.region(_finite(step, value))
    return region, goal.certificate(program, value, proposal)


def _together(
    program: Program, parts: list[tuple[AbstractSet, AbstractCertificate]]
) -> tuple[AbstractSet, AbstractCertificate]:
    """One set of all parts: itself, or the intersection of facets and an ellipsoid."""
    if len(parts) == 1:
        return parts[0]
    sets, proofs = zip(*parts, strict=True)
    return Intersection(*sets), MixedCertificate.joining(program, *proofs)


def _slices(rows: list[Array]) -> list[slice]:
    """Where the rows of each goal stand among those of all."""
    ends = np.cumsum([len(each) for each in rows])
    return [slice(end - len(each), end) for end, each in zip(ends, rows, strict=True)]


def _finite(step: Step, numbers: T) -> T:
    """The numbers themselves.

    Raises:
        ValueError: one of them is known not to be finite.
    """
    fixed = jax.lax.stop_gradient(numbers)
    if is_concrete(fixed) and not all_finite(jax.device_get(fixed)):
        raise overflow(step.t + 1)
    return numbers


@singledispatch
def goals_of(template: AbstractTemplate, step: Step) -> tuple[AbstractGoal, ...]:
    """What is sought of a step's successors: one goal for each part of the template's sets."""
    raise TypeError(f"there is no step for templates of kind {type(template).__name__}")


@goals_of.register
def _(template: Template, step: Step) -> tuple[AbstractGoal, ...]:
    return (Facets(template.directions),)


@goals_of.register
def _(template: EllipsoidTemplate, step: Step) -> tuple[AbstractGoal, ...]:
    if template.shape is None:
        return (LeastVolume(),)
    middle = step.setting.loop.step(step.box.center, step.t)
    return (GivenShape(Ellipsoid(middle, template.shape).normal_form),)


@goals_of.register
def _(template: MixedTemplate, step: Step) -> tuple[AbstractGoal, ...]:
    return goals_of(template.facets, step) + goals_of(template.ellipsoid, step)


LARGEST_WINDOW = 64
"""The most columns of a window whose length is chosen."""

LATE = LocalBounds(repeated=False)
"""The relaxation of a step for which there is no time left, and which no solver sees."""


@dataclasses.dataclass(frozen=True)
class Recursion(AbstractMethod):
    """Semidefinite programs, step by step: each set is the next one's set of states.

    Source: equation (seq_SDP) of Hu, Fazlyab, Morari, Pappas (CDC 2020).

    Attributes:
        relaxation: which products of facts are used.
        window: over how many steps a program reaches back; None for as many as may be.
        solver: what solves the programs.
    """

    relaxation: AbstractRelaxation
    window: int | None = None
    solver: AbstractSolver = Auto()  # noqa: RUF009  (immutable)

    def sets(self, problem: Problem, known: Sequence[ReachSet] = ()) -> Iterator[ReachSet]:
        """The smallest sets that are proved; by forms once there is no time left for programs."""
        if self.window is None:
            problem.require_numbers()
        steps = self._by_programs(problem, known)
        if problem.template.parts[1] is not None or not problem.of_numbers:
            return steps
        return _in_time(problem, steps, AffineForms(programs=False), len(known))

    def _by_programs(self, problem: Problem, known: Sequence[ReachSet]) -> Iterator[ReachSet]:
        setting, horizon = (
            setting_of(problem, self.relaxation, self.window, self.solver),
            problem.horizon,
        )
        X, proof, steps = problem.X0, None, list[Step]()
        # what is traced is not compiled otherwise for having been traced slowly
        known_numbers = problem.of_numbers
        for k in range(horizon):
            before = steps if self.window is None else steps[max(0, k + 1 - self.window) :]
            if known_numbers and setting.budget.late:
                step = Step(dataclasses.replace(setting, relaxation=LATE), X, k, (), proof)
            else:
                step = Step(setting, X, k, tuple(before), proof)
            steps.append(step)
            if k < len(known):
                X, proof = known[k].region, _of_programs(known[k].proof)
                continue
            setting.note("semidefinite programs")
            share = setting.budget.share(1 / (horizon - k))
            X, proof = successors(step, problem.template.at(k + 1), share)
            states = np.zeros((0, X.dimension))
            if len(step.window) == k + 1 and is_concrete(proof.moments):
                states = np.asarray(proof.moments)[:, : X.dimension, -1]
            yield ReachSet(X, proof, at(k + 1), states, ascend=True)


def setting_of(
    problem: Problem, relaxation: AbstractRelaxation, window: int | None, solver: AbstractSolver
) -> Setting:
    """What the steps of a problem have in common."""
    return Setting(
        loop=problem.loop,
        start=problem.start,
        relaxation=relaxation,
        solver=solver,
        limit=LARGEST_WINDOW if window is None else None,
        drop_columns=window != 1 and problem.of_numbers,
        simulations=problem.simulations,
        gap=problem.gap,
        budget=problem.budget,
        note=problem.note,
    )


def _in_time(
    problem: Problem, steps: Iterator[ReachSet], forms: AbstractMethod, known: int
) -> Iterator[ReachSet]:
    """Steps by programs as long as there is time, then by forms, which take little.

    A step shares the time that is left with the later ones. What it takes beyond its share is what
    no clock cuts; the next one takes as much again, and is not begun where that is not left.

    Args:
        problem: the problem.
        steps: the ones by programs that are not known.
        forms: bounds the others.
        known: how many steps are known.
    """
    budget, horizon, beyond = problem.budget, problem.horizon, 0.0
    while known < horizon and budget.left > beyond:
        share = budget.share(1 / (horizon - known))
        try:
            with budget.in_force():
                step = next(steps, None)
        except TimeOverError:
            break
        if step is None:
            return
        known, beyond = known + 1, share.overrun
        yield step
    if known == horizon:
        return
    for step in itertools.islice(forms.sets(problem), known, None):
        codes = np.full(len(step.proof.codes), int(SolverStatus.TIME))
        yield step._replace(proof=step.proof.replace(codes=codes))


def _of_programs(proof: AbstractProof) -> AbstractCertificate | None:
    """A proof by programs, whose products the next one may begin with; None if it is another."""
    return proof if isinstance(proof, AbstractCertificate) else None
