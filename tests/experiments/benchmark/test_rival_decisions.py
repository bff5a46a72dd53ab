"""Verdicts of the library beside those of affine forms and of simulations."""

import dataclasses
import json
import re

import numpy as np
import pytest
from rich.console import Console

import reachjax as rj
from experiments.benchmark import study
from experiments.benchmark.cases import Settings
from experiments.benchmark.rivals import cruise_control, decisions
from experiments.benchmark.rivals.decision_table import DECISIONS_NOTE, decision_table
from experiments.benchmark.rivals.decisions import contradictions, decision_rows, margins, totals
from experiments.benchmark.rivals.procedures import PROCEDURES, Decision

PROVED, REFUTED, UNKNOWN = (
    rj.VerdictStatus.PROVED,
    rj.VerdictStatus.REFUTED,
    rj.VerdictStatus.UNKNOWN,
)
OPTIONS = {"study": "decisions", "simulations": 500, "repetitions": 1, "patience": 100.0}
SETTINGS = Settings(**OPTIONS)
COLUMNS = 80


def following(ahead, horizon=30):
    """As the study has it, over fewer steps."""
    return dataclasses.replace(cruise_control.following(ahead), horizon=horizon)


SETS = {"far": following(-25.0), "near": following(-35.0)}


def decided(method, task):
    return PROCEDURES[method](task, SETTINGS)


@pytest.fixture(scope="module")
def rooms():
    return margins(SETS, SETTINGS)


@pytest.fixture(scope="module")
def rows(rooms):
    """Of all procedures, called in this process."""

    def here(_, *arguments, patience):
        return decisions._calls(*arguments)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(decisions, "from_process", here)
        return [row for name in PROCEDURES for row in decision_rows(name, SETS, rooms, SETTINGS)]


def test_nothing_is_proved_that_a_trajectory_breaks(rows, rooms):
    assert rooms["far"] > 0 > rooms["near"]
    assert not contradictions(rows)
    said = {(row["method"], row["set"]): row["verdict"] for row in rows}
    for name in ("decide", "verify"):
        assert (said[name, "far"], said[name, "near"]) == ("PROVED", "REFUTED")
    assert (said["numpy", "far"], said["numpy", "near"]) == ("PROVED", "UNKNOWN")
    assert (said["samples", "far"], said["samples", "near"]) == ("UNKNOWN", "REFUTED")


def test_an_initial_set_that_is_unsafe_itself_is_not_proved():
    """The lead drives away from it at first, so one step later all is well."""
    task = following(-35.35, horizon=1)
    states = task.simulated(500, 0)
    assert task.margin(states[:, :1]) < 0 < task.margin(states[:, 1:])
    said = {name: decided(name, task).verdict for name in PROCEDURES}
    assert said == {"decide": REFUTED, "verify": REFUTED, "numpy": UNKNOWN, "samples": REFUTED}


def test_a_proof_that_is_broken_or_refuted_is_noticed(rows):
    wrong = [row | {"verdict": "PROVED"} for row in rows if row["method"] == "numpy"]
    assert contradictions(wrong) == ["numpy at near"]
    unseen = [row | {"margin": 1.0} for row in rows if row["method"] == "decide"]
    assert not contradictions(unseen)  # a refutation that simulations do not find
    assert contradictions([*unseen, *wrong]) == ["numpy at near"]
    assert contradictions([*unseen, wrong[1] | {"margin": 1.0}]) == ["numpy at near"]


def test_linear_programs_are_counted_where_they_are_told():
    on_the_edge = cruise_control.following(-30.7)
    assert decided("decide", on_the_edge).verdict is PROVED
    assert decided("decide", on_the_edge).programs > 0
    assert decided("decide", SETS["near"]) == Decision(REFUTED, 0)
    assert decided("verify", SETS["near"]) == Decision(REFUTED, None)
    assert decided("samples", SETS["near"]) == Decision(REFUTED, 0)
    assert decided("numpy", on_the_edge) == Decision(UNKNOWN, 0)


def test_totals_are_sums_over_the_sets_of_a_procedure(rows):
    found = totals(rows)
    assert [row["method"] for row in found] == list(PROCEDURES)
    assert [(row["proved"], row["refuted"]) for row in found] == [(1, 1), (1, 1), (1, 0), (0, 1)]
    for row in found:
        mine = [each for each in rows if each["method"] == row["method"]]
        assert row["seconds"] == pytest.approx(sum(np.median(each["calls"]) for each in mine))
        assert row["first"] == pytest.approx(sum(each["first"] for each in mine))
        assert row["sets"] == 2


def test_the_table_has_a_row_for_each_set_and_procedure_in_eighty_columns(rows):
    late = [row | {"set": "late", "verdict": None, "programs": None} for row in rows[::2]]
    late = [row | {"seconds": np.nan, "first": np.nan, "problem": "it took long"} for row in late]
    console = Console(width=COLUMNS)
    with console.capture() as capture:
        console.print(decision_table([*rows, *late]))
    lines = re.sub(r"\x1b\[[0-9;]*m", "", capture.get()).splitlines()
    assert max(map(len, [*lines, *DECISIONS_NOTE.splitlines()])) <= COLUMNS
    words = [line.split() for line in lines]
    for name in PROCEDURES:
        assert sum(name in each for each in words) == 4  # three sets and the total
    assert sum("proved" in each for each in words) == 3
    assert sum("refuted" in each for each in words) == 3
    assert sum("!" in each for each in words) == len(late)


def test_the_command_prints_one_table_and_writes_its_rows(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(decisions, "AHEAD", (-25.0, -35.0))
    monkeypatch.setattr(study, "PROCEDURES", {"numpy": PROCEDURES["numpy"]})
    study.main(Settings(**OPTIONS, output=tmp_path))
    assert "is the distance kept?" in capsys.readouterr().out
    found = json.loads((tmp_path / "decisions.json").read_text())
    assert [row["set"] for row in found["rows"]] == ["-25 m", "-35 m"]
    assert [row["verdict"] for row in found["rows"]] == ["PROVED", "UNKNOWN"]
    assert [row["margin"] > 0 for row in found["rows"]] == [True, False]
    assert [(row["proved"], row["sets"]) for row in found["totals"]] == [(1, 2)]


def test_a_procedure_that_takes_too_long_has_no_verdict(rooms):
    hasty = Settings(**OPTIONS | {"patience": 1e-3})
    found = decision_rows("decide", SETS, rooms, hasty)
    assert [row["verdict"] for row in found] == [None, None]
    assert all("more than 0.001 seconds" in row["problem"] for row in found)
