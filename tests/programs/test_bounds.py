"""Claims about the interval bounds of one step: they hold on samples, and are no looser than told.

An independent propagation of intervals through the same layers says how tight they must be.
"""

import jax
import numpy as np
import pytest

import reachjax as rj
from reachjax.programs.bounds import loop_bounds
from tests.closed_loops import closed_loop
from tests.networks import (
    LoopData,
    affine_network,
    dead_network,
    he_network,
    input_box,
    plant,
    saturating_network,
)

STATES = [1, 2, 3, 6]
STEPS, TIME = 3, 2
NETWORKS = [he_network, dead_network, affine_network, saturating_network]


def loop_data(n_x, boxed, network=he_network, hidden=(6, 4)):
    n_u = min(n_x, 2)
    box = input_box(n_u, n_x, STEPS) if boxed else (None, None)
    return LoopData(
        network((n_x, *hidden, n_u), 30 + n_x), *plant(n_x, n_u, n_x, steps=STEPS), *box
    )


def state_box(n_x):
    rng = np.random.default_rng(n_x)
    center, radius = rng.uniform(-0.5, 0.5, n_x), rng.uniform(0.1, 0.4, n_x)
    return center - radius, center + radius


def simulated(data, x):
    """Preactivations (k, units), outputs (k, units) and successors (k, n_x) of states x."""
    A, B, c, lower, upper = data.at(TIME)
    ys, zs, v = [np.zeros((len(x), 0))], [np.zeros((len(x), 0))], x
    for W, b in data.layers[:-1]:
        ys.append(v @ W.T + b)
        v = np.maximum(ys[-1], 0.0)
        zs.append(v)
    W, b = data.layers[-1]
    u = v @ W.T + b
    if lower is not None:
        ys.append(u - lower)
        zs.append(np.maximum(ys[-1], 0.0))
        ys.append(upper - lower - zs[-1])
        zs.append(np.maximum(ys[-1], 0.0))
        u = upper - zs[-1]
    return np.hstack(ys), np.hstack(zs), x @ A.T + u @ B.T + c


def intervals(data, lower, upper):
    """Lower and upper bounds of every preactivation, by the sign of each weight."""

    def image(W, b, low, high):
        plus, minus = np.maximum(W, 0), np.minimum(W, 0)
        return plus @ low + minus @ high + b, plus @ high + minus @ low + b

    _, _, _, u_lower, u_upper = data.at(TIME)
    found = [(np.zeros(0), np.zeros(0))]
    for W, b in data.layers[:-1]:
        found.append(image(W, b, lower, upper))
        lower, upper = (np.maximum(side, 0.0) for side in found[-1])
    if u_lower is not None:
        low, high = image(*data.layers[-1], lower, upper)
        found.append((low - u_lower, high - u_lower))
        low, high = (np.maximum(side, 0.0) + u_lower for side in found[-1])
        found.append((u_upper - high, u_upper - low))
    return tuple(np.concatenate(side) for side in zip(*found, strict=True))


@pytest.fixture(
    scope="module",
    params=[(n, boxed, net) for n in STATES for boxed in (True, False) for net in NETWORKS],
    ids=lambda p: f"{p[0]} states, {'box' if p[1] else 'no box'}, {p[2].__name__}",
)
def case(request):
    """(data, lower, upper, bounds at t = 2)."""
    n_x, boxed, network = request.param
    data = loop_data(n_x, boxed, network)
    lower, upper = state_box(n_x)
    bounds = jax.jit(loop_bounds)(closed_loop(data), rj.Box(lower, upper), TIME)
    return data, lower, upper, bounds


def affine_units(bounds):
    """Masks of the units that are the identity, and of those that are zero."""
    affine, (slope, offset) = np.asarray(bounds.affine), bounds.lines.above
    assert np.all(offset[affine] == 0)
    assert np.all((slope[affine] == 0) | (slope[affine] == 1))
    return affine & np.asarray(slope == 1), affine & np.asarray(slope == 0)


def samples(lower, upper):
    rng = np.random.default_rng(0)
    inside = rng.uniform(lower, upper, (2000, len(lower)))
    return np.vstack([inside, rng.choice([0.0, 1.0], (200, len(lower))) * (upper - lower) + lower])


def test_everything_simulated_lies_within_its_bounds(case):
    data, lower, upper, bounds = case
    x = samples(lower, upper)
    y, z, successor = simulated(data, x)
    for name, values in (
        ("state", x),
        ("preactivation", y),
        ("output", z),
        ("successor", successor),
    ):
        ball = getattr(bounds, name)
        assert ball.mid.shape == values.shape[1:], name
        rounding = 1e-13 * np.maximum(1.0, np.abs(values))  # of this simulation
        assert np.all(np.asarray(ball.lower) <= values + rounding), name
        assert np.all(values - rounding <= np.asarray(ball.upper)), name


def test_preactivation_bounds_are_those_of_interval_arithmetic(case):
    data, lower, upper, bounds = case
    expected_lower, expected_upper = intervals(data, lower, upper)
    np.testing.assert_allclose(bounds.preactivation.lower, expected_lower, rtol=0, atol=1e-11)
    np.testing.assert_allclose(bounds.preactivation.upper, expected_upper, rtol=0, atol=1e-11)


def test_masks_name_the_units_that_are_surely_affine(case):
    data, lower, upper, bounds = case
    low, high = intervals(data, lower, upper)
    passing, blocking = affine_units(bounds)
    np.testing.assert_array_equal(passing, low > 0)
    np.testing.assert_array_equal(blocking, high < 0)
    y, _, _ = simulated(data, samples(lower, upper))
    assert (y[:, passing] >= 0).all()
    assert (y[:, blocking] <= 0).all()


@pytest.mark.costly
def test_the_networks_have_units_of_all_three_kinds():
    kinds = []
    for network in NETWORKS:
        data = loop_data(3, True, network)
        bounds = loop_bounds(closed_loop(data), rj.Box(*state_box(3)), TIME)
        passing, blocking = affine_units(bounds)
        kinds.append([passing.any(), blocking.any(), (~passing & ~blocking).any()])
    assert np.array(kinds).any(axis=0).all()


@pytest.mark.parametrize("n_x", STATES)
@pytest.mark.costly
def test_bounds_of_the_first_layer_are_attained_at_corners(n_x):
    data, box = loop_data(n_x, True), rj.Box(*state_box(n_x))
    y = np.asarray(box.vertices()) @ data.layers[0][0].T + data.layers[0][1]
    first = loop_bounds(closed_loop(data), box, TIME).preactivation[: y.shape[1]]
    np.testing.assert_allclose(first.upper, y.max(axis=0), rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(first.lower, y.min(axis=0), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("n_x", STATES)
def test_a_linear_controller_without_input_box_has_no_units(n_x):
    data = loop_data(n_x, False, hidden=())
    lower, upper = state_box(n_x)
    bounds = loop_bounds(closed_loop(data), rj.Box(lower, upper), TIME)
    assert bounds.preactivation.mid.shape == bounds.output.mid.shape == (0,)
    assert bounds.affine.shape == bounds.excess.shape == (0,)
    successor = simulated(data, samples(lower, upper))[2]
    assert (np.asarray(bounds.successor.lower) <= successor.min(axis=0)).all()
    assert (np.asarray(bounds.successor.upper) >= successor.max(axis=0)).all()


def test_a_neuron_that_is_constantly_zero_is_affine():
    net = rj.MLP.from_layers([([[0.0]], [0.0]), ([[1.0]], [0.0])])
    loop = rj.ClosedLoop(rj.AffinePlant([[1.0]], [[1.0]]), net)
    bounds = loop_bounds(loop, rj.Box([0.0], [1.0]), 0)
    assert bool(bounds.affine[0])
    assert float(bounds.output.upper[0]) <= 1e-300


@pytest.mark.parametrize("size", [1e10, 1e14])
def test_what_counts_as_zero_is_off_by_no_more_than_the_input_box(size):
    net = rj.MLP.from_layers([([[size, size]], [0.0]), ([[1.0]], [0.0])])  # inputs of 0 to `size`
    loop = rj.ClosedLoop(rj.AffinePlant(np.eye(2), np.ones((2, 1))), net, rj.Box([-1.0], [1.0]))
    bounds = loop_bounds(loop, rj.Box([-1.0, -1.0], [1.0, 1.0]), 0)
    assert bool(
        affine_units(bounds)[1][-1]
    )  # 1 - u, whose part above zero is next to nothing of `size`
    assert 1.0 <= float(bounds.excess[-1]) <= 1.0 + 1e-13 * size
