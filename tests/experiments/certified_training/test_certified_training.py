"""The study of training until proved: laws do what is asked, runs are kept and judged alike."""

import json
from dataclasses import replace

import numpy as np
import pytest

from experiments.certified_training import study
from experiments.certified_training.problems import PROBLEMS, under_law
from experiments.certified_training.study import WAYS, Settings, main

QUICK = Settings(
    only=("cruise control",),
    ways=("plain", "forms"),
    seeds=1,
    pretraining_steps=500,
    seconds=3.0,
    decide=5.0,
    samples=1000,
)


@pytest.mark.parametrize("name", PROBLEMS)
def test_laws_do_what_is_asked_at_samples(name):
    problem = PROBLEMS[name]()
    states = under_law(problem)
    assert problem.goal is None or problem.goal.contains(states[:, -1]).all()
    assert problem.safe is None or problem.safe.contains(states.reshape(-1, states.shape[2])).all()
    flat = states.reshape(-1, states.shape[2])
    assert not any(np.asarray(region.contains(flat)).any() for region in problem.avoid)


def test_networks_are_trained_judged_and_kept(tmp_path, capsys, monkeypatch):
    settings = replace(QUICK, output=tmp_path)
    main(settings)
    printed = capsys.readouterr().out
    assert all(name in printed for name in QUICK.ways)
    found = json.loads((tmp_path / "results.json").read_text())["outcomes"]["cruise control"]
    assert list(found) == list(QUICK.ways)
    assert (tmp_path / "certified_training.png").stat().st_size > 10_000

    def refuse(*_):
        raise AssertionError("trained again")

    monkeypatch.setattr(study.Study, "_trained", refuse)
    main(settings)
    with pytest.raises(AssertionError, match="trained again"):
        main(replace(settings, seconds=4.0))


def test_options_are_checked():
    with pytest.raises(ValueError, match="--only must be some of"):
        Settings(only=("bicycle",))
    with pytest.raises(ValueError, match="--ways must be some of"):
        Settings(ways=())
    with pytest.raises(ValueError, match="--seconds must be"):
        Settings(seconds=0.0)
    assert set(WAYS) == set(study.figures.COLOURS)
