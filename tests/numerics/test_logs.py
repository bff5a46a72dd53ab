"""Calls and long compilations are logged under one name, and nothing is printed."""

import logging
import re

import jax
import jax.numpy as jnp
import pytest

import reachjax as rj
from reachjax.numerics import logs
from tests.closed_loops import autonomous

HALVES = autonomous([[0.5]])
X0, SAFE = rj.Box([-1.0], [1.0]), rj.Box([-2.0], [2.0])


@pytest.fixture
def lines(caplog):
    caplog.set_level(logging.INFO, logger="reachjax")

    def said():
        assert {record.name for record in caplog.records} <= {"reachjax"}
        return [record.getMessage() for record in caplog.records]

    return said


@pytest.mark.parametrize(
    ("name", "call"),
    {
        "reach": lambda: rj.reach(HALVES, X0, 1, rj.Template.box(1), samples=10),
        "decide": lambda: rj.decide(HALVES, X0, 1, safe=SAFE, samples=10),
        "winning_set": lambda: rj.winning_set(HALVES, X0, 1, safe=SAFE, cells=2),
        "largest_set": lambda: rj.largest_set(HALVES, X0, 1, safe=SAFE, rounds=1),
    }.items(),
)
def test_a_call_says_when_it_begins_and_ends_and_those_within_it_do_not(name, call, lines, capsys):
    call()
    said = lines()
    assert said[0] == f"{name} begins"
    assert re.fullmatch(rf"{name} ended after \d+\.\d s", said[-1])
    others = [line for line in said[1:-1] if "compile" not in line]
    assert not others
    assert capsys.readouterr() == ("", "")


def test_a_call_that_fails_was_stopped(lines):
    with pytest.raises(ValueError, match="horizon"):
        rj.reach(HALVES, X0, 0, rj.Template.box(1))
    assert lines()[-1].startswith("reach was stopped after")


def test_a_long_compilation_is_said_of_penalties_too(lines, monkeypatch):
    rj.volume_penalty(HALVES, X0, 1, rj.Template.box(1))
    assert not [line for line in lines() if "compile" not in line]  # penalties come by thousands
    jax.eval_shape(lambda X0: rj.volume_penalty(HALVES, X0, 1, rj.Template.box(1)), X0)
    assert any(line.startswith("volume_penalty is traced, and then compiled") for line in lines())
    monkeypatch.setattr(logs, "LONG", 0.0)

    def step_of_training(x):
        return jnp.sin(x) * 17

    jax.jit(step_of_training)(jnp.arange(3.0))
    assert any(re.search(r"compiled .* in \d+\.\d s", line) for line in lines())


def test_whoever_asks_for_nothing_hears_nothing():
    handlers = logging.getLogger("reachjax").handlers
    assert any(isinstance(each, logging.NullHandler) for each in handlers)
