"""The experiment in continuous time: laws steer, sets hold dense simulations, a wall is seen."""

import json

import numpy as np
import pytest

import reachjax as rj
from experiments.sampled.problems import PROBLEMS, spacecraft
from experiments.sampled.study import DENSE, Settings, main

QUICK = {"samples": 500, "training_steps": 1000, "simulations": 100}


@pytest.mark.parametrize("name", [*PROBLEMS, "docking"])
def test_laws_do_what_is_asked_at_samples(name):
    sampled = spacecraft(0.5) if name == "docking" else PROBLEMS[name]()
    problem = sampled.problem
    n, m = problem.X0.dimension, problem.law(np.zeros((1, problem.X0.dimension))).shape[1]
    loop = sampled.loop([(np.zeros((m, n)), np.zeros(m))])
    x = np.asarray(problem.X0.center)
    runs = [x]
    for _ in range(problem.horizon):
        x = np.asarray(loop.moved(x, loop.projected(problem.law(x[None])[0])))
        runs.append(x)
    runs = np.array(runs)
    assert problem.goal is None or problem.goal.contains(runs[-1])
    assert problem.safe is None or problem.safe.contains(runs).all()
    assert not any(region.contains(runs).any() for region in problem.avoid)
    for (begin, end), region in (sampled.later or {}).items():
        period = float(loop.plant.period)
        assert region.contains(runs[round(begin / period) : round(end / period) + 1]).all()


def test_the_experiment_sees_the_wall_between_two_samples(tmp_path):
    main(Settings(loops=("car",), output=tmp_path, **(QUICK | {"samples": 2000})))
    result = json.loads((tmp_path / "results.json").read_text())["results"]["car"]
    assert result["verdict"] == "REFUTED"
    assert result["at_samples"] == "PROVED"
    samples = result["instant"] / 0.5
    assert abs(samples - round(samples)) > 0.05
    assert result["beyond"] < 1e-9
    assert (tmp_path / "car.png").stat().st_size > 10_000


def test_dense_simulations_meet_samples_and_are_of_the_flow():
    sampled = PROBLEMS["pendulum"]()
    loop = sampled.loop([(np.array([[-9.0, -4.0]]), np.zeros(1))])
    begun = np.asarray(sampled.problem.X0.corners())
    dense, plain = loop.simulate(begun, 3, parts=DENSE), loop.simulate(begun, 3)
    np.testing.assert_allclose(dense[:, ::DENSE], plain, rtol=1e-12)
    again = rj.ClosedLoop(loop.plant.replace(steps=64), loop.controller)
    np.testing.assert_allclose(dense, again.simulate(begun, 3, parts=DENSE), atol=1e-9)


def test_options_are_checked():
    with pytest.raises(ValueError, match="--loops must be some of"):
        Settings(loops=("bicycle",))
    with pytest.raises(ValueError, match="--part must be above 0"):
        Settings(part=0.0)
