"""The oracle agrees with known answers, and the campaign fails where something is false."""

import json
from dataclasses import replace
from fractions import Fraction
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.campaign import gradients
from tests.campaign.architectures import BLOCK, EVERY, Architecture
from tests.campaign.cases import drawn
from tests.campaign.claims import tried
from tests.campaign.containment import searched
from tests.campaign.errors import unclear
from tests.campaign.faults import FAULTS, Faulty
from tests.campaign.oracle import WIDE, Loop, Region, exact, inverse_factor, solved
from tests.campaign.outcomes import Outcome
from tests.campaign.random_regions import Initial
from tests.campaign.regions import plain
from tests.campaign.suprema import affine_steps, root
from tests.campaign.verdicts import Question, judged
from tests.closed_loops import proposal_of

# x+ = x + clip(-0.4 x, -1, 1), its controller written with the two parts of |x|
LAYERS = [(np.array([[1.0], [-1.0]]), np.zeros(2)), (np.array([[-0.4, 0.4]]), np.zeros(1))]
ONE = np.ones((1, 1))
CHAINS = [BLOCK * k for k, shapes in enumerate(EVERY) if isinstance(shapes, Architecture)]
"""The first case of each architecture that has a plain loop: the others have an oracle each."""
KNOWN = Loop(LAYERS, ONE, ONE, np.zeros(1), -np.ones(1), np.ones(1))


def interval(lower, upper):
    corners, text = exact([[lower], [upper]]), f"rj.Box([{lower}], [{upper}])"
    region = Region(np.array([[-1.0], [1.0]]), np.array([-lower, upper]))
    return Initial("Box, generic", text, region, corners, corners.sum(axis=0) / 2)


def library_loop():
    plant = rj.AffinePlant(ONE, ONE)
    return rj.ClosedLoop(plant, rj.MLP.from_layers(LAYERS), rj.Box([-1.0], [1.0]))


def test_fractions_follow_the_loop_exactly():
    states = KNOWN.simulate(exact([[1.0], [4.0]]), 2)[:, :, 0]
    gain = 1 - Fraction(0.4)  # 0.4 is not two fifths
    assert states.tolist() == [[1, 4], [gain, 3], [gain**2, 2]]


def every_chain(step):
    return (drawn(first + k) for first in CHAINS for k in range(0, BLOCK, step))


@pytest.mark.costly
def test_longdouble_is_off_by_no_more_than_it_says():
    for case in every_chain(7):
        if case.initial.inner is None:
            continue
        starts = case.initial.starts(case.rng, 3)[-3:]
        wide = case.loop.simulate_wide(starts, np.zeros_like(starts), case.shapes.horizon)
        true = case.loop.simulate(exact(starts), case.shapes.horizon)
        for (states, error), right in zip(wide, true, strict=True):
            assert np.all(abs(exact(states) - right) <= exact(error))


def test_rooms_in_longdouble_are_off_by_no_more_than_they_say():
    rng = np.random.default_rng(0)
    for size in (1.0, 1e-4, 1e-6):
        L = rng.normal(size=(3, 3)) * [1, 1e8, size]
        Q = L @ L.T
        ball = Region(np.eye(3), np.ones(3), rng.normal(size=3), (Q + Q.T) / 2)
        points = (ball.center + rng.normal(size=(5, 3)) @ L.T / 2).astype(WIDE)
        room, off = ball.room_wide(points, np.zeros_like(points))
        right = np.array([ball.room(x) for x in exact(points)])
        assert np.all(abs(exact(room) - right) <= exact(off))
        # seven roundings of numbers of this size, whatever is drawn
        assert np.all(off[:, :3] <= 8 * np.finfo(WIDE).eps * (1 + abs(points)))


def test_a_ball_is_what_it_is():
    ball = Region(None, None, np.array([1.0, 0.0]), np.diag([4.0, 0.25]))
    assert ball.room(exact([3.0, 0.0])) == [0]
    assert ball.room(exact([2.0, 0.25])) == [Fraction(1, 2)]
    assert np.allclose(inverse_factor(ball.shape)[0].astype(float), np.diag([0.5, 2.0]))
    assert solved(exact([[1.0, 1.0], [2.0, 2.0]]), exact([1.0, 2.0])) is None


def test_suprema_of_affine_loops_are_exact():
    steps = affine_steps(KNOWN, interval(1.0, 2.0), 2)  # no unit switches there
    gain = 1 - Fraction(0.4)
    assert steps[2].supremum(interval(1.0, 2.0), exact([1.0])) == (2 * gain**2, 2 * gain**2)
    assert affine_steps(KNOWN, interval(-1.0, 2.0), 2) is None
    far = affine_steps(KNOWN, interval(10.0, 20.0), 2)  # saturated: minus one each step
    assert far[2].supremum(interval(10.0, 20.0), exact([1.0])) == (18, 18)
    low, high = root(Fraction(1, 9) * 10**120)
    assert low <= Fraction(10**60, 3) <= high
    assert high - low < 10**20


@pytest.mark.parametrize("lower", [-2.0, 1.0])
@pytest.mark.costly
def test_tubes_that_hold_pass_and_shrunk_ones_do_not(lower):
    X0 = interval(lower, 2.0)
    tube = rj.reach(library_loop(), rj.Box([lower], [2.0]), 2, rj.Template.box(1), window=2)
    sets = [plain(region) for region in tube.sets]
    assert searched(KNOWN, X0, sets, np.random.default_rng(0)).outside == []
    for t in (1, 2):
        shrunk = list(sets)
        shrunk[t] = replace(sets[t], b=sets[t].b - 1e-6)
        assert searched(KNOWN, X0, shrunk, np.random.default_rng(0)).outside != []


def extremes(case, around):
    """The largest values of `+-x_i` after one step that the search finds, and their errors."""
    rows = np.vstack([np.eye(case.shapes.states), -np.eye(case.shapes.states)])
    sets = [case.initial.region, Region(rows, around.astype(float))]
    states, error = searched(case.loop, case.initial, sets, case.rng).states[1]
    return (states @ rows.T).max(axis=0), np.tile(error.max(axis=0), 2)


@pytest.mark.parametrize("first", CHAINS)
def test_the_search_finds_about_as_much_as_many_samples(first):
    cases = map(drawn, range(first, first + BLOCK))
    case = next(c for c in cases if c.initial.kind.endswith(("generic", "half")))
    starts = case.initial.starts(case.rng, 200)
    held = [case.initial.region.holds(x) for x in exact(starts)]
    states, _ = case.loop.simulate_wide(starts[held], np.zeros_like(starts[held]), 1)[1]
    most = np.hstack([states.max(axis=0), -states.min(axis=0)])
    ranges = np.tile(states.max(axis=0) - states.min(axis=0), 2)
    assert np.all(extremes(case, most)[0] >= most - 0.2 * ranges)


@pytest.mark.costly
def test_the_search_attains_the_suprema_of_affine_loops():
    checked = 0
    for case in every_chain(3):
        steps = affine_steps(case.loop, case.initial, 1)
        n = case.shapes.states
        rows = exact(np.vstack([np.eye(n), -np.eye(n)]))
        suprema = [] if steps is None else [steps[1].supremum(case.initial, a) for a in rows]
        most = np.array([found[1] for found in suprema if found is not None])
        if len(most) < len(rows):
            continue
        ranges = np.tile(most[:n] + most[n:], 2)
        found, error = map(exact, extremes(case, most))
        assert np.all(found - error <= most)
        assert np.all(found + error >= most - ranges / 10**9)
        checked += 1
    assert checked > 20


def asked(kind, limits, violated, satisfied):
    rows = np.array([[1.0], [2.0]])
    return Question("", kind, rows, np.array(limits), violated, satisfied)


def test_false_verdicts_are_seen():
    case = SimpleNamespace(initial=interval(1.0, 2.0), loop=KNOWN)
    broken = asked("goal", [1.0, 9.0], True, False)  # 1.2 is reached
    assert judged(case, broken, "UNKNOWN", None) is None
    assert "false verdict: PROVED" in judged(case, broken, "PROVED", None)
    kept = asked("goal", [1.3, 9.0], False, True)
    assert judged(case, kept, "PROVED", None) is None
    assert "false verdict: REFUTED" in judged(case, kept, "REFUTED", None)
    real = SimpleNamespace(states=np.array([[2.0], [1.2]]), time=1)
    assert judged(case, broken, "REFUTED", real) is None
    outside = SimpleNamespace(states=np.array([[2.5], [1.5]]), time=1)
    assert "is not in X0" in judged(case, broken, "REFUTED", outside)
    harmless = SimpleNamespace(states=np.array([[1.0], [0.6]]), time=1)
    assert "breaks nothing" in judged(case, broken, "REFUTED", harmless)


def test_errors_are_told_apart():
    with pytest.raises(ValueError, match="empty") as clear:
        rj.Box([1.0], [0.0])
    assert unclear(clear.value) is None
    with pytest.raises(np.linalg.LinAlgError) as foreign:
        np.linalg.cholesky(-np.eye(2))
    assert unclear(foreign.value) == "LinAlgError from elsewhere"


@pytest.mark.parametrize(
    ("errors", "word"),
    [
        ((0.0, 0.5), "agrees"),
        ((0.006, 0.0), "agrees, solved more exactly"),
        ((0.006, 0.006), "wrong"),
        ((0.05, 0.0), "wrong"),
    ],
)
def test_wrong_derivatives_are_seen(monkeypatch, errors, word):
    def pretended(template, relaxation, solver, horizon):
        def value(given, weights):
            def weighed(given):
                b = jnp.concatenate([given[1].upper, -given[1].lower])
                return weights @ b, (b, jnp.zeros(2))

            found, slopes = jax.value_and_grad(weighed, has_aux=True)(given)
            wrong = 1 + errors[gradients.SOLVERS.index(solver)]
            return found, jax.tree.map(lambda slope: wrong * slope, slopes)

        return value

    monkeypatch.setattr(gradients, "_compiled", pretended)
    case = SimpleNamespace(
        parts={"template": "", "relaxation": ""}, shapes=SimpleNamespace(states=1, horizon=1)
    )
    far = rj.Box([1000.0], [1001.0])
    assert gradients.compared(case, library_loop(), far, np.random.default_rng(1))[0] == word


def test_words_of_other_libraries_are_unclear(monkeypatch):
    def broken(*arguments):
        raise ValueError("points must not contain NaN")

    monkeypatch.setattr("reachjax.sets.hulls.ConvexHull", broken)
    X0 = rj.Polytope([[1.0, 0.0], [0.0, 1.0], [-1.0, -1.0]], [1.0, 1.0, 1.0])
    loop = rj.ClosedLoop(
        rj.AffinePlant(np.eye(2), [[1.0], [0.0]]), rj.MLP.from_layers([([[0.1, 0.2]], [0.0])])
    )
    with pytest.raises(ValueError, match="points must not contain NaN") as repeated:
        rj.reach(loop, X0, 1, rj.Template.box(2))
    assert unclear(repeated.value) == "ValueError from elsewhere"


@pytest.mark.costly
def test_an_exception_of_a_solver_is_a_failed_program():
    solver = Faulty(rj.Clarabel(), "raises")
    with pytest.warns(RuntimeWarning, match="LicenceError was raised"):
        _, proof = rj.reach_step(
            library_loop(), rj.Box([1.0], [2.0]), rj.Template.box(1), solver=solver
        )
    assert set(proof.statuses) == {rj.SolverStatus.FAILED}
    with pytest.raises(RuntimeError, match="licence") as passed_on:
        proposal_of(solver, jax.device_get(proof.program))
    assert unclear(passed_on.value) == "LicenceError from elsewhere"


def test_a_case_fails_where_the_library_breaks(monkeypatch):
    def broken(*arguments, **options):
        raise AttributeError("'NoneType' object has no attribute 'T'")

    monkeypatch.setattr(rj, "reach", broken)
    outcome = tried(drawn(0))
    (failure,) = outcome.failures
    assert failure.family.startswith("reach: AttributeError from elsewhere")


def test_a_case_is_its_seed_and_number():
    assert drawn(3, 5).script == drawn(3, 5).script
    assert drawn(3, 5).script != drawn(3, 6).script
    assert drawn(3, 5).script != drawn(4, 5).script


@pytest.mark.costly
def test_every_fault_is_one():
    assert hash(Faulty(rj.Clarabel(), "None")) == hash(Faulty(rj.Clarabel(), "None"))
    _, proof = rj.reach_step(library_loop(), rj.Box([1.0], [2.0]), rj.Template.box(1))
    program = jax.device_get(proof.program)
    right = proposal_of(rj.Clarabel(), program)
    for fault in FAULTS:
        try:
            answer = proposal_of(Faulty(rj.Clarabel(), fault), program)
        except RuntimeError:
            continue
        assert type(answer) is not type(right) or not same(answer, right)


def same(one, other):
    parts = zip(one[:4], other[:4], strict=True)  # all but the seconds
    return all(
        np.array_equal(np.asarray(a), np.asarray(b)) and type(a) is type(b) for a, b in parts
    )


@pytest.mark.costly
def test_an_outcome_survives_being_written():
    outcome = tried(drawn(0))
    again = Outcome.read(json.loads(json.dumps(outcome.record())))
    assert again == outcome
    assert again.counts["states"] > 100
