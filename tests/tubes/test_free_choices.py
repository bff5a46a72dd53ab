"""Whoever may take any of some options: all sequences of choices are in the sets, the worst too.

Numbers are small multiples of powers of two, so that trajectories are exact fractions.
"""

import itertools
from fractions import Fraction

import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.loops.scenarios import Runs
from reachjax.methods.cells import Cells
from reachjax.verdicts.counterexamples import SUSPECTS, counterexample, suspects
from reachjax.verdicts.specification import requirements

STEPS = 3
OPTIONS = np.array([[0.0, -0.25], [0.125, 0.0], [0.0, 0.5]])
A, B, K = np.array([[1.0, 0.375], [0.0, 1.0]]), np.array([[0.0], [0.25]]), np.array([[-0.5, -0.75]])
X0 = rj.Box([-0.5, -0.375], [0.375, 0.5])
ANY = rj.Box(np.zeros(3), np.ones(3))
METHODS = {
    "forms": rj.LinearBounds(),
    "branches": rj.BranchAndCut(),
    "forms along ways": Cells(most=3),
}
DIRECTIONS = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, -1.0]])


def loop_of(W=ANY):
    plant = rj.NonlinearPlant(
        lambda x, u, w: A @ x + B @ u + rj.one_of(OPTIONS, w), 2, 1, disturbances=3
    )
    return rj.ClosedLoop(plant, rj.MLP.from_layers([(K, [0.0])]), disturbance=W)


def fractions(values):
    return np.vectorize(Fraction, otypes=[object])(np.asarray(values))


def reached(steps):
    """Exact states after every sequence of choices, from all corners."""
    closed, options = fractions(A + B @ K), fractions(OPTIONS)
    states = fractions(X0.corners())
    for _ in range(steps):
        states = np.concatenate([states @ closed.T + option for option in options])
    return states


TIED = rj.Box(np.zeros(3), np.zeros(3))


@pytest.mark.parametrize(
    ("name", "W"), [*((name, ANY) for name in METHODS), ("forms", TIED), ("forms along ways", TIED)]
)
def test_every_sequence_of_choices_is_in_the_sets(name, W):
    relaxation = METHODS[name]
    tube = rj.reach(loop_of(W), X0, STEPS, rj.Template(DIRECTIONS), relaxation=relaxation)
    for t in range(1, STEPS + 1):
        rows, limits = map(fractions, tube.sets[t].facets)
        assert np.all((reached(t) @ rows.T).max(axis=0) <= limits)


def test_bounds_are_those_of_the_worst_choices_and_are_attained():
    tube = rj.reach(loop_of(), X0, STEPS, rj.Template(DIRECTIONS))
    for t in range(1, STEPS + 1):
        worst = (reached(t) @ fractions(DIRECTIONS).T).max(axis=0).astype(float)
        np.testing.assert_allclose(tube.sets[t].b, worst, atol=1e-9)
        assert np.all(tube.certificates[t].gaps <= 1e-4)
        assert {status.name for status in tube.certificates[t].statuses} == {"SOLVED"}


@pytest.mark.parametrize("row", DIRECTIONS, ids=str)
def test_goals_are_proved_beside_the_worst_choice_and_refuted_within(row):
    loop, worst = loop_of(), float((reached(STEPS) @ fractions(row)).max())
    for by, status in ((1e-5, "PROVED"), (-1e-5, "REFUTED")):
        goal = rj.Polytope([row], [worst + by])
        verdict = rj.decide(loop, X0, STEPS, goal=goal)
        assert verdict.status.name == status
    assert verdict.counterexample.decision > 0  # no tie
    states = np.asarray(verdict.counterexample.states)
    again = loop.simulate(states[0], STEPS, disturbances=verdict.counterexample.disturbances)
    np.testing.assert_allclose(again, states, atol=1e-12)
    assert states[-1] @ row > worst - 1e-5


def test_options_that_never_win_are_not_taken():
    never = rj.Box([0.0, 0.0, -1.0], [1.0, 1.0, -0.5])
    tube = rj.reach(loop_of(never), X0, 1, rj.Template(DIRECTIONS))
    closed = X0.corners() @ (A + B @ K).T
    worst = np.max([(closed + option) @ DIRECTIONS.T for option in OPTIONS[:2]], axis=(0, 1))
    np.testing.assert_allclose(tube.sets[1].b, worst, atol=1e-9)


def test_numbers_times_decisions_are_bounded_exactly():
    """`s x_1`, where `s` is whether `x_0` is above zero: the larger of what both sides have."""
    plant = rj.NonlinearPlant(lambda x, u: jnp.append(x[0], (x[0] > 0) * x[1]), 2, 1)
    loop = rj.ClosedLoop(plant, rj.MLP.from_layers([([[0.0, 0.0]], [0.0])]))
    rows = np.array([[1.0, 1.0], [-1.0, 1.0], [0.0, 1.0], [0.0, -1.0], [2.0, -1.0], [-1.0, -3.0]])
    box = rj.Box([-1.0, -1.0], [1.0, 2.0])
    corners = itertools.product((0.0, 1.0), (-1.0, 2.0))  # where s is one, closed; else (x_0, 0)
    points = np.array([*corners, (-1.0, 0.0), (0.0, 0.0)])
    tube = rj.reach(loop, box, 1, rj.Template(rows), gap=1e-6)
    np.testing.assert_allclose(tube.sets[1].b, (points @ rows.T).max(axis=0), atol=1e-7)


def test_a_choice_that_is_clear_is_examined_before_many_that_are_tied():
    plant = rj.NonlinearPlant(
        lambda x, u, w: x + u + rj.one_of([[1.0], [-1.0]], w), 1, 1, disturbances=2
    )
    law, box = rj.MLP.from_layers([([[0.0]], [0.0])]), rj.Box([0.0], [0.125])
    loop = rj.ClosedLoop(plant, law, disturbance=rj.Box(np.zeros(2), np.ones(2)))
    tied, clear = np.array([0.125, 1.0, 1.0]), np.array([0.0625, 1.0, 0.0])
    scenarios = np.stack([*[tied] * (2 * SUSPECTS), clear])
    states = np.stack([[[x], [x + 1.0]] for x in scenarios[:, 0]])  # of a tie the first wins
    (item,) = [
        each for each in requirements(1, 1, None, safe=rj.Box([-2.0], [0.5])) if each.time == 1
    ]
    runs = Runs(scenarios, states)
    found = suspects(loop, item, 0.5 - states[:, 1, 0], runs)
    example = counterexample(loop, box, found, 0)
    assert example is not None
    assert example.decision == 1.0
    np.testing.assert_array_equal(example.disturbances, [[1.0, 0.0]])
    assert counterexample(loop, box, found[:SUSPECTS], 0) is None
