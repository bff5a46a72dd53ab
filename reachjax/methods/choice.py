"""Which method a relaxation stands for."""

from __future__ import annotations

from functools import singledispatch

from reachjax.methods.affine_forms import AffineForms
from reachjax.methods.branch_and_cut import Branching
from reachjax.methods.cells import Cells
from reachjax.methods.problem import AbstractMethod, Problem
from reachjax.methods.recursion import Recursion
from reachjax.programs.relaxations import AbstractRelaxation, BranchAndCut, LinearBounds
from reachjax.sets import Template
from reachjax.solvers import AbstractSolver


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
    if window is not None or not isinstance(problem.template, Template):
        return Recursion(relaxation, window, solver)
    branching = Branching(relaxation, solver)
    if problem.loop.curved and relaxation.cells > 1 and problem.X0.parts[1] is None:
        return Cells(branching, relaxation.cells)
    return branching
