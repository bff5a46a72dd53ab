"""Sets of a template around the states of each step by semidefinite programs, step by step."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from reachjax.methods.affine_forms import AffineForms
from reachjax.methods.problem import AbstractMethod, Problem, ReachSet, at
from reachjax.methods.steps import Setting, Step
from reachjax.methods.successors import successors
from reachjax.numerics.budget import TimeOverError
from reachjax.numerics.checks import is_concrete
from reachjax.programs.relaxations import AbstractRelaxation, LocalBounds
from reachjax.proofs.certificates import AbstractCertificate, AbstractProof
from reachjax.proofs.proposal import SolverStatus
from reachjax.solvers import AbstractSolver, Auto

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
