"""What is proved before and after training for size: laws, boxes, ratios, and files."""

import json
from dataclasses import replace

import numpy as np
import pytest

import reachjax as rj
from experiments.certified_training import grown
from experiments.certified_training.grown import Settings, Size, law, main, ratios

QUICK = Settings(rounds=1, seconds=5.0, limit=5.0, cells=20, samples=500, training_steps=500)


def linear(*gains):
    """The discrete pendulum under a linear law, as layers of `tanh` that hardly bend."""
    W = 1e-3 * np.array([gains])
    eye = np.ones((1, 1))
    layers = [(W, np.zeros(1)), (eye, np.zeros(1)), (1e3 * eye, np.zeros(1))]
    return grown.closed(layers, replace(QUICK, discrete=True))


def size(half, cells=()):
    half = np.array(half)
    ends = np.array(cells, float).reshape(-1, 2, 2)
    return Size(-half, half, np.array([0.01, 0.02]), ends, np.ones(2))


def test_the_plain_law_uses_a_part_of_the_force_and_more_than_the_weight():
    states = np.random.default_rng(0).uniform(-1, 1, (1000, 2)) * grown.WIDEST
    found = law(states)
    assert np.abs(found).max() <= grown.CAUTION * grown.FORCE
    slope = law(np.array([[1e-6, 0.0]]))[0, 0] / 1e-6
    assert slope == pytest.approx(-grown.GAIN * grown.GRAVITY, rel=1e-6)


def test_a_box_is_simulated_all_of_whose_states_do_what_is_required():
    loop = linear(-12.0, -5.0)
    box = grown.simulated_box(loop)
    assert box.volume() > grown.goal().volume()
    runs = np.asarray(loop.simulate(box.corners(), grown.HORIZON))
    assert np.asarray(grown.goal().contains(runs[:, -1])).all()
    wider = rj.Box(1.2 * box.lower, 1.2 * box.upper)
    region = grown.simulated_region(loop)
    assert np.all(np.asarray(region.upper) >= box.upper)
    last = np.asarray(loop.simulate(wider.corners(), grown.HORIZON))[:, -1]
    assert not np.asarray(grown.goal().contains(last)).all()
    falls = grown.simulated_box(linear(0.0, 0.0))
    assert falls.volume() < box.volume()


def test_volumes_and_areas_are_compared():
    before = size([0.1, 0.1], [[[0.0, 0.0], [0.1, 0.1]]])
    after = size([0.2, 0.4], [[[0.0, 0.0], [0.1, 0.1]], [[0.1, 0.0], [0.3, 0.1]]])
    assert ratios({"before": before, "after": after}) == pytest.approx((8.0, 3.0))
    assert size([0.1, 0.1]).attracted == pytest.approx(0.02 * 0.04)  # of the box itself
    nowhere = replace(size([0.1, 0.1]), back=np.full(2, np.nan))
    assert nowhere.attracted == 0
    assert np.isnan(ratios({"before": nowhere, "after": after})[1])


def test_what_is_not_known_is_a_dash():
    nowhere = replace(size([0.1, 0.1]), back=np.full(2, np.nan))
    columns = grown.table({"before": nowhere, "after": size([0.2, 0.2])}).columns
    assert list(columns[2].cells) == ["-", "0.001", "-"]
    columns = grown.table({"before": size([0.1, 0.1]), "after": nowhere}).columns
    assert list(columns[2].cells) == ["0.001", "-", "0.0"]


def test_boxes_are_wider_again_after_one_that_is_proved():
    factor = grown.next_factor(grown.WIDER, proved=False)
    assert factor == pytest.approx(1.15)
    assert grown.next_factor(factor, proved=True) == pytest.approx(grown.WIDER)
    assert grown.next_factor(grown.WIDER, proved=True) == grown.WIDER


@pytest.mark.costly
def test_cells_of_a_region_of_attraction_come_into_a_box_that_is_come_back_to():
    loop = linear(-12.0, -5.0)
    back, cells = grown.attraction(loop, replace(QUICK, limit=600.0, cells=60))
    assert np.all(back > 0)
    assert np.all(back < np.asarray(grown.GOAL))
    assert len(cells) > 0
    corners = np.concatenate([cells[:, 0], cells[:, 1]])
    runs = np.asarray(loop.simulate(corners, 200))
    assert np.abs(runs[:, -1]).max(initial=0.0) < 1e-3
    assert np.asarray(grown.safe().contains(runs.reshape(-1, 2))).all()


@pytest.mark.costly
def test_a_controller_is_trained_for_size_measured_and_kept(tmp_path, capsys, monkeypatch):
    before = size([0.01, 0.02], [[[0.0, 0.0], [0.01, 0.01]]])
    monkeypatch.setattr(Size, "of", lambda loop, settings: before)
    settings = replace(QUICK, discrete=True, output=tmp_path)
    main(settings)
    assert "times as large" in capsys.readouterr().out
    found = json.loads((tmp_path / "grown.json").read_text())
    assert found["times_as_large"]["volume"] == 1.0
    assert (tmp_path / "grown.png").stat().st_size > 10_000

    def refuse(*_):
        raise AssertionError("trained again")

    monkeypatch.setattr(grown, "grown", refuse)
    main(settings)
    with pytest.raises(AssertionError, match="trained again"):
        main(replace(settings, seconds=6.0))


def test_options_are_checked():
    for wrong in ({"rounds": 0}, {"limit": 0.0}, {"samples": 1}):
        with pytest.raises(ValueError, match=f"--{next(iter(wrong))} must be"):
            Settings(**wrong)
