"""Trajectories that break a requirement are enclosed closely however many steps they have."""

import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.loops.closed_loop import Scenario
from reachjax.loops.units import UnboundedError
from reachjax.numerics.host import in_numpy
from reachjax.programs.bounds import successor_box
from reachjax.programs.unrolled import boxes_from_point
from reachjax.verdicts.counterexamples import enclosures

H = 0.1
FIRST = np.array([[0.4, -2.5, -3.1], [0.1, -0.3, 0.6], [0.2, 0.1, -0.4]]), np.array([0.1, 0.0, 0.2])
LAST = np.array([[8.0, 1.5, -2.0]]), np.array([0.1])
"""A network that steers back to the axis of the first coordinate, firmly."""
X0 = rj.Box([0.0, 0.1, -0.1], [0.1, 0.2, 0.1])
ROOM = 0.05
"""By so much a requirement is broken, at most."""


def rates(x, u):
    return jnp.array([jnp.cos(x[2]), jnp.sin(x[2]), u[0]])


def euler(x, u):
    return x + H * rates(x, u)


def runge_kutta(x, u):
    k1 = rates(x, u)
    k2 = rates(x + H / 2 * k1, u)
    k3 = rates(x + H / 2 * k2, u)
    return x + H / 6 * (k1 + 2 * k2 + 2 * k3 + rates(x + H * k3, u))


PLANTS = {
    "Euler": lambda: rj.NonlinearPlant(euler, 3, 1),
    "Runge-Kutta": lambda: rj.NonlinearPlant(runge_kutta, 3, 1),
    "equation": lambda: rj.SampledPlant(rates, 3, 1, H),
}


def unicycle(kind):
    return rj.ClosedLoop(PLANTS[kind](), rj.MLP.from_layers([FIRST, LAST], rj.Tanh()))


def widths(boxes):
    return [float(np.max(np.asarray(box.upper) - np.asarray(box.lower))) for box in boxes]


def from_box_to_box(loop, x0, steps):
    """Boxes around successors of boxes, which forget what their coordinates have in common."""
    found = [rj.Box(x0, x0)]
    for t in range(steps):
        found.append(successor_box(loop, found[-1], t))
    return found


def more_precisely(x0, steps):
    """The trajectory of Euler's unicycle in numbers of more digits than enclosures round to."""
    x, found = np.asarray(x0, np.longdouble), []
    for _ in range(steps):
        hidden = np.tanh(FIRST[0].astype(np.longdouble) @ x + FIRST[1])
        u = LAST[0].astype(np.longdouble) @ hidden + LAST[1]
        h = np.longdouble(H)
        x = x + h * np.array([np.cos(x[2]), np.sin(x[2]), u[0]])
        found.append(x)
    return found


@pytest.mark.parametrize(
    ("kind", "steps"),
    [
        ("Euler", 30),
        ("Euler", 150),
        pytest.param("Runge-Kutta", 30, marks=pytest.mark.costly),
        pytest.param("Runge-Kutta", 150, marks=pytest.mark.costly),
        pytest.param("equation", 30, marks=pytest.mark.costly),
    ],
)
def test_a_clear_violation_after_many_periods_is_refuted(kind, steps):
    loop = unicycle(kind)
    limit = float(loop.simulate(X0.upper, steps)[-1, 0]) - ROOM
    avoid = rj.Polytope([[-1.0, 0.0, 0.0]], [-limit])
    verdict = rj.decide(loop, X0, steps, avoid={steps: [avoid]}, time_limit=60)
    assert verdict.refuted
    example = verdict.counterexample
    assert example.time == steps
    assert np.max(example.upper - example.lower) < 1e-9
    wide = from_box_to_box(in_numpy(loop), example.states[0], 30)[-1]
    assert wide.lower[0] < example.states[30, 0] - ROOM


def test_enclosures_of_many_periods_hold_the_exact_trajectory():
    loop, x0 = in_numpy(unicycle("Euler")), np.array([0.05, 0.2, -0.1])
    boxes = enclosures(loop, Scenario(x0, None, None), 150, 0)
    for box, state in zip(boxes[1:], more_precisely(x0, 150), strict=True):
        assert np.all((box.lower <= state) & (state <= box.upper))
    assert widths(boxes)[-1] < 1e-9


def pushed(kind):
    def field(x, u, w):
        return jnp.array([x[1], jnp.sin(x[0]) + u[0] + w[0]])

    plant = {
        "function": lambda: rj.NonlinearPlant(lambda x, u, w: x + H * field(x, u, w), 2, 1, 1),
        "equation": lambda: rj.SampledPlant(field, 2, 1, H, 1, held=True),
        "matrices": lambda: rj.AffinePlant([[1.0, H], [H, 1.0]], [[0.0], [H]], E=[[0.0], [H / 3]]),
    }[kind]()
    net = rj.MLP.from_layers([([[-1.5, -0.5], [0.3, 0.2]], [0.1, 0.0]), ([[2.0, 1.0]], [0.0])])
    box = rj.Box([-0.1], [0.3])
    return rj.ClosedLoop(plant, net, disturbance=box, noise=rj.Box([-0.1] * 2, [0.1] * 2))


@pytest.mark.parametrize("kind", ["function", "equation", "matrices"])
def test_known_disturbances_and_noise_are_those_of_the_trajectory(kind):
    loop, rng, steps = in_numpy(pushed(kind)), np.random.default_rng(0), 6
    w, v = rng.uniform(-0.1, 0.3, size=(steps, 1)), rng.uniform(-0.1, 0.1, size=(steps, 2))
    x0 = np.array([0.3, -0.2])
    found = list(boxes_from_point(loop, Scenario(x0, w, v), steps, 2))
    known = rj.Box(x0, x0)
    for t, box in enumerate(found):
        known = successor_box(loop, known, 2 + t, w[t], v[t])
        assert np.all(box.lower <= known.upper)  # both hold the exact trajectory
        assert np.all(known.lower <= box.upper)
    assert widths(found)[-1] < 1e-12


def test_where_forms_have_no_bounds_boxes_go_on_and_say_nothing_false():
    """The second root is of what may be below zero, by rounding; the first one is known."""
    plant = rj.NonlinearPlant(lambda x, u, w: jnp.sqrt(x + w) + u, 1, 1, 1)
    net = rj.MLP.from_layers([([[0.0]], [0.0])])
    loop = in_numpy(rj.ClosedLoop(plant, net, disturbance=rj.Box([0.0], [1.0])))
    scenario = Scenario(np.zeros(1), np.zeros((2, 1)), None)
    with pytest.raises(UnboundedError):
        list(boxes_from_point(loop, scenario, 2))
    _, first, last = enclosures(loop, scenario, 2, 0)
    assert first.lower[0] <= 0.0 <= first.upper[0] < 1e-150
    assert not last.lower[0] > 0.0
    assert not last.upper[0] < 0.0


@pytest.mark.parametrize("scale", [1.0, 1e-6])
def test_the_earliest_clear_violation_is_shown_whatever_the_units_of_another_one(scale):
    """A state that grows by one at each step is beside the limit of 2.5 by a tenth of 27.5 at six.

    The second state is in other units: how far it is beside its own limit says nothing of that.
    """
    plant = rj.AffinePlant(np.eye(2), np.zeros((2, 1)), [1.0, 1.0 / scale])
    loop = rj.ClosedLoop(plant, rj.MLP.from_layers([([[0.0, 0.0]], [0.0])]))
    start = rj.Box([0.0, 0.0], [1e-3, 1e-3 / scale])
    safe, avoid = rj.Polytope([[1.0, 0.0]], [2.5]), rj.Polytope([[0.0, -1.0]], [-25.5 / scale])
    example = rj.decide(loop, start, 30, safe=safe, avoid=[avoid]).counterexample
    assert (example.requirement, example.time) == ("safe", 6)
