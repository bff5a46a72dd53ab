"""Verdicts of the library beside those of affine forms and of simulations."""

import dataclasses
import json
import re

import pytest

from experiments.benchmark import study
from experiments.benchmark.cases import Settings
from experiments.benchmark.rivals import cruise_control, decisions

OPTIONS = {"study": "decisions", "simulations": 500, "repetitions": 0, "patience": 100.0}
SETTINGS = Settings(**OPTIONS)


@pytest.fixture(scope="module")
def sets():
    """One from which the distance is kept, and one from which it is not."""
    return {ahead: cruise_control.following(ahead) for ahead in (-25.0, -45.0)}


def test_what_methods_say_agrees_with_what_simulations_show(sets):
    safe, unsafe = decisions.margins(sets, SETTINGS).values()
    assert safe > 0 > unsafe
    said = {
        name: [method(task, SETTINGS) for task in sets.values()]
        for name, method in decisions.METHODS.items()
    }
    assert said["decide"] == said["verify"] == ["proved", "refuted"]
    assert said["numpy"] == ["proved", "-"]
    assert said["samples"] == ["-", "refuted"]


def test_an_initial_set_that_is_unsafe_itself_is_not_proved():
    """The lead drives away from it at first, so one step later all is well."""
    task = dataclasses.replace(cruise_control.following(-35.35), horizon=1)
    rooms = task.margin(task.simulated(500, 0)[:, :1]), task.margin(task.simulated(500, 0)[:, 1:])
    assert rooms[0] < 0 < rooms[1]
    said = {name: method(task, SETTINGS) for name, method in decisions.METHODS.items()}
    assert said == {"decide": "refuted", "verify": "refuted", "numpy": "-", "samples": "refuted"}


def test_the_command_prints_one_table_and_writes_its_rows(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(decisions, "AHEAD", (-25.0, -45.0))
    monkeypatch.setattr(decisions, "METHODS", {"numpy": decisions.by_numpy})
    study.main(Settings(**OPTIONS, output=tmp_path))
    shown = capsys.readouterr().out
    assert re.search(r"numpy +proved +- ", shown)
    written = json.loads((tmp_path / "decisions.json").read_text())
    assert [row["answers"] for row in written["rows"]] == [{"-25": "proved", "-45": "-"}]
    assert [seen["room"] > 0 for seen in written["simulated"]] == [True, False]


def test_a_method_that_takes_too_long_says_nothing(sets):
    hasty = Settings(**OPTIONS | {"patience": 1e-3})
    assert decisions.row("decide", sets, hasty)["answers"] == {"-25": "?", "-45": "?"}
