"""Affine forms are what ten lines of numpy say, rounded outwards, and the same compiled."""

import itertools
from fractions import Fraction

import jax
import numpy as np
import pytest

import reachjax as rj
from reachjax.loops.units import AbstractUnit
from reachjax.numerics.pytrees import pytree
from reachjax.programs.affine import AffineForms
from reachjax.programs.affine_steps import step_forms
from reachjax.programs.initial import InitialColumns
from reachjax.programs.unrolled import unrolled, unrolled_at_once
from tests.activations import ACTIVATIONS, CONTROLLERS, LEAK, NAMES, UNITS, controlled
from tests.closed_loops import closed_loop, initial_set, random_loop, recursion
from tests.networks import box_region, directions

STEPS = 4


def box_of(n_x, seed=0):
    corners = box_region(n_x, seed).corners
    return rj.Box(corners.min(axis=0), corners.max(axis=0))


def repeated(D, steps=STEPS):
    return np.broadcast_to(D, (steps, *D.shape))


def offsets(loop, X0, D, **options):
    box = X0.bounding_box()
    return np.stack([step.offsets for step in unrolled(loop, X0, box, repeated(D), **options)])


def by_hand(case, box, D, steps):
    """Offsets (steps, m) of forms `c + G eta` met with intervals; nothing is rounded outwards."""
    *hidden, (W, b) = case.data.layers
    leak = {rj.ReLU(): 0.0, rj.LeakyReLU(LEAK): LEAK}.get(case.activation)

    def affine(W, y, b):
        c, G, low, high = y
        mid, rad = W @ (low + high) / 2 + b, abs(W) @ (high - low) / 2
        return W @ c + b, W @ G, mid - rad, mid + rad

    def ends(y):
        c, G, low, high = y
        r = abs(G).sum(axis=1)
        return np.maximum(c - r, low), np.minimum(c + r, high)

    def bent(y, a):
        c, G, *_ = y
        lo, u = ends(y)
        s = np.where(u <= 0, a, (u - a * lo) / np.where(u > lo, u - lo, 1))
        s = np.where(lo >= 0, 1.0, s)
        e = np.where((lo < 0) & (u > 0), (1 - s) * u / 2, 0.0)
        z = np.maximum(lo, a * lo), np.maximum(u, a * u)
        return s * c + e, np.hstack([s[:, None] * G, np.diag(e)]), *z

    def sum_of(x, y):
        c, G, low, high = y
        wide = np.hstack([x[1], np.zeros((len(c), G.shape[1] - x[1].shape[1]))])
        return x[0] + c, wide + G, x[2] + low, x[3] + high

    def clipped(y, low, high):
        eye = np.eye(len(y[0]))
        v = affine(eye, bent(affine(eye, y, -low), 0.0), low)
        return affine(-eye, bent(affine(-eye, v, high), 0.0), high)

    low, high = np.asarray(box.lower), np.asarray(box.upper)
    x, found = ((low + high) / 2, np.diag(high - low) / 2, low, high), []
    for t in range(steps):
        A, B, c, u_low, u_high = case.data.at(t)
        y = x
        for V, a in hidden:
            y = affine(V, y, a)
            y = clipped(y, -np.ones(len(a)), np.ones(len(a))) if leak is None else bent(y, leak)
        u = affine(W, y, b)
        if case.skip is not None:
            u = sum_of(affine(case.skip, x, 0.0), u)
        u = u if u_low is None else clipped(u, u_low, u_high)
        x = sum_of(affine(A, x, c), affine(B, u, 0.0))
        x = (*x[:2], *ends(x))
        found.append(ends(affine(D, x, 0.0))[1])
    return np.stack(found)


@pytest.mark.parametrize("n_x", [1, 2, 3, 6])
@pytest.mark.parametrize("options", CONTROLLERS, ids=NAMES)
def test_bounds_are_those_of_ten_lines_of_numpy(options, n_x):
    case, box, D = controlled(**options, n_x=n_x, seed=n_x), box_of(n_x), directions(n_x, 0, 3)
    expected = by_hand(case, box, D, STEPS)
    np.testing.assert_allclose(offsets(case.loop, box, D), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", ["box", "ellipsoid", "intersection", "far intersection"])
@pytest.mark.costly
def test_compiled_bounds_are_those_of_numpy(kind):
    loop, X0, D = closed_loop(random_loop(3)), initial_set(kind, 3), directions(3, 0, 3)
    box = X0.bounding_box()
    if kind.endswith("intersection"):  # compiled, its polytope counts as a box
        X0 = X0.replace(polytope=box)
    compiled = unrolled_at_once(loop, X0, box, repeated(D)).offsets
    np.testing.assert_allclose(compiled, offsets(loop, X0, D), rtol=0, atol=1e-9)


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e8])
@pytest.mark.parametrize("options", CONTROLLERS[:3], ids=NAMES[:3])
def test_no_exact_trajectory_is_outside(options, scale):
    """Corners are simulated in fractions, from sets so small that bounds are attained."""
    case, D = controlled(**options, hidden=(4,), boxed=False, seed=1), directions(2)
    (W, a), (V, b) = case.data.layers
    # whatever is drawn, states stay below one: roundings are of numbers of that size
    u = abs(V) @ (abs(W).sum(axis=1) + abs(a)) + abs(b)
    most = max(1.0, (abs(case.data.A).sum(axis=1) + abs(case.data.B) @ u + abs(case.data.c)).max())
    A, B, c = case.data.A / most, case.data.B / most, scale * case.data.c / most
    W, V, b = W / scale, scale * V, scale * b
    center = scale * np.array([0.7, -0.4])
    X0 = rj.Box(center - 1e-9 * scale, center + 1e-9 * scale)
    network = rj.MLP.from_layers([(W, a), (V, b)], activation=options["activation"])
    loop = rj.ClosedLoop(rj.AffinePlant(A, B, c), network)
    exact = np.vectorize(lambda number: Fraction(float(number)), otypes=[object])
    x, bounds, size = exact(X0.vertices()), offsets(loop, X0, D), np.asarray(abs(center))
    compiled = np.asarray(unrolled_at_once(loop, X0, X0, repeated(D)).offsets)
    for t in range(STEPS):
        z = ACTIVATIONS[options["activation"]](x @ exact(W).T + exact(a))
        u = z @ exact(V).T + exact(b)
        x = x @ exact(A).T + u @ exact(B).T + exact(c)
        values = (x @ exact(D).T).max(axis=0)
        for found in (bounds[t], compiled[t]):
            assert all(Fraction(float(y)) >= value for y, value in zip(found, values, strict=True))
        off = bounds[t] - values.astype(float)
        assert off.max() <= 1e-12 * scale  # a few roundings, no more
        # a step is some thirty sums and products, each rounded, and twice as much outwards
        size = abs(A) @ size + abs(B) @ (abs(V) @ (abs(W) @ size + abs(a)) + abs(b)) + abs(c)
        assert np.all(off <= 128 * (t + 1) * np.finfo(float).eps * (abs(D) @ size))


@pytest.mark.parametrize("unit", [*UNITS, "any other"], ids=str)
def test_a_remainder_holds_for_any_slope(unit):
    rng = np.random.default_rng(0)
    lower = np.r_[rng.normal(size=300), 0.0, -1.0, 0.0]
    upper = np.r_[lower[:-3] + rng.exponential(size=300), 0.0, 0.0, 1.0]
    slope = np.r_[rng.normal(size=300), 0.5, 0.0, 1.0]
    said = rj.ReLU() if unit == "any other" else unit
    remainder = said.remainder if unit != "any other" else AbstractUnit.remainder.__get__(said)
    low, high = remainder(slope, lower, upper)
    for part in np.linspace(0, 1, 21):
        y = lower + part * (upper - lower)
        rest = np.asarray(said(y)) - slope * y
        assert (low - 1e-15 <= rest).all()
        assert (rest <= high + 1e-15).all()
    if unit != "any other":  # attained at ends or at 0
        ends = [np.asarray(said(y)) - slope * y for y in (lower, upper, np.clip(0, lower, upper))]
        np.testing.assert_allclose(low, np.min(ends, axis=0), atol=1e-14)
        np.testing.assert_allclose(high, np.max(ends, axis=0), atol=1e-14)


@pytest.mark.parametrize("unit", UNITS, ids=str)
def test_where_a_unit_is_affine_nothing_remains(unit):
    lower, upper = np.array([0.0, 0.3, -2.0, -1.0]), np.array([1.0, 0.7, -1.0, 0.0])
    low, high = unit.remainder(unit.lines(lower, upper).above.slope, lower, upper)
    assert not low.any()
    assert not high.any()


def test_forms_keep_what_later_programs_need():
    case = controlled(rj.ReLU(), seed=3)
    loop, box = jax.device_get((case.loop, box_of(2)))
    start = InitialColumns.of(box, box)
    state, layers, _ = step_forms(loop, AffineForms.beginning(start), 0, start)
    x = np.asarray(rj.Box(box.lower, box.upper).sample(jax.random.key(0), 500))
    w = (x - start.center) / np.diag(start.spread)
    eta = np.zeros((500, state.columns.shape[1]))
    eta[:, :2] = w
    taken = []
    for layer in layers:
        rows = layer.inputs.rows
        y = rows[:, 0] + eta[:, : rows.shape[1] - 2] @ rows[:, 2:].T
        assert (layer.lower - 1e-12 <= y).all()
        assert (y <= layer.upper + 1e-12).all()
        z, own = np.asarray(layer.unit(y)), layer.places >= 0
        off = z - layer.slope * y - layer.offset
        assert (abs(off) <= layer.gap + 1e-12).all()
        np.testing.assert_array_equal(own, layer.gap > 0)
        eta[:, layer.places[own]] = off[:, own] / layer.gap[own]
        taken += layer.places[own].tolist()
    assert taken == list(range(2, 2 + len(taken)))
    assert taken  # some unit switches
    there = state.rows[:, 0] + eta @ state.columns.T
    np.testing.assert_allclose(there, case.successors(x), atol=1e-12)


@pytest.mark.costly
def test_rounding_does_not_grow_with_the_horizon():
    """Forty degrees a step: `|A|^200` is 1e28, and radii of states would grow as much."""
    angle = np.deg2rad(40)
    A = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    loop = rj.ClosedLoop(rj.AffinePlant(A, np.zeros((2, 1))), rj.MLP.from_layers([([[0, 0]], [0])]))
    X0, D = rj.Box([1.0, -1.0], [2.0, 1.0]), directions(2)
    last = list(unrolled(loop, X0, X0, repeated(D, 200)))[-1]
    exact = X0.support(D @ np.linalg.matrix_power(A, 200))
    np.testing.assert_allclose(last.offsets, exact, rtol=1e-10)
    compiled = unrolled_at_once(loop, X0, X0, repeated(D, 200)).offsets[-1]
    np.testing.assert_allclose(compiled, exact, rtol=1e-10)


@pytest.mark.parametrize("kind", ["polytope", "simplex", "far intersection"])
def test_a_polytope_is_more_than_its_box(kind):
    """Where the loop is affine, bounds are supports of the set, not of its box or ball."""
    case = controlled(rj.LeakyReLU(0.999), hidden=(3,), boxed=False)
    X0, D = initial_set(kind, 2), directions(2, 0, 4)
    W = np.linalg.multi_dot([case.data.B, *[W for W, _ in reversed(case.data.layers)]])
    net = rj.MLP.from_layers([(W, np.zeros(2))])
    loop = rj.ClosedLoop(rj.AffinePlant(case.data.A, np.eye(2)), net)
    exact = X0.support(D @ np.linalg.matrix_power(case.data.A + W, STEPS))
    np.testing.assert_allclose(offsets(loop, X0, D)[-1], exact, atol=1e-9)


@pytest.mark.costly
def test_what_is_known_of_states_is_used():
    case, box, D = controlled(rj.ReLU(), seed=1), box_of(2), directions(2)
    tube = recursion(case.loop, box, STEPS, rj.Template.box(2), relaxation=rj.LocalBounds())
    boxes = [region.bounding_box() for region in tube.sets[1:]]
    better = offsets(case.loop, box, D, known=boxes)
    assert (better <= offsets(case.loop, box, D) + 1e-12).all()
    for t, held in enumerate(boxes):
        assert (better[t] <= held.support(D) + 1e-12).all()


@pytree
class Sum(rj.AbstractNetwork):
    """Two networks side by side, of one input, whose outputs are added."""

    one: rj.MLP
    two: rj.MLP

    @property
    def inputs(self):
        return self.one.inputs

    @property
    def outputs(self):
        return self.one.outputs

    @property
    def unit_layers(self):
        return (*self.one.unit_layers, *self.two.unit_layers)

    def propagate(self, x, unit):
        return self.one.propagate(x, unit) + self.two.propagate(x, unit)


def test_branches_that_began_alike_have_columns_of_their_own():
    """`|x_1| - |x_2|` over a box around zero: shared columns would cancel to nothing."""
    branches = [
        rj.MLP.from_layers([([row], [0.0]), ([[sign]], [0.0])])
        for row, sign in (([2.0, 0.0], 0.5), ([0.0, 2.0], -0.5))
    ]
    net = rj.Residual(Sum(*branches), [[-0.5, 0.5]])
    loop = rj.ClosedLoop(rj.AffinePlant(np.zeros((2, 2)), [[1.0], [0.0]]), net)
    box = rj.Box([-1.0, -1.0], [1.0, 1.0])
    tube = rj.reach(loop, box, 2, rj.Template.box(2), rj.LinearBounds())
    assert (tube.proof(1).gaps >= 0).all()
    assert tube.sets[1].b[0] >= 0.5
    assert tube.proof(1).recheck()[0] >= 0.5
    start = InitialColumns.of(*jax.device_get((box, box)))
    _, layers, _ = step_forms(jax.device_get(loop), AffineForms.beginning(start), 0, start)
    places = np.concatenate([layer.places for layer in layers])
    assert len(np.unique(places)) == len(places) == 2


@pytest.mark.parametrize("n", range(1, 8))
def test_no_polynomial_of_degree_two_is_beyond_its_bounds_on_a_box(n):
    box = jax.device_get(rj.Box([-1.0] * n, [1.0] * n))
    start, rng = InitialColumns.of(box, box, curved=True), np.random.default_rng(n)
    rows, (i, j) = rng.normal(size=(50, start.count)), start.pairs
    corners = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=n)))
    w = np.concatenate([corners, rng.uniform(-1, 1, size=(2000, n))])
    products = w[:, i] * w[:, j]
    columns = np.concatenate([w, np.where(i == j, 2 * products - 1, products)], axis=1)
    values, (lower, upper) = rows @ columns.T, start.curved_ends(rows)
    assert np.all(values <= upper[:, None])
    assert np.all(values >= lower[:, None])
    norms = abs(rows).sum(axis=1)
    assert np.all(upper <= norms * (1 + 1e-12))
    assert np.all(-lower <= norms * (1 + 1e-12))
    assert (upper < norms * 0.99).any()
