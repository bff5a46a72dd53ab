"""Whatever multipliers arrive, the offset that is reported holds."""

import jax
import numpy as np
import pytest

import reachjax as rj
from reachjax.numerics.rounding import Ball
from reachjax.programs.lmi import weighted_products
from reachjax.proofs.recheck import interval_offsets, sound_offsets
from tests.closed_loops import closed_loop, proposal_of, random_loop, step_program
from tests.networks import box_region, dead_network, directions, he_network, simulate

STATES = [1, 2, 3, 6]


@pytest.fixture(scope="module", params=STATES)
def case(request):
    """(program, solver's multipliers, largest sampled value of each direction)."""
    n_x = request.param
    data, region = random_loop(n_x, seed=n_x), box_region(n_x, seed=n_x)
    X, template = rj.Polytope(region.A, region.b), rj.Template(directions(n_x, extra=1))
    program = jax.device_get(
        step_program(
            closed_loop(data),
            X,
            X.bounding_box(),
            template.directions,
            0,
            rj.LocalBounds(remove_stable=False),
        )
    )
    states = np.vstack([region.corners, region.sample(20_000, seed=0)])
    attained = (simulate(data, states, 1)[1] @ directions(n_x, extra=1).T).max(axis=0)
    return program, proposal_of(rj.Clarabel(), program), attained


def garbage(kind, solved, rng):
    shape = solved.shape
    return {
        "normal": lambda: rng.normal(size=shape),
        "positive": lambda: rng.uniform(size=shape),
        "negative": lambda: -rng.uniform(size=shape),
        "huge": lambda: 10.0 ** rng.uniform(0, 300, size=shape),
        "huge, both signs": lambda: rng.normal(size=shape) * 1e160,
        "tiny": lambda: 10.0 ** -rng.uniform(0, 300, size=shape),
        "zero": lambda: np.zeros(shape),
        "sparse": lambda: rng.uniform(size=shape) * (rng.uniform(size=shape) < 0.1),
        "perturbed solution": lambda: solved * (1 + 0.1 * rng.normal(size=shape)),
        "half the solution": lambda: solved / 2,
        "twice the solution": lambda: solved * 2,
        "wrong signs": lambda: -solved,
        "permuted": lambda: rng.permuted(solved, axis=1),
    }[kind]()


KINDS = [
    "normal",
    "positive",
    "negative",
    "huge",
    "huge, both signs",
    "tiny",
    "zero",
    "sparse",
    "perturbed solution",
    "half the solution",
    "twice the solution",
    "wrong signs",
    "permuted",
]


@pytest.mark.parametrize("kind", KINDS)
def test_garbage_multipliers_never_give_an_offset_below_the_true_support(case, kind):
    program, solution, attained = case
    rng = np.random.default_rng(0)
    for _ in range(5):
        offsets = sound_offsets(program, garbage(kind, solution.multipliers, rng))
        assert np.all(offsets >= attained)
        assert np.all(np.isfinite(offsets))


def test_products_without_weight_change_nothing_that_is_proved(case):
    program, solution, _ = case
    given, count = program.products, len(program.products.free)
    twice = jax.tree.map(lambda part: np.concatenate([part, part]), given).replace(
        multiplier=np.concatenate([given.multiplier, count + np.asarray(given.multiplier)])
    )
    padded = np.pad(solution.multipliers, ((0, 0), (0, count)))
    np.testing.assert_array_equal(
        sound_offsets(program.replace(products=twice), padded),
        sound_offsets(program, solution.multipliers),
    )


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_multipliers_that_are_not_finite_are_a_clear_failure(case, bad):
    program, solution, _ = case
    broken = solution.multipliers.copy()
    broken[-1, 0] = bad
    with pytest.raises(ValueError, match=f"program {len(broken) - 1} contain NaN or infinity"):
        sound_offsets(program, broken)


def test_multipliers_of_another_shape_are_a_clear_failure(case):
    program, solution, _ = case
    with pytest.raises(ValueError, match=r"multipliers must have shape .* arrived"):
        sound_offsets(program, solution.multipliers[:, 1:])


@pytest.mark.parametrize("n_x", STATES)
@pytest.mark.costly
def test_the_recheck_of_a_solved_program_costs_next_to_nothing(n_x):
    region = box_region(n_x, seed=n_x)
    X, template = rj.Polytope(region.A, region.b), rj.Template(directions(n_x, extra=1))
    loop = closed_loop(random_loop(n_x, seed=n_x))
    program = jax.device_get(
        step_program(loop, X, X.bounding_box(), template.directions, 0, rj.LocalBounds())
    )
    solution = proposal_of(rj.Clarabel(tolerance=1e-9), program)
    solved = solution.statuses == rj.SolverStatus.SOLVED
    excess = sound_offsets(program, solution.multipliers) - solution.unknowns[:, 0]
    # a hundred times the solver's tolerance: feasibility counts once for every entry of the basis
    assert excess[solved].max() <= 1e-7
    assert solved.mean() >= 0.9


def test_an_offset_that_falls_short_is_raised_by_at_least_what_is_missing(case):
    """The matrix inequality really is what is checked: the quadratic form bounds the offset."""
    program, solution, _ = case
    rng = np.random.default_rng(1)
    n = len(program.transform)
    for i, multipliers in enumerate(np.maximum(solution.multipliers * 0.9, 0)):
        raised = sound_offsets(program, np.tile(multipliers, (len(solution.statuses), 1)))[i]
        M = weighted_products(program, multipliers).mid
        p = program.objective.mid[i]
        eta = np.c_[rng.uniform(-1, 1, size=(2000, n - 1)), np.ones(2000)]
        # for eta in the box: 2 p.eta + eta' F'Gamma F eta <= 2 b must hold of a proved b
        assert np.all(2 * eta @ p + np.einsum("ci,ij,cj->c", eta, M, eta) <= 2 * raised + 1e-12)


def test_interval_offsets_hold(case):
    program, _, attained = case
    assert np.all(interval_offsets(program) >= attained)


def test_rounding_errors_of_the_rows_are_paid_for(case):
    program, solution, _ = case
    plain = sound_offsets(program, solution.multipliers)
    rough = program.replace(
        facts=Ball(program.facts.mid, program.facts.rad + 1e-6),
        objective=Ball(program.objective.mid, program.objective.rad + 1e-6),
    )
    assert np.all(sound_offsets(rough, solution.multipliers) >= plain + 1e-6)


@pytest.mark.parametrize("n_x", [1, pytest.param(2, marks=pytest.mark.long), 3])
@pytest.mark.costly
def test_degenerate_sets_and_networks_stay_sound(n_x):
    """A single point, a set flat in one coordinate, dead neurons, a network that is zero."""
    point, wide = np.linspace(-0.2, 0.3, n_x), np.full(n_x, 0.5)
    flat = wide.copy()
    flat[0] = 0.0
    template = rj.Template.box(n_x)
    for network in (
        he_network,
        dead_network,
        lambda sizes, seed: [(0 * W, 0 * b) for W, b in he_network(sizes, seed)],
    ):
        data = random_loop(n_x, network=network)
        for radius in (0 * wide, flat, wide, 1e-12 * wide, 1e3 * wide):
            X = rj.Box(point - radius, point + radius)
            for relaxation in (rj.PaperQC(), rj.LocalBounds()):
                following, _ = rj.reach_step(closed_loop(data), X, template, relaxation=relaxation)
                states = np.vstack([X.vertices(), X.sample(jax.random.key(0), 500)])
                successors = simulate(data, states, 1)[1]
                # the simulation rounds too, in the size of its states
                assert np.all(following.contains(successors, 1e-15 * (1 + radius.max())))
