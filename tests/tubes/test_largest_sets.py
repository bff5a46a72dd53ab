"""The largest sets that are proved: what is returned is proved, and hardly anything larger is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.closed_loops import double_integrator
from tests.tubes.test_forever import scalar

WANTED = {"goal": rj.Box([-0.6, -0.6], [0.6, 0.6]), "safe": rj.Box([-3.5, -1.5], [3.5, 1.5])}
HORIZON = 5
QUICK = rj.BranchAndCut(nodes=20)


@pytest.fixture(scope="module")
def loop():
    return double_integrator()


def wins(loop, X):
    """Whether all trajectories from corners and samples of a set have what is wanted."""
    states = jnp.concatenate([X.corners(), X.sample(jax.random.key(0), 3000)])
    runs = loop.simulate(states, HORIZON)
    inside = WANTED["safe"].contains(runs, 1e-9).all() & WANTED["goal"].contains(runs[:, -1], 1e-9)
    return bool(inside.all())


@pytest.mark.parametrize(
    "X0",
    [rj.Box([1.0, -0.2], [1.2, 0.2]), rj.Ellipsoid([0.5, 0.0], [[0.01, 0.0], [0.0, 0.01]])],
    ids=["box", "ellipsoid"],
)
@pytest.mark.costly
def test_it_is_proved_and_much_larger(loop, X0):
    found = rj.largest_set(loop, X0, HORIZON, rounds=10, relaxation=QUICK, **WANTED)
    assert found.verdict.status is rj.VerdictStatus.PROVED
    assert type(found.region) is type(X0)
    assert wins(loop, found.region)
    assert found.region.volume() > 20 * X0.volume()


@pytest.mark.costly
def test_a_set_that_is_too_large_is_shrunk():
    safe = rj.Box([-2.0], [1.0])
    found = rj.largest_set(scalar(0.9), rj.Box([-8.0], [9.0]), 3, safe=safe, rounds=10)
    assert found.region.upper == pytest.approx(1.0, abs=0.02)
    assert found.region.lower == pytest.approx(-2.0, abs=0.02)
    assert (found.region.upper <= 1.0) & (found.region.lower >= -2.0)


@pytest.mark.costly
def test_avoided_sets_are_kept_away_from():
    avoid = [rj.Box([1.0], [1.5]), rj.Box([-3.0], [-2.0])]
    found = rj.largest_set(scalar(0.5), rj.Box([0.1], [0.2]), 2, avoid=avoid, rounds=10)
    assert found.region.upper == pytest.approx(1.0, abs=0.02)
    assert found.region.lower == pytest.approx(-2.0, abs=0.02)


@pytest.mark.costly
def test_it_can_be_gone_on_with_and_shows_its_progress(loop):
    seen = []

    def bar(items):
        for item in items:
            seen.append(item)
            yield item

    X0, more = rj.Box([1.0, -0.1], [1.1, 0.1]), {"relaxation": QUICK, "progress": bar, **WANTED}
    some = rj.largest_set(loop, X0, HORIZON, rounds=2, **more)
    later = rj.largest_set(loop, some.region, HORIZON, rounds=5, **more)
    assert later.region.volume() >= some.region.volume() * (1 - 1e-9)
    assert seen
    assert np.isfinite(seen).all()


@pytest.mark.costly
def test_what_begins_where_nothing_is_proved_is_named(loop):
    with pytest.raises(ValueError, match="nothing is proved around the center of X0"):
        rj.largest_set(loop, rj.Box([3.6, 0.0], [3.8, 0.1]), HORIZON, rounds=1, **WANTED)
    with pytest.raises(TypeError, match="X0 must be a Box or an Ellipsoid"):
        rj.largest_set(loop, rj.Polytope(np.eye(2), [1.0, 1.0]), HORIZON, **WANTED)


@pytest.mark.costly
def test_flat_sides_stay_flat(loop):
    point = rj.largest_set(scalar(0.9), rj.Box([1.0], [1.0]), 2, goal=rj.Box([-1.0], [2.0]))
    assert (point.region.lower, point.region.upper) == (1.0, 1.0)
    given = rj.Box([0.5, 0.1], [0.6, 0.1])
    found = rj.largest_set(loop, given, HORIZON, rounds=5, relaxation=QUICK, **WANTED)
    assert found.region.lower[1] == found.region.upper[1] == 0.1
    assert found.region.widths[0] > 10 * given.widths[0]
    assert wins(loop, found.region)


@pytest.mark.filterwarnings("error")
@pytest.mark.costly
def test_a_side_that_nothing_limits_ends():
    net = rj.MLP.from_layers([(np.zeros((1, 2)), [0.0])])
    loop = rj.ClosedLoop(rj.AffinePlant(0.5 * np.eye(2), np.zeros((2, 1))), net)
    goal = rj.Polytope.between([-1.0, -np.inf], [1.0, np.inf])
    found = rj.largest_set(loop, rj.Box([-0.1, -0.1], [0.1, 0.1]), 1, goal=goal, rounds=2)
    assert found.region.upper[0] == pytest.approx(2.0, rel=0.01)
    assert 1e4 < found.region.widths[1] < 1e6
