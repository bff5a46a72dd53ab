"""Sets one after the other, by forms, branches or programs, from the initial set or a later one."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from reachjax.loops import ClosedLoop
from reachjax.numerics.budget import Budget, TimeOverError
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
from reachjax.programs.relaxations import AbstractRelaxation, BranchAndCut
from reachjax.proofs.certificates import AbstractProof
from reachjax.proofs.proposal import SolverStatus
from reachjax.proofs.witnesses import Simulations
from reachjax.sets import AbstractSet, AbstractTemplate, Box, Template
from reachjax.sets.unusable import ThinSetError, UnusableSetError
from reachjax.solvers import AbstractSolver, Auto
from reachjax.tubes.by_branching import sets_by_branching
from reachjax.tubes.by_cells import sets_by_cells
from reachjax.tubes.by_forms import sets_by_forms
from reachjax.tubes.by_programs import sets_by_programs
from reachjax.tubes.steps import Reached, Setting, boxed

Progress = Callable[[Iterable[int]], Iterable[int]]
"""Wraps the iteration over time steps, such as `tqdm.tqdm` or `rich.progress.track`."""

SAMPLES = 1000

GAP = 1e-4
"""What may stay open of a facet, as a part of its range."""

LARGEST_WINDOW = 64
"""The most columns of a window whose length is chosen."""

KINDS = {
    "loop": (ClosedLoop, "a ClosedLoop"),
    "X0": (AbstractSet, "a set such as Box(lower, upper) or Polytope(A, b)"),
    "template": (AbstractTemplate, "a template, such as Template.box(n) or EllipsoidTemplate()"),
    "relaxation": (AbstractRelaxation, "a relaxation object, such as BranchAndCut()"),
    "solver": (AbstractSolver, "a solver object, such as Auto()"),
}
"""What arguments of these names are, and what errors say was expected."""


class Options(NamedTuple):
    """By what sets are bounded: see `reach`."""

    relaxation: AbstractRelaxation = BranchAndCut()
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


class Task(NamedTuple):
    """What sets are bounded of.

    Attributes:
        loop: the closed loop.
        X0: the set of initial states.
        horizon: the number of steps.
        template: what every set looks like.
        start: the time of `X0`.
    """

    loop: ClosedLoop
    X0: AbstractSet
    horizon: int
    template: AbstractTemplate
    start: int

    @property
    def fixed(self) -> Task:
        """The task without derivatives."""
        loop, X0, template = jax.lax.stop_gradient((self.loop, self.X0, self.template))
        return self._replace(loop=loop, X0=X0, template=template)


class Propagated(NamedTuple):
    """The sets after `1 .. k` steps and their proofs.

    Attributes:
        sets: `k` of them.
        proofs: one for each.
        interrupted: whether the horizon was to be reached, and somebody stopped that (Ctrl-C).
    """

    sets: list[AbstractSet]
    proofs: list[AbstractProof]
    interrupted: bool


def propagated(
    task: Task, options: Options, known: Sequence[tuple[AbstractSet, AbstractProof]] = ()
) -> Propagated:
    """The sets of a task, whose arguments have been checked.

    Args:
        task: what they are bounded of.
        options: by what.
        known: the first ones, with their proofs.

    Raises:
        KeyboardInterrupt: the call was interrupted before any set was proved.
        ValueError: the initial set is empty or unbounded, states overflow, or the progress bar
            leaves out steps.
    """
    budget = Budget.of(options.time_limit)
    loop, X0, template = first_order((task.loop, task.X0, task.template))
    task = task._replace(loop=loop, X0=X0, template=template)
    fixed, horizon, simulations = task.fixed, task.horizon, None
    if is_concrete((fixed.loop, fixed.X0)):
        simulations = simulations_from(
            fixed.loop, fixed.X0, horizon, task.start, options.samples, options.seed
        )
    before = [_as_reached(*each) for each in known]
    bar = wrapped(options.progress, range(len(before), horizon))
    setting = Setting(
        loop=task.loop,
        start=task.start,
        relaxation=options.relaxation,
        solver=options.solver,
        limit=LARGEST_WINDOW if options.window is None else None,
        drop_columns=options.window != 1 and is_concrete((fixed.loop, fixed.X0, fixed.template)),
        simulations=simulations,
        gap=options.gap,
        budget=budget,
        note=getattr(bar, "set_postfix_str", _unheard),
    )
    steps, interrupted = list(before), False
    try:
        for _, step in zip(bar, _following(task, options, setting, before), strict=False):
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
    return Propagated([step.region for step in steps], owned(proofs), interrupted)


def _following(
    task: Task, options: Options, setting: Setting, known: Sequence[Reached]
) -> Iterator[Reached]:
    """The steps after those that are known."""
    loop, X0, horizon, template, start = task
    relaxation, window = options.relaxation, options.window
    box = boxed(X0, "X0")
    if relaxation.by_forms:  # forms go back to the initial set: they take milliseconds
        held = X0 if getattr(relaxation, "programs", False) else X0.closed_form(box)
        forms = sets_by_forms(loop, X0, held, box, template, horizon, start)
        return itertools.islice(forms, len(known), None)
    if window is None and isinstance(relaxation, BranchAndCut) and isinstance(template, Template):
        if loop.curved and relaxation.cells > 1 and X0.parts[1] is None:
            given = setting, relaxation.cells, X0, box, template, horizon
            return sets_by_cells(*given, known=len(known))
        return sets_by_branching(setting, relaxation.nodes, X0, box, template, horizon, known)
    steps = sets_by_programs(setting, X0, template, horizon, window, known)
    concrete = is_concrete(jax.lax.stop_gradient((loop, X0, template)))
    if template.parts[1] is not None or not concrete:
        return steps
    forms = sets_by_forms(loop, X0, X0.closed_form(box), box, template, horizon, start)
    return _in_time(setting.budget, steps, forms, len(known), horizon)


def _in_time(
    budget: Budget, steps: Iterator[Reached], forms: Iterator[Reached], known: int, horizon: int
) -> Iterator[Reached]:
    """Steps by programs as long as there is time, then by forms, which take little.

    A step shares the time that is left with the later ones. What it takes beyond its share is what
    no clock cuts; the next one takes as much again, and is not begun where that is not left.

    Args:
        budget: of the time.
        steps: the ones by programs that are not known.
        forms: all steps by forms.
        known: how many steps are known.
        horizon: how many there are in all.
    """
    beyond = 0.0
    while known < horizon and budget.left > beyond:
        began, share = time.monotonic(), budget.left / (horizon - known)
        try:
            with budget.in_force():
                step = next(steps, None)
        except TimeOverError:
            break
        if step is None:
            return
        known, beyond = known + 1, max(time.monotonic() - began - share, 0.0)
        yield step
    for step in itertools.islice(forms, known, None):
        codes = np.full(len(step.proof.codes), int(SolverStatus.TIME))
        yield step._replace(proof=step.proof.replace(codes=codes))


def _as_reached(region: AbstractSet, proof: AbstractProof) -> Reached:
    states = proof.witness_states
    if not is_concrete(states):
        return Reached(region, proof, np.zeros((0, 0)), climb=False)
    states = np.asarray(states)
    return Reached(region, proof, states[np.isfinite(states).all(axis=1)], climb=False)


def _unheard(note: str) -> None:
    """Where there is no bar that shows notes."""


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
    steps: list[Reached], simulations: Simulations, climb: bool
) -> list[AbstractProof]:
    """Simulate what the certificates bound, from the initial set.

    Args:
        steps: all of them.
        simulations: from the initial set.
        climb: whether there is time for gradient ascent.
    """
    simulated = [step.states for step in steps if not (step.climb and climb) and len(step.states)]
    if simulated:
        simulations.include(*simulated)
    for k, step in enumerate(steps, start=1):
        if climb and step.climb and len(step.states):
            simulations.climb(k, step.region, np.arange(len(step.states)), step.states)
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
    if isinstance(X, Box) and X.steps is not None:
        raise ValueError(f"{name} must be one box, but a time-varying one arrived")
    return owned(fixed)


def require_kinds(**arguments: Any) -> None:
    """Raise a `TypeError` that names the first argument that is not of the kind of its name."""
    for name, value in arguments.items():
        require_kind(name, value, *KINDS[name])


def check_task(task: Task, options: Options) -> None:
    """Check what a user gave.

    Raises:
        RuntimeError: JAX's 64-bit floats are off.
        TypeError: an argument is of another kind.
        ValueError: dimensions disagree, a number is too small, a time-varying loop or template ends
            before the horizon, or the window is to be chosen from traced numbers.
    """
    loop, X0, horizon, template, start = task
    relaxation, window = options.relaxation, options.window
    require_kinds(loop=loop, X0=X0, template=template, relaxation=relaxation, solver=options.solver)
    require_double_precision(loop=loop, X0=X0, template=template)
    same_size(
        "the loop's number of states is", "the dimension of X0 is", (loop.states, X0.dimension)
    )
    same_size(
        "the loop's number of states is",
        "the dimension of template is",
        (loop.states, template.dimension or loop.states),
    )
    loop.check_horizon(horizon, start)
    if template.steps is not None and template.steps < horizon:
        raise ValueError(f"template is given for {template.steps} steps, but horizon is {horizon}")
    require_bar(options.progress)
    whole_number("samples", options.samples, 1)
    whole_number("seed", options.seed, 0)
    real_number("gap", options.gap, 0.0)
    Budget.of(options.time_limit)
    if window is not None:
        whole_number("window", window, 1)
    elif not (relaxation.by_forms or is_concrete(jax.lax.stop_gradient((loop, X0, template)))):
        raise ValueError(
            "window=None is chosen from numbers: inside jax.jit, vmap or scan give a number, such "
            "as window=1"
        )
