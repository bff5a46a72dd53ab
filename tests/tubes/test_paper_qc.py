"""The library agrees with the reference, written from the paper alone, and its sets are sound.

On networks the project did not train, for 1, 2, 3 and 6 states, LTI and LTV, with and without
input box. A tube of three steps is computed once per case. Each of its sets is then compared with
the reference's step from the set before it, so every step is a comparison of one step.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest

import reachjax as rj
from experiments.benchmark.reference import paper_E_in, paper_E_mid, paper_E_out, paper_step
from tests.closed_loops import closed_loop, recursion
from tests.networks import (
    LoopData,
    Region,
    box_region,
    dead_network,
    directions,
    he_network,
    input_box,
    plant,
    saturating_network,
    simplex_region,
    simulate,
)
from tests.quick_cases import some

STATES = [1, 2, 3, 6]
STEPS = 3
HIDDEN = (5, 3)

# cvxpy warns of a stall before 1e-9; the reference accepts it where 1e-7 holds.
pytestmark = pytest.mark.filterwarnings("ignore:Solution may be inaccurate")


@dataclass(frozen=True)
class Case:
    """A tube to compute; `facets` are those of the template that the reference solves again."""

    loop: LoopData
    region: Region
    directions: np.ndarray
    repeated: bool
    facets: list


def loop_data(n_x, boxed, time_varying, network=he_network):
    n_u, steps = min(n_x, 2), STEPS if time_varying else None
    box = input_box(n_u, seed=n_x, steps=steps) if boxed else (None, None)
    layers = network((n_x, *HIDDEN, n_u), seed=20 + n_x)
    return LoopData(layers, *plant(n_x, n_u, seed=n_x, steps=steps), *box)


def case(n_x, boxed, time_varying, region, repeated, network=he_network):
    a = directions(n_x, seed=n_x, extra=2)
    chosen = [0, n_x, 2 * n_x, 2 * n_x + 1]  # two facets of the box, two oblique ones
    loop = loop_data(n_x, boxed, time_varying, network)
    return Case(loop, region, a, repeated, chosen)


# Every dimension meets each option both ways; box and polytope, LTI and LTV alternate.
CASES = {
    f"{n_x} states, {'box' if boxed else 'no box'}, {'repeated' if repeated else 'plain'}": case(
        n_x,
        boxed,
        time_varying=boxed != repeated,
        region=simplex_region(n_x, seed=n_x) if repeated else box_region(n_x, seed=n_x),
        repeated=repeated,
    )
    for n_x in STATES
    for boxed in (True, False)
    for repeated in (True, False)
} | {
    "3 states, LTV, rotated box": case(3, False, True, box_region(3, 3, rotated=True), False),
    "2 states, dead neurons": case(2, True, False, box_region(2, 2), True, dead_network),
    "2 states, saturated": case(2, True, False, box_region(2, 2), True, saturating_network),
}


def quick(name):
    """Odd dimensions with loops that vary in time, even ones with loops that do not; the others."""
    loop = CASES[name].loop
    one_of_many = name.endswith(("repeated", "plain"))
    return not one_of_many or (loop.A.ndim == 3) == bool(loop.A.shape[-1] % 2)


@pytest.fixture(scope="module", params=some(CASES, quick))
def tube_of(request):
    """(case, tube)."""
    case = CASES[request.param]
    tube = recursion(
        closed_loop(case.loop),
        rj.Polytope(case.region.A, case.region.b),
        horizon=STEPS,
        template=rj.Template(case.directions),
        relaxation=rj.PaperQC(repeated=case.repeated),
        solver=rj.Clarabel(tolerance=1e-9),
    )
    return case, tube


@pytest.mark.parametrize("time_varying", [False, True])
@pytest.mark.parametrize("boxed", [True, False])
@pytest.mark.parametrize("n_x", STATES)
def test_the_change_of_basis_is_that_of_propositions_three_to_five(n_x, boxed, time_varying):
    loop, t = loop_data(n_x, boxed, time_varying), 2
    A, B, c, lower, upper = loop.at(t)
    basis = rj.change_of_basis(closed_loop(loop), t=t)
    expected = {
        "E_in": paper_E_in(loop.layers, boxed),
        "E_mid": paper_E_mid(loop.layers, lower, upper),
        "E_out": paper_E_out(loop.layers, A, B, c, boxed),
    }
    for name, matrix in expected.items():
        actual = np.asarray(getattr(basis, name))
        # Equal bit for bit, but where an entry is a sum of several numbers of order one: the
        # constants in the last column, and B W^l when there is no box.
        np.testing.assert_allclose(actual, matrix, rtol=0, atol=1e-15, err_msg=name)
        if boxed or name != "E_out":
            np.testing.assert_array_equal(actual[:, :-1], matrix[:, :-1], err_msg=name)


@pytest.mark.parametrize(
    "which",
    [slice(-1, None), pytest.param(slice(None), marks=pytest.mark.long)],
    ids=["one", "all"],
)
def test_every_facet_agrees_with_the_reference_from_the_same_set(tube_of, which):
    """An oblique one of the last step, of all sets and options; by `-m long` every one."""
    case, tube = tube_of
    facets = case.facets[which]
    for t in range(STEPS)[which]:
        start = tube.sets[t]
        reference, _ = paper_step(
            case.loop.layers,
            *case.loop.at(t),
            np.asarray(start.A),
            np.asarray(start.b),
            case.directions[facets],
            repeated=case.repeated,
        )
        offsets = np.asarray(tube.sets[t + 1].b)[facets]
        error = np.abs(offsets - reference) / np.maximum(1.0, np.abs(reference))
        assert error.max() <= 1e-5, f"step {t + 1}: {offsets} against {reference}"


def test_the_sets_have_the_directions_of_the_template_and_the_certified_bounds(tube_of):
    case, tube = tube_of
    for t in range(1, STEPS + 1):
        np.testing.assert_array_equal(tube.sets[t].A, case.directions)
        np.testing.assert_array_equal(tube.sets[t].b, tube.certificates[t].bounds)


def test_no_sampled_successor_lies_outside_any_set(tube_of):
    case, tube = tube_of
    x0 = np.vstack([case.region.corners, case.region.sample(100_000, seed=0)])
    for t, states in enumerate(simulate(case.loop, x0, STEPS)):
        if t > 0:
            b = np.asarray(tube.sets[t].b)
            # 1e-12 is the rounding of the simulation, not an allowance for the solver
            assert np.all(states @ case.directions.T <= b + 1e-12 * np.maximum(1.0, np.abs(b)))


@pytest.mark.parametrize("n_x", STATES)
@pytest.mark.costly
def test_a_box_and_the_polytope_of_its_facets_give_the_same_bounds(n_x):
    loop, region = closed_loop(loop_data(n_x, True, False)), box_region(n_x, seed=n_x)
    box = rj.Box(region.corners.min(axis=0), region.corners.max(axis=0))
    bounds = [
        recursion(
            loop,
            initial,
            horizon=1,
            template=rj.Template(directions(n_x)),
            relaxation=rj.PaperQC(repeated=False),
            solver=rj.Clarabel(tolerance=1e-9),
        )
        .sets[1]
        .b
        for initial in (box, rj.Polytope(region.A, region.b))
    ]
    np.testing.assert_allclose(*bounds, rtol=1e-5, atol=1e-5)


@pytest.mark.costly
def test_neurons_whose_output_is_constant_do_not_tell_the_solver_their_value():
    """A dead layer makes the next one constant to rounding; the paper's program does not know."""
    rng = np.random.default_rng(0)
    sizes = (2, 3, 3, 1)
    layers = [
        (rng.normal(size=(out, into)) * np.sqrt(2 / into), 0.1 * rng.normal(size=out))
        for into, out in pairwise(sizes)
    ]
    layers[0][1][:] = -20.0
    A, B, c = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]]), np.zeros(2)
    loop = LoopData(layers, A, B, c, np.array([-1.0]), np.array([1.0]))
    X0, a = rj.Box([0.25, -0.25], [0.75, 0.25]), directions(2, extra=2)
    following, certificate = rj.reach_step(
        closed_loop(loop), X0, rj.Template(a), relaxation=rj.PaperQC(repeated=True)
    )
    facets = map(np.asarray, X0.facets)
    reference, _ = paper_step(
        layers, A, B, c, loop.u_lower, loop.u_upper, *facets, a, repeated=True
    )
    np.testing.assert_allclose(following.b, reference, rtol=1e-5, atol=1e-5)
    assert set(certificate.statuses) == {rj.SolverStatus.SOLVED}
