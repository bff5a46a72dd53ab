"""The experiment of nonlinear loops: sets hold samples, laws do what is asked, training proves."""

import json

import numpy as np
import pytest

import reachjax as rj
from experiments.nonlinear.problems import PROBLEMS, pendulum
from experiments.nonlinear.study import GOAL, WEAK, Settings, learned, main
from experiments.nonlinear.training import trained_on

QUICK = {"samples": 500, "training_steps": 500, "simulations": 300}


@pytest.mark.parametrize("name", PROBLEMS)
def test_laws_steer_their_plants(name):
    problem = PROBLEMS[name]()
    states = problem.samples(50, 0).states
    inputs = problem.law(states)
    assert inputs.shape == (50, 1)
    n, m = states.shape[1], inputs.shape[1]
    loop = problem.closed(problem.network([(np.zeros((m, n)), np.zeros(m))]))
    assert loop.states == n == problem.X0.dimension
    assert loop.is_disturbed == (name == "oscillator")
    # the law itself, not a network, does what is asked from the middle of the initial set
    x = np.asarray(problem.X0.center)
    runs = [x]
    for _ in range(problem.horizon):
        x = np.asarray(loop.moved(x, loop.projected(problem.law(x[None])[0])))
        runs.append(x)
    runs = np.array(runs)
    assert problem.goal is None or problem.goal.contains(runs[-1])
    assert problem.safe is None or problem.safe.contains(runs).all()
    assert not any(region.contains(runs).any() for region in problem.avoid)


def test_the_experiment_writes_what_it_finds(tmp_path):
    main(Settings(loops=("oscillator",), steps=1, output=tmp_path, **QUICK))
    results = json.loads((tmp_path / "results.json").read_text())["results"]
    assert list(results) == ["oscillator", "weak", "trained"]
    for result in results.values():
        assert max(result["beyond"].values()) < 1e-12
        assert min(result["volumes"].values()) > 1 - 1e-12
    for name in ("oscillator", "training"):
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000


def test_training_proves_what_was_not(tmp_path):
    settings = Settings(output=tmp_path, **(QUICK | {"training_steps": 2000}))
    problem = pendulum(GOAL, WEAK)
    layers = learned(problem, "weak", settings)
    trained = trained_on(problem, layers, problem.samples(500, 1), 60, progress=False)
    assert trained.shortfalls[0] > 0
    assert trained.shortfalls[-1] == 0
    before, after = (
        rj.decide(task.loop, task.X0, task.horizon, **task.required)
        for task in map(problem.task, (layers, trained.layers))
    )
    assert before.status is not rj.VerdictStatus.PROVED
    assert after.status is rj.VerdictStatus.PROVED


def test_options_are_checked():
    with pytest.raises(ValueError, match="--loops must be some of"):
        Settings(loops=("bicycle",))
    with pytest.raises(ValueError, match="--steps must be finite and at least 1"):
        Settings(steps=0)
