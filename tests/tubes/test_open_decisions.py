"""Verdicts name decisions that stay open; those of a counterexample win by more than rounding."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.numerics.budget import Budget
from reachjax.verdicts.cell_tasks import CellTask, outcome_of
from reachjax.verdicts.specification import requirements

STILL = rj.MLP.from_layers([([[0.0]], [0.0])])


def straight(x, u):
    return jnp.where(x > 0.0, 1.0, -1.0) + u


def bent(x, u):
    return jnp.where(x > 0.0, 1.0, -1.0) + u + 0.01 * jnp.sin(x)


def best(x, u):
    scores = jnp.stack([x[0], -x[0], x[0] - 1.0])
    return jnp.array([1.0, -1.0, 0.0])[jnp.argmax(scores)] + u


def loop_of(plant):
    return rj.ClosedLoop(rj.NonlinearPlant(plant, states=1, inputs=1), STILL)


SAFE = rj.Box([-0.5], [2.0])


@pytest.mark.parametrize("plant", [straight, bent, best])
def test_a_tie_refutes_nothing_and_is_named(plant):
    verdict = rj.decide(loop_of(plant), rj.Box([0.0], [0.0]), 1, safe=SAFE)
    assert verdict.unknown
    (first, *_) = verdict.decisions
    assert (first.time, first.room) == (0, pytest.approx(0.0, abs=1e-12))
    assert plant.__name__ in first.line
    assert "test_open_decisions.py" in first.line
    assert f"stay open; widest at t = 0{first.line}" in str(verdict)


@pytest.mark.parametrize("plant", [straight, bent, best])
def test_the_closest_decision_of_a_counterexample_is_shown(plant):
    verdict = rj.decide(loop_of(plant), rj.Box([-0.5], [-0.25]), 1, safe=SAFE)
    assert verdict.refuted
    example = verdict.counterexample
    size = abs(float(example.states[0, 0]))
    assert example.decision == pytest.approx(2 * size if plant is best else size)
    assert f"its closest decision wins by {example.decision:.3g}" in str(verdict)


@pytest.mark.parametrize("plant", [straight, bent, best])
def test_what_holds_on_both_sides_is_proved_across_the_surface(plant):
    wide = rj.Box([-1.5], [1.5])
    verdict = rj.decide(loop_of(plant), rj.Box([-1.0], [1.0]), 3, safe=wide)
    assert verdict.proved
    assert "stay open" not in str(verdict)


def test_a_cell_is_halved_along_what_decides():
    def plant(x, u):
        after = jnp.where(x[1] > 0.0, 1.0, -1.0) + u[0]
        return jnp.stack([x[0] + 0.1 * jnp.sin(x[0]), after])

    still = rj.MLP.from_layers([([[0.0, 0.0]], [0.0])])
    loop = rj.ClosedLoop(rj.NonlinearPlant(plant, states=2, inputs=1), still)
    goal, X0 = rj.Box([-3.0, -0.5], [3.0, 2.0]), rj.Box([-1.0, -1.0], [1.0, 1.0])
    task = CellTask(jax.device_get(loop), 1, 0, tuple(requirements(2, 1, goal=goal)), nodes=0)
    outcome = outcome_of(task, jax.device_get(X0), Budget())
    assert not outcome.proved
    assert outcome.axis == 1


def test_a_loop_without_jumps_has_no_decisions():
    loop = loop_of(lambda x, u: x + 1.0 + u)
    verdict = rj.decide(loop, rj.Box([0.0], [1.0]), 2, safe=SAFE)
    assert verdict.refuted
    assert verdict.counterexample.decision is None
    assert verdict.decisions == ()


def test_gaps_between_the_sides_are_seen_by_cells():
    loop, X0 = loop_of(bent), rj.Box([-1.0], [1.0])
    verdict = rj.decide(loop, X0, 1, avoid={1: [rj.Box([-0.9], [0.9])]})
    assert verdict.proved
    tube = rj.reach(loop, X0, 1, rj.Template.box(1))
    assert np.all(np.asarray(tube.sets[1].bounding_box().widths) > 1.9)
