"""Solvers propose; what they propose is well formed, and every way of ending is mapped."""

from types import SimpleNamespace

import clarabel
import jax
import numpy as np
import pytest
from scipy.linalg import eigvalsh

import reachjax as rj
from reachjax.programs.presolve import presolved
from reachjax.proofs.proposal import CLAIMING
from reachjax.proofs.recheck import interval_offsets
from reachjax.proofs.reported import judged_offsets
from reachjax.solvers import clarabel as direct
from reachjax.solvers import conic
from reachjax.solvers.conic import STATUSES
from tests.closed_loops import closed_loop, one_step, proposal_of, random_loop, step_program
from tests.networks import box_region, directions, simulate

SOLVERS = {
    "Clarabel": rj.Clarabel(),
    "SCS": rj.SCS(),
    "by name": rj.CvxpySolver(*rj.Clarabel().settings()),
}


@pytest.fixture(scope="module")
def setting():
    """(loop arrays, set, program) of a loop with three states."""
    data, region = random_loop(3, seed=5), box_region(3, seed=5)
    X, template = rj.Polytope(region.A, region.b), rj.Template(directions(3, extra=1))
    program = step_program(
        closed_loop(data), X, X.bounding_box(), template.directions, 0, rj.LocalBounds()
    )
    return data, region, jax.device_get(program)


@pytest.fixture(scope="module", params=SOLVERS.values(), ids=SOLVERS.keys())
def solution(request, setting):
    return proposal_of(request.param, setting[2])


def test_solvers_agree(setting, solution):
    reference = proposal_of(rj.Clarabel(), setting[2])
    # SCS stops at 1e-7 of feasibility, which leaves some 1e-5 in the value
    np.testing.assert_allclose(solution.unknowns, reference.unknowns, atol=2e-5)


def test_called_directly_clarabel_answers_as_it_does_by_cvxpy(setting):
    straight, by_name = (proposal_of(SOLVERS[name], setting[2]) for name in ("Clarabel", "by name"))
    np.testing.assert_allclose(straight.unknowns, by_name.unknowns, atol=1e-8)
    np.testing.assert_allclose(straight.moments, by_name.moments, atol=1e-4)
    np.testing.assert_array_equal(straight.statuses, by_name.statuses)


def test_moments_are_semidefinite_with_corner_one_and_satisfy_facts_and_complementarity(
    setting, solution
):
    program = setting[2]
    products = program.products
    for X in solution.moments:
        assert X[-1, -1] == pytest.approx(1.0, abs=1e-12)
        assert eigvalsh(X)[0] >= -1e-6
        values = np.einsum(
            "pi,ij,pj->p", program.facts.mid[products.left], X, program.facts.mid[products.right]
        )
        sums = np.bincount(products.multiplier, values, len(products.free))
        assert abs(sums[products.free]).max() <= 1e-4
        assert sums[~products.free].min() >= -1e-4


def test_the_moment_attains_the_offset(setting, solution):
    program = setting[2]
    attained = np.einsum("fi,fi->f", program.objective.mid, solution.moments[:, :, -1])
    np.testing.assert_allclose(attained, solution.unknowns[:, 0], atol=1e-4)


def test_signed_multipliers_are_nonnegative_to_tolerance(setting, solution):
    signed = solution.multipliers[:, ~setting[2].products.free]
    assert signed.min() >= -1e-6


LIMITED = {
    "iteration limit": (rj.Clarabel(max_iterations=2), {rj.SolverStatus.LIMIT}),
    "time limit": (rj.Clarabel(time_limit=1e-9), {rj.SolverStatus.LIMIT}),
    "SCS stopped early": (
        rj.SCS(max_iterations=3),
        {rj.SolverStatus.LIMIT, rj.SolverStatus.INACCURATE},
    ),
    "crude tolerance": (rj.Clarabel(tolerance=1e-1), {rj.SolverStatus.SOLVED}),
}


@pytest.mark.parametrize(("solver", "expected"), LIMITED.values(), ids=LIMITED.keys())
@pytest.mark.costly
def test_bounds_are_sound_when_the_solver_is_stopped_early(setting, solver, expected):
    data, region, _ = setting
    X = rj.Polytope(region.A, region.b)
    following, certificate = one_step(
        closed_loop(data), X, rj.Template(directions(3, extra=1)), solver=solver
    )
    assert set(certificate.statuses) <= expected
    states = np.vstack([region.corners, region.sample(20_000, seed=0)])
    assert np.all(following.contains(simulate(data, states, 1)[1]))
    assert np.all(certificate.gaps >= 0)


@pytest.mark.parametrize("word", sorted(STATUSES))
def test_bounds_are_sound_under_every_status_that_cvxpy_has(setting, monkeypatch, word):
    """Whatever cvxpy says, with values of any kind or none, the bound holds."""
    import cvxpy as cp

    data, region, program = setting
    rng = np.random.default_rng(0)

    def solve(problem, **_):
        if word == "solver_error":
            raise cp.SolverError("broken")
        problem._status = word
        for variable in problem.variables():
            value = rng.normal(size=variable.shape)
            variable.save_value(None if "feasible" in word else value)

    monkeypatch.setattr(cp.Problem, "solve", solve)
    solution = proposal_of(rj.SCS(), program)
    assert set(solution.statuses) == {STATUSES[word]}
    require_sound(data, region, program, solution)
    if word == "solver_error" or "feasible" in word:
        require_nothing_proposed(program, solution)


def require_sound(data, region, program, solution):
    bounds = judged_offsets(program, solution).value
    claims = solution.unknowns[:, 0]
    certificate = rj.Certificate.of(program, solution, bounds=bounds, solver_offsets=claims)
    states = np.vstack([region.corners, region.sample(20_000, seed=0)])
    attained = (simulate(data, states, 1)[1] @ directions(3, extra=1).T).max(axis=0)
    assert np.all(certificate.bounds >= attained)
    assert all(status.advice for status in certificate.statuses)


def require_nothing_proposed(program, solution):
    bounds = judged_offsets(program, solution).value
    np.testing.assert_array_equal(bounds, interval_offsets(program))
    assert np.isnan(solution.unknowns).all()
    assert np.isnan(solution.moments).all()


class Panic(BaseException):
    """As compiled code raises it."""


@pytest.mark.parametrize("word", [*direct.STATUSES, "NumericalError", "Unsolved", "a panic", "NaN"])
def test_bounds_are_sound_under_every_status_that_clarabel_has(setting, monkeypatch, word):
    """Whatever Clarabel says, with values of any kind, the bound holds."""
    data, region, program = setting
    rng = np.random.default_rng(0)

    def solver(P, q, A, b, cones, settings):
        def solve():
            if word == "a panic":
                raise Panic
            x, z = rng.normal(size=A.shape[1]), rng.normal(size=A.shape[0])
            return SimpleNamespace(status=word, x=x * np.nan if word == "NaN" else x, z=z)

        return SimpleNamespace(solve=solve)

    monkeypatch.setattr(clarabel, "DefaultSolver", solver)
    solution = proposal_of(rj.Clarabel(), program)
    assert set(solution.statuses) == {direct.STATUSES.get(word, rj.SolverStatus.FAILED)}
    require_sound(data, region, program, solution)
    if direct.STATUSES.get(word) not in CLAIMING:
        require_nothing_proposed(program, solution)


def test_every_status_of_clarabel_is_mapped():
    words = {word for word in dir(clarabel.SolverStatus) if word[0].isupper()}
    failures = {"Unsolved", "NumericalError", "CallbackTerminated"}
    assert words == set(direct.STATUSES) | failures


@pytest.mark.parametrize("interrupt", [KeyboardInterrupt, SystemExit])
def test_clarabel_can_be_interrupted(setting, monkeypatch, interrupt):
    def solver(*_):
        def solve():
            raise interrupt

        return SimpleNamespace(solve=solve)

    monkeypatch.setattr(clarabel, "DefaultSolver", solver)
    with pytest.raises(interrupt):
        proposal_of(rj.Clarabel(), setting[2])


def test_every_status_of_cvxpy_is_mapped():
    import cvxpy.settings as s

    words = {
        getattr(s, name)
        for name in (
            "OPTIMAL",
            "OPTIMAL_INACCURATE",
            "INFEASIBLE",
            "INFEASIBLE_INACCURATE",
            "UNBOUNDED",
            "UNBOUNDED_INACCURATE",
            "INFEASIBLE_OR_UNBOUNDED",
            "USER_LIMIT",
            "SOLVER_ERROR",
        )
    }
    assert words == set(STATUSES)


def test_rows_at_rounding_level_and_empty_columns_do_not_reach_the_solver(setting):
    program = setting[2]
    noisy = program.facts.mid.copy()
    noisy[5] = 1e-17 * np.sign(noisy[5] + 0.5)
    noise = program.facts.rad.copy()
    noise[5] = 1e-17
    reduced = presolved(program.replace(facts=type(program.facts)(noisy, noise)))
    touched = (program.products.left == 5) | (program.products.right == 5)
    gone = set(range(len(program.products.free))) - set(reduced.kept.tolist())
    alone = {
        k
        for k in program.products.multiplier[touched]
        if np.all(touched[program.products.multiplier == k])
    }
    assert alone
    assert alone <= gone
    np.testing.assert_array_equal(reduced.columns, np.flatnonzero(program.used))
    generators = reduced.generators.columns()
    sizes = np.sqrt(generators.multiply(generators).sum(axis=0))
    np.testing.assert_allclose(sizes, 1.0, rtol=0.5)  # sums of pairs are estimated


@pytest.mark.parametrize(("model", "name"), [(direct.Cone, "Clarabel"), (conic.Model, "SCS")])
def test_the_model_is_built_once_for_all_facets(setting, monkeypatch, model, name):
    built = []
    original = model.__init__

    def counted(self, *args):
        built.append(args)
        original(self, *args)

    monkeypatch.setattr(model, "__init__", counted)
    proposal_of(SOLVERS[name], setting[2])
    assert len(built) == 1


def test_a_facet_does_not_depend_on_the_facets_solved_before_it(setting):
    program = setting[2]
    order = np.arange(len(program.objective.mid))[::-1]
    turned = program.replace(objective=program.objective[order])
    forward, backward = (proposal_of(rj.Clarabel(), each) for each in (program, turned))
    np.testing.assert_allclose(forward.unknowns, backward.unknowns[order], atol=1e-12)
