"""Claims about the rows over the basis `[x, z, 1]`: they give what is simulated."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.programs.basis import columns, loop_rows
from reachjax.programs.bounds import loop_bounds
from tests.closed_loops import closed_loop
from tests.networks import LoopData, dead_network, he_network, input_box, plant

STATES = [1, 2, 3, 6]
STEPS, TIME = 3, 2
fractions = np.vectorize(Fraction, otypes=[object])


def loop_data(n_x, boxed, hidden=(6, 4)):
    n_u = min(n_x, 2)
    box = input_box(n_u, n_x, STEPS) if boxed else (None, None)
    network = dead_network if hidden else he_network  # some neurons are off, some are not
    layers = network((n_x, *hidden, n_u), 40 + n_x)
    if hidden:
        layers[0][1][-1] += 20.0  # and one is always on
        layers[1][1][:] -= 20.0 * layers[1][0][:, -1]
    return LoopData(layers, *plant(n_x, n_u, n_x, steps=STEPS), *box)


def state_box(n_x):
    rng = np.random.default_rng(n_x)
    center, radius = rng.uniform(-0.5, 0.5, n_x), rng.uniform(0.1, 0.4, n_x)
    return center - radius, center + radius


def layers_of(data, x):
    """Inputs `y` and outputs `z` of each layer of units, and the successors, of states x."""
    A, B, c, lower, upper = data.at(TIME)
    ys, zs, v = [], [], x
    for W, b in data.layers[:-1]:
        ys.append(v @ W.T + b)
        v = np.maximum(ys[-1], 0.0)
        zs.append(v)
    u = v @ data.layers[-1][0].T + data.layers[-1][1]
    if lower is not None:
        ys.append(u - lower)
        zs.append(np.maximum(ys[-1], 0.0))
        ys.append(upper - (zs[-1] + lower))
        zs.append(np.maximum(ys[-1], 0.0))
        u = upper - zs[-1]
    return ys, zs, x @ A.T + u @ B.T + c


@jax.jit
def bounds_and_rows(loop, box, t):
    """Bounds, and rows without and with pruning."""
    bounds, n = loop_bounds(loop, box, t), loop.states
    state, places = columns(0, n, n + loop.units + 1), n + jnp.arange(loop.units)
    return bounds, [loop_rows(loop, state, places, t, bounds, prune) for prune in (False, True)]


@pytest.fixture(
    scope="module",
    params=[(n, b, h, p) for n in STATES for b in (0, 1) for h in ((6, 4), ()) for p in (0, 1)],
    ids=lambda p: f"{p[0]} states, {'no ' * (not p[1])}box, {p[2]}, {'all' * (not p[3])}",
)
def case(request):
    """(rows, bounds, prune, simulated x, y, z, successor)."""
    n_x, boxed, hidden, prune = request.param
    data, (lower, upper) = loop_data(n_x, boxed, hidden), state_box(n_x)
    bounds, both = bounds_and_rows(closed_loop(data), rj.Box(lower, upper), TIME)
    x = np.random.default_rng(0).uniform(lower, upper, (500, n_x))
    ys, zs, successor = layers_of(data, x)
    none = np.zeros((len(x), 0))
    return both[prune], bounds, prune, x, np.hstack([none, *ys]), np.hstack([none, *zs]), successor


def basis_points(x, z):
    return np.hstack([x, z, np.ones((len(x), 1))])


def values(rows, points):
    return points @ np.asarray(rows.mid).T


def test_every_row_gives_the_simulated_number(case):
    rows, _, _, x, y, z, successor = case
    points = basis_points(x, z)
    for name, expected in (
        ("state", x),
        ("preactivation", y),
        ("output", z),
        ("successor", successor),
    ):
        actual = values(getattr(rows, name), points)
        np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-12, err_msg=name)


def test_facts_are_nonnegative_and_outputs_complement_slacks(case):
    rows, _, _, x, y, z, _ = case
    if not rows.facts:
        assert not y.shape[1]
        return
    (stated,) = rows.facts  # of one kind of unit
    facts = [values(block.rows, basis_points(x, z)) for block in stated.blocks]
    assert all((part >= -1e-9).all() for part in facts)
    output, slack, output_cap, slack_cap = facts
    np.testing.assert_allclose(output, np.maximum(y, 0), rtol=0, atol=1e-12)
    np.testing.assert_allclose(slack, np.maximum(-y, 0), rtol=0, atol=1e-12)
    np.testing.assert_allclose(output * slack, 0.0, atol=1e-9)
    _, bounds, *_ = case
    low, high = np.asarray(bounds.preactivation.lower), np.asarray(bounds.preactivation.upper)
    np.testing.assert_allclose(output_cap, np.maximum(high, 0) - output, rtol=0, atol=1e-12)
    np.testing.assert_allclose(slack_cap, np.maximum(-low, 0) - slack, rtol=0, atol=1e-12)


def test_pruning_empties_the_columns_of_stable_units_in_all_rows(case):
    rows, bounds, prune, x, _, z, _ = case
    stable = np.asarray(bounds.affine)
    gone = x.shape[1] + np.flatnonzero(stable) if prune else []
    for part in jax.tree.leaves(rows):
        np.testing.assert_array_equal(part[:, gone], 0.0)
    if z.shape[1] and not prune:
        used = np.abs(rows.output.mid).sum(axis=0)[x.shape[1] : -1]
        np.testing.assert_array_equal(used, 1.0)


@pytest.mark.costly
def test_pruning_meets_units_that_pass_that_block_and_that_do_neither():
    loop = closed_loop(loop_data(3, True))
    bounds, _ = bounds_and_rows(loop, rj.Box(*state_box(3)), TIME)
    affine, slope = np.asarray(bounds.affine), np.asarray(bounds.lines.above.slope)
    assert (affine & (slope == 1)).any()
    assert (affine & (slope == 0)).any()
    assert (~affine).any()


def exact_rows(data, bounds, prune):
    """The rows in exact arithmetic: preactivation, output, successor."""
    A, B, c, lower, upper = (fractions(part) for part in data.at(TIME))
    n, size = A.shape[0], A.shape[0] + len(bounds.affine) + 1
    unit_vectors, one = fractions(np.eye(size)), fractions(np.eye(size))[-1:]
    ys, zs, done = [], [], 0

    def unit(y):
        nonlocal done
        z = unit_vectors[n + done : n + done + len(y)].copy()
        for i in range(len(y)):
            if prune and bounds.affine[done + i]:
                z[i] = y[i] * int(bounds.lines.above.slope[done + i])
        done += len(y)
        ys.append(y)
        zs.append(z)
        return z

    state = v = unit_vectors[:n]
    *hidden, (W, b) = [(fractions(W), fractions(b)[:, None]) for W, b in data.layers]
    for weight, bias in hidden:
        v = unit(weight @ v + bias * one)
    u = W @ v + b * one
    u = unit(u - lower[:, None] * one) + lower[:, None] * one
    u = upper[:, None] * one - unit(upper[:, None] * one - u)
    return np.vstack(ys), np.vstack(zs), A @ state + B @ u + c[:, None] * one


@pytest.mark.parametrize("prune", [False, True])
@pytest.mark.parametrize("n_x", [1, 3])
@pytest.mark.costly
def test_coefficients_are_within_their_radii_of_the_exact_ones(n_x, prune):
    data = loop_data(n_x, True)
    bounds, both = bounds_and_rows(closed_loop(data), rj.Box(*state_box(n_x)), TIME)
    rows = both[prune]
    y, z, successor = exact_rows(data, bounds, prune)
    high = fractions(np.maximum(bounds.preactivation.upper, 0))[:, None]
    low = fractions(np.maximum(-bounds.preactivation.lower, 0))[:, None]
    one = fractions(np.eye(z.shape[1]))[-1:]
    exact = {
        "preactivation": (rows.preactivation, y),
        "output": (rows.output, z),
        "successor": (rows.successor, successor),
        "slack": (rows.facts[0]["slack"], z - y),
        "output cap": (rows.facts[0]["output cap"], high * one - z),
        "slack cap": (rows.facts[0]["slack cap"], low * one - (z - y)),
    }
    # compiled code may fuse the sums that the ends of ranges are, and round them otherwise
    ends = bounds.preactivation.lower, bounds.preactivation.upper
    digit = fractions(2.0**-51 * np.max(np.abs(ends), axis=0))[:, None] * one
    for name, (ball, expected) in exact.items():
        slack = digit if name.endswith("cap") else 0
        assert (abs(fractions(ball.mid) - expected) <= fractions(ball.rad) + slack).all(), name
        assert np.max(ball.rad) < 1e-11, name
    assert (fractions(rows.successor.mid) != successor).any()  # there is rounding to bound


@pytest.mark.parametrize("hidden", [(6, 4), ()], ids=["hidden layers", "linear"])
@pytest.mark.parametrize("boxed", [True, False], ids=["box", "no box"])
@pytest.mark.parametrize("n_x", STATES)
def test_the_papers_matrices_give_states_units_and_successor(n_x, boxed, hidden):
    data = loop_data(n_x, boxed, hidden)
    basis = rj.change_of_basis(closed_loop(data), t=TIME)
    x = np.random.default_rng(0).normal(size=(500, n_x))
    ys, zs, successor = layers_of(data, x)
    blocks = list(zs)
    if boxed:  # the paper keeps x^{l+1} and x^{l+2} = u in place of the last outputs
        lower, upper = data.at(TIME)[3:]
        blocks[-2:] = [zs[-2] + lower, upper - zs[-1]]
    one = np.ones((len(x), 1))
    points = np.hstack([x, *blocks, one])
    for name, expected in (
        ("E_in", [x, one]),
        ("E_mid", [*ys, *zs, one]),
        ("E_out", [successor, one]),
    ):
        actual = points @ np.asarray(getattr(basis, name)).T
        np.testing.assert_allclose(actual, np.hstack(expected), atol=1e-11, err_msg=name)


@pytest.mark.costly
def test_a_traced_time_compiles_once():
    loop, traces = closed_loop(loop_data(2, True)), []

    @jax.jit
    def successor(loop, box, t):
        traces.append(t)
        bounds = loop_bounds(loop, box, t)
        state = columns(0, 2, 3 + loop.units)
        places = 2 + jnp.arange(loop.units)
        return loop_rows(loop, state, places, t, bounds, prune=True).successor.mid

    box = rj.Box(*state_box(2))
    traced = [successor(loop, box, t) for t in range(STEPS)]
    assert len(traces) == 1
    for t in range(STEPS):
        alone = loop.replace(
            plant=rj.AffinePlant(*loop.plant.at(t)), input_box=loop.input_box.at(t)
        )
        np.testing.assert_allclose(traced[t], successor(alone, box, 0), atol=1e-14)
    assert jnp.ptp(jnp.stack(traced), axis=0).max() > 0.01
