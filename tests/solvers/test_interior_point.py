"""The interior-point method: its algebra, its answers, and how it ends when it cannot answer."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import eigvalsh

import reachjax as rj
from reachjax.programs.presolve import presolved
from reachjax.proofs.proposal import ANSWERS
from reachjax.proofs.recheck import interval_offsets
from reachjax.proofs.reported import judged_least, judged_offsets, judged_shape
from reachjax.sets import NormalForm
from reachjax.solvers import GivenShape, LeastVolume, barrier, primal_dual
from reachjax.solvers.barrier import Barrier
from reachjax.solvers.ellipsoids import form_of
from tests.closed_loops import (
    closed_loop,
    one_step,
    proposal_of,
    random_loop,
    recursion,
    step_program,
)
from tests.differences import dot, error_in_all_parts
from tests.networks import (
    affine_network,
    box_region,
    dead_network,
    directions,
    he_network,
    saturating_network,
    simplex_region,
    simulate,
)
from tests.solvers.test_differentiable import ALL_PARTS, PROMISED, planar, proved_offsets
from tests.solvers.test_differentiable import value as planar_value

SOLVER = rj.InteriorPoint()


def program_of(data, X, relaxation, rows):
    loop = closed_loop(data)
    return jax.device_get(step_program(loop, X, X.bounding_box(), rows, 0, relaxation))


def box_of(n_x, seed):
    region = box_region(n_x, seed)
    return rj.Box(region.corners.min(axis=0), region.corners.max(axis=0))


def round_of(n_x, seed):
    box = box_of(n_x, seed)
    return rj.Ellipsoid(box.center, jnp.diag(((box.upper - box.lower) / 2) ** 2))


def flat(n_x, seed):
    box = box_of(n_x, seed)
    return rj.Box(box.lower, box.upper.at[0].set(box.lower[0]))


def simplex(n_x, seed):
    region = simplex_region(n_x, seed)
    return rj.Polytope(region.A, region.b)


def program(n_x=3, seed=0, hidden=(5, 3), network=he_network, X=box_of, relaxation=None, rows=None):
    data = random_loop(n_x, hidden, seed, network=network)
    rows = directions(n_x, seed, extra=1)[:: n_x + 1] if rows is None else rows
    return program_of(data, X(n_x, seed), relaxation or rj.LocalBounds(), rows)


KINDS = {
    "single pairs": {"relaxation": rj.PaperQC(repeated=False)},
    "two pairs": {"seed": 1, "relaxation": rj.PaperQC()},
    "an ellipsoid's squares": {"seed": 2, "X": round_of, "relaxation": rj.PaperQC()},
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.costly
def test_the_schur_matrix_is_that_of_traces_of_explicit_matrices(kind):
    rng, generators = np.random.default_rng(0), presolved(program(**KINDS[kind])).generators
    n = generators.rows.shape[1]
    G = generators.columns().T.toarray().reshape(-1, n, n)
    X, W = (A @ A.T for A in rng.normal(size=(2, n, n)))
    paired, paired_W, schur = generators.schur(X, W)
    traces = np.einsum("kij,jm,lmn,ni->kl", G, X, G, W, optimize=True)
    np.testing.assert_allclose(schur, traces, atol=1e-12 * abs(traces).max())
    np.testing.assert_allclose(paired, np.einsum("kij,ij->k", G, X), atol=1e-10)
    np.testing.assert_allclose(paired_W, generators.paired(W), atol=1e-10)
    y = rng.normal(size=generators.size)
    np.testing.assert_allclose(generators.weighted(y), np.tensordot(y, G, 1), atol=1e-10)


DEGENERATE = {
    "generic": {},
    "dead neurons": {"network": dead_network, "relaxation": rj.PaperQC()},
    "an affine network": {"network": affine_network, "relaxation": rj.PaperQC(repeated=False)},
    "saturated inputs": {"network": saturating_network, "relaxation": rj.LocalBounds(True, False)},
    "a flat set": {"X": flat, "relaxation": rj.PaperQC()},
    "a simplex": {"X": simplex},
    "an ellipsoid": {"X": round_of, "network": saturating_network},
    "one state": {"n_x": 1, "seed": 4},
    "every product": {"hidden": (4,), "relaxation": rj.AllProducts()},
    "every product, all of it implied": {
        "n_x": 2,
        "hidden": (4, 3),
        "network": affine_network,
        "relaxation": rj.AllProducts(),
    },
}


@pytest.fixture(scope="module", params=DEGENERATE.values(), ids=DEGENERATE.keys())
def answer(request):
    """(program, solution, Clarabel's)."""
    given = program(**request.param)
    return given, proposal_of(SOLVER, given), proposal_of(rj.Clarabel(), given)


def test_a_run_that_stalls_goes_again_with_less_damping(monkeypatch):
    given = program(X=simplex)
    expected = proposal_of(SOLVER, given)
    monkeypatch.setattr(primal_dual, "DAMPING", 100.0)  # stalls
    found = proposal_of(SOLVER, given)
    assert np.all(found.statuses == rj.SolverStatus.SOLVED)
    np.testing.assert_allclose(found.unknowns, expected.unknowns, atol=1e-6)


def test_it_agrees_with_clarabel(answer):
    given, solution, reference = answer
    solved = reference.statuses == rj.SolverStatus.SOLVED
    assert solved.any()
    size = interval_offsets(given) - given.objective.mid[:, -1]
    apart = (solution.unknowns - reference.unknowns)[solved, 0] / np.maximum(size[solved], 1e-9)
    # Clarabel itself moves by 1.5e-5 from a tolerance of 1e-8 to one of 1e-9
    np.testing.assert_allclose(apart, 0, atol=1e-5)
    # what the recheck proves is never looser
    bounds = judged_offsets(given, solution).value
    others = judged_offsets(given, reference).value
    assert np.all(bounds <= others + 1e-6 * size + 1e-12)


def test_what_it_proposes_is_well_formed(answer):
    given, solution, _ = answer
    products = given.products
    assert np.isfinite(solution.multipliers).all()
    assert solution.multipliers[:, ~products.free].min(initial=0.0) >= 0
    assert np.all(solution.seconds > 0)
    for X in solution.moments:
        assert X[-1, -1] == pytest.approx(1.0, abs=1e-12)
        assert eigvalsh(X)[0] >= -1e-9
        pairs = np.einsum(
            "pi,ij,pj->p", given.facts.mid[products.left], X, given.facts.mid[products.right]
        )
        sums = np.bincount(products.multiplier, products.sign * pairs, len(products.free))
        size = 1e-4 * (1 + abs(sums).max(initial=0.0))  # as accurate as a solver is
        assert abs(sums[products.free]).max(initial=0.0) <= size
        assert sums[~products.free].min(initial=0.0) >= -size


def test_facets_are_optimal_and_solved_or_inaccurate(answer):
    given, solution, _ = answer
    allowed = {rj.SolverStatus.SOLVED, rj.SolverStatus.INACCURATE}
    assert set(solution.statuses) <= allowed
    assert judged_offsets(given, solution).optimal.all()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.costly
def test_no_sampled_successor_is_outside(seed):
    data, region = random_loop(3, seed=seed), box_region(3, seed)
    loop, template = closed_loop(data), rj.Template(directions(3, seed, extra=2))
    following, certificate = one_step(loop, box_of(3, seed), template, solver=SOLVER)
    states = np.vstack([region.corners, region.sample(20_000, seed)])
    assert np.all(following.contains(simulate(data, states, 1)[1]))
    assert set(certificate.statuses) == {rj.SolverStatus.SOLVED}


def test_a_run_that_is_stopped_early_says_so_and_is_sound():
    given = program()
    best = proposal_of(SOLVER, given).unknowns[:, 0]
    for limit in (1, 3, 6):
        solution = proposal_of(rj.InteriorPoint(max_iterations=limit), given)
        assert set(solution.statuses) == {rj.SolverStatus.LIMIT}
        assert np.isfinite(solution.multipliers).all()
        bounds, optimal, *_ = judged_offsets(given, solution)
        assert np.all(bounds >= best - 1e-9)
        assert np.all(bounds <= interval_offsets(given))
        assert not optimal.any()


def test_a_tolerance_that_is_out_of_reach_ends_inaccurate():
    given = program(relaxation=rj.PaperQC(repeated=False))
    solution = proposal_of(rj.InteriorPoint(tolerance=1e-16), given)
    assert set(solution.statuses) == {rj.SolverStatus.INACCURATE}
    expected = proposal_of(SOLVER, given).unknowns
    np.testing.assert_allclose(solution.unknowns, expected, atol=1e-7)


GARBAGE = {
    "huge": lambda rows, rng: 1e200 * rows,
    "noise": lambda rows, rng: rng.normal(size=rows.shape),
    "nothing": lambda rows, rng: 0 * rows,
    "wild": lambda rows, rng: rows * 10.0 ** rng.uniform(-12, 12, size=rows.shape),
}


@pytest.mark.parametrize("kind", GARBAGE)
@pytest.mark.costly
def test_garbage_ends_with_finite_multipliers_and_a_status(kind):
    given = program(hidden=(4,))
    rows = GARBAGE[kind](given.facts.mid, np.random.default_rng(0))
    given = given.with_midpoints(rows, given.objective.mid)
    solution = proposal_of(SOLVER, given)
    assert np.isfinite(solution.multipliers).all()
    assert np.all(solution.multipliers[:, ~given.products.free] >= 0)
    assert {rj.SolverStatus(int(code)).advice for code in solution.statuses}
    assert np.isfinite(judged_offsets(given, solution).value).all()


@pytest.mark.parametrize("traced", [False, True])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_programs_that_are_not_numbers_get_a_blank_proposal(traced, bad):
    given = program(hidden=(4,))
    rows = given.facts.mid.copy()
    rows[2, 1] = bad
    given = given.with_midpoints(rows, given.objective.mid)
    solve = partial(proved_offsets, solver=SOLVER)
    offsets, solution = (jax.jit(solve) if traced else solve)(given)
    assert np.isnan(offsets).all()
    assert np.all(solution.multipliers == 0)
    assert np.isnan(solution.unknowns).all()
    assert np.isnan(solution.moments).all()
    assert set(np.asarray(solution.statuses)) == {rj.SolverStatus.FAILED}


@pytest.mark.parametrize("kind", KINDS)
def test_traced_and_plain_programs_get_the_same_answer(kind):
    given = program(**KINDS[kind])
    bounds, plain = proved_offsets(given, SOLVER)
    traced_bounds, traced = jax.jit(partial(proved_offsets, solver=SOLVER))(given)
    np.testing.assert_array_equal(traced_bounds, bounds)
    np.testing.assert_array_equal(traced.moments, plain.moments)
    np.testing.assert_array_equal(traced.statuses, plain.statuses)
    assert judged_offsets(given, jax.device_get(traced)).optimal.all()


value = partial(planar_value, solver=SOLVER)


@pytest.fixture(scope="module")
def planar_gradient():
    """(compiled value, arguments, the compiled gradient there)."""
    args = planar(0)
    return jax.jit(value), args, jax.jit(jax.grad(value, argnums=(0, 1)))(*args)


@pytest.mark.costly
def test_the_gradient_is_the_central_difference(planar_gradient):
    assert error_in_all_parts(*planar_gradient, ALL_PARTS) <= PROMISED


@pytest.mark.costly
def test_compiled_and_plain_gradients_agree(planar_gradient):
    f, args, gradient = planar_gradient
    assert float(f(*args)) == pytest.approx(float(value(*args)), abs=1e-7)
    plain = jax.grad(value, argnums=(0, 1))(*args)
    off = jax.tree.map(jnp.subtract, gradient, plain)
    assert np.sqrt(dot(off, off) / dot(plain, plain)) <= 1e-4


@pytest.mark.costly
def test_scan_and_vmap_equal_one_at_a_time(planar_gradient):
    f, (loop, X0), _ = planar_gradient
    nets = [jax.tree.map(lambda w, s=s: w * (1 + s), loop.controller) for s in (0.0, 0.1)]
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), *nets)

    def of(net):
        return value(loop.replace(controller=net), X0)

    single = [f(loop.replace(controller=net), X0) for net in nets]
    np.testing.assert_allclose(jax.jit(jax.vmap(of))(stack), single, atol=1e-7)
    scanned = jax.lax.scan(lambda carry, net: (carry, of(net)), 0, stack)[1]
    np.testing.assert_allclose(scanned, single, atol=1e-7)


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"tolerance": 0}, ValueError),
        ({"tolerance": "1e-6"}, TypeError),
        ({"max_iterations": 2.5}, TypeError),
        ({"max_iterations": -1}, ValueError),
        ({"tol": 1e-6}, TypeError),
    ],
    ids=str,
)
def test_wrong_options_are_refused(options, error):
    with pytest.raises(error):
        rj.InteriorPoint(**options)


ROUND = {
    **{f"{n} states": {"n_x": n, "seed": n} for n in (1, 2, 3, 6)},
    "every neuron": {"seed": 1, "relaxation": rj.PaperQC(repeated=False)},
    "every pair": {"seed": 2, "relaxation": rj.PaperQC()},
    "dead neurons": {"network": dead_network, "relaxation": rj.PaperQC()},
    "a box": {"X": box_of, "seed": 3},
    "many neurons": {"n_x": 6, "hidden": (20, 20), "relaxation": rj.PaperQC(repeated=False)},
}


@pytest.fixture(scope="module", params=ROUND.values(), ids=ROUND.keys())
def enclosed(request):
    """(program of an ellipsoid, what is proposed for it)."""
    n_x = request.param.get("n_x", 3)
    given = program(**{"X": round_of, **request.param, "rows": np.eye(n_x)})
    return given, SOLVER.solve(given, LeastVolume())


SIGNS = 1e-5
"""What moments may miss their signs by: the path's last point is a centre up to rounding."""


def least_log_volume(given, enclosure):
    """What `-log det A` is at least in this relaxation, by weak duality.

    Where moments `X >= 0` weigh no product negatively and `b` not at all, `<X, Z> >= 0` says that
    `<D, R> <= c` for `A = R K^-1` with a symmetric `R`, if `c = X_ee + trace X_22` and `D` is the
    symmetric part of `-2 X_21 (K^-1 P)'`, where `P` are the rows of the successor. The largest
    `det R` of these is that of `R = c / q D^-1`.
    """
    n, q, X = len(given.transform), len(given.objective.mid), enclosure.moments[0]
    facts, products = given.facts.mid, given.products
    pairs = np.einsum("pi,pi->p", facts[products.left] @ X[:n, :n], facts[products.right])
    sums = np.bincount(products.multiplier, products.sign * pairs, len(products.free))
    assert eigvalsh(X)[0] >= -1e-12 * np.trace(X)
    assert abs(sums[products.free]).max(initial=0.0) <= SIGNS * np.trace(X)
    assert sums[~products.free].min(initial=0.0) >= -SIGNS * np.trace(X)
    assert abs(X[n:, n - 1]).max() <= SIGNS * np.trace(X)
    K = presolved(given).widths
    D = -2 * X[n:, :n] @ (given.objective.mid / K[:, None]).T
    c = X[n - 1, n - 1] + np.trace(X[n:, n:])
    return np.linalg.slogdet((D + D.T) / 2)[1] - q * np.log(c / q) + np.log(K).sum()


def test_an_ellipsoid_is_the_smallest_of_its_relaxation(enclosed):
    given, enclosure = enclosed
    assert enclosure.statuses == rj.SolverStatus.SOLVED
    value, optimal = judged_least(given, enclosure, form_of(enclosure.unknowns[0]))
    assert optimal
    assert value.level == pytest.approx(1.0, abs=1e-6)
    size = -np.linalg.slogdet(value.form.A)[1]
    assert size == pytest.approx(least_log_volume(given, enclosure), abs=1e-4)


def test_ellipsoids_are_those_of_clarabel_where_it_solves(enclosed):
    given, enclosure = enclosed
    reference = rj.Clarabel().solve(given, LeastVolume())
    assert reference.statuses == rj.SolverStatus.SOLVED or len(given.products.free) > 20
    if reference.statuses == rj.SolverStatus.SOLVED:
        forms = [form_of(found.unknowns[0]) for found in (enclosure, reference)]
        sizes = [-np.linalg.slogdet(form.A)[1] for form in forms]
        assert sizes[0] == pytest.approx(sizes[1], abs=1e-5)


def test_a_given_shape_gets_the_size_that_clarabel_gives_it(enclosed):
    given, enclosure = enclosed
    q = len(given.objective.mid)
    A, b = form_of(enclosure.unknowns[0])
    shape = NormalForm(A @ np.diag(np.linspace(1, 2, q)), 0.7 * b)
    ours, theirs = (each.solve(given, GivenShape(shape)) for each in (SOLVER, rj.Clarabel()))
    assert ours.statuses == rj.SolverStatus.SOLVED
    value, optimal = judged_shape(given, ours, shape)
    assert optimal
    assert value.factor == ours.unknowns[0, 0]
    if theirs.statuses == rj.SolverStatus.SOLVED:
        np.testing.assert_allclose(ours.unknowns, theirs.unknowns, rtol=1e-5)


@pytest.mark.costly
def test_all_neurons_of_a_step_that_clarabel_gives_up_on():
    """The paper's constraints on a set so small that all neurons are affine there."""
    given = program(
        n_x=6,
        hidden=(20, 20),
        X=lambda n_x, seed: rj.Ellipsoid(np.zeros(n_x), 1e-6 * np.eye(n_x)),
        rows=np.eye(6),
        relaxation=rj.PaperQC(repeated=False),
    )
    assert SOLVER.solve(given, LeastVolume()).statuses == rj.SolverStatus.SOLVED


@pytest.mark.costly
def test_a_shape_around_one_point_has_no_size():
    given = program(X=round_of, rows=np.eye(3))
    given = given.with_midpoints(given.facts.mid, 0 * given.objective.mid)
    found = SOLVER.solve(given, GivenShape(NormalForm(np.eye(3), np.zeros(3))))
    assert found.statuses == rj.SolverStatus.UNBOUNDED
    assert np.all(found.multipliers == 0)


@pytest.mark.parametrize("kind", GARBAGE)
@pytest.mark.costly
def test_ellipsoids_from_garbage_are_sound_or_blank(kind):
    given = program(X=round_of, hidden=(4,), rows=np.eye(3))
    rows = GARBAGE[kind](given.facts.mid, np.random.default_rng(0))
    given = given.with_midpoints(rows, given.objective.mid)
    found = SOLVER.solve(given, LeastVolume())
    assert np.isfinite(found.multipliers).all()
    assert np.all(found.multipliers[:, ~given.products.free] >= 0)
    assert np.isfinite(found.unknowns).all() == (found.statuses[0] in ANSWERS)
    value, _ = judged_least(given, found, form_of(found.unknowns[0]))
    assert np.isfinite(value.log_volume)


UNKNOWN = {
    "a row": lambda given: given.with_midpoints(np.nan * given.facts.mid, given.objective.mid),
    "the successor": lambda given: given.with_midpoints(
        given.facts.mid, np.nan * given.objective.mid
    ),
}


@pytest.mark.parametrize("kind", UNKNOWN)
def test_no_ellipsoid_is_proposed_from_what_is_no_number(kind):
    found = SOLVER.solve(UNKNOWN[kind](program(X=round_of, rows=np.eye(3))), LeastVolume())
    assert found.statuses == rj.SolverStatus.FAILED
    assert np.all(found.multipliers == 0)


@pytest.mark.parametrize("network", [he_network, saturating_network, dead_network])
@pytest.mark.costly
def test_a_path_that_is_lost_still_gives_an_ellipsoid(network):
    """Stable neurons that are kept have opposite facts, whose multipliers grow without bound."""
    relaxation = rj.LocalBounds(repeated=False, remove_stable=False)
    given = program(X=round_of, network=network, rows=np.eye(3), relaxation=relaxation)
    both = [solver.solve(given, LeastVolume()) for solver in (SOLVER, rj.Clarabel())]
    assert both[0].statuses[0] in ANSWERS
    values = [judged_least(given, found, form_of(found.unknowns[0]))[0] for found in both]
    assert values[0].log_volume <= values[1].log_volume + 0.2


@pytest.mark.parametrize(
    "shape", [pytest.param(None, marks=pytest.mark.long), np.eye(2)], ids=["free", "given"]
)
@pytest.mark.costly
def test_gradients_of_ellipsoids_of_weights_that_are_no_numbers_are_none(shape):
    loop, X = closed_loop(random_loop(2)), round_of(2, 0)

    def size(net):
        template = rj.EllipsoidTemplate(shape)
        return rj.log_volume(recursion(loop.replace(controller=net), X, 1, template))

    astray = jax.tree.map(lambda w: np.nan * w, loop.controller)
    gradient = jax.jit(jax.grad(size))(astray)
    assert all(np.isnan(leaf).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize("shape", [None, np.diag([2.0, 1.0])], ids=["free", "given"])
@pytest.mark.costly
def test_the_barrier_s_derivatives_are_its_differences(shape, monkeypatch):
    monkeypatch.setattr(barrier, "DAMPING", 0.3)
    goal = LeastVolume() if shape is None else GivenShape(NormalForm(shape, np.array([0.1, -0.2])))
    function = Barrier(goal.pencil(program(n_x=2, X=round_of, rows=np.eye(2))))
    function.cost[function.count] = 7.0 * function.unit
    weight, rng = 0.1, np.random.default_rng(0)
    y = function.inside()
    for _ in range(5):  # away from the edge
        gradient, hessian = function.derivatives(y, weight)
        step = -np.linalg.solve(hessian, gradient)
        y = y + step / (1 + np.sqrt(max(0.0, -gradient @ step / weight)))
    gradient, hessian = function.derivatives(y, weight)
    for _ in range(4):
        move = rng.normal(size=len(y)) * y[function.count] * 1e-5
        there, back = y + move, y - move
        slope = (function.value(there, weight) - function.value(back, weight)) / 2
        assert gradient @ move == pytest.approx(slope, rel=1e-5)
        slopes = (
            function.derivatives(there, weight)[0] - function.derivatives(back, weight)[0]
        ) / 2
        np.testing.assert_allclose(hessian @ move, slopes, rtol=1e-5, atol=1e-5 * abs(slopes).max())


@pytest.mark.costly
def test_programs_with_too_many_multipliers_are_left_alone(monkeypatch):
    monkeypatch.setattr(barrier, "MOST_MULTIPLIERS", 3)
    found = SOLVER.solve(program(X=round_of, rows=np.eye(3)), LeastVolume())
    assert found.statuses == rj.SolverStatus.FAILED
    assert np.all(found.multipliers == 0)


@pytest.mark.costly
def test_auto_chooses_by_size_alone_and_asks_the_small_one_where_the_large_one_fails(monkeypatch):
    small, large = program(), program(hidden=(20, 10), relaxation=rj.PaperQC(repeated=False))
    auto = rj.Auto()
    assert auto.choice(small) == rj.Clarabel()
    assert auto.choice(large) == rj.InteriorPoint()
    for given, solver in ((small, rj.Clarabel()), (large, SOLVER)):
        found, expected = (proposal_of(each, given).unknowns for each in (auto, solver))
        np.testing.assert_array_equal(found, expected)
    many = program(hidden=(20, 20), relaxation=rj.LocalBounds())
    assert auto.choice(many) == rj.Clarabel()
    given = program(X=round_of, rows=np.eye(3), relaxation=rj.PaperQC(repeated=False))
    for limit, solver in ((1500, SOLVER), (3, rj.Clarabel())):
        monkeypatch.setattr(barrier, "MOST_MULTIPLIERS", limit)
        found, expected = (each.solve(given, LeastVolume()).unknowns for each in (auto, solver))
        np.testing.assert_array_equal(found, expected)
    with pytest.raises(TypeError, match=r"Auto\.small"):
        rj.Auto(small="clarabel")
