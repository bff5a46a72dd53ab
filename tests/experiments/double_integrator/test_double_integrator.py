"""The paper's double integrator: what is proved and refuted, and what the command leaves behind."""

import json
from pathlib import Path

import numpy as np
import pytest

import reachjax as rj
from experiments.analysis import RELAXATIONS
from experiments.double_integrator.problem import INITIAL_BOX
from experiments.double_integrator.study import Settings, certify, main
from experiments.imitation import Fit

DATA = Path(__file__).parents[2] / "data"


def trained(name):
    """A controller that the experiment trained with its default settings."""
    with np.load(DATA / f"double_integrator_{name}.npz") as file:
        layers = [(file[f"W{i}"], file[f"b{i}"]) for i in range(3)]
    return Fit(layers, np.nan, np.nan)


@pytest.mark.parametrize("relaxation", RELAXATIONS)
def test_the_controller_with_a_margin_is_proved(relaxation):
    analysis = certify("with margin", trained("with_margin"), relaxation, Settings())
    assert analysis.verdict.status is rj.VerdictStatus.PROVED
    assert np.nanmin(analysis.verdict.margins["goal"]) > 0.1
    assert np.nanmin(analysis.verdict.margins["safe"]) > 0.1
    for t in range(1, 7):
        assert np.all(analysis.tube.sets[t].contains(analysis.states[:, t]))


def test_the_controller_as_printed_is_refuted_by_a_trajectory_below_the_constraint():
    analysis = certify("as printed", trained("as_printed"), "local-bounds", Settings())
    assert analysis.verdict.status is rj.VerdictStatus.REFUTED
    example = analysis.verdict.counterexample
    assert example.requirement == "safe"
    assert example.states[example.time, 1] < -1.001
    assert np.all(example.states[0] >= INITIAL_BOX[0])
    assert np.all(example.states[0] <= INITIAL_BOX[1])


def test_the_command_writes_everything_and_uses_the_networks_again(tmp_path, capsys):
    settings = Settings(
        horizon=2,
        facets=5,
        relaxation=("local-bounds",),
        samples=150,
        hidden=(4,),
        training_steps=500,
        simulations=300,
        output=tmp_path / "results",
    )
    main(settings)
    first = capsys.readouterr().out
    assert "verdicts" in first
    written = {str(p.relative_to(settings.output)) for p in settings.output.rglob("*.*")}
    folders = [
        f"{name}/{part}.npz"
        for name in ("as_printed", "with_margin")
        for part in ("samples", "weights")
    ]
    assert written == {"tubes.png", "results.json", *folders}
    results = json.loads((settings.output / "results.json").read_text())
    assert [analysis["controller"] for analysis in results["analyses"]] == [
        "as printed",
        "with margin",
    ]
    assert all(len(analysis["steps"]) == 2 for analysis in results["analyses"])

    before = {path: path.stat().st_mtime_ns for path in settings.output.rglob("*.npz")}
    main(settings)
    assert before == {path: path.stat().st_mtime_ns for path in settings.output.rglob("*.npz")}
