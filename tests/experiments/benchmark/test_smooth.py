"""Smooth loops beside what is asked of them: rows in processes of their own, kept, in a table."""

import json
import pickle
import re
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

import reachjax as rj
from experiments.benchmark import study
from experiments.benchmark.cases import Settings
from experiments.benchmark.smooth import decisions, forms, loops, run, training, widths
from experiments.benchmark.smooth.rows import MEMORY, Row, kept
from experiments.competition import fields
from experiments.competition.instances import instances

COLUMNS = 100
QUICK = Settings(study="smooth", simulations=50, repetitions=1, training_steps=10)


def told(settings):
    """Figures, one after the other."""
    yield {"width": 1.1, "verdict": "PROVED"}
    yield {"seconds": 2.0 * settings.repetitions}


def broken(settings):
    """A first figure, and an error."""
    yield {"width": 1.1}
    raise RuntimeError("this row cannot be measured")


ASKED = {"verdict": "PROVED", "width": 1.0, "seconds": None}
STAND_INS = (
    Row("first", "one that is measured", ASKED, told),
    Row("second", "one that fails", ASKED, broken),
    Row("third", "one without its network", ASKED, told, (loops.SINGLE,)),
)


def figures(row, settings=QUICK):
    """All that a row's function finds, here."""
    found = {}
    for each in row.measure(settings):
        found |= each
    return found


def named(title):
    (row,) = (row for row in run.ROWS if row.title == title)
    return row


def test_rows_have_different_titles_and_read_networks_that_instances_name():
    titles = [row.title for row in run.ROWS]
    assert len(set(titles)) == len(titles)
    assert {title for row in run.ROWS for title in row.networks} <= set(instances())


def test_figures_are_compared_as_they_are_shown():
    assert kept(1.13, 1.1349)
    assert not kept(1.13, 1.136)
    assert not kept(1.13, float("nan"))
    assert not kept("REFUTED", "UNKNOWN")
    assert not kept(2.0, "UNKNOWN")
    assert kept(None, 1e9) is None
    assert kept(1.0, None) is None


def test_loops_are_named_and_others_are_an_error():
    assert [row.loop for row in run.rows_of(replace(QUICK, loops=("second",)), STAND_INS)] == [
        "second"
    ]
    with pytest.raises(ValueError, match=r"--loops must be some of first, second, third, but"):
        run.rows_of(replace(QUICK, loops=("fourth",)), STAND_INS)
    with pytest.raises(ValueError, match="--folder must be a folder"):
        Settings(study="smooth", folder=QUICK.output / "missing")


def test_rows_without_their_networks_are_left_out_with_a_word(tmp_path):
    for folder, why in ((None, "no --folder is given"), (tmp_path, "has none of")):
        there, missing = run.available(STAND_INS, folder)
        assert [row.loop for row in there] == ["first", "second"]
        (words,) = missing
        assert words.startswith("third: one without its network is left out")
        assert why in words


@pytest.mark.costly
def test_rows_are_measured_in_processes_kept_and_tabled(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(study, "rows_of", lambda settings: list(STAND_INS))
    settings = replace(QUICK, output=tmp_path)
    study.main(settings)
    assert "third: one without its network" in capsys.readouterr().out
    one, other = json.loads((tmp_path / "smooth.json").read_text())["rows"]
    assert one["found"].pop(MEMORY) > 0.05
    assert one["found"] == {"width": 1.1, "verdict": "PROVED", "seconds": 2.0}
    assert other["found"] == {"width": 1.1}
    assert "exit code 1" in other["stopped"]

    console = Console(width=COLUMNS, record=True)
    with console.capture() as capture:
        console.print(run.smooth_table([one, other]))
    lines = re.sub(r"\x1b\[[0-9;]*m", "", capture.get()).splitlines()
    assert any(re.search(r"verdict +PROVED +PROVED *$", line) for line in lines)
    assert any(re.search(r"width +<= 1 +1\.1 +! *$", line) for line in lines)
    assert any(re.search(r"verdict +PROVED +- +! *$", line) for line in lines)

    again = []

    def refuse(row, settings):
        again.append(row.loop)
        return other

    monkeypatch.setattr(study, "record", refuse)
    study.main(settings)
    assert again == ["second"]  # what failed is measured again, and nothing else


@pytest.mark.costly
def test_products_of_factors_of_unlike_sizes_are_bounded_alike():
    found = figures(named("products: (sin x1 / s) (s sin x2) on [0, 1]^2"))
    assert list(found) == [forms._of_scale(s) for s in forms.SCALES]
    assert all(1 - 1e-9 <= each <= 1.13 for each in found.values())


@pytest.mark.costly
def test_a_penalty_that_is_compiled_is_that_of_certified_sets():
    found = {}
    lesson = replace(training.pendulum("Euler", QUICK), horizon=3)
    for each in training.jitted(lambda _: lesson, QUICK):
        found |= each
    assert found["penalty"] > 0
    assert found["gradient"] > 0
    assert found["off the certified"] < 1e-9
    assert found["first, s"] == pytest.approx(found["compilation, s"] + found["ms"] / 1000)


def test_a_loop_at_samples_moves_as_its_differential_equation():
    net = rj.MLP.from_layers([([[-1.0, -0.5]], [0.1])])
    loop = rj.ClosedLoop(rj.SampledPlant(loops.swing, 2, 1, 0.05), net)
    x, u = np.array([0.4, -0.2]), np.array([0.3])
    found = loops.at_samples(loop).plant.propagate(x, u)
    np.testing.assert_allclose(found, loop.plant.propagate(x, u), atol=1e-8)
    assert not loops.at_samples(loop).plant.continuous


def test_widths_are_compared_where_something_moves():
    certified, attained = np.array([1.0, 3.0, 1.0]), np.array([1.0, 2.0, 0.0])
    assert widths.ratio(certified, attained) == 1.5
    states = widths.drawn(rj.Box([0.0, 1.0], [1.0, 1.0]), 5)
    assert states.shape == (7, 2)
    assert (states[:, 1] == 1.0).all()


def test_spans_hold_dense_samples_and_are_hardly_larger():
    plant = rj.SampledPlant.affine([[0.0, 1.0], [-1.0, 0.0]], [[0.0], [1.0]], period=0.2)
    loop = rj.ClosedLoop(plant, rj.MLP.from_layers([([[0.0, -0.5]], [0.0])]))
    X0 = rj.Box([0.5, -0.1], [0.7, 0.1])
    tube = rj.reach(loop, X0, 3, rj.Template.box(2), rj.LinearBounds())
    runs = np.asarray(loop.simulate(widths.drawn(X0, 10), 3, parts=widths.DENSE))
    assert 1 - 1e-6 <= widths.span_volumes(tube, runs, widths.DENSE) <= 1.1
    assert 1 - 1e-6 <= widths.at_the_end(tube, runs) <= 1.001


def test_a_decision_is_made_twice_and_its_verdict_kept():
    loop = rj.ClosedLoop(rj.AffinePlant([[0.5]], [[1.0]]), rj.MLP.from_layers([([[0.0]], [0.0])]))
    X0, calls = rj.Box([-1.0], [1.0]), []

    def decide():
        calls.append(0)
        return rj.decide(loop, X0, 2, safe=rj.Box([-2.0], [2.0]))

    first, again = decisions.twice(decide)
    assert (first["verdict"], first["cells"], len(calls)) == ("PROVED", 1, 2)
    assert first["first, s"] > 0 < again["warm, s"]


def test_noise_and_disturbances_enter_the_cart_pole():
    net = rj.MLP.from_layers([([[0.1, 0.2, 3.0, 0.5]], [0.0])])
    calm, noisy = loops.pole(net, 0.1), loops.noisy_pole(net, 0.1, 0.5, 0.01)
    x, u = np.array([0.1, 0.0, 0.05, 0.2]), np.array([0.3])
    pushed = noisy.plant.propagate(x, u, w=np.array([0.2]))
    np.testing.assert_allclose(pushed, calm.plant.propagate(x, u + 0.2))
    X0, template = rj.Box(x, x), rj.Template.box(4)
    tube = rj.reach(noisy, X0, 1, template, rj.LinearBounds())
    seen = np.asarray(calm.plant.propagate(x, np.asarray(net(x))))
    assert tube.sets[-1].contains(seen)
    assert widths.widths_of(tube.sets[-1])[1] >= 2 * 0.1 * 2 * (0.5 + 0.01 * 3.8) - 1e-9


def test_loops_at_samples_can_be_sent_to_other_processes():
    """Decisions by cells send them; a step that stands within a function cannot be sent."""
    pole = rj.SampledPlant(fields.cart_pole, 4, 1, 0.02)
    loop = rj.ClosedLoop(pole, rj.MLP(((np.ones((1, 4)), np.zeros(1)),)))
    sent = pickle.loads(pickle.dumps(loops.at_samples(loop)))
    x, u = np.array([0.1, 0.0, 0.2, -0.1]), np.array([0.3])
    np.testing.assert_array_equal(sent.plant.f(x, u), loops.at_samples(loop).plant.f(x, u))
