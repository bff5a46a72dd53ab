"""Bounds by supports and linear relaxations hold on every sample, and no interval is tighter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.methods.steps import Setting, Step
from reachjax.programs.bounds import loop_bounds, successor_box
from reachjax.programs.preactivations import bounds_over, known_inputs
from reachjax.programs.windows import Window
from tests.closed_loops import closed_loop, random_loop
from tests.networks import (
    affine_network,
    box_region,
    dead_network,
    he_network,
    saturating_network,
    simplex_region,
    simulate,
)
from tests.quick_cases import some

NETWORKS = [he_network, saturating_network, dead_network, affine_network]
SETS = [
    *((kind, n_x) for n_x in (1, 2, 3, 6) for kind in ("box", "polytope", "flat", "point")),
    *(("ellipsoid", n_x) for n_x in (1, 2, 6)),
    ("intersection", 3),
]
QUICK = {"box": (1, 6), "polytope": (2, 3), "flat": (1, 3), "point": (2, 6), "ellipsoid": (2, 6)}


def quick(kind, n_x):
    """Whether the test command has it: every kind, and every dimension."""
    return kind not in QUICK or n_x in QUICK[kind]


THIN = ("flat", "point")
ROUNDING = 1e-14
"""Of what is simulated with numpy, as a part of the largest number it is a sum of."""

bounds_over = jax.jit(bounds_over)
intervals = jax.jit(loop_bounds)


def initial(kind, n_x, seed=0):
    """A set of this kind; the flat ones have no width along one axis, or along any."""
    corners = box_region(n_x, seed).corners
    box = rj.Box(corners.min(axis=0), corners.max(axis=0))
    ball = rj.Ellipsoid(box.center, jnp.diag((box.widths / 2) ** 2))
    simplex = simplex_region(n_x, seed)
    return {
        "box": box,
        "polytope": rj.Polytope(simplex.A, simplex.b),
        "ellipsoid": ball,
        "intersection": rj.Intersection(rj.Box(box.center - box.widths, box.center), ball),
        "flat": rj.Box(box.lower, box.upper.at[0].set(box.lower[0])),
        "point": rj.Box(box.lower, box.lower),
    }[kind]


def samples(X, count=4000):
    """Points of a set, and its corners if it has any."""
    points = X.sample(jax.random.key(0), count)
    corners = X.vertices() if hasattr(X, "vertices") else points[:0]
    return np.asarray(jnp.concatenate([points, corners]))


def linear_bounds(loop, X, t=0):
    """What a window of one step has for bounds, where a relaxation asks for linear ones."""
    setting = Setting(loop, t, rj.AllProducts(), rj.Auto(), None, False, None)
    known, box = known_inputs(loop.units, Step(setting, X, 0, ()).first_inputs), X.bounding_box()
    return bounds_over(loop, X.closed_form(box), box, t, known).preactivation


def preactivations(data, x, t=0):
    """The inputs (k, units) of all units at the points x (k, n_x): neurons, then projections."""
    *hidden, (W, b) = data.layers
    inputs, z = [], x
    for V, a in hidden:
        inputs.append(z @ V.T + a)
        z = np.maximum(inputs[-1], 0.0)
    lower, upper = data.at(t)[3:]
    if lower is not None:
        inputs.append(z @ W.T + b - lower)
        inputs.append(upper - lower - np.maximum(inputs[-1], 0.0))
    return np.hstack(inputs)


def check_sound(data, X, t=0):
    inputs = preactivations(data, samples(X), t)
    bounds = linear_bounds(closed_loop(data), X, t)
    size = ROUNDING * abs(inputs).max()
    assert np.all(inputs <= bounds.upper + size)
    assert np.all(inputs >= bounds.lower - size)


@pytest.mark.parametrize(("kind", "n_x"), some(SETS, quick))
@pytest.mark.costly
def test_no_sampled_input_of_a_unit_is_beyond_its_bounds(kind, n_x):
    for seed, network in enumerate(NETWORKS):
        check_sound(random_loop(n_x, seed=seed, network=network), initial(kind, n_x, seed))


@pytest.mark.parametrize("t", range(3))
@pytest.mark.costly
def test_a_time_varying_loop_has_the_bounds_of_its_time(t):
    data = random_loop(3, seed=2, steps=3)
    check_sound(data, initial("box", 3, seed=2), t)
    bounds = [
        linear_bounds(closed_loop(data), initial("box", 3), step) for step in (t, (t + 1) % 3)
    ]
    # only the projection, the last four units, depends on the time
    assert np.all(bounds[0].upper[:-4] == bounds[1].upper[:-4])
    assert np.all(bounds[0].upper[-4:] != bounds[1].upper[-4:])


@pytest.mark.parametrize(("kind", "n_x"), some(SETS, quick))
@pytest.mark.costly
def test_no_bound_is_looser_than_that_by_intervals(kind, n_x):
    for seed in range(3):
        loop, X = closed_loop(random_loop(n_x, seed=seed)), initial(kind, n_x, seed)
        bounds = linear_bounds(loop, X)
        plain = intervals(loop, X.bounding_box(), 0).preactivation
        # ends are rounded outwards where a midpoint and a radius are formed of them again
        size = 1e-13 * (abs(plain.mid) + plain.rad)
        assert np.all(bounds.upper <= plain.upper + size)
        assert np.all(bounds.lower >= plain.lower - size)


@pytest.mark.parametrize(
    ("kind", "n_x"), some((case for case in SETS if case[0] not in THIN), quick)
)
@pytest.mark.costly
def test_some_bounds_are_much_tighter_than_those_by_intervals(kind, n_x):
    data, X = random_loop(n_x, seed=1), initial(kind, n_x, seed=1)
    bounds = linear_bounds(closed_loop(data), X)
    plain = intervals(closed_loop(data), X.bounding_box(), 0).preactivation
    assert np.min(bounds.rad / plain.rad) < 0.8


@pytest.mark.parametrize("n_x", [1, 2, 3, 6])
@pytest.mark.costly
def test_the_bounds_of_the_first_layer_are_its_supports(n_x):
    data = random_loop(n_x, seed=4)
    W, b = data.layers[0]
    box, simplex = box_region(n_x, seed=4).corners, simplex_region(n_x, seed=4).corners
    ball = initial("ellipsoid", n_x, seed=4)
    middle = W @ np.asarray(ball.center)
    spread = np.linalg.norm(W @ np.sqrt(np.asarray(ball.shape)), axis=1)  # its shape is diagonal
    for kind, largest, smallest in (
        ("box", (box @ W.T).max(axis=0), (box @ W.T).min(axis=0)),
        ("polytope", (simplex @ W.T).max(axis=0), (simplex @ W.T).min(axis=0)),
        ("ellipsoid", middle + spread, middle - spread),
    ):
        bounds = linear_bounds(closed_loop(data), initial(kind, n_x, seed=4))[: len(b)]
        # supports are rounded outwards, those of polytopes after a linear program's 1e-9
        assert np.all(largest + b <= bounds.upper + ROUNDING)
        assert np.all(smallest + b >= bounds.lower - ROUNDING)
        np.testing.assert_allclose(bounds.upper, largest + b, atol=1e-8)
        np.testing.assert_allclose(bounds.lower, smallest + b, atol=1e-8)


@pytest.mark.parametrize("n_x", [1, 2, 3, 6])
@pytest.mark.costly
def test_a_single_point_has_inputs_and_not_intervals(n_x):
    data, X = random_loop(n_x, seed=3), initial("point", n_x, seed=3)
    bounds, inputs = linear_bounds(closed_loop(data), X), preactivations(data, samples(X, 1))[0]
    np.testing.assert_allclose(bounds.lower, inputs, atol=1e-12)
    np.testing.assert_allclose(bounds.upper, inputs, atol=1e-12)


@pytest.mark.costly
def test_a_loop_whose_neurons_do_not_switch_has_exact_bounds():
    data, X = random_loop(2, seed=2, network=affine_network), initial("ellipsoid", 2, seed=2)
    bounds = linear_bounds(closed_loop(data), X)
    inputs = preactivations(data, np.asarray(X.sample_boundary(jax.random.key(0), 20_000)))
    # 20,000 points of a circle are that close to each other
    first = slice(0, -2)  # the upper projection comes after one that may switch
    reach = np.ptp(inputs[:, first], axis=0)
    assert np.all(2 * np.asarray(bounds.rad)[first] <= (1 + 1e-4) * reach)


@pytest.mark.parametrize("scale", [1e-8, 1e3, 1e8])
@pytest.mark.parametrize("kind", ["box", "polytope", "intersection"])
@pytest.mark.costly
def test_weights_of_any_size_have_sound_bounds(kind, scale):
    data = random_loop(3, seed=5)
    data.layers[:] = [(scale * W, scale * b) for W, b in data.layers]
    check_sound(data, initial(kind, 3, seed=5))


@pytest.mark.costly
def test_weights_that_overflow_prove_nothing():
    data, X = random_loop(2, seed=5), initial("box", 2, seed=5)
    data.layers[:] = [(1e200 * W, 1e200 * b) for W, b in data.layers]
    bounds = linear_bounds(closed_loop(data), X)
    # not a number is no bound: only one that is could be wrong
    last = slice(6, None)
    assert not np.any(np.isfinite(bounds.upper[last]) & np.isfinite(bounds.lower[last]))


@pytest.mark.costly
@pytest.mark.parametrize("kind", ["box", "ellipsoid"])
def test_every_fact_of_a_window_holds_on_trajectories(kind):
    data, X = random_loop(2, hidden=(5, 4), seed=2, steps=2), initial(kind, 2, seed=2)
    loop, box = closed_loop(data), X.bounding_box()
    after = successor_box(loop, box, 0)
    window = Window.beginning(loop, X, box, 0, rj.AllProducts()).extended(loop, X, box)
    window = window.extended(loop, after, after)
    program = window.program(jnp.eye(2), rj.AllProducts())
    points = samples(X)
    path = simulate(data, points, 2)
    units = [np.maximum(preactivations(data, path[t], t), 0.0) for t in range(2)]
    basis = np.hstack([points, *units, np.ones((len(points), 1))])
    # columns of units that left the basis are empty, in rows as in the scaling
    scaled = basis @ np.linalg.pinv(np.asarray(program.transform)).T
    linear = np.asarray(program.facts.mid)[list(window.layout.linear)]
    values = scaled @ linear.T
    # facts hold up to their own rounding, the radius of the rows, and that of the pseudoinverse
    assert values.min() >= -1e-12 * abs(linear).max() * abs(scaled).max()
    ends = scaled @ np.asarray(program.objective.mid).T
    np.testing.assert_allclose(ends, path[2], atol=1e-10)
