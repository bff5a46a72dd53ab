"""Remedies in the order that pays: what smooth loops leave open is halved before programs come."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.loops.units import UnboundedError
from reachjax.solvers.linear_programs import LinearPrograms
from tests.networks import he_network

STEPS = 8


@pytest.fixture(scope="module")
def wavy():
    """A pendulum under rectifiers, of which no form of the whole set proves what its halves do."""
    layers = he_network((2, 24, 24, 1), 0)
    layers[-1] = 0.6 * layers[-1][0], layers[-1][1]
    net = rj.MLP.from_layers(layers)

    def control(x):
        return 2 * jnp.tanh(net(x) - net(jnp.zeros(2)) - jnp.array([4.0, 1.0]) @ x)

    def step(x, u):
        return x + 0.05 * jnp.array([x[1], 14.7 * jnp.sin(x[0]) + 6 * u[0]])

    loop = rj.ClosedLoop(rj.NonlinearPlant(step, 2, 1), rj.Network(control, 2, 1))
    return loop, rj.Box([-0.2, -0.2], [0.2, 0.2])


@pytest.fixture
def programs(monkeypatch):
    """The linear programs that are solved, one entry for each."""
    found, largest = [], LinearPrograms.largest

    def counted(*given, **options):
        found.append(given)
        return largest(*given, **options)

    monkeypatch.setattr(LinearPrograms, "largest", counted)
    return found


@pytest.fixture(scope="module")
def room(wavy):
    """A set in which all simulated states are, with room."""
    states = np.asarray(wavy[0].simulate(wavy[1].sample(jax.random.key(0), 500), STEPS))
    sizes = abs(states).max(axis=(0, 1))
    return rj.Box(-1.3 * sizes, 1.3 * sizes)


@pytest.mark.parametrize("cells", [None, 300])
@pytest.mark.costly
def test_halves_prove_a_smooth_loop_without_any_program(wavy, room, programs, cells):
    verdict = rj.decide(*wavy, STEPS, safe=room, cells=cells)
    assert verdict.status is rj.VerdictStatus.PROVED
    assert len(verdict.cells) > 1
    assert not programs


@pytest.mark.costly
def test_a_whole_set_that_forms_prove_keeps_its_certificates(wavy):
    verdict = rj.decide(*wavy, STEPS, safe=rj.Box([-50.0, -50.0], [50.0, 50.0]))
    assert verdict.status is rj.VerdictStatus.PROVED
    assert not verdict.cells
    assert all(proof.recheck().all() for proof in verdict.certificates.values())


def test_programs_are_the_last_remedy_of_cells_that_may_not_be_halved(programs):
    # u = -0.4 x in two rectifiers, whose lines forms take for granted only up to their gaps
    net = rj.MLP.from_layers([([[1.0], [-1.0]], [0.0, 0.0]), ([[-0.4, 0.4]], [0.0])])
    plant = rj.NonlinearPlant(lambda x, u: x + u + 1e-3 * jnp.sin(x), 1, 1)
    loop, X0 = rj.ClosedLoop(plant, net), rj.Box([-1.0], [2.0])
    goal = rj.Box([-0.62], [1.22])
    without = rj.BranchAndCut(nodes=0)
    assert rj.decide(loop, X0, 1, goal=goal, cells=1, relaxation=without).status.name == "UNKNOWN"
    assert rj.decide(loop, X0, 1, goal=goal, cells=1).status.name == "PROVED"
    assert programs


@pytest.mark.parametrize("many", [8, 12])
@pytest.mark.costly
def test_a_set_without_bounds_is_halved_like_any_part_of_it(many):
    # all states go to -1, 0 or 1; forms of the whole set end beyond all numbers, or nearly
    def step(x, u):
        for _ in range(many):
            x = x + 0.3 * (x - x**3)
        return x + u

    loop = rj.ClosedLoop(rj.NonlinearPlant(step, 1, 1), rj.Network(lambda x: 0.0 * x, 1, 1))
    X0 = rj.Box([-1.5], [1.5])
    tube = rj.reach(loop, X0, 1, rj.Template.box(1), rj.BranchAndCut(cells=64))
    states = np.asarray(loop.simulate(X0.sample(jax.random.key(0), 500), 1))[:, 1]
    assert bool(tube.sets[1].contains(jnp.asarray(states), 1e-9).all())
    assert (np.asarray(tube.sets[1].b) < 1.01).all()
    assert rj.decide(loop, X0, 1, goal=rj.Box([-1.1], [1.1])).status.name == "PROVED"
    if many > 8:
        with pytest.raises(UnboundedError, match="shorter step of integration"):
            rj.reach(loop, X0, 1, rj.Template.box(1), rj.LinearBounds())


@pytest.mark.parametrize(
    ("relaxation", "parts"),
    [(rj.LinearBounds(), "smaller cells of X0"), (rj.BranchAndCut(cells=2), "a smaller X0")],
)
def test_bounds_that_overflow_are_not_said_to_be_states(relaxation, parts):
    def step(x, u):
        ones = jnp.sin(9 * x) ** 2 + jnp.cos(9 * x) ** 2
        return 1e306 * (x + 900 * ones - 900) + u

    loop = rj.ClosedLoop(rj.NonlinearPlant(step, 1, 1), rj.Network(lambda x: 0.0 * x, 1, 1))
    with pytest.raises(ValueError, match=f"bounds of .* at t = 1 overflow .* shorter .*{parts}"):
        rj.reach(loop, rj.Box([-1.5], [1.5]), 1, rj.Template.box(1), relaxation)


def test_a_pole_is_named_with_its_line_its_time_its_range_and_the_smallest_cell():
    plant = rj.NonlinearPlant(lambda x, u: 1 / x + u, 1, 1)
    loop = rj.ClosedLoop(plant, rj.Network(lambda x: -0.1 * x, 1, 1))
    with pytest.raises(
        UnboundedError, match=r"Reciprocal.*test_halving.py.* at t = 0 .*\[-"
    ) as found:
        rj.reach(loop, rj.Box([-1.0], [1.3]), 2, rj.Template.box(1), rj.BranchAndCut(cells=32))
    assert "even over one of" in str(found.value)
    assert "smaller X0" in str(found.value)


def test_a_remainder_that_is_infinite_says_where_and_what_to_do():
    loop = rj.ClosedLoop(
        rj.NonlinearPlant(lambda x, u: 1 / x + u, 1, 1), rj.Network(lambda x: 0 * x, 1, 1)
    )
    message = r"Reciprocal .in .*test_halving.* at t = 0 has inputs in .-.*, .*cells"
    for relaxation in (rj.LinearBounds(), rj.BranchAndCut()):
        with pytest.raises(ValueError, match=message):
            rj.reach(loop, rj.Box([-1.0], [1.0]), 1, rj.Template.box(1), relaxation)
    whole = rj.BranchAndCut(cells=1)
    with pytest.raises(ValueError, match=message):
        rj.decide(loop, rj.Box([-1.0], [1.0]), 1, goal=rj.Box([-1e9], [1e9]), relaxation=whole)
