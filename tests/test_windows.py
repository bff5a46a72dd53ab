"""Windows: longer ones are tighter, and none forgets what the loop can do."""

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.windows import COLUMNS, Window
from tests.loops import closed_loop, random_loop
from tests.networks import box_region, simulate

HORIZON = 3
RELAXATIONS = [
    rj.PaperQC(repeated=False),
    rj.LocalBounds(repeated=False),
    rj.AllProducts(),
    rj.CuttingPlanes(),
]


def tube_of(data, relaxation, window, scale=1.0, **options):
    corners = box_region(2, seed=0).corners
    middle = corners.mean(axis=0)
    ends = (middle + scale * (end - middle) for end in (corners.min(axis=0), corners.max(axis=0)))
    X0, template = rj.Box(*ends), rj.Template.octagonal(2)
    return rj.reach(closed_loop(data), X0, HORIZON, template, relaxation, window=window, **options)


@pytest.mark.parametrize("steps", [None, HORIZON])
@pytest.mark.parametrize("relaxation", RELAXATIONS, ids=str)
def test_longer_windows_are_tighter_and_hold_every_sample(relaxation, steps):
    data = random_loop(2, hidden=(4, 3), seed=1, steps=steps)
    tubes = [tube_of(data, relaxation, window) for window in (1, 2, HORIZON)]
    states = np.asarray(tubes[0].sets[0].sample(jax.random.key(1), 20_000))
    trajectories = simulate(data, states, HORIZON)
    for t in range(1, HORIZON + 1):
        bounds = [np.asarray(tube.proof(t).bounds) for tube in tubes]
        values = (trajectories[t] @ np.asarray(tubes[0].sets[t].A).T).max(axis=0)
        for bound in bounds:
            assert np.all(values <= bound + 1e-12)
        size = np.ptp(bounds[0])
        assert np.all(bounds[2] <= bounds[0] + 1e-5 * size)
        assert np.all(bounds[1] <= bounds[0] + 1e-5 * size)


@pytest.mark.parametrize("window", [2, None])
def test_a_window_begins_at_the_time_of_its_first_set(window):
    data = random_loop(2, hidden=(4, 3), seed=4, steps=6)
    tube = tube_of(data, rj.CuttingPlanes(), window, start=2)
    states = np.asarray(tube.sets[0].sample(jax.random.key(1), 5000))
    loop = closed_loop(data)
    for t in range(1, HORIZON + 1):
        states = np.stack(
            [np.asarray(x) for x in jax.vmap(lambda x, t=t: loop.step(x, t + 1))(states)]
        )
        assert bool(tube.sets[t].contains(states, 1e-12).all())
        assert tube.proof(t).gaps.max() < 1e-2  # of sets of size 0.1 to 1: facts of other times


def test_a_window_of_any_length_may_be_asked_for():
    data = random_loop(2, hidden=(3, 2), seed=2)
    long, whole = (tube_of(data, rj.CuttingPlanes(), window) for window in (10, HORIZON))
    np.testing.assert_allclose(long.sets[-1].b, whole.sets[-1].b, atol=1e-9)


def test_the_length_is_chosen_by_the_columns_that_are_needed(monkeypatch):
    monkeypatch.setattr(importlib.import_module("reachjax.reach"), "LARGEST", 8)
    data = random_loop(2, hidden=(5, 4), seed=2)
    tube = tube_of(data, rj.CuttingPlanes(), None)
    used = [int(tube.proof(t).program.used.sum()) for t in range(1, HORIZON + 1)]
    alone = [
        int(tube_of(data, rj.CuttingPlanes(), 1).proof(t).program.used.sum())
        for t in range(1, HORIZON + 1)
    ]
    assert all(n <= max(9, m) for n, m in zip(used, alone, strict=True))


def test_units_that_left_the_basis_take_no_columns():
    data = random_loop(2, hidden=(20, 20), seed=1)
    loop, box = closed_loop(data), rj.Box([0.0, 0.0], [1e-3, 1e-3])
    relaxation = rj.CuttingPlanes()
    windows = [
        Window.beginning(loop, box, box, 0, relaxation, compact) for compact in (False, True)
    ]
    for _ in range(2):
        windows = [window.extended(loop, box, box) for window in windows]
    whole, small = windows
    assert whole.transform.shape[0] == 2 + 2 * loop.units + 1
    assert small.transform.shape[0] % COLUMNS == 0
    assert small.transform.shape[0] < whole.transform.shape[0]
    programs = [window.program(jnp.eye(2), relaxation) for window in windows]
    used = [np.flatnonzero(program.used) for program in programs]
    rows = [
        np.asarray(program.facts.mid)[:, here] for program, here in zip(programs, used, strict=True)
    ]
    np.testing.assert_allclose(*rows, atol=1e-14)


def test_traced_windows_need_a_number():
    data = random_loop(2, hidden=(3, 2), seed=2)
    X0, template = rj.Box([0.0, 0.0], [0.1, 0.1]), rj.Template.box(2)

    def size(loop, window):
        tube = rj.reach(loop, X0, 2, template, rj.LocalBounds(), window=window)
        return jnp.sum(tube.sets[2].b)

    loop = closed_loop(data)
    with pytest.raises(ValueError, match="window=None is chosen from numbers"):
        jax.jit(lambda loop: size(loop, None))(loop)
    compiled, plain = jax.jit(lambda loop: size(loop, 2))(loop), size(loop, 2)
    assert float(compiled) == pytest.approx(float(plain), abs=1e-6)
    assert jnp.isfinite(jax.grad(lambda loop: size(loop, None))(loop).controller.layers[0][0]).all()


@pytest.mark.parametrize(
    ("window", "error"), [(0, ValueError), (1.5, TypeError), ("all", TypeError)]
)
def test_bad_windows_are_named(window, error):
    with pytest.raises(error, match="window"):
        tube_of(random_loop(2, hidden=(3, 2)), rj.LocalBounds(), window)
