"""Offsets on the central path: proved, looser, and without kinks."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import reachjax as rj
from reachjax.programs.compact import compact
from reachjax.programs.windows import step_program
from reachjax.proofs.recheck import interval_offsets, sound_offsets
from reachjax.solvers import facet_centres
from reachjax.solvers.central_path import PRICES
from reachjax.solvers.primal_dual import DAMPING
from reachjax.solvers.smoothing import smoothed_offsets
from tests.loops import closed_loop, one_step, random_loop, recursion
from tests.networks import box_region, directions, simulate
from tests.solvers.test_differentiable import along, planar, relative_error
from tests.solvers.test_differentiable import value as planar_value

SMOOTH = 1e-6
"""What a smooth derivative is held to; without the term of the damping it misses by 5e-4."""


def program_of(X, relaxation, n_x=3, seed=0, t=0):
    loop = closed_loop(random_loop(n_x, (5, 3), seed))
    rows = directions(n_x, seed, extra=1)[:: n_x + 1]
    return jax.device_get(step_program(loop, X, X.bounding_box(), rows, t, relaxation))


def box_of(n_x, seed):
    region = box_region(n_x, seed)
    return rj.Box(region.corners.min(axis=0), region.corners.max(axis=0))


def round_of(n_x, seed):
    box = box_of(n_x, seed)
    return rj.Ellipsoid(box.center, jnp.diag(((box.upper - box.lower) / 2) ** 2))


CASES = {
    "one state": (box_of(1, 1), rj.LocalBounds(), 1, 1),
    "pairs of products": (box_of(3, 0), rj.PaperQC(), 3, 0),
    "an ellipsoid": (round_of(2, 2), rj.PaperQC(), 2, 2),
}


@pytest.fixture(scope="module", params=CASES.values(), ids=CASES.keys())
def program(request):
    return program_of(*request.param)


@pytest.mark.parametrize("weight", [1.0, 1e-1, 1e-3])
def test_the_centre_is_that_of_the_barrier_function(program, weight):
    """Stated from the program's rows with its own sizes; convex, so no slope means the minimum."""
    reduced, products = compact(program), program.products
    facts, n = program.facts.mid[:, reduced.columns], len(reduced.columns)
    outer = np.einsum("pi,pj->pij", facts[products.left], facts[products.right])
    outer = products.sign[:, None, None] * (outer + outer.transpose(0, 2, 1)) / 2
    G, squares = np.zeros((len(products.free), n, n)), np.zeros(len(products.free))
    np.add.at(G, products.multiplier, outer)
    np.add.at(squares, products.multiplier, (outer**2).sum(axis=(1, 2)))
    kept, e = reduced.kept, np.eye(n)[-1]
    sizes = np.sqrt(squares[kept])
    row = program.objective.mid[0, reduced.columns]
    unit = np.linalg.norm(row[:-1])
    p = np.r_[row[:-1] / unit, 0.0]
    mu = weight / (n + len(kept) + 1)

    def barrier(y, t, b):
        Z = 2 * b * np.outer(e, e) - np.outer(p, e) - np.outer(e, p)
        Z += t * np.diag(np.r_[np.ones(n - 1), 1.0 - n])
        Z -= jnp.tensordot(y, G[kept] / sizes[:, None, None], 1)
        logs = jnp.linalg.slogdet(Z)[1] + jnp.log(t)
        logs += jnp.where(reduced.free, 0.0, jnp.log(jnp.where(reduced.free, 1.0, y))).sum()
        return b + PRICES[-1] * n * t - mu * (logs - DAMPING / 2 * (y**2).sum())

    found = facet_centres.facet_centres(program, weight)
    assert np.all(found.solution.statuses == rj.SolverStatus.SOLVED)
    y, b = found.slopes.multipliers[0, kept] * sizes, found.centres[0]
    slopes = jax.jit(jax.grad(barrier, argnums=(0, 1, 2)))
    # the path keeps `t` to itself: it is where the function has no slope in it
    t = brentq(lambda t: slopes(y, t, b)[1], 1e-9 * mu / n, mu / n, xtol=1e-24)
    in_y, in_b = slopes(y, t, b)[::2]
    assert abs(in_b) < 1e-6
    assert abs(in_y).max() < 1e-3 * mu
    assert found.offsets[0] >= b * unit + row[-1]


@pytest.mark.parametrize("weight", [1.0, 1e-1, 1e-2])
def test_the_rows_have_the_derivative_of_differences(program, weight):
    rng = np.random.default_rng(0)
    facts, objective = program.facts.mid, program.objective.mid
    # rows that are zero, or one, stay: they say which products there are
    ways = [rng.normal(size=part.shape) * part for part in (facts, objective)]

    def value(step):
        moved = program.with_midpoints(facts + step * ways[0], objective + step * ways[1])
        return jnp.sum(jnp.sin(smoothed_offsets(moved, weight)[0]))

    h = 1e-3 * weight  # the offset's fourth derivative grows like the weight's inverse cubed
    values = {k: float(value(k * h)) for k in (-2, -1, 1, 2)}
    slope = (values[-2] - 8 * values[-1] + 8 * values[1] - values[2]) / (12 * h)
    assert float(jax.grad(value)(0.0)) == pytest.approx(slope, rel=SMOOTH, abs=SMOOTH)


@pytest.mark.parametrize("part", ["weights", "A", "initial set", "input limits"])
def test_the_gradient_is_the_central_difference(part):
    args = planar(0)
    f = jax.jit(partial(planar_value, solver=rj.CentralPath(1e-1)))
    gradient = jax.grad(f, argnums=(0, 1))(*args)
    assert relative_error(f, args, gradient, along(part, *args, 0), 1e-4) <= SMOOTH


@pytest.mark.parametrize("weight", [1.0, 1e-2, 1e-4])
@pytest.mark.parametrize("relaxation", [rj.LocalBounds(), rj.PaperQC()], ids=repr)
def test_offsets_are_sound_and_looser_by_no_more_than_their_weight(weight, relaxation):
    data, region = random_loop(3), box_region(3, 0)
    loop, template = closed_loop(data), rj.Template(directions(3, 0, extra=2))
    X = rj.Polytope(region.A, region.b)
    options = {"relaxation": relaxation, "solver": rj.CentralPath(weight)}
    following, certificate = one_step(loop, X, template, **options)
    best, _ = one_step(loop, X, template, **options | {"solver": rj.Clarabel()})
    states = np.vstack([region.corners, region.sample(20_000, 0)])
    assert np.all(following.contains(simulate(data, states, 1)[1]))
    unit = np.linalg.norm(certificate.program.objective.mid[:, :-1], axis=1)
    assert np.all(following.b >= best.b - 1e-7)
    assert np.all(following.b <= best.b + weight * unit + 1e-6)
    assert np.all(certificate.recheck() <= following.b + 1e-9)


def test_a_kink_is_gone():
    """The offset of `x_1 + a x_2` over a box has one at `a = 0`, of slopes -1 and 1."""
    box = rj.Box([-1.0, -1.0], [1.0, 1.0])
    net = rj.MLP.from_layers([([[0.0, 0.0]], [0.0])])

    def offset(a, solver):
        loop = rj.ClosedLoop(rj.AffinePlant(jnp.array([[1.0, a], [0.0, 1.0]]), [[0.0], [0.0]]), net)
        return recursion(loop, box, 1, rj.Template.box(2), solver=solver).sets[1].b[0]

    smooth = partial(offset, solver=rj.CentralPath(1e-1))
    h = 1e-4
    for a in (0.0, 1e-3, 3e-2):
        slope = (smooth(a + h) - smooth(a - h)) / (2 * h)
        assert float(jax.grad(smooth)(a)) == pytest.approx(float(slope), abs=1e-5)
    assert float(jax.grad(smooth)(0.0)) == pytest.approx(0.0, abs=1e-6)
    assert offset(h, rj.Clarabel()) - offset(0.0, rj.Clarabel()) > 0.9 * h


def test_where_a_neuron_becomes_stable_the_offset_jumps_by_less_than_the_weight():
    box, weight = rj.Box([-1.0, -1.0], [1.0, 1.0]), 1e-2

    def bound(bias):
        net = rj.MLP.from_layers([([[1.0, 0.3], [-0.5, 1.0]], [bias, 0.1]), ([[0.7, -0.4]], [0.0])])
        loop = rj.ClosedLoop(rj.AffinePlant(0.5 * np.eye(2), [[1.0], [0.5]]), net)
        template = rj.Template.box(2)
        following, proof = one_step(loop, box, template, solver=rj.CentralPath(weight))
        program = proof.program
        unit = np.linalg.norm(program.objective.mid[:, :-1], axis=1)
        return following.b, unit, len(compact(program).columns)

    (before, unit, kept), (after, _, fewer) = (bound(1.3 + side) for side in (-1e-7, 1e-7))
    assert kept == fewer + 1  # the first neuron is active from 1.3 on
    assert np.all(abs(after - before) < weight * unit)


def test_compiled_batched_and_scanned_offsets_agree_and_compile_once():
    loop, X0 = planar(0)
    traced = []

    @jax.jit
    def of(net):
        traced.append(net)
        value = partial(planar_value, solver=rj.CentralPath(1e-2))
        return jax.value_and_grad(lambda net: value(loop.replace(controller=net), X0))(net)

    nets = [jax.tree.map(lambda w, s=s: w * (1 + s), loop.controller) for s in (0.0, 0.1)]
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), *nets)
    single = [of(net) for net in nets]
    assert len(traced) == 1
    single = jax.tree.map(lambda *leaves: jnp.stack(leaves), *single)
    scanned = jax.lax.scan(lambda carry, net: (carry, of(net)), 0, stack)[1]
    for together in (jax.vmap(of)(stack), scanned):
        jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-7, atol=1e-9), together, single)


def test_what_is_no_number_gives_none():
    loop, X0 = planar(0)
    astray = jax.tree.map(lambda w: np.nan * w, loop.controller)

    def f(net):
        return planar_value(loop.replace(controller=net), X0, solver=rj.CentralPath())

    value, gradient = jax.jit(jax.value_and_grad(f))(astray)
    assert np.isnan(value)
    assert all(np.isnan(leaf).all() for leaf in jax.tree.leaves(gradient))


PROGRAM = program_of(box_of(3, 0), rj.LocalBounds())


def derivative_of(part):
    """What comes back to the facts for the first facet's offset, or for what is proposed."""

    def value(facts):
        moved = PROGRAM.with_midpoints(facts, PROGRAM.objective.mid)
        return part(*smoothed_offsets(moved, 1e-2))

    return jax.grad(value)(PROGRAM.facts.mid)


def lost(monkeypatch, **replaced):
    for name, value in replaced.items():
        monkeypatch.setattr(facet_centres, name, value)
    return facet_centres.facet_centres(PROGRAM, 1e-2)


def proved_along(move, solution, h=1e-6):
    """How fast what the first facet's multipliers prove changes as the facts move."""
    ends = [
        sound_offsets(
            PROGRAM.with_midpoints(PROGRAM.facts.mid + s * h * move, PROGRAM.objective.mid),
            solution.multipliers,
        )[0]
        for s in (1, -1)
    ]
    return (ends[0] - ends[1]) / (2 * h)


def test_a_path_that_is_lost_leaves_what_is_proved_and_its_derivative(monkeypatch):
    path_end = facet_centres.path_end
    early = lost(monkeypatch, path_end=lambda *args: path_end(*args)._replace(weight=1e-3))
    assert np.all(early.solution.statuses == rj.SolverStatus.INACCURATE)
    assert np.all(early.offsets < interval_offsets(PROGRAM))
    move = np.random.default_rng(0).normal(size=PROGRAM.facts.mid.shape) * abs(PROGRAM.facts.mid)
    mine = np.sum(derivative_of(lambda offsets, _: offsets[0]) * move)
    assert mine == pytest.approx(proved_along(move, early.solution), rel=1e-5)


def test_no_path_and_too_many_multipliers_leave_intervals(monkeypatch):
    for found in (lost(monkeypatch, path_end=lambda *args: None), lost(monkeypatch, LARGEST=3)):
        assert np.all(found.solution.statuses == rj.SolverStatus.FAILED)
        np.testing.assert_allclose(found.offsets, interval_offsets(PROGRAM), rtol=1e-9)
        # an interval bound knows of no facts
        np.testing.assert_array_equal(derivative_of(lambda offsets, _: offsets[0]), 0.0)


def test_a_centre_that_its_multipliers_do_not_prove_is_none(monkeypatch):
    sound = facet_centres.sound_offsets
    found = lost(monkeypatch, sound_offsets=lambda *args: sound(*args) + 1.0)
    assert np.all(found.solution.statuses == rj.SolverStatus.INACCURATE)
    assert np.isnan(found.centres).all()
    assert np.isfinite(derivative_of(lambda offsets, _: offsets[0])).all()


@pytest.mark.parametrize("width", [0.0, 1e-9])
def test_points_have_their_offsets_and_derivatives(width):
    loop = closed_loop(random_loop(2))

    def bound(shift):
        X = rj.Box([0.3 + shift, 0.3], [0.3 + shift + width, 0.3 + width])
        template = rj.Template.box(2)
        return recursion(loop, X, 1, template, solver=rj.CentralPath(1e-2)).sets[1].b[0]

    h = 1e-4
    slope = (bound(h) - bound(-h)) / (2 * h)
    assert float(jax.grad(bound)(0.0)) == pytest.approx(float(slope), abs=1e-5)


@pytest.mark.parametrize("part", ["small", "large"])
def test_auto_does_not_mix_centres_and_optima(part):
    with pytest.raises(ValueError, match=rf"Auto\.{part} must solve to optimality"):
        rj.Auto(**{part: rj.CentralPath()})


def test_what_is_proposed_has_no_derivative():
    assert np.isnan(derivative_of(lambda _, solution: solution.multipliers.sum())).all()
    assert np.isfinite(derivative_of(lambda offsets, _: offsets[0])).all()


def test_ellipsoids_are_those_of_the_interior_point_method():
    loop = closed_loop(random_loop(2))
    volumes = [
        float(one_step(loop, round_of(2, 0), rj.EllipsoidTemplate(), solver=solver)[0].volume())
        for solver in (rj.CentralPath(), rj.InteriorPoint())
    ]
    assert volumes[0] == pytest.approx(volumes[1], rel=1e-6)


@pytest.mark.parametrize(
    ("weight", "error"),
    [
        (-1.0, ValueError),
        (0, ValueError),
        ("little", TypeError),
        (np.nan, ValueError),
        (np.inf, ValueError),
    ],
)
def test_a_weight_that_is_none_is_refused(weight, error):
    with pytest.raises(error, match=r"CentralPath\.weight"):
        rj.CentralPath(weight)
