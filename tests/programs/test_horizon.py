"""Claims about a loop over its whole horizon: facts and forms hold of simulated trajectories."""

import numpy as np
import pytest

import reachjax as rj
from reachjax.methods.witnesses import initial_states
from reachjax.programs.affine import AffineForms
from reachjax.programs.horizon import Horizon, joined, upper_bounds
from tests.closed_loops import initial_set, on_host, switching_loop, that_switches

STEPS = 3

LOOPS = {
    "ReLU": {"activation": rj.ReLU()},
    "LeakyReLU": {"activation": rj.LeakyReLU(0.1)},
    "HardTanh": {"activation": rj.HardTanh()},
    "residual, no input box": {"residual": True, "boxed": False},
    "time-varying": {"steps": STEPS + 2},
}

CASES = [
    (1, "box", "ReLU"),
    (1, "ellipsoid", "HardTanh"),
    (2, "box", "HardTanh"),
    (2, "polytope", "ReLU"),
    (2, "ellipsoid", "LeakyReLU"),
    (2, "intersection", "time-varying"),
    (3, "box", "LeakyReLU"),
    (3, "polytope", "time-varying"),
    (3, "simplex", "HardTanh"),
    (3, "ellipsoid", "ReLU"),
    (3, "intersection", "residual, no input box"),
    (6, "box", "time-varying"),
    (6, "polytope", "residual, no input box"),
    (6, "ellipsoid", "ReLU"),
]


def nonnegative(seed):
    """Multipliers that nothing recommends, but their sign."""
    rng = np.random.default_rng(seed)

    def multipliers(horizon, forms):
        shape = len(forms.rows), len(horizon.facts.rows)
        return rng.exponential(size=shape) * (rng.uniform(size=shape) < 0.3)

    return multipliers


def horizon_of(loop, X0, start, multipliers=None):
    horizon = Horizon(*on_host(loop, X0), start)
    for _ in range(STEPS):
        if multipliers is None:
            horizon.advance()
        else:
            horizon.advance(
                lambda forms: (multipliers(horizon, forms), np.zeros((len(forms.rows), 0)))
            )
    return horizon


def inputs_of_units(loop, X0, states, start):
    """Inputs `(c, units)` of each layer of each step, by the loop itself."""
    on_the_way = []

    def unit(unit, *y):
        on_the_way.append(np.concatenate(y))
        return unit(*y)

    loop, *_ = on_host(loop, X0)
    for state in states:
        x = state
        for t in range(start, start + STEPS):
            x = loop.step(x, t, unit)
    layers = len(on_the_way) // len(states)
    return [np.stack(on_the_way[layer::layers]) for layer in range(layers)]


@pytest.fixture(scope="module", params=CASES, ids=lambda case: "-".join(map(str, case)))
def case(request):
    """(loop, X0, start, horizon, initial states, trajectories, their columns)."""
    n_x, kind, options = request.param
    start = 2 if options == "time-varying" else 0
    X0 = initial_set(kind, n_x, seed=n_x)
    loop = that_switches(
        lambda seed: switching_loop(n_x, seed=seed, **LOOPS[options]), X0, n_x, start
    )
    horizon = horizon_of(loop, X0, start)
    states = initial_states(X0, 200, seed=0)
    runs = np.asarray(loop.simulate(states, STEPS, start))
    columns = np.stack([horizon.columns_at(state) for state in states])
    return loop, X0, start, horizon, states, runs, columns


def values(forms, columns):
    """What forms are at columns: `(c, k)`."""
    return forms.rows[:, 0] + columns[:, : forms.columns.shape[1]] @ forms.columns.T


@pytest.mark.costly
def test_no_column_is_larger_than_one(case):
    *_, horizon, _, _, columns = case
    states = horizon.start.spread.shape[1]
    first, rest = columns[:, :states], columns[:, states:]
    length = np.linalg.norm(first, axis=1) if horizon.start.round else abs(first).max(axis=1)
    assert length.max() <= 1 + 1e-9
    assert abs(rest).max(initial=0.0) <= 1 + 1e-9


@pytest.mark.costly
def test_units_switch_in_every_case(case):
    *_, horizon, _, _, _ = case
    assert len(horizon.zero) >= 2


def test_facts_are_nonnegative_on_trajectories(case):
    *_, horizon, _, _, columns = case
    assert values(horizon.facts, columns).min() >= -1e-9


def test_one_fact_of_each_pair_vanishes_on_trajectories(case):
    *_, horizon, _, _, columns = case
    pairs = values(horizon.facts, columns)[:, horizon.zero]
    assert abs(pairs).min(axis=2).max() <= 1e-9
    assert pairs.max() > 1e-3  # not both always


def test_the_state_is_simulated(case):
    *_, horizon, _, runs, columns = case
    np.testing.assert_allclose(values(horizon.state, columns), runs[:, -1], atol=1e-9)


def test_each_fact_is_of_the_unit_it_says(case):
    *_, horizon, _, _, _ = case
    assert horizon.origins.shape == (len(horizon.facts.rows), 3)
    step, unit, _ = horizon.origins.T
    for number, layers in enumerate(horizon.steps):
        places = np.concatenate([layer.places for layer in layers])
        assert set(unit[step == number]) == set(np.flatnonzero(places >= 0))


def test_facts_of_the_initial_set_are_its_facets(case):
    _, X0, _, horizon, states, _, columns = case
    ours = horizon.origins[:, 0] < 0
    cut, _ = X0.parts
    if horizon.start.cut is None:
        assert not ours.any()
    else:
        A, b = map(np.asarray, cut.facets)
        found = values(horizon.facts[ours], columns)
        np.testing.assert_allclose(found, b - states @ A.T, atol=1e-9)


@pytest.mark.parametrize("seed", [0, 1])
def test_bounds_by_random_multipliers_hold(case, seed):
    loop, _, _, horizon, _, runs, _ = case
    rng = np.random.default_rng(seed)
    directions = np.concatenate([np.eye(loop.states), rng.normal(size=(9, loop.states))])
    forms, attained = directions @ horizon.state, (runs[:, -1] @ directions.T).max(axis=0)
    for scale in (1e-3, 1.0, 1e3):
        multipliers = scale * nonnegative(seed)(horizon, forms)
        found = upper_bounds(forms, horizon.facts, multipliers, horizon.start)
        assert np.all(found >= attained - 1e-12)
        np.testing.assert_array_equal(horizon.bounds(forms, multipliers), found)


def test_facts_that_are_no_numbers_do_no_harm_without_multipliers(case):
    loop, _, _, horizon, _, _, _ = case
    forms, facts = np.eye(loop.states) @ horizon.state, horizon.facts
    multipliers = nonnegative(0)(horizon, forms)
    multipliers[:, 0] = 0.0
    lost = np.arange(len(facts.rows)) == 0
    broken = AffineForms(np.where(lost[:, None], np.nan, facts.rows), facts.radii)
    wanted = upper_bounds(forms, facts, multipliers, horizon.start)
    found = upper_bounds(forms, broken, multipliers, horizon.start)
    np.testing.assert_array_equal(found, wanted)
    multipliers[:, 0] = 1.0
    assert np.isnan(upper_bounds(forms, broken, multipliers, horizon.start)).all()


def test_bounds_by_multipliers_of_any_sign_hold_where_facts_are_zero(case):
    loop, _, _, horizon, _, runs, columns = case
    rng = np.random.default_rng(0)
    forms, facts = np.eye(loop.states) @ horizon.state, values(horizon.facts, columns)
    for run, row in zip(runs[::20], facts[::20], strict=True):
        free = row <= 1e-12
        multipliers = rng.normal(size=(loop.states, len(row)))
        multipliers = np.where(free, multipliers, abs(multipliers))
        assert np.all(horizon.bounds(forms, multipliers) >= run[-1] - 1e-9)


def test_bounds_without_multipliers_are_those_of_forms(case):
    loop, _, _, horizon, _, _, _ = case
    none = np.zeros((loop.states, len(horizon.facts.rows)))
    _, upper = horizon.state.ends(horizon.start)
    np.testing.assert_allclose(horizon.bounds(horizon.state, none), upper, atol=1e-12)


def test_ranges_by_garbage_hold(case):
    loop, X0, start, _, states, _, _ = case
    horizon = horizon_of(loop, X0, start, nonnegative(seed=1))
    seen = inputs_of_units(loop, X0, states[:40], start)
    layers = [layer for step in horizon.steps for layer in step]
    assert len(seen) == len(layers)
    for layer, inputs in zip(layers, seen, strict=True):
        assert np.all(inputs.min(axis=0) >= layer.lower - 1e-12)
        assert np.all(inputs.max(axis=0) <= layer.upper + 1e-12)


def test_a_state_that_is_narrowed_is_within_both_bounds():
    loop, X0 = switching_loop(2), initial_set("box", 2)
    horizon = horizon_of(loop, X0, 0)
    lower, upper = horizon.state.ends(horizon.start)
    horizon.narrow(np.array([lower[0] + 0.1, -np.inf]), np.array([np.inf, upper[1] - 0.1]))
    narrowed = np.stack(horizon.state.ends(horizon.start))
    expected = [[lower[0] + 0.1, lower[1]], [upper[0], upper[1] - 0.1]]
    np.testing.assert_allclose(narrowed, expected, atol=1e-12)


def test_joined_forms_are_in_their_order():
    state = horizon_of(switching_loop(2), initial_set("box", 2), 0).state
    forms = np.array([[1.0, 0.0], [0.0, 2.0], [3.0, 1.0]]) @ state
    found = joined([forms[2:], forms[:2]])
    np.testing.assert_array_equal(found.rows, forms.rows[[2, 0, 1]])
    np.testing.assert_array_equal(found.radii, forms.radii[[2, 0, 1]])
