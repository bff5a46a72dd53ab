"""The study of training until proved: laws do what is asked, runs are kept and judged alike."""

import json
from dataclasses import replace

import numpy as np
import pytest

from experiments.certified_training import figures, study
from experiments.certified_training.problems import (
    PROBLEMS,
    fingerprint,
    least_room,
    margin,
    under_law,
)
from experiments.certified_training.study import GIVEN, WAYS, Outcome, Settings, main

QUICK = Settings(
    only=("cruise control",),
    ways=("plain", "forms"),
    seeds=1,
    sized=1,
    pretraining_steps=500,
    seconds=3.0,
    decide=5.0,
    growing=1.0,
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


@pytest.mark.parametrize("name", PROBLEMS)
def test_margins_are_within_the_room_of_the_law(name):
    problem = PROBLEMS[name]()
    assert 0 < margin(problem) <= 0.2 * least_room(problem)
    states = under_law(problem)
    if problem.safe is not None:
        C, d = (np.asarray(part) for part in problem.safe.facets)
        rooms = (d - states @ C.T) / np.linalg.norm(C, axis=1)
        assert margin(problem) <= 0.2 * rooms.min() * (1 + 1e-9)


def test_a_problem_is_told_from_another_one():
    problem = PROBLEMS["navigation"]()
    assert fingerprint(problem) == fingerprint(PROBLEMS["navigation"]())
    others = (replace(problem, horizon=29), replace(problem, goal=None), replace(problem, avoid=()))
    found = {fingerprint(each) for each in (problem, *others, PROBLEMS["cruise control"]())}
    assert len(found) == 5


def outcome(**given):
    known = {"verdict": "PROVED", "error": 1.0, "decision": "PROVED", "cells": 7, "proved": 7}
    clocks = {"deciding": 2.0, "first": 3.0, "compiling": 4.0, "training": 5.0, "steps": 10}
    return Outcome(**(known | clocks | {"volume": 1.0} | given))


def test_cells_are_those_of_decisions_that_prove():
    unknown = {"verdict": "UNKNOWN", "decision": "UNKNOWN", "cells": 900, "first": np.nan}
    group = {
        "plain": [outcome(), outcome(volume=0.0)],
        "forms": [outcome(volume=3.0), outcome(**unknown)],
        "samples": [outcome(**unknown), outcome(decision="UNKNOWN", cells=800)],
    }
    columns = {column.header: list(column.cells) for column in figures.table("", group).columns}
    assert columns["P/R/U"] == ["2/0/0", "1/0/1", "1/0/1"]
    assert columns["cells"] == ["7", "7", "-"]
    assert columns["first"] == ["7", "7", "7"]
    assert columns["box"] == ["1.00", "3.00", "1.00"]


def test_networks_are_trained_judged_and_kept(tmp_path, capsys, monkeypatch):
    settings = replace(QUICK, output=tmp_path)
    main(settings)
    printed = capsys.readouterr().out
    assert all(name in printed for name in QUICK.ways)
    found = json.loads((tmp_path / "results.json").read_text())["outcomes"]["cruise control"]
    assert list(found) == [GIVEN, *QUICK.ways]
    assert found["plain"][0]["volume"] >= 0
    assert (tmp_path / "certified_training.png").stat().st_size > 10_000

    def refuse(*_):
        raise AssertionError("trained again")

    monkeypatch.setattr(study.Study, "_trained", refuse)
    main(settings)
    other = study.collected(settings, {})  # as a process does that runs another loop
    assert list(other) == ["cruise control"]
    assert study.collected(replace(settings, seeds=2), {}) == {}
    with pytest.raises(AssertionError, match="trained again"):
        main(replace(settings, seconds=4.0))


def test_options_are_checked():
    with pytest.raises(ValueError, match="--only must be some of"):
        Settings(only=("bicycle",))
    with pytest.raises(ValueError, match="--ways must be some of"):
        Settings(ways=())
    with pytest.raises(ValueError, match="--seconds must be"):
        Settings(seconds=0.0)
    assert {GIVEN, *WAYS} == set(figures.COLOURS)
