"""Sets one after the other, by forms, branches or programs, from the initial set or a later one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from functools import singledispatch
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from reachjax.loops import ClosedLoop
from reachjax.methods.affine_forms import AffineForms
from reachjax.methods.branch_and_cut import Branching
from reachjax.methods.cells import Cells
from reachjax.methods.problem import AbstractMethod, Problem, ReachSet, at
from reachjax.methods.recursion import Recursion
from reachjax.methods.witnesses import Simulations
from reachjax.numerics.budget import Budget
from reachjax.numerics.checks import (
    is_concrete,
    owned,
    real_number,
    require_bar,
    require_double_precision,
    require_kind,
    same_size,
    whole_number,
    wrapped,
)
from reachjax.numerics.derivatives import first_order
from reachjax.programs.relaxations import AbstractRelaxation, BranchAndCut, LinearBounds
from reachjax.proofs.certificates import AbstractProof
from reachjax.sets import AbstractSet, AbstractTemplate, Template
from reachjax.sets.unusable import ThinSetError, UnusableSetError
from reachjax.solvers import AbstractSolver, Auto

T = TypeVar("T")


@singledispatch
def method_of(
    relaxation: AbstractRelaxation | AbstractMethod,
    problem: Problem,
    window: int | None,
    solver: AbstractSolver,
) -> AbstractMethod:
    """The method that bounds a problem as a relaxation asks: a method is one already.

    Args:
        relaxation: what a user gave.
        problem: the problem.
        window: over how many steps programs reach back; None for as many as may be.
        solver: what solves semidefinite programs.
    """
    return (
        relaxation
        if isinstance(relaxation, AbstractMethod)
        else Recursion(relaxation, window, solver)
    )


@method_of.register
def _(
    relaxation: LinearBounds, problem: Problem, window: int | None, solver: AbstractSolver
) -> AbstractMethod:
    return AffineForms(relaxation.programs)


@method_of.register
def _(
    relaxation: BranchAndCut, problem: Problem, window: int | None, solver: AbstractSolver
) -> AbstractMethod:
    if window is not None or problem.template.alone is None:
        return Recursion(relaxation, window, solver)
    branching = Branching(relaxation, solver)
    if problem.loop.curved and relaxation.cells > 1 and problem.X0.parts[1] is None:
        return Cells(branching, relaxation.cells)
    return branching


Progress = Callable[[Iterable[int]], Iterable[int]]
"""Wraps the iteration over time steps, such as `tqdm.tqdm` or `rich.progress.track`."""

SAMPLES = 1000

GAP = 1e-4
"""What may stay open of a facet, as a part of half its simulated range."""

KINDS = {
    "loop": (ClosedLoop, "a ClosedLoop"),
    "X0": (AbstractSet, "a set such as Box(lower, upper) or Polytope(A, b)"),
    "template": (
        AbstractTemplate,
        "a template, such as Template.box(n) or EllipsoidTemplate(), or None",
    ),
    "relaxation": (
        (AbstractRelaxation, AbstractMethod),
        "a relaxation object, such as BranchAndCut()",
    ),
    "solver": (AbstractSolver, "a solver object, such as Auto()"),
}
"""What arguments of these names are, and what errors say was expected."""


class Options(NamedTuple):
    """By what sets are bounded: see `reach`."""

    relaxation: AbstractRelaxation | AbstractMethod = BranchAndCut()
    window: int | None = None
    solver: AbstractSolver = Auto()
    samples: int = SAMPLES
    seed: int = 0
    progress: Progress | None = None
    gap: float = GAP
    time_limit: float | Budget | None = None

    @classmethod
    def named(cls, options: dict[str, Any]) -> Options:
        """The options that are given, the others being as `reach` has them.

        Raises:
            TypeError: there is no such option.
        """
        for name in options:
            if name not in cls._fields:
                known = ", ".join(cls._fields)
                raise TypeError(f"the options are {known}, but {name} arrived")
        return cls(**options)


class Propagated(NamedTuple):
    """The sets after `1 .. k` steps with their proofs.

    Attributes:
        sets: `k` of them.
        interrupted: whether the horizon was to be reached, and somebody stopped that (Ctrl-C).
    """

    sets: list[ReachSet]
    interrupted: bool


def propagated(
    problem: Problem, options: Options, known: Sequence[tuple[AbstractSet, AbstractProof]] = ()
) -> Propagated:
    """The sets of a problem, whose arguments have been checked.

    Args:
        problem: the problem.
        options: by what they are bounded.
        known: the first sets, with their proofs.

    Raises:
        KeyboardInterrupt: the call was interrupted before any set was proved.
        ValueError: the initial set is empty or unbounded, states overflow, or the progress bar
            leaves out steps.
    """
    budget, horizon, simulations = Budget.of(options.time_limit), problem.horizon, None
    loop, X0, template = first_order(problem.parts)
    fixed = jax.lax.stop_gradient((loop, X0))
    if is_concrete(fixed):
        given = horizon, problem.start, options.samples, options.seed
        simulations = simulations_from(*fixed, *given)
    before = [_as_reached(k, *each) for k, each in enumerate(known, start=1)]
    bar = wrapped(options.progress, range(len(before), horizon))
    problem = dataclasses.replace(
        problem,
        loop=loop,
        X0=X0,
        template=template,
        simulations=simulations,
        gap=options.gap,
        budget=budget,
        note=getattr(bar, "set_postfix_str", problem.note),
    )
    method = method_of(options.relaxation, problem, options.window, options.solver)
    steps, interrupted = list(before), False
    try:
        for _, step in zip(bar, method.sets(problem, before), strict=False):
            steps.append(step)
            if budget.stopped:
                raise KeyboardInterrupt
    except KeyboardInterrupt:
        if not steps or not is_concrete([step.proof for step in steps]):
            raise
        interrupted = True
    if len(steps) < horizon and not interrupted:
        missing = horizon - len(before)
        raise ValueError(
            f"progress must pass on each of the {missing} steps, but {len(steps) - len(before)} "
            "arrived"
        )
    proofs = [step.proof for step in steps]
    if simulations is not None and is_concrete(proofs):
        proofs = _with_witnesses(steps, simulations, climb=not budget.late)
    both = zip(steps, owned(proofs), strict=True)
    return Propagated([step._replace(proof=proof) for step, proof in both], interrupted)


def _as_reached(k: int, region: AbstractSet, proof: AbstractProof) -> ReachSet:
    states = proof.witness_states
    if not is_concrete(states):
        return ReachSet(region, proof, at(k))
    states = np.asarray(states)
    return ReachSet(region, proof, at(k), states[np.isfinite(states).all(axis=1)])


def simulations_from(
    loop: ClosedLoop, X0: AbstractSet, horizon: int, start: int, samples: int, seed: int
) -> Simulations | None:
    """Trajectories from the initial set; None if it is too thin for states to be drawn from it.

    Raises:
        ValueError: it surely is empty.
    """
    try:
        return Simulations(loop, X0, horizon, start, samples, seed)
    except UnusableSetError as error:
        raise ValueError(f"X0 cannot be used: {error}") from None
    except ThinSetError:
        if X0.surely_empty():
            raise ValueError(
                "X0 is empty: its polytope and its ellipsoid have no point in common"
            ) from None
    return None


def _with_witnesses(
    steps: list[ReachSet], simulations: Simulations, climb: bool
) -> list[AbstractProof]:
    """Simulate what the certificates bound, from the initial set.

    Args:
        steps: all of them.
        simulations: from the initial set.
        climb: whether there is time for gradient ascent.
    """
    simulated = [step.worst for step in steps if not (step.ascend and climb) and len(step.worst)]
    if simulated:
        simulations.include(*simulated)
    for k, step in enumerate(steps, start=1):
        if climb and step.ascend and len(step.worst):
            simulations.climb(k, step.region, np.arange(len(step.worst)), step.worst)
    found = [simulations.attained(k, step.region) for k, step in enumerate(steps, start=1)]
    return [
        step.proof.replace(witnesses=values, witness_states=states)
        for step, (values, states) in zip(steps, found, strict=True)
    ]


def known_numbers(call: str, loop: ClosedLoop, X: AbstractSet, name: str) -> tuple[Any, Any]:
    """A loop and a set without derivatives.

    Args:
        call: which one needs numbers.
        loop: the loop.
        X: the set.
        name: what the call's argument for it is.

    Raises:
        ValueError: numbers are traced inside `jax.jit`, or the set is a time-varying box.
    """
    fixed = jax.lax.stop_gradient((loop, X))
    if not is_concrete(fixed):
        raise ValueError(
            f"loop or {name} holds traced numbers, and a verdict is decided on known ones: call "
            f"{call} outside of jax.jit"
        )
    if X.steps is not None:
        raise ValueError(f"{name} must be one box, but a time-varying one arrived")
    return owned(fixed)


def require_kinds(**arguments: Any) -> None:
    """Raise a `TypeError` that names the first argument that is not of the kind of its name."""
    for name, value in arguments.items():
        require_kind(name, value, *KINDS[name])


def template_of(loop: ClosedLoop, template: T | None) -> T | Template:
    """The template that is given, or the default one of a loop's states.

    Raises:
        TypeError: none is given, and the loop is none.
    """
    if template is not None:
        return template
    require_kinds(loop=loop)
    return Template.default(loop.states)


def check_problem(problem: Problem, options: Options) -> None:
    """Check what a user gave.

    Raises:
        RuntimeError: JAX's 64-bit floats are off.
        TypeError: an argument is of another kind.
        ValueError: dimensions disagree, a number is too small, a time-varying loop or template ends
            before the horizon.
    """
    (loop, X0, template), horizon = problem.parts, problem.horizon
    given = {"relaxation": options.relaxation, "solver": options.solver}
    require_kinds(loop=loop, X0=X0, template=template, **given)
    require_double_precision(loop=loop, X0=X0, template=template)
    same_size(
        "the loop's number of states is", "the dimension of X0 is", (loop.states, X0.dimension)
    )
    same_size(
        "the loop's number of states is",
        "the dimension of template is",
        (loop.states, template.dimension or loop.states),
    )
    loop.check_horizon(horizon, problem.start)
    if template.steps is not None and template.steps < horizon:
        raise ValueError(f"template is given for {template.steps} steps, but horizon is {horizon}")
    require_bar(options.progress)
    whole_number("samples", options.samples, 1)
    whole_number("seed", options.seed, 0)
    real_number("gap", options.gap, 0.0)
    Budget.of(options.time_limit)
    if options.window is not None:
        whole_number("window", options.window, 1)
