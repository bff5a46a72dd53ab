"""Verified training: a penalised controller is proved where the plain one is refuted."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments.double_integrator.problem import linear_mpc
from experiments.sampling import sample_policy
from experiments.verified_training import fine_tuning
from experiments.verified_training.fine_tuning import run
from experiments.verified_training.study import Settings, main, ways

DATA = Path(__file__).parents[2] / "data"
SHORT = Settings(steps=24, every=3, simulations=300)


@pytest.fixture(scope="module")
def as_printed():
    """A controller that undershoots, and samples of its teacher."""
    with np.load(DATA / "double_integrator_as_printed.npz") as file:
        layers = [(file[f"W{i}"], file[f"b{i}"]) for i in range(3)]
    return layers, sample_policy(linear_mpc(0.0), 400, 0, progress=False)


def test_the_penalty_turns_a_refuted_controller_into_a_proved_one(as_printed, tmp_path):
    outcomes = {
        way: run(*as_printed, tuning, tmp_path / f"{way}.npz")
        for way, tuning in ways(SHORT).items()
        if way != "volume"
    }
    plain, penalised = outcomes["plain"], outcomes["specification"]
    assert plain.verdict == "REFUTED"
    assert penalised.verdict == "PROVED"
    assert penalised.safe_margin > 0 > plain.safe_margin
    assert penalised.simulated_safe_margin >= penalised.safe_margin
    assert penalised.skipped == 0
    assert np.all(penalised.hulls <= penalised.areas)
    assert penalised.validation_error < 0.02  # of inputs in [-1, 1], after 24 steps only
    assert len(penalised.penalty) == 8
    assert np.all(np.diff(np.array(plain.goals, int)) <= 0)


def test_a_finished_job_is_not_done_again(as_printed, tmp_path, monkeypatch):
    tuning = replace(ways(SHORT)["plain"], steps=2)
    first = run(*as_printed, tuning, tmp_path / "plain.npz")

    def refuse(*_):
        raise AssertionError("trained again")

    monkeypatch.setattr(fine_tuning, "_trained", refuse)
    again = run(*as_printed, tuning, tmp_path / "plain.npz")
    assert again.validation_error == first.validation_error
    np.testing.assert_array_equal(again.layers[0][0], first.layers[0][0])
    np.testing.assert_array_equal(again.areas, first.areas)
    with pytest.raises(AssertionError, match="trained again"):
        run(*as_printed, replace(tuning, learning_rate=0.1), tmp_path / "plain.npz")


@pytest.mark.long
def test_the_command_prints_tables_and_writes_figures_and_results(tmp_path, capsys):
    settings = Settings(
        seeds=1,
        samples=150,
        hidden=(4,),
        pretraining_steps=500,
        steps=2,
        every=1,
        goals=(0.25, 0.1),
        simulations=300,
        workers=1,
        output=tmp_path / "results",
    )
    main(settings)
    printed = capsys.readouterr().out
    for words in ("verdicts", "areas", "half-width", "seconds of a training step"):
        assert words in printed
    results = json.loads((settings.output / "results.json").read_text())
    assert list(results["outcomes"]) == ["plain", "specification", "volume"]
    assert len(results["outcomes"]["volume"][0]["areas"]) == 6
    assert 0 < results["cost"]["solver"] < results["cost"]["forward"]
    assert results["cost"]["both"] < 1.3 * results["cost"]["forward"]  # backward in 0.3 of forward
    assert {path.name for path in settings.output.glob("*.png")} == {"tubes.png", "seeds.png"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seeds": 0}, "--seeds must be finite and at least 1, but 0 arrived"),
        ({"workers": 0}, "--workers must be finite and at least 1, but 0 arrived"),
        ({"every": 0}, "--every must be finite and at least 1, but 0 arrived"),
        ({"volume": -1.0}, r"--volume must be finite and above 0, but -1\.0 arrived"),
        (
            {"learning_rate": float("nan")},
            "--learning-rate must be .* above 0, but nan arrived",
        ),
        (
            {"specification": float("inf")},
            "--specification must be .* above 0, but inf arrived",
        ),
        ({"seed": -1}, "--seed must be finite and at least 0, but -1 arrived"),
        ({"samples": 5}, "--samples must be finite and at least 10"),
        ({"goals": ()}, "--goals must be finite and above 0"),
        ({"goals": (0.1, 0.0)}, "--goals must be finite and above 0"),
        ({"hidden": (10, 0)}, "--hidden must be finite and at least 1"),
        ({"margin": -0.1}, "--margin must be finite and at least 0"),
    ],
)
def test_bad_settings_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        Settings(**options)
