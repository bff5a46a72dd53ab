"""The study of tightness: ratios are over the tightest sets, no bound is below what is known."""

import csv
import re
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

import reachjax as rj
from experiments.tightness import cases, methods, study
from experiments.tightness.cases import Group, Settings, groups
from experiments.tightness.figures import NOTE, STYLES, table
from experiments.tightness.methods import METHODS, Measurement, chosen
from experiments.tightness.reference import Reference, Result

COLUMNS = 80
NAMES = ("local, no lambda", "grid of cells")
QUICK = {"loops": ("tiny",), "methods": NAMES, "horizon": 2, "seeds": 1, "samples": 100}


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    return Settings(**QUICK, repetitions=0, output=tmp_path_factory.mktemp("tightness"))


@pytest.fixture(scope="module")
def results(settings):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cases, "TINY", (2, 3, 1))
        return study.study(settings)


def written(results):
    console = Console(width=COLUMNS)
    with console.capture() as capture:
        console.print(table(results))
    return re.sub(r"\x1b\[[0-9;]*m", "", capture.get())


def test_exact_maxima_lie_between_witnesses_and_bounds(results):
    (result,) = results
    assert result.reference.exact
    for each in result.measured.values():
        assert np.all(result.reference.values >= each.witnesses)
        assert np.all(each.bounds >= result.reference.values - 1e-9)
    assert result.sound


def test_cells_are_tighter_than_one_set_and_never_tighter_than_exact(results):
    (result,) = results
    loose, tight = (result.excess(name) for name in NAMES)
    assert loose.shape == (1, 2)
    assert np.all(tight >= -1e-9)
    assert np.all(tight <= loose + 1e-6)
    assert tight[0, -1] < loose[0, -1] / 2


def unsound(result):
    lower = {
        name: replace(each, bounds=each.bounds - 1e-2 * abs(each.bounds))
        for name, each in result.measured.items()
    }
    return replace(result, measured=lower)


def test_a_bound_below_a_value_that_is_attained_fails_the_study(
    results, settings, tmp_path, monkeypatch, capsys
):
    wrong = unsound(results[0])
    assert not wrong.sound
    assert "NOT SOUND" in written(wrong)
    monkeypatch.setattr(study, "study", lambda settings: [wrong])
    with pytest.raises(SystemExit, match="bounds are below values that are attained"):
        study.main(replace(settings, output=tmp_path))


def test_a_bound_that_is_no_number_is_no_sound_one(results):
    (result,) = results
    first = result.measured[NAMES[0]]
    nothing = replace(first, bounds=np.full_like(first.bounds, np.nan))
    assert not replace(result, measured={NAMES[0]: nothing}).sound


def test_the_command_measures_once_and_writes_rows_and_figures(
    results, settings, monkeypatch, capsys
):
    def refuse(*_):
        raise AssertionError("what is stored was not used")

    monkeypatch.setattr(cases, "TINY", (2, 3, 1))
    monkeypatch.setattr(methods, "repeated", refuse)
    study.main(settings)
    assert max(map(len, written(results[0]).splitlines())) <= COLUMNS
    assert "random 2-3-1" in capsys.readouterr().out

    with (settings.output / "tightness.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["method"], row["t"]) for row in rows] == [(n, t) for n in NAMES for t in "12"]
    ratios = 1 + np.concatenate([results[0].excess(name)[0] for name in NAMES])
    np.testing.assert_allclose([float(row["ratio"]) for row in rows], ratios)
    for kind, begin in (("png", b"\x89PNG"), ("pdf", b"%PDF")):
        assert (settings.output / f"tightness.{kind}").read_bytes().startswith(begin)


def test_in_space_the_worst_width_counts():
    template = rj.Template.box(3)
    group = Group("box", (), rj.Box(-np.ones(3), np.ones(3)), template, 1)
    tightest = np.ones((1, 1, 6))
    bounds = tightest + 0.5 * (np.asarray(template.directions)[:, 1] > 0)
    measured = Measurement(bounds, tightest, np.ones(1), 1.0)
    assert Reference(tightest, False).excess(measured, group) == pytest.approx(0.25)
    result = Result(group, {"paper": measured}, Reference(tightest, False))
    assert result.slacks() == {"paper": 0.0}
    assert result.sound


def test_every_method_has_a_style_and_the_note_fits():
    assert list(STYLES) == list(METHODS)
    assert all(len(line) <= COLUMNS for line in NOTE.splitlines())


def test_what_is_asked_for_is_checked():
    with pytest.raises(ValueError, match=r"--methods must be of paper, .* but 'papre' arrived"):
        chosen(Settings(methods=("papre",)))
    with pytest.raises(ValueError, match="--seeds must be finite and at least 1"):
        Settings(seeds=0)
    with pytest.raises(ValueError, match="--patience must be finite and at least 0"):
        Settings(patience=-1.0)


def test_random_networks_have_the_sizes_asked_for():
    made = groups(Settings(loops=("random",), widths=(3, 5), seeds=2))
    assert [group.name for group in made] == ["random 2x3", "random 2x5"]
    for width, group in zip((3, 5), made, strict=True):
        assert len(group.loops) == 2
        shapes = [W.shape for W, _ in group.loops[0].controller.layers]
        assert shapes == [(width, 2), (width, width), (1, width)]
