"""Windows: longer ones are tighter, and none forgets what the loop can do."""

import importlib
from dataclasses import replace
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.programs.windows import COLUMNS, Window
from tests.closed_loops import closed_loop, initial_set, random_loop
from tests.networks import box_region, simulate
from tests.quick_cases import some

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


# those of the paper and of all products on a loop that does not vary, the others on one that does
@pytest.mark.parametrize(
    ("relaxation", "steps"),
    some(
        product(RELAXATIONS, [None, HORIZON]),
        lambda relaxation, steps: (RELAXATIONS.index(relaxation) % 2 == 0) == (steps is None),
    ),
    ids=str,
)
@pytest.mark.costly
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
@pytest.mark.costly
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
    varying = "A", "B", "c", "u_lower", "u_upper"
    later = replace(data, **{name: getattr(data, name)[2:] for name in varying})
    expected = tube_of(later, rj.CuttingPlanes(), window)
    for mine, its in zip(tube.sets[1:], expected.sets[1:], strict=True):
        np.testing.assert_allclose(mine.b, its.b, atol=1e-6)


@pytest.mark.costly
def test_a_window_of_any_length_may_be_asked_for():
    data = random_loop(2, hidden=(3, 2), seed=2)
    long, whole = (tube_of(data, rj.CuttingPlanes(), window) for window in (10, HORIZON))
    np.testing.assert_allclose(long.sets[-1].b, whole.sets[-1].b, atol=1e-9)


@pytest.mark.costly
def test_the_length_is_chosen_by_the_columns_that_are_needed(monkeypatch):
    monkeypatch.setattr(importlib.import_module("reachjax.methods.recursion"), "LARGEST_WINDOW", 8)
    data = random_loop(2, hidden=(5, 4), seed=2)
    tube = tube_of(data, rj.CuttingPlanes(), None)
    used = [int(tube.proof(t).program.used.sum()) for t in range(1, HORIZON + 1)]
    alone = [
        int(tube_of(data, rj.CuttingPlanes(), 1).proof(t).program.used.sum())
        for t in range(1, HORIZON + 1)
    ]
    assert all(n <= max(9, m) for n, m in zip(used, alone, strict=True))


@pytest.mark.costly
def test_units_that_left_the_basis_take_no_columns():
    loop = closed_loop(random_loop(2, hidden=(20, 20), seed=1))
    box = rj.Box([0.0, 0.0], [1e-3, 1e-3])
    relaxation = rj.CuttingPlanes()
    windows = [
        Window.beginning(loop, box, box, 0, relaxation, drop_columns)
        for drop_columns in (False, True)
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


def unrolled(loop, states):
    """`[x, z, 1]` of trajectories over `HORIZON` steps, and the states after them."""

    def advance(x, t):
        outputs = []

        def unit(activation, y):
            outputs.append(activation(y))
            return outputs[-1]

        following = loop.step(x, t, unit)
        return following, jnp.concatenate(outputs)

    def trajectory(x):
        last, z = jax.lax.scan(advance, x, jnp.arange(HORIZON))
        return jnp.concatenate([x, z.ravel(), jnp.ones(1)]), last

    return jax.vmap(trajectory)(states)


def around(loop, X0):
    """Polytopes around simulated states at times 1 to `HORIZON - 1`."""
    reached = np.asarray(loop.simulate(X0.sample(jax.random.key(2), 2000), HORIZON - 1))[:, 1:]
    boxes = (rj.Box(x.min(axis=0), x.max(axis=0)) for x in np.moveaxis(reached, 1, 0))
    return [rj.Polytope(*box.facets) for box in boxes]


FACTS = [rj.PaperQC(), rj.CuttingPlanes()]
KINDS = ["box", "polytope", "ellipsoid", "intersection"]
QUICK = {("box", 1, 0), ("box", 6, 1), ("polytope", 2, 1), ("ellipsoid", 6, 0)}
QUICK |= {("intersection", 1, 1), ("intersection", 2, 0)}


@pytest.mark.parametrize(
    ("n_x", "kind", "relaxation"),
    some(
        product([1, 2, 6], KINDS, FACTS),
        lambda n_x, kind, relaxation: (kind, n_x, FACTS.index(relaxation)) in QUICK,
    ),
    ids=str,
)
@pytest.mark.costly
def test_facts_hold_of_every_trajectory(n_x, kind, relaxation):
    loop, X0 = closed_loop(random_loop(n_x, hidden=(5, 4), seed=3)), initial_set(kind, n_x)
    sets = [X0, *around(loop, X0)]
    windows = [
        Window.beginning(loop, X0, X0.bounding_box(), 0, relaxation, drop_columns)
        for drop_columns in (False, True)
    ]
    for X in sets:
        windows = [window.extended(loop, X, X.bounding_box()) for window in windows]
    programs = [window.program(jnp.eye(n_x), relaxation) for window in windows]
    xi, last = map(np.asarray, unrolled(loop, X0.sample(jax.random.key(2), 2000)))
    stays = np.asarray(programs[0].used)
    for program in programs:
        used = np.asarray(program.used)
        eta = np.zeros((len(xi), len(used)))
        T = np.asarray(program.transform)[np.ix_(used, used)]
        eta[:, used] = np.linalg.solve(T, xi[:, stays].T).T
        np.testing.assert_allclose(eta @ program.objective.mid.T, last, atol=1e-12)
        linear, cone = np.split(eta @ program.facts.mid.T, [len(windows[0].layout.linear)], axis=1)
        assert linear.min() >= -1e-12
        assert cone.shape[1] == len(X0.cone_facts())
        if cone.shape[1]:
            assert np.all(np.linalg.norm(cone[:, 1:], axis=1) <= cone[:, 0] + 1e-12)


@pytest.mark.costly
def test_traced_windows_need_a_number():
    data = random_loop(2, hidden=(3, 2), seed=2)
    X0, template = rj.Box([0.0, 0.0], [0.1, 0.1]), rj.Template.box(2)

    def size(loop, window, relaxation=rj.LocalBounds()):  # noqa: B008
        tube = rj.reach(loop, X0, 2, template, relaxation, window=window)
        return jnp.sum(tube.sets[2].b)

    loop, cuts = closed_loop(data), rj.CuttingPlanes(rounds=2, batch=20)
    with pytest.raises(ValueError, match="window=None is chosen from numbers"):
        jax.jit(lambda loop: size(loop, None))(loop)
    local, tight = (float(size(loop, 2, relaxation)) for relaxation in (rj.LocalBounds(), cuts))
    compiled = jax.jit(size, static_argnums=(1, 2))
    assert float(compiled(loop, 2)) == pytest.approx(local, abs=1e-6)
    assert tight - 1e-6 <= float(compiled(loop, 2, cuts)) <= local + 1e-6


@pytest.mark.parametrize(
    ("window", "error"), [(0, ValueError), (1.5, TypeError), ("all", TypeError)]
)
def test_bad_windows_are_named(window, error):
    with pytest.raises(error, match="window"):
        tube_of(random_loop(2, hidden=(3, 2)), rj.LocalBounds(), window)
