"""Winning sets: what is proved wins, what is refuted loses, and cells cover the domain."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import reachjax as rj
from tests.closed_loops import autonomous, double_integrator
from tests.tubes.test_forever import scalar

HORIZON = 5
PROVED, REFUTED, UNKNOWN = rj.VerdictStatus
DOMAIN = rj.Box([-4.0, -2.0], [4.0, 2.0])
WANTED = {
    "goal": rj.Box([-0.6, -0.6], [0.6, 0.6]),
    "safe": rj.Box([-3.5, -1.5], [3.5, 1.5]),
    "avoid": [rj.Box([1.0, 0.2], [1.5, 0.6])],
}


def wins(runs):
    """Which trajectories `(c, h + 1, 2)` have all that is wanted."""
    goal, safe, (avoid,) = WANTED["goal"], WANTED["safe"], WANTED["avoid"]
    return np.asarray(
        goal.contains(runs[:, -1])
        & safe.contains(runs).all(axis=1)
        & ~avoid.contains(runs).any(axis=1)
    )


@pytest.fixture(scope="module")
def loop():
    return double_integrator()


@pytest.fixture(scope="module")
def smooth():
    def swing(x, u):
        return jnp.array([x[0] + 0.2 * x[1], x[1] + 0.2 * (jnp.sin(x[0]) + u[0])])

    law = rj.Network(lambda x: -5 * jnp.tanh(x[:1] + 0.7 * x[1:]), 2, 1)
    return rj.ClosedLoop(rj.NonlinearPlant(swing, 2, 1), law)


def attacked(found, loop):
    """Simulate a grid and the corners of all cells; return the true and the proved volume."""
    grid = np.stack(np.meshgrid(np.linspace(-4, 4, 161), np.linspace(-2, 2, 81)), -1).reshape(-1, 2)
    ends = [np.stack([c.lower, c.upper]) for c in found.cells if c.status is not UNKNOWN]
    corners = np.concatenate([[[x, y] for x in e[:, 0] for y in e[:, 1]] for e in ends])
    points = np.concatenate([grid, corners])
    won = wins(loop.simulate(points, HORIZON))
    assert not (found.contains(grid) & ~won[: len(grid)]).any()
    assert not (found.excludes(grid) & won[: len(grid)]).any()
    assert won[len(grid) :][found.contains(corners) & ~found.excludes(corners)].all()
    return won[: len(grid)].mean() * 32.0


@pytest.mark.costly
@pytest.mark.parametrize("name", ["loop", "smooth"])
def test_what_is_proved_wins_and_what_is_refuted_loses(name, request):
    loop = request.getfixturevalue(name)
    found = rj.winning_set(loop, DOMAIN, HORIZON, cells=300, **WANTED)
    true = attacked(found, loop)
    assert true > 1.0
    assert 0.75 * true < found.volume(PROVED) < 1.02 * true
    assert sum(map(found.volume, rj.VerdictStatus)) == pytest.approx(32.0)
    assert len(found.cells) == 300


@pytest.mark.costly
def test_what_is_known_is_gone_on_with_and_no_cell_is_lost(loop):
    few = rj.winning_set(loop, DOMAIN, HORIZON, cells=60, **WANTED)
    more = rj.winning_set(loop, DOMAIN, HORIZON, cells=200, known=few, **WANTED)
    assert len(more.cells) == 200
    assert few.volume(PROVED) < more.volume(PROVED)
    kept = {tuple(c.lower) + tuple(c.upper) for c in more.cells}
    assert all(
        tuple(c.lower) + tuple(c.upper) in kept for c in few.cells if c.status is not UNKNOWN
    )
    attacked(more, loop)
    none = rj.winning_set(loop, DOMAIN, HORIZON, cells=200, time_limit=0.0, **WANTED)
    assert [c.status for c in none.cells] == [UNKNOWN]


@pytest.mark.costly
def test_an_executor_finds_the_same_volumes(loop):
    alone = rj.winning_set(loop, DOMAIN, HORIZON, cells=100, **WANTED)
    seen = []

    def bar(items):
        for item in items:
            seen.append(item)
            yield item

    with ThreadPoolExecutor(2) as pool:
        found = rj.winning_set(
            loop, DOMAIN, HORIZON, cells=100, executor=pool, progress=bar, **WANTED
        )
    assert len(found.cells) == len(alone.cells)
    assert found.volume(PROVED) == pytest.approx(alone.volume(PROVED), rel=0.1)
    assert seen


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.costly
def test_other_dimensions(n):
    net = rj.MLP.from_layers([(np.zeros((1, n)), [0.0])])
    plant = rj.AffinePlant(0.5 * np.eye(n), np.zeros((n, 1)))
    loop = rj.ClosedLoop(plant, net)
    domain = rj.Box(-2.0 * np.ones(n), 2.0 * np.ones(n))
    safe = rj.Box(-np.ones(n), np.ones(n))
    few = rj.winning_set(loop, domain, 2, safe=safe, cells=4**n)
    assert few.volume(PROVED) == pytest.approx(2.0**n)
    more = rj.winning_set(loop, domain, 2, safe=safe, cells=200 * n, known=few)
    assert more.volume(PROVED) == pytest.approx(2.0**n)
    assert more.volume(UNKNOWN) < 0.01 * 4.0**n


@pytest.mark.costly
def test_disturbances_may_not_matter_to_what_is_proved():
    loop = scalar(0.5)
    loop = loop.replace(plant=loop.plant.replace(E=[[1.0]]), disturbance=rj.Box([-0.1], [0.1]))
    domain, safe = rj.Box([-4.0], [4.0]), rj.Box([-1.0], [1.0])
    found = rj.winning_set(loop, domain, 1, goal=safe, cells=400)
    inner, outer = found.volume(PROVED) / 2, 4 - found.volume(REFUTED) / 2
    assert 1.75 < inner <= 1.8  # 0.5 x + w <= 1 for all w
    assert 2.2 <= outer < 2.25  # for some w


@pytest.mark.costly
def test_it_is_shown(loop):
    found = rj.winning_set(loop, DOMAIN, HORIZON, cells=60, **WANTED)
    lines = str(found).splitlines()
    assert [line.split()[0] for line in lines[1:]] == ["proved", "refuted", "unknown"]
    assert len({len(line) for line in lines}) == 1
    ax = rj.plot_cells(found)
    assert len(ax.get_legend().get_texts()) == 3
    plt.close(ax.figure)
    assert found.contains([[100.0, 0.0]]).tolist() == [False]


def test_cells_that_were_not_found_are_not_known(loop):
    few = rj.winning_set(loop, DOMAIN, HORIZON, cells=20, **WANTED)
    proved = tuple(cell._replace(status=PROVED) for cell in few.cells)
    for cells in (proved, few.cells[1:], ()):
        changed = dataclasses.replace(few, cells=cells)
        with pytest.raises(ValueError, match="the cells that were found, but others arrived"):
            rj.winning_set(loop, DOMAIN, HORIZON, cells=40, known=changed, **WANTED)


@pytest.mark.parametrize(
    "changes",
    [
        {"goal": rj.Box([-0.5, -0.6], [0.6, 0.6])},
        {"goal": {4: WANTED["goal"]}},
        {"avoid": []},
        {"horizon": HORIZON + 1, "goal": {HORIZON: WANTED["goal"]}},
        {"start": 1},
        {"loop": None},
    ],
)
def test_what_is_known_of_another_question_is_refused(loop, changes):
    asked = {"loop": loop, "domain": DOMAIN, "horizon": HORIZON, **WANTED, "cells": 2}
    few = rj.winning_set(**asked)
    rj.winning_set(**asked, known=few)
    asked |= changes
    if asked["loop"] is None:
        asked["loop"] = loop.replace(input_box=rj.Box([-1.0], [1.0 + 1e-15]))
    with pytest.raises(ValueError, match="known must be of the same loop"):
        rj.winning_set(**asked, known=few)


def test_bad_input_is_named(loop):
    few = rj.winning_set(loop, DOMAIN, HORIZON, cells=1, **WANTED)
    other = rj.Box([-1.0, -1.0], [1.0, 1.0])
    with pytest.raises(TypeError, match="domain must be a Box"):
        rj.winning_set(loop, rj.Ellipsoid([0, 0], np.eye(2)), HORIZON, **WANTED)
    with pytest.raises(ValueError, match="nothing to verify"):
        rj.winning_set(loop, DOMAIN, HORIZON)
    with pytest.raises(ValueError, match="known must be of the same loop, domain"):
        rj.winning_set(loop, other, HORIZON, known=few, **WANTED)
    with pytest.raises(TypeError, match="known must be a WinningSet"):
        rj.winning_set(loop, DOMAIN, HORIZON, known=DOMAIN, **WANTED)
    with pytest.raises(ValueError, match="dimension of states"):
        few.contains([[0.0]])
    with pytest.raises(ValueError, match="cells"):
        rj.winning_set(loop, DOMAIN, HORIZON, cells=0, **WANTED)


def test_of_a_flat_domain_parts_are_of_what_is_wide():
    halves = autonomous(0.5 * np.eye(2))
    domain = rj.Box([-2.0, 1.0], [2.0, 1.0])
    found = rj.winning_set(halves, domain, 1, safe=rj.Box([-1.0] * 2, [1.0] * 2), cells=8)
    assert "nan" not in str(found) + found._repr_html_()
    assert "50.00%" in str(found)


def test_in_32_bits_nothing_is_said_of_a_state():
    cell = rj.DecidedCell(np.zeros(1), np.ones(1), PROVED, 1.0)
    found = rj.WinningSet(rj.Box([0.0], [1.0]), (cell,), jnp.zeros(32, jnp.uint8))
    beside = np.array([1.0 + 1e-12])
    assert not found.contains(beside)
    for ask in (found.contains, found.excludes):
        with jax.enable_x64(False), pytest.raises(RuntimeError, match="needs 64-bit floats"):
            ask(beside)
