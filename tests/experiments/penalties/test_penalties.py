"""The study of penalties: all ways are trained, judged alike and kept."""

import json
from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.penalties import training
from experiments.penalties.loops import LOOPS
from experiments.penalties.study import Settings, main
from experiments.penalties.training import PENALTIES, Trainer

QUICK = Settings(
    loops=("double integrator",),
    seeds=1,
    pretraining_steps=500,
    seconds=0.2,
    decide=5.0,
    simulations=300,
    workers=1,
)


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    studied = LOOPS["double integrator"]()
    folder = tmp_path_factory.mktemp("penalties")
    samples = studied.samples(folder)
    return studied, samples, studied.networks(samples, 1, 500, folder)[0]


@pytest.mark.parametrize("loop", LOOPS)
def test_compiled_penalties_bound_those_of_samples(loop):
    studied = LOOPS[loop]()
    task, rng = studied.task, np.random.default_rng(0)
    inputs = 5 if loop == "cruise control" else task.loop.states
    widths = inputs, *studied.hidden, task.loop.plant.B.shape[1]
    layers = [
        (jnp.asarray(rng.normal(size=(m, n)) / n), jnp.asarray(rng.normal(size=m)))
        for n, m in pairwise(widths)
    ]
    key = jax.random.key(0)
    by_samples, certified = (
        PENALTIES[name](studied)(layers, key) for name in ("samples", "LinearBounds")
    )
    assert float(certified[0]) >= float(by_samples[0]) * (1 - 1e-9)
    for _, gradient in (by_samples, certified):
        assert all(np.isfinite(part).all() for part in jax.tree.leaves(gradient))
    compiled = jax.jit(PENALTIES["LinearBounds"](studied)).lower(layers, key).compile()
    assert "callback" not in compiled.as_text()  # nothing is asked of the host at each step


@pytest.mark.parametrize("penalty", ["none", "samples", "default"])
def test_a_network_is_trained_and_judged_once(learned, penalty, tmp_path, monkeypatch):
    studied, samples, layers = learned
    trainer = Trainer(studied, samples, QUICK.way(penalty))
    outcome = trainer.run(layers, 0, tmp_path / "0.npz")
    assert outcome.verdict in ("PROVED", "REFUTED", "UNKNOWN")
    assert outcome.steps >= outcome.penalised >= 1
    assert outcome.skipped == 0
    assert np.all(outcome.certified >= outcome.simulated)

    def refuse(*_):
        raise AssertionError("trained again")

    monkeypatch.setattr(training.Trainer, "trained", refuse)
    assert trainer.run(layers, 0, tmp_path / "0.npz").error == outcome.error
    other = Trainer(studied, samples, replace(QUICK.way(penalty), seconds=0.3))
    with pytest.raises(AssertionError, match="trained again"):
        other.run(layers, 0, tmp_path / "0.npz")


@pytest.mark.long
def test_the_command_prints_a_table_and_writes_figure_and_results(tmp_path, capsys):
    main(replace(QUICK, output=tmp_path))
    printed = capsys.readouterr().out
    assert all(name in printed for name in PENALTIES)
    found = json.loads((tmp_path / "results.json").read_text())["outcomes"]
    assert list(found["double integrator"]) == list(PENALTIES)
    assert (tmp_path / "penalties.png").stat().st_size > 10_000
