"""Cutting planes: tighter than what they begin with, sound whatever the rounds end with."""

from dataclasses import dataclass, field, replace
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.programs.windows import Window
from reachjax.solvers import Facets, Rounds
from reachjax.solvers.cutting_planes import CutPool, joint
from tests.closed_loops import closed_loop, random_loop
from tests.networks import box_region, dead_network, saturating_network, simplex_region, simulate
from tests.quick_cases import some

CUTS = rj.CuttingPlanes()
CASES = {
    "one state": {"n_x": 1},
    "two states": {"n_x": 2},
    "three states": {"n_x": 3},
    "a saturated input": {"n_x": 2, "network": saturating_network},
    "dead neurons": {"n_x": 2, "network": dead_network},
    "a time-varying loop": {"n_x": 2, "steps": 2},
    "no input box": {"n_x": 2, "boxed": False},
}
SETS = ("box", "polytope", "ellipsoid", "intersection", "flat", "point")


def initial(kind, n_x, seed=0):
    """A set of this kind, and points of it."""
    corners = box_region(n_x, seed).corners
    box = rj.Box(corners.min(axis=0), corners.max(axis=0))
    ball = rj.Ellipsoid(box.center, jnp.diag((box.widths / 2) ** 2))
    simplex = simplex_region(n_x, seed)
    lower = box.lower
    chosen = {
        "box": box,
        "polytope": rj.Polytope(simplex.A, simplex.b),
        "ellipsoid": ball,
        "intersection": rj.Intersection(box.replace(upper=box.center), ball),
        "flat": rj.Box(lower, box.upper.at[0].set(lower[0])),
        "point": rj.Box(lower, lower),
    }[kind]
    return chosen, np.asarray(chosen.sample(jax.random.key(0), 20_000))


def tube_of(data, X0, relaxation, window=1, **options):
    n_x = X0.dimension
    template = rj.Template.octagonal(n_x) if n_x < 3 else rj.Template.box(n_x)
    return rj.reach(closed_loop(data), X0, 2, template, relaxation, window, **options)


def check_sound(tube, data, states):
    trajectories = simulate(data, states, tube.horizon)
    for t in range(1, tube.horizon + 1):
        proof, region = tube.proof(t), tube.sets[t]
        values = np.asarray(region.bounded_values(trajectories[t])).max(axis=0)
        size = 1e-13 * max(1.0, abs(values).max())
        assert np.all(values <= proof.bounds + size)
        assert np.all(proof.witnesses <= proof.bounds + size)
        assert np.all(proof.witnesses >= values - 1e-2)
        assert np.all(proof.recheck() <= np.asarray(proof.bounds) + size)


STEPWISE = ["two states", "dead neurons", "no input box"]
LARGE = ["three states", "a time-varying loop"]
"""They are tried with a window of one step, the other cases with the window of `rj.reach`."""


@pytest.mark.parametrize(
    ("name", "window"),
    some(
        product(CASES, [1, None]),
        lambda name, window: (window == 1) == (name in STEPWISE) and name not in LARGE,
    ),
)
@pytest.mark.costly
def test_no_bound_is_looser_than_with_local_bounds(name, window):
    case = CASES[name]
    data = random_loop(**case)
    X0, states = initial("box", case["n_x"])
    tube = tube_of(data, X0, CUTS, window=window)
    check_sound(tube, data, states)
    first, other = tube.proof(1), tube_of(data, X0, rj.LocalBounds()).proof(1)
    assert np.all(first.bounds <= np.asarray(other.bounds) + 1e-6)


@pytest.mark.parametrize("kind", SETS)
@pytest.mark.costly
def test_sets_of_every_kind(kind):
    data = random_loop(2, seed=1)
    X0, states = initial(kind, 2)
    check_sound(tube_of(data, X0, CUTS, window=None), data, states)


@pytest.mark.costly
@pytest.mark.parametrize("seed", range(3))
def test_as_tight_as_all_products(seed):
    data = random_loop(2, hidden=(4, 3), seed=seed)
    X0, _ = initial("box", 2, seed)
    few = tube_of(data, X0, replace(CUTS, gap=0.0, rounds=30), window=1).proof(1)
    every = tube_of(data, X0, rj.AllProducts(), window=1).proof(1)
    np.testing.assert_allclose(few.bounds, every.bounds, atol=1e-5)
    assert len(few.program.products.free) <= len(every.program.products.free)


@pytest.mark.costly
def test_without_rounds_the_products_of_local_bounds_are_there_all_the_same():
    data = random_loop(2, hidden=(8, 6), seed=3)
    X0, states = initial("box", 2, seed=3)
    none = tube_of(data, X0, replace(CUTS, rounds=0), window=1)
    check_sound(none, data, states)
    local = tube_of(data, X0, rj.LocalBounds())
    assert np.all(none.proof(1).bounds <= np.asarray(local.proof(1).bounds) + 1e-6)


@pytest.mark.costly
@pytest.mark.parametrize(
    "solver",
    [
        rj.Clarabel(),
        rj.Clarabel(max_iterations=1),
        rj.InteriorPoint(max_iterations=1),
        rj.SCS(max_iterations=5),
    ],
    ids=str,
)
def test_sound_however_a_solver_ends(solver):
    data = random_loop(2, seed=2)
    X0, states = initial("box", 2, seed=2)
    check_sound(tube_of(data, X0, CUTS, window=None, solver=solver), data, states)


@pytest.mark.costly
def test_garbage_multipliers_prove_loose_bounds_not_wrong_ones():
    data = random_loop(2, seed=2)
    X0, _ = initial("box", 2, seed=2)
    proof, rng = tube_of(data, X0, CUTS, window=None).proof(2), np.random.default_rng(0)
    for scale in (1e-3, 1.0, 1e3):
        multipliers = scale * rng.normal(size=proof.multipliers.shape)
        assert np.all(proof.recheck(multipliers) >= np.asarray(proof.witnesses) - 1e-12)


@dataclass(frozen=True)
class Counting(rj.AbstractSolver):
    """Notes how many products each program has that it solves."""

    solved: list = field(default_factory=list, compare=False)

    def solve(self, program, goal):
        self.solved.append(len(program.products.free))
        return rj.InteriorPoint().solve(program, goal)


@pytest.mark.costly
def test_products_found_once_are_not_sought_again():
    loop, (X0, _) = closed_loop(random_loop(2, hidden=(8, 6), seed=3)), initial("box", 2, seed=3)
    window = Window.beginning(loop, X0, X0, 0, CUTS).extended(loop, X0, X0)
    directions = rj.Template.octagonal(2).directions
    program, solver = jax.device_get(window.program(directions, CUTS)), Counting()
    goal = Facets(program.objective.mid)
    products, first = goal.in_rounds(program, solver, Rounds(window.layout, CUTS))
    rounds = len(solver.solved)
    warm_start = np.stack([products.left, products.right], axis=1)
    _, again = goal.in_rounds(program, solver, Rounds(window.layout, CUTS, warm_start=warm_start))
    assert len(solver.solved) - rounds < rounds
    np.testing.assert_allclose(again.value, first.value, atol=1e-5)


@pytest.mark.costly
def test_violated_products_are_those_of_negative_moments():
    data = random_loop(2, hidden=(3, 2), seed=1)
    X0, _ = initial("box", 2)
    window = Window.beginning(closed_loop(data), X0, X0, 0, CUTS).extended(
        closed_loop(data), X0, X0
    )
    program = jax.device_get(window.program(jnp.eye(2), CUTS))
    candidates = CutPool(program, window.layout)
    n = len(program.transform)
    point = np.append(np.random.default_rng(0).uniform(-1, 1, n - 1), 1.0)
    moment = np.outer(point, point)  # of a point of the box that is no trajectory
    pairs = candidates.violated(moment, np.zeros((0, 2), dtype=int), 10**6)
    facts = program.facts.mid
    norms = np.linalg.norm(facts, axis=1)
    facts = facts / np.where(norms > 0, norms, 1.0)[:, None]
    values = facts @ moment @ facts.T
    assert len(pairs)
    assert np.all(values[pairs[:, 0], pairs[:, 1]] < 0)
    there = joint(candidates.core, pairs)
    known = set(map(frozenset, zip(there.left.tolist(), there.right.tolist(), strict=True)))
    missing = np.argwhere(np.triu(values < -1e-5, 1))
    linear = [pair for pair in missing if max(pair) < len(window.layout.linear)]
    assert all(frozenset(pair.tolist()) in known for pair in linear)
    assert len(candidates.violated(moment, pairs, 10**6)) == 0
    assert len(candidates.violated(moment, pairs[:0], 3)) == 3


def sizes(layers, X0, data, window, cuts=CUTS, horizon=2):
    loop = closed_loop(data)
    loop = loop.replace(controller=rj.MLP.from_layers(layers))
    tube = rj.reach(loop, X0, horizon, rj.Template.octagonal(2), cuts, window=window)
    return jnp.sum(tube.sets[-1].b)


@pytest.mark.parametrize("window", some([1, 2, None], lambda window: window is None))
@pytest.mark.costly
def test_the_gradient_is_that_of_differences(window):
    data = random_loop(2, hidden=(4, 3), seed=5)
    X0, _ = initial("box", 2, seed=5)
    layers = [tuple(map(jnp.asarray, pair)) for pair in data.layers]
    slope = jax.grad(sizes)(layers, X0, data, window)
    rng = np.random.default_rng(0)
    along = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), layers)
    expected = sum(
        jnp.vdot(a, b) for a, b in zip(*map(jax.tree.leaves, (slope, along)), strict=True)
    )
    step = 1e-4
    ends = []
    for k in (-2, -1, 1, 2):
        moved = jax.tree.map(lambda leaf, d, by=k * step: leaf + by * d, layers, along)
        ends.append(sizes(moved, X0, data, window))
    difference = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * step)
    # where it is next to nothing, as of a loop whose input stays at a limit, bounds are off by 1e-7
    assert float(expected) == pytest.approx(float(difference), rel=1e-3, abs=1e-5)


@pytest.mark.long
def test_the_gradient_in_facet_directions_is_that_of_differences():
    # of offsets times directions: the normals of a box's successors, from the initial set on
    loop, (X0, _) = closed_loop(random_loop(2, hidden=(4, 3), seed=5)), initial("box", 2, seed=5)
    directions = jnp.array([[1.0, 0.2], [-0.7, 0.6], [-0.3, -1.0]])

    def total(by):
        turned = directions + by * jnp.array([[0.3, -0.1], [0.2, 0.5], [-0.4, 0.1]])
        return jnp.sum(rj.reach(loop, X0, 2, rj.Template(turned), CUTS).sets[2].b)

    difference = (total(1e-4) - total(-1e-4)) / 2e-4
    assert float(jax.grad(total)(0.0)) == pytest.approx(float(difference), rel=1e-3)


MOVED = {
    "polytope": lambda X, by: X.replace(b=X.b * (1 + by)),
    "ellipsoid": lambda X, by: X.replace(center=X.center + by),
    "intersection": lambda X, by: X.replace(
        polytope=X.polytope.replace(upper=X.polytope.upper + by),
        ellipsoid=X.ellipsoid.replace(center=X.ellipsoid.center - by),
    ),
}


@pytest.mark.parametrize("kind", some(MOVED, lambda kind: kind == "polytope"))
@pytest.mark.costly
def test_the_gradient_in_the_initial_set_is_that_of_differences(kind):
    loop, (X0, _) = closed_loop(random_loop(2, hidden=(4, 3), seed=5)), initial(kind, 2, seed=5)

    def total(by):
        X = MOVED[kind](X0, by)
        return jnp.sum(rj.reach(loop, X, 2, rj.Template.box(2), CUTS).sets[2].b[:3])

    difference = (total(1e-4) - total(-1e-4)) / 2e-4
    assert float(jax.grad(total)(0.0)) == pytest.approx(float(difference), rel=1e-3)


@pytest.mark.parametrize("horizon", [1, pytest.param(2, marks=pytest.mark.long)])
@pytest.mark.costly
def test_compiled_bounds_are_between_those_of_cuts_and_of_local_bounds(horizon):
    """Where numbers are traced nobody sees what a moment violates: products are LocalBounds'."""
    data = random_loop(2, hidden=(4, 3), seed=5)
    X0, _ = initial("box", 2, seed=5)
    layers = [tuple(map(jnp.asarray, pair)) for pair in data.layers]
    cuts = rj.CuttingPlanes(rounds=2, batch=20, gap=0.0)

    def size(layers, relaxation):
        return sizes(layers, X0, data, 1, relaxation, horizon)

    tight, loose = (size(layers, by) for by in (cuts, rj.LocalBounds()))
    value, slope = jax.jit(jax.value_and_grad(size), static_argnums=1)(layers, cuts)
    assert float(tight) - 1e-6 <= float(value) <= float(loose) + 1e-6
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope))


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"rounds": -1}, ValueError),
        ({"rounds": 1.5}, TypeError),
        ({"batch": 0}, ValueError),
        ({"batch": None}, TypeError),
        ({"gap": -1.0}, ValueError),
        ({"gap": "small"}, TypeError),
        ({"cuts": 3}, TypeError),
    ],
)
def test_bad_options_are_named(options, error):
    with pytest.raises(error, match=next(iter(options))):
        rj.CuttingPlanes(**options)
