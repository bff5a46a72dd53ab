"""The exact maximum is attained, nothing simulated is beyond it, and no certificate is below it.

It is written from the definition of the loop, with mixed-integer programming: nothing of the rows,
products and multipliers that certificates are made of.
"""

from types import SimpleNamespace

import jax
import numpy as np
import pytest
from scipy.optimize import OptimizeResult

import reachjax as rj
from experiments.tightness import exact, program
from experiments.tightness.exact import SHARP, exact_maxima, exact_maximum, exact_tube
from experiments.tightness.program import Limits
from tests.closed_loops import closed_loop, random_loop, recursion
from tests.networks import (
    LoopData,
    box_region,
    dead_network,
    he_network,
    input_box,
    plant,
    saturating_network,
    simplex_region,
    simulate,
)

HORIZON = 3
CASES = {
    "2-4-4-1, seed 1": ((2, 4, 4, 1), 1),
    "2-4-4-1, seed 5": ((2, 4, 4, 1), 5),
    "3-3-1": ((3, 3, 1), 1),
}
RECURSIVE = [rj.PaperQC(), rj.LocalBounds(), rj.AllProducts()]
LOOPS = {
    "one state": {"n_x": 1, "hidden": (5, 4)},
    "three states": {"n_x": 3},
    "a saturated input": {"n_x": 2, "network": saturating_network},
    "dead neurons": {"n_x": 2, "network": dead_network},
    "no input box": {"n_x": 2, "boxed": False},
    "no hidden layer": {"n_x": 2, "hidden": ()},
}
ROUNDING = 1e-13  # of simulated values of order one


def box_of(region):
    return rj.Box(region.corners.min(axis=0), region.corners.max(axis=0))


@pytest.fixture(scope="module", params=CASES.values(), ids=list(CASES))
def case(request):
    """A loop, its initial box, a template, and the exact maxima of its facets step by step."""
    sizes, seed = request.param
    n_x = sizes[0]
    data = LoopData(he_network(sizes, seed), *plant(n_x, 1, seed), *input_box(1, seed))
    loop, X0, template = closed_loop(data), box_of(box_region(n_x, seed)), rj.Template.box(n_x)
    maxima = [exact_maxima(loop, X0, k, template.directions)[0] for k in range(1, HORIZON + 1)]
    # opposite facets are next to each other
    widths = [values.reshape(-1, 2).sum(axis=1).repeat(2) for values in maxima]
    return SimpleNamespace(loop=loop, X0=X0, template=template, maxima=maxima, widths=widths)


@pytest.fixture(scope="module")
def one_shot(case):
    return rj.reach(case.loop, case.X0, HORIZON, case.template, rj.CuttingPlanes(), window=None)


def check_between(tube, case):
    for k, (largest, widths) in enumerate(zip(case.maxima, case.widths, strict=True), start=1):
        proof = tube.proof(k)
        # the value is attained; HiGHS may have left out larger ones, by its tolerances
        assert np.all(proof.witnesses <= largest + SHARP * widths)
        assert np.all(largest <= np.asarray(proof.bounds) + ROUNDING)


@pytest.mark.parametrize("relaxation", RECURSIVE, ids=lambda each: type(each).__name__)
def test_the_exact_maximum_is_between_witness_and_bound(case, relaxation):
    check_between(rj.reach(case.loop, case.X0, HORIZON, case.template, relaxation), case)


def test_cutting_planes_over_the_whole_window_prove_the_exact_maximum(case, one_shot):
    check_between(one_shot, case)
    for k, (largest, widths) in enumerate(zip(case.maxima, case.widths, strict=True), start=1):
        # rounds end at a gap of 1e-4
        assert np.all(one_shot.proof(k).bounds <= largest + 1e-4 * widths)


def test_recursion_is_not_exact(case):
    # or the claims above would say little
    tube = recursion(case.loop, case.X0, HORIZON, case.template)
    assert np.any(tube.proof(HORIZON).bounds > case.maxima[-1] + 1e-2 * case.widths[-1])


@pytest.mark.parametrize("kind", LOOPS.values(), ids=list(LOOPS))
def test_nothing_simulated_is_beyond_the_maximum_and_its_state_attains_it(kind):
    data, region = random_loop(**kind), box_region(kind["n_x"], seed=0)
    X0, rows = box_of(region), np.vstack([np.eye(kind["n_x"]), -np.ones(kind["n_x"])])
    values, states = exact_maxima(closed_loop(data), X0, 2, rows)
    assert np.asarray(X0.contains(states)).all()
    attained = np.sum(simulate(data, states, 2)[-1] * rows, axis=1)
    np.testing.assert_allclose(values, attained, atol=ROUNDING)
    sampled = np.vstack([np.asarray(X0.sample(jax.random.key(0), 20_000)), region.corners])
    ends = simulate(data, sampled, 2)[-1] @ rows.T
    assert np.all(ends.max(axis=0) <= values + SHARP * np.ptp(ends, axis=0))


@pytest.mark.parametrize("n_x", [1, 2, 3])
def test_an_affine_loop_has_the_support_of_its_last_set(n_x):
    W = np.random.default_rng(n_x).normal(size=(1, n_x))
    A, B, c = plant(n_x, 1, seed=n_x)
    loop = rj.ClosedLoop(rj.AffinePlant(A, B, c), rj.MLP.from_layers([(W, [0.1])]))
    region, direction = simplex_region(n_x, seed=n_x), np.ones(n_x)
    value, state = exact_maximum(loop, rj.Polytope(region.A, region.b), 2, direction)
    ends = region.corners
    for _ in range(2):
        ends = ends @ (A + B @ W).T + B @ [0.1] + c
    # a linear program's solution may be off by 1e-7
    assert value == pytest.approx((ends @ direction).max(), abs=1e-6)
    assert np.all(region.A @ state <= region.b + 1e-6)


def test_a_time_varying_loop_begins_at_its_start():
    data = random_loop(2, hidden=(3,), steps=4)
    X0, later = (
        rj.Box([0.0, 0.0], [0.2, 0.3]),
        LoopData(
            data.layers,
            *(part[2:] for part in (data.A, data.B, data.c, data.u_lower, data.u_upper)),
        ),
    )
    (value, _), (expected, _) = (
        exact_maximum(closed_loop(data), X0, 2, [1.0, -1.0], start=2),
        exact_maximum(closed_loop(later), X0, 2, [1.0, -1.0]),
    )
    assert value == pytest.approx(expected, abs=ROUNDING)
    assert value != pytest.approx(exact_maximum(closed_loop(data), X0, 2, [1.0, -1.0])[0])


def test_a_single_point_goes_where_it_is_simulated():
    data, point = random_loop(2), np.array([0.3, -0.2])
    value, state = exact_maximum(closed_loop(data), rj.Box(point, point), 3, [0.0, 1.0])
    np.testing.assert_array_equal(state, point)
    assert value == pytest.approx(simulate(data, point[None], 3)[-1, 0, 1], abs=ROUNDING)


@pytest.mark.parametrize("n_x", [1, pytest.param(3, marks=pytest.mark.long)])
def test_a_tube_unrolled_once_has_the_maxima_of_each_step(n_x):
    data, region = random_loop(n_x, steps=5), box_region(n_x, seed=0)
    loop, rows = closed_loop(data), np.vstack([np.eye(n_x), -np.ones(n_x)])
    for X0 in (box_of(region), rj.Polytope(region.A, region.b)):
        tube = exact_tube(loop, X0, 3, rows, start=2)
        tube.require_sharp()
        for k, (values, states) in enumerate(zip(tube.values, tube.states, strict=True), start=1):
            expected, attained_by = exact_maxima(loop, X0, k, rows, start=2)
            np.testing.assert_allclose(values, expected, rtol=0, atol=1e-6)
            assert states.shape == attained_by.shape
        assert np.all(tube.bounds >= tube.values - SHARP)


@pytest.fixture
def small():
    """A loop with units that switch, a box, three steps, and two directions."""
    loop, X0 = closed_loop(random_loop(2)), rj.Box([-1.0, -1.0], [1.0, 1.0])
    return loop, X0, 3, np.eye(2)


def test_when_time_is_over_the_rest_is_not_a_number(small, monkeypatch):
    seconds, programs = Limits.seconds, []

    def few(self):
        programs.append(1)
        if len(programs) > 80:
            raise TimeoutError
        return seconds(self)

    whole = exact_tube(*small)
    monkeypatch.setattr(Limits, "seconds", few)
    part = exact_tube(*small)
    known = ~np.isnan(part.values)
    assert 0 < known.sum() < known.size
    np.testing.assert_allclose(part.values[known], whole.values[known], atol=SHARP)
    assert known[part.within(SHARP)].all()
    assert np.isnan(part.bounds[~known]).all()
    with pytest.raises(RuntimeError, match="not sharp"):
        part.require_sharp()


def test_a_program_that_is_not_finished_in_time_still_has_a_bound(small, monkeypatch):
    milp, whole = program.milp, exact_tube(*small)

    def unfinished(objective, integrality, **options):
        if not integrality.any():
            return milp(objective, integrality=integrality, **options)
        assert options["options"]["time_limit"] <= 100
        return OptimizeResult(status=1, x=None, fun=None, mip_dual_bound=None, message="Time")

    monkeypatch.setattr(program, "milp", unfinished)
    part = exact_tube(*small, limits=Limits(program=100))
    assert not part.within(SHARP).any()
    assert np.isnan(part.values).all()
    assert np.all(part.bounds >= whole.values - SHARP)


class Absolute(rj.AbstractUnit):
    """`|y|`, of which the program knows nothing."""

    def __call__(self, y):
        return abs(y)

    def interval(self, lower, upper):
        raise NotImplementedError

    lines = interval

    def facts(self, y, z, lower, upper):
        raise NotImplementedError


def test_only_relus_are_taken():
    loop = closed_loop(random_loop(2, hidden=(2,)))
    loop = loop.replace(controller=rj.MLP.from_layers(loop.controller.layers, Absolute()))
    with pytest.raises(TypeError, match="network of ReLUs"):
        exact_maximum(loop, rj.Box([0.0, 0.0], [1.0, 1.0]), 1, [1.0, 0.0])


@pytest.mark.parametrize(
    ("module", "name", "value", "words"),
    [
        (program, "milp", lambda *_, **__: OptimizeResult(status=1, message="Time"), "Time"),
        (exact, "SHARP", -1.0, "not sharp"),
    ],
)
def test_what_is_not_proved_to_be_largest_is_an_error(monkeypatch, module, name, value, words):
    monkeypatch.setattr(module, name, value)
    loop, X0 = closed_loop(random_loop(2, hidden=(2,))), rj.Box([0.0, 0.0], [1.0, 1.0])
    with pytest.raises(RuntimeError, match=words):
        exact_maximum(loop, X0, 1, [1.0, 0.0])


@pytest.mark.parametrize(
    ("X0", "options", "error", "words"),
    [
        (rj.Ellipsoid([0.0, 0.0], np.eye(2)), {}, TypeError, "X0 must be a Box or a Polytope"),
        (rj.Polytope([[1.0, 0.0]], [1.0]), {}, ValueError, "X0 .* unbounded"),
        (rj.Polytope([[1.0, 0.0], [-1.0, 0.0]], [1.0, -2.0]), {}, ValueError, "X0 .* empty"),
        (rj.Box([0.0], [1.0]), {}, ValueError, "X0 .* dimension 1"),
        (rj.Box([0.0, 0.0], [1.0, 1.0]), {"direction": [1.0]}, ValueError, "directions"),
        (rj.Box([0.0, 0.0], [1.0, 1.0]), {"k": 0}, ValueError, "at least 1"),
        (rj.Box([0.0, 0.0], [1.0, 1.0]), {"k": 9}, ValueError, "3 time steps"),
    ],
)
def test_bad_arguments_are_named(X0, options, error, words):
    loop = closed_loop(random_loop(2, hidden=(2,), steps=3))
    with pytest.raises(error, match=words):
        exact_maximum(loop, X0, **{"k": 1, "direction": [1.0, 0.0], **options})
