"""Decisions by cells: what is proved holds, what is refuted does not, and cells cover the set."""

import itertools
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import reachjax as rj
from reachjax.loops.units import UnboundedError
from reachjax.methods.ladder import Ladder
from reachjax.methods.propagation import simulations_from
from reachjax.numerics.budget import Budget
from reachjax.verdicts.cell_tasks import CellTask, far_from, outcome_of
from reachjax.verdicts.sieve import Sieve
from reachjax.verdicts.specification import requirements
from tests.networks import he_network

HORIZON = 4


def swing(x, u):
    return jnp.array([x[0] + 0.1 * x[1], x[1] + 0.1 * (5 * jnp.sin(x[0]) + u[0])])


@pytest.fixture(scope="module")
def smooth():
    law = rj.Network(lambda x: -8 * jnp.tanh(x[:1] + 0.5 * x[1:]), 2, 1)
    return rj.ClosedLoop(rj.NonlinearPlant(swing, 2, 1), law)


@pytest.fixture(scope="module")
def rectified():
    plant = rj.AffinePlant([[1.0, 0.2], [0.0, 1.0]], [[0.0], [0.2]])
    net = rj.MLP.from_layers(he_network((2, 5, 1), 3))
    return rj.ClosedLoop(plant, net, rj.Box([-1.0], [1.0]))


X0 = rj.Box([-1.0, -1.0], [1.0, 1.0])


def around(loop, X0, room):
    """A box that simulations leave by no more than a room, which may be negative."""
    states = jnp.concatenate([X0.corners(), X0.sample(jax.random.key(0), 4000)])
    runs = np.asarray(loop.simulate(states, HORIZON)).reshape(-1, 2)
    return rj.Box(runs.min(axis=0) - room, runs.max(axis=0) + room)


def covered(verdict, X):
    """Whether every point of a set is in a cell."""
    points = np.asarray(jnp.concatenate([X.corners(), X.sample(jax.random.key(1), 2000)]))
    lower, upper = (
        np.stack([getattr(c, end) for c in verdict.cells]) for end in ("lower", "upper")
    )
    inside = (lower <= points[:, None] + 1e-12) & (points[:, None] <= upper + 1e-12)
    return bool(inside.all(axis=2).any(axis=1).all())


@pytest.mark.parametrize("name", ["smooth", "rectified"])
@pytest.mark.parametrize("cells", [(2, 3), 400])
@pytest.mark.costly
def test_what_simulations_keep_a_distance_of_is_proved(name, cells, request):
    loop = request.getfixturevalue(name)
    verdict = rj.decide(loop, X0, HORIZON, safe=around(loop, X0, 0.02), cells=cells)
    assert verdict.status is rj.VerdictStatus.PROVED
    assert all(cell.status is rj.VerdictStatus.PROVED for cell in verdict.cells)
    assert covered(verdict, X0)
    assert 0 < np.nanmin(verdict.margins["safe"]) <= np.nanmin(verdict.simulated["safe"]) + 1e-12
    assert "proved, 0 refuted, 0 undecided" in str(verdict)


@pytest.mark.parametrize("name", ["smooth", "rectified"])
@pytest.mark.costly
def test_what_is_broken_is_refuted_by_a_trajectory(name, request):
    loop = request.getfixturevalue(name)
    region = around(loop, X0, -1e-3)
    verdict = rj.decide(loop, X0, HORIZON, safe=region, cells=20)
    assert verdict.status is rj.VerdictStatus.REFUTED
    states = verdict.counterexample.states
    np.testing.assert_allclose(loop.simulate(states[0], HORIZON), states, atol=1e-9)
    assert not region.contains(states[verdict.counterexample.time])


@pytest.mark.costly
def test_a_limit_leaves_cells_undecided_and_margins_that_say_so(smooth):
    region = around(smooth, X0, 1e-4)
    for limit in ({"cells": 5}, {"cells": (2, 2), "time_limit": 0.0}):
        verdict = rj.decide(smooth, X0, HORIZON, safe=region, **limit)
        assert verdict.status is rj.VerdictStatus.UNKNOWN
        assert len(verdict.cells) == (5 if limit["cells"] == 5 else 4)
        assert covered(verdict, X0)
        assert np.min(verdict.margins["safe"]) < 0


@pytest.mark.costly
def test_an_executor_finds_the_same(smooth):
    region = around(smooth, X0, 0.05)
    alone = rj.decide(smooth, X0, HORIZON, safe=region, cells=(2, 2))
    with ThreadPoolExecutor(2) as executor:
        shared = rj.decide(smooth, X0, HORIZON, safe=region, cells=(2, 2), executor=executor)
    assert alone.status is shared.status is rj.VerdictStatus.PROVED
    np.testing.assert_array_equal(alone.margins["safe"], shared.margins["safe"])


@pytest.mark.costly
def test_cells_of_polytopes_and_avoided_sets(smooth):
    triangle = rj.Polytope([[-1.0, 0], [0, -1], [1, 1]], [0.2, 0.2, 0.3])
    reached = around(smooth, triangle, 0.02)
    beyond = rj.Box(np.asarray(reached.upper), np.asarray(reached.upper) + 1)
    verdict = rj.decide(smooth, triangle, HORIZON, safe=reached, avoid=[beyond], cells=200)
    assert verdict.status is rj.VerdictStatus.PROVED
    assert covered(verdict, triangle)


@pytest.mark.costly
def test_a_bar_sees_every_cell_that_is_bounded(smooth):
    seen = []

    def bar(items):
        for item in items:
            seen.append(item)
            yield item

    verdict = rj.decide(
        smooth, X0, HORIZON, safe=around(smooth, X0, 0.05), cells=(2, 2), progress=bar
    )
    assert seen[-1] == len(verdict.cells)


@pytest.mark.costly
def test_cells_are_drawn_by_what_is_known_of_them(smooth):
    verdict = rj.decide(smooth, X0, HORIZON, safe=around(smooth, X0, 1e-4), cells=6)
    ax = rj.plot_cells(verdict)
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert sum(int(label.split(": ")[1]) for label in labels) == len(verdict.cells)
    assert ax.get_xlabel() == "$x_{1}$"
    plt.close(ax.figure)
    with pytest.raises(ValueError, match="verdict has no cells"):
        rj.plot_cells(rj.decide(smooth, X0, 1, safe=rj.Box([-9, -9], [9, 9])))


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        ({"cells": "many"}, TypeError, r"cells must be a whole number, or one for each"),
        ({"cells": 0}, ValueError, r"cells must be at least 1"),
        ({"cells": (2,)}, ValueError, r"cells must be a number for each of 2 coordinates"),
        (
            {"cells": 3, "executor": 2},
            TypeError,
            r"executor must be an object with a method",
        ),
        ({"cells": 3, "progress": 2}, TypeError, r"progress must wrap an iterable"),
    ],
)
def test_what_is_no_number_of_cells_is_named(smooth, given, error, message):
    with pytest.raises(error, match=message):
        rj.decide(smooth, X0, 1, safe=X0, **given)


def test_what_overflows_in_every_cell_is_unknown():
    net = rj.MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
    loop = rj.ClosedLoop(rj.AffinePlant([[1e60]], [[1.0]]), net)
    verdict = rj.decide(loop, rj.Box([1.0], [2.0]), 8, goal=rj.Box([-1.0], [1.0]), cells=4)
    assert verdict.status is rj.VerdictStatus.UNKNOWN
    assert len(verdict.cells) == 4


def test_a_bar_that_ends_early_proves_nothing_of_the_rest():
    net = rj.MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
    loop, domain = rj.ClosedLoop(rj.AffinePlant([[1.0]], [[1.0]]), net), rj.Box([-5.0], [5.0])

    def short(items):
        return itertools.islice(items, 1)

    verdict = rj.decide(loop, domain, 3, safe=domain, cells=(64,), progress=short)
    assert verdict.status is rj.VerdictStatus.UNKNOWN
    assert covered(verdict, domain)
    assert np.nanmin(verdict.margins["safe"]) == -np.inf
    found = rj.winning_set(loop, domain, 2, safe=rj.Box([-4], [4]), cells=99, progress=short)
    assert sum(map(found.volume, rj.VerdictStatus)) == pytest.approx(10.0)


def rooted(f):
    law = rj.Network(lambda x: -x, inputs=1, outputs=1)
    return rj.ClosedLoop(rj.NonlinearPlant(lambda x, u: f(x) + 0 * u, states=1, inputs=1), law)


@pytest.mark.costly
def test_a_cell_over_which_a_unit_has_no_bounds_is_halved():
    waves = rooted(lambda x: jnp.sqrt(0.3 + jnp.sin(5 * x) * jnp.sin(5 * x + 0.2)))
    domain, goal = rj.Box([0.0], [2.0]), rj.Box([0.4], [1.3])
    with pytest.raises(UnboundedError, match="Sqrt"):
        rj.decide(waves, domain, 1, goal=goal, relaxation=rj.BranchAndCut(cells=1))
    assert rj.decide(waves, domain, 1, goal=goal).status is rj.VerdictStatus.PROVED
    verdict = rj.decide(waves, domain, 1, goal=goal, cells=100)
    assert verdict.status is rj.VerdictStatus.PROVED
    found = rj.winning_set(waves, domain, 1, goal=goal, cells=100)
    assert found.volume(rj.VerdictStatus.PROVED) == pytest.approx(2.0)


@pytest.mark.costly
def test_where_units_have_no_bounds_nothing_is_known():
    loop, goal = rooted(jnp.sqrt), rj.Box([-1.0], [3.0])
    verdict = rj.decide(loop, rj.Box([-1.0], [2.0]), 2, goal=goal, cells=8)
    assert verdict.status is rj.VerdictStatus.UNKNOWN
    assert {cell.status for cell in verdict.cells} == {*rj.VerdictStatus} - {
        rj.VerdictStatus.REFUTED
    }
    with pytest.raises(UnboundedError, match="Sqrt"):
        rj.decide(loop, rj.Box([-2.0], [-1.0]), 2, goal=goal, cells=8)
    found = rj.winning_set(loop, rj.Box([-1.0], [2.0]), 2, goal=goal, cells=8)
    assert found.contains([[1.0], [-0.5]]).tolist() == [True, False]
    assert not found.of(rj.VerdictStatus.REFUTED)


@pytest.mark.costly
def test_a_flow_that_has_no_bounds_over_any_cell_says_so():
    law = rj.Network(lambda x: -x, inputs=1, outputs=1)
    plant = rj.SampledPlant(lambda x, u: jnp.sqrt(x) + 0 * u, 1, 1, period=0.1)
    loop, goal = rj.ClosedLoop(plant, law), rj.Box([-1.0], [3.0])
    with pytest.raises(UnboundedError, match="Sqrt"):
        rj.decide(loop, rj.Box([-2.0], [-1.0]), 2, goal=goal, cells=64)


def test_trajectories_that_are_no_numbers_say_nothing():
    loop, X0 = rooted(jnp.sqrt), rj.Box([-1.0], [2.0])
    for cells in (None, 4):
        verdict = rj.decide(loop, X0, 2, goal=rj.Box([-1.0], [1.0]), cells=cells)
        assert verdict.status is rj.VerdictStatus.REFUTED
        assert np.nanmin(verdict.simulated["goal"]) == pytest.approx(1 - 2**0.25)


def test_a_cell_is_halved_where_what_is_left_out_comes_from():
    """Not where it is longest, nor where requirements point: a flow bends along one coordinate."""
    plant = rj.SampledPlant(
        lambda x, u: jnp.array([jnp.sin(3 * x[1]) - x[0], -x[1] + 0 * u[0]]), 2, 1, period=0.3
    )
    loop = rj.ClosedLoop(plant, rj.Network(lambda x: -x[:1], 2, 1))
    wide = rj.Box([-2.0, -0.7], [2.0, 0.7])
    last = np.asarray(loop.simulate(wide.sample(jax.random.key(0), 4000), 2))[:, -1]
    goal = rj.Box(last.min(axis=0) - 0.02, last.max(axis=0) + 0.02)
    verdict = rj.decide(loop, wide, 2, goal=goal, cells=2)
    first, second = verdict.cells
    assert verdict.status is rj.VerdictStatus.UNKNOWN
    assert {float(first.upper[1]), float(second.upper[1])} == {0.0, 0.7}
    assert first.lower[0] == second.lower[0] == -2.0


def test_an_executor_runs_the_cells_of_a_set_that_forms_do_not_prove(smooth):
    sent = []

    class Counting(ThreadPoolExecutor):
        def submit(self, *given, **named):
            sent.append(given)
            return super().submit(*given, **named)

    with Counting(2) as executor:
        verdict = rj.decide(
            smooth, X0, HORIZON, safe=around(smooth, X0, 0.02), samples=100, executor=executor
        )
    assert verdict.proved
    assert len(sent) > 1
    with pytest.raises(TypeError, match="executor must be an object with a method submit"):
        rj.decide(smooth, X0, 1, safe=X0, executor=2)


def test_a_cell_whose_bounds_are_far_from_all_that_is_simulated_is_given_up(smooth, monkeypatch):
    steps, horizon, advance = [], 200, Ladder.advance

    def counted(*given, **named):
        steps.append(1)
        advance(*given, **named)

    monkeypatch.setattr(Ladder, "advance", counted)
    wanted = tuple(requirements(2, horizon, goal={horizon: rj.Box([-0.1, -0.1], [0.1, 0.1])}))
    loop, part = jax.device_get((smooth, rj.Box([-2.0, -2.0], [2.0, 2.0])))
    simulations = simulations_from(loop, part, horizon, 0, 100, 0)
    beyond = far_from(simulations)
    states = simulations.runs.states
    assert np.all((beyond[0] < states) & (states < beyond[1]))
    task = CellTask(loop, horizon, 0, wanted, 0, beyond)
    outcome = outcome_of(task, part, Budget(np.inf))
    assert not outcome.proved
    assert outcome.axis >= 0
    assert len(steps) < horizon
    small = jax.device_get(rj.Box([-1e-4, -1e-4], [1e-4, 1e-4]))
    assert outcome_of(task, small, Budget(np.inf)).proved


def test_flat_coordinates_do_not_say_how_far_bounds_may_be():
    net = rj.MLP.from_layers([([[-0.5, 0.0]], [0.0]), ([[1.0]], [0.0])])
    loop = rj.ClosedLoop(rj.AffinePlant(np.eye(2), [[1.0], [0.0]]), net)
    X0 = rj.Box([1.0, 0.0], [2.0, 0.0])
    beyond = far_from(simulations_from(loop, X0, 3, 0, 10, 0))
    assert beyond is not None
    assert np.isfinite(beyond[:, 0]).all()
    assert beyond[:, 1].tolist() == [-np.inf, np.inf]


@pytest.mark.costly
def test_cells_that_compiled_steps_leave_open_are_proved_by_shorter_ones(monkeypatch):
    """A period of 1.5 rad is too long for one step; the host halves it, compiled code does not."""
    turning = rj.SampledPlant(
        lambda x, u: jnp.array([x[1], u[0] - jnp.sin(x[0])]), states=2, inputs=1, period=1.5
    )
    loop = rj.ClosedLoop(turning, rj.MLP.from_layers([([[0.0, -0.1]], [0.0])]))
    X0, safe = rj.Box([0.1, 0.1], [0.2, 0.2]), rj.Box([-0.8] * 2, [0.8] * 2)
    called = list[int]()

    def pays(sieve, cells, budget, calls=None):
        called.append(len(cells))
        return True

    monkeypatch.setattr(Sieve, "pays", pays)
    assert rj.decide(loop, X0, 2, safe=safe, cells=(2, 2), time_limit=120).proved
    assert called == [4]
