"""Derivatives of loops that jump: those of each branch as it is, the jump itself has none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import reachjax as rj
from reachjax.methods.cells import Cells
from tests.differences import central_difference

STEPS = 2
PLANT = rj.AffinePlant([[1.0, 0.25], [0.0, 1.0]], [[0.0], [0.5]])
BELOW, ABOVE, PLACE = 0, 1, 2
GAINS = jnp.array([0.75, -0.5, 0.125])
"""Of the branch below a place, of the one above it, and that place."""

BRANCHES = {
    BELOW: lambda p, x: p[BELOW] * x[1:] - 1.0,
    ABOVE: lambda p, x: p[ABOVE] * (x[:1] + x[1:]) + 1.0,
}
CELLS = {
    BELOW: rj.Box([-0.75, -0.25], [-0.5, 0.25]),
    ABOVE: rj.Box([0.75, -0.25], [1.0, 0.25]),
}
"""Where it is known for all steps which branch is taken."""

METHODS = {
    "forms": rj.LinearBounds(),
    "branches": rj.BranchAndCut(),
    "cells": Cells(most=2),
}


def jumping(p, x):
    return jnp.where(x[:1] > p[PLACE], BRANCHES[ABOVE](p, x), BRANCHES[BELOW](p, x))


def size(law, X0, relaxation, p):
    """Offsets of all sets, each with a weight of its own."""
    loop = rj.ClosedLoop(PLANT, rj.Network(Partial(law, p), 2, 1))
    tube = rj.reach(loop, X0, STEPS, rj.Template.box(2), relaxation=relaxation, samples=50)
    return sum(jnp.array([1.0, 0.7, 0.9, 1.2]) @ each.b for each in tube.sets[1:])


@pytest.mark.parametrize("side", CELLS, ids=["below", "above"])
@pytest.mark.parametrize("name", METHODS)
def test_where_decisions_are_settled_derivatives_are_those_of_the_branch(name, side):
    of = lambda law, p: size(law, CELLS[side], METHODS[name], p)  # noqa: E731
    gradient = np.asarray(jax.grad(lambda p: of(jumping, p))(GAINS))
    alone = np.asarray(jax.grad(lambda p: of(BRANCHES[side], p))(GAINS))
    np.testing.assert_allclose(gradient, alone, rtol=1e-9, atol=1e-12)
    along = jnp.zeros(3).at[side].set(1.0)
    difference = central_difference(lambda p: of(jumping, p), (GAINS,), (along,), 1e-4)
    assert gradient[side] == pytest.approx(difference, rel=1e-6)
    assert abs(gradient[side]) > 0.01
    others = np.delete(gradient, side)
    # of the other branch, and of the place of the jump: no more than what rounding is counted by
    np.testing.assert_allclose(others, 0.0, atol=1e-12)


def test_forms_of_an_open_decision_have_no_slope_in_the_place_of_the_jump():
    around = rj.Box([-0.5, -0.25], [0.5, 0.25])
    of = lambda p: size(jumping, around, METHODS["forms"], p)  # noqa: E731
    gradient = np.asarray(jax.grad(of)(GAINS))
    assert gradient[PLACE] == 0.0
    assert np.all(abs(gradient[[BELOW, ABOVE]]) > 0.01)


@pytest.mark.parametrize("x", [-0.5, 0.125, 0.5])
def test_what_is_simulated_has_no_slope_in_the_place_of_the_jump(x):
    loop = lambda p: rj.ClosedLoop(PLANT, rj.Network(Partial(jumping, p), 2, 1))  # noqa: E731
    states = jnp.array([x, 0.25])
    slopes = jax.jacobian(lambda p: loop(p).simulate(states, STEPS)[-1])(GAINS)
    np.testing.assert_array_equal(slopes[:, PLACE], 0.0)
