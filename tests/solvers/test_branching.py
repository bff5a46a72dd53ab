"""Claims about programs over a horizon, and about branch and bound on the phases of units."""

import itertools

import cvxpy as cp
import numpy as np
import pytest
from scipy.optimize import linprog

from experiments.tightness.exact import exact_maxima
from reachjax.methods.witnesses import initial_states
from reachjax.programs.affine import AffineForms
from reachjax.programs.horizon import Horizon, upper_bounds
from reachjax.programs.initial import InitialColumns
from reachjax.proofs.branches import Branches, HorizonFacts, bounds_of, leaf_bounds
from reachjax.solvers.branching import Tree, affine_leaf, attained_multipliers
from reachjax.solvers.linear_programs import ConicPrograms, LinearPrograms
from tests.closed_loops import initial_set, on_host, switching_loop


def forms_of(rows, constants):
    """Exact forms over columns."""
    constants = np.asarray(constants)[:, None]
    rows = np.concatenate([constants, constants, rows], axis=1)
    return AffineForms(rows, np.tile([0.0, np.inf], (len(rows), 1)))


def start_of(states, round):
    return InitialColumns(np.zeros(states), np.eye(states), np.eye(states), None, round)


class Random:
    """Rows and facts over random columns, which hold at a random point, and their optimum."""

    def __init__(self, seed, round, states=2, columns=7, facts=9, rows=1):
        rng = np.random.default_rng(seed)
        self.round, self.states, self.rng = round, states, rng
        self.inside = rng.uniform(-0.5, 0.5, columns)
        normals = rng.normal(size=(facts, columns)) * 10.0 ** rng.uniform(-2, 2, (facts, 1))
        room = abs(normals).sum(axis=1) * rng.uniform(0.0, 0.3, facts) * (np.arange(facts) > 2)
        self.facts = forms_of(normals, room - normals @ self.inside)
        size = 10.0 ** rng.uniform(-3, 3)
        self.rows = forms_of(size * rng.normal(size=(rows, columns)), size * rng.normal(size=rows))
        self.zero = [0, 2]  # the first three are zero at the point

    def programs(self, cuts=()):
        """The library's, which grow as the facts and columns do."""
        programs = ConicPrograms(self.states)
        if not self.round:
            programs = LinearPrograms(self.states, bounded=True)
        columns = self.facts.columns.shape[1]
        for facts, width in [*cuts, (len(self.facts.rows), columns)]:
            grown = AffineForms(self.facts.rows[:facts, : 2 + width], self.facts.radii[:facts])
            programs.grow(grown, np.arange(width))
        return programs

    def exact(self, zero=(), reach=1.0):
        """The largest value of the least of the rows, by cvxpy; minus infinity if there is none."""
        eta = cp.Variable(self.facts.columns.shape[1])
        facts = self.facts.columns @ eta + self.facts.rows[:, 0]
        first, rest = eta[: self.states], eta[self.states :]
        limits = [cp.norm(first) <= 1 if self.round else cp.abs(first) <= 1, cp.abs(rest) <= reach]
        scale = abs(self.rows.columns).max()
        least = cp.min((self.rows.columns @ eta + self.rows.rows[:, 0]) / scale)
        held = [facts[i] == 0 for i in zero]
        problem = cp.Problem(cp.Maximize(least), [*limits, *held, facts >= 0])
        return scale * problem.solve(solver=cp.CLARABEL if self.round else cp.HIGHS)

    @property
    def scale(self):
        return abs(self.rows.columns).max()


ROUND = pytest.mark.parametrize("round", [False, True], ids=["linear", "conic"])
SEEDS = pytest.mark.parametrize("seed", range(4))


def proved_by(case, vertex, zero, reach=1.0):
    """What a vertex's multipliers and weights prove, with their signs set right."""
    free = np.isin(np.arange(len(case.facts.rows)), list(zero))
    assert vertex.multipliers[~free].min() >= -1e-6 * max(1.0, abs(vertex.multipliers).max())
    assert vertex.weights.min() >= 0
    assert vertex.weights.sum() == pytest.approx(1.0)
    multipliers = np.where(free, vertex.multipliers, np.fmax(vertex.multipliers, 0.0))
    start = start_of(case.states, case.round)
    (found,) = upper_bounds(vertex.weights[None] @ case.rows, case.facts, multipliers[None], start)
    return found


@ROUND
@SEEDS
@pytest.mark.parametrize("rows", [1, 3])
@pytest.mark.parametrize("held", [False, True], ids=["free", "facts at zero"])
def test_values_and_multipliers_are_those_of_a_reference(seed, round, rows, held):
    case = Random(seed, round, rows=rows)
    zero = case.zero if held else []
    vertex = case.programs().largest(case.rows.columns, case.rows.rows[:, 0], zero)
    tolerance = (1e-5 if round else 1e-7) * case.scale
    assert vertex.value == pytest.approx(case.exact(zero), abs=tolerance)
    assert proved_by(case, vertex, zero) == pytest.approx(vertex.value, abs=tolerance)
    facts = case.facts.rows[:, 0] + case.facts.columns @ vertex.columns
    sizes = abs(case.facts.columns).max(axis=1)
    assert (facts / sizes).min() >= -1e-6
    assert abs((facts / sizes)[zero]).max(initial=0.0) <= 1e-6
    attained = (case.rows.rows[:, 0] + case.rows.columns @ vertex.columns).min()
    assert vertex.value == pytest.approx(attained, abs=tolerance)


@ROUND
def test_a_reference_is_not_met_without_the_facts_that_are_held(round):
    cases = [Random(seed, round) for seed in range(8)]
    assert any(abs(each.exact() - each.exact(each.zero)) > 1e-3 * each.scale for each in cases)


@ROUND
@SEEDS
def test_models_that_grew_are_those_built_at_once(seed, round):
    case = Random(seed, round, rows=2)
    grown = case.programs(cuts=[(0, 2), (3, 4), (3, 5)])
    case.facts.columns[:3, 5:] = 0.0  # earlier facts are over earlier columns
    grown, once = case.programs(cuts=[(0, 2), (3, 5)]), case.programs()
    for zero in ((), (4,), (), (0, 2)):
        both = [
            each.largest(case.rows.columns, case.rows.rows[:, 0], zero) for each in (grown, once)
        ]
        assert both[0].value == pytest.approx(both[1].value, abs=1e-6 * case.scale)


@ROUND
def test_programs_forget_what_an_earlier_one_asked_for(round):
    case, programs = Random(1, round, rows=2), Random(1, round, rows=2).programs()
    rows, constants = case.rows.columns, case.rows.rows[:, 0]
    plain = programs.largest(rows, constants, ()).value
    programs.largest(rows, constants, case.zero)
    programs.largest(rows[:1], constants[:1], case.zero, reach=2.0)
    assert programs.largest(rows, constants, ()).value == pytest.approx(
        plain, abs=1e-6 * case.scale
    )


@ROUND
def test_columns_of_units_reach_as_far_as_they_are_let(round):
    case = Random(2, round)
    programs = case.programs()
    found = [
        programs.largest(case.rows.columns, case.rows.rows[:, 0], (), reach=reach).value
        for reach in (0.6, 1.0, 2.0)
    ]
    expected = [case.exact(reach=reach) for reach in (0.6, 1.0, 2.0)]
    np.testing.assert_allclose(found, expected, atol=1e-5 * case.scale)
    assert found[0] < found[1] < found[2]


@ROUND
def test_columns_that_are_left_out_stay_zero(round):
    case = Random(3, round)
    chosen = np.array([0, 1, 3, 6])
    programs = ConicPrograms(2) if round else LinearPrograms(2, bounded=True)
    case.facts.rows[:, 0] = abs(case.facts.rows[:, 0])  # all zero is inside
    programs.grow(case.facts, chosen)
    vertex = programs.largest(case.rows.columns, case.rows.rows[:, 0], ())
    case.rows.columns[:, [2, 4, 5]] = case.facts.columns[:, [2, 4, 5]] = 0.0
    assert vertex.value == pytest.approx(case.exact(), abs=1e-5 * case.scale)
    assert vertex.columns.shape == (7,)
    assert not vertex.columns[[2, 4, 5]].any()


@ROUND
@SEEDS
def test_empty_branches_are_proved_empty(seed, round):
    case = Random(seed, round)
    opposite = forms_of(-case.facts.columns[5:6], -case.facts.rows[5:6, 0] - 0.1)
    rows = np.concatenate([case.facts.rows, opposite.rows])  # fact 5 below -0.1
    case.facts = AffineForms(rows, np.concatenate([case.facts.radii, opposite.radii]))
    for zero in ((), (3,)):
        vertex = case.programs().largest(case.rows.columns, case.rows.rows[:, 0], zero)
        assert vertex.value == -np.inf
        assert not len(vertex.columns)
        free = np.isin(np.arange(len(rows)), list(zero))
        rays = np.outer([1.0, -1.0], vertex.multipliers)
        rays = np.where(free, rays, np.fmax(rays, 0.0))
        nothing = forms_of(np.zeros((2, 7)), np.zeros(2))
        found = upper_bounds(nothing, case.facts, rays, start_of(2, round))
        assert found.min() < 0


@ROUND
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_rows_that_are_no_numbers_have_no_answer(round, bad):
    case = Random(0, round)
    assert case.programs().largest(bad * case.rows.columns, case.rows.rows[:, 0], ()) is None


# branch and bound over loops

STEPS = 2


def horizon_of(loop, X0, steps=STEPS):
    horizon = Horizon(*on_host(loop, X0))
    for _ in range(steps):
        horizon.advance()
    return horizon


def programs_of(horizon):
    start = horizon.start
    states = start.spread.shape[1]
    programs = ConicPrograms(states) if start.round else LinearPrograms(states, start.cut is None)
    programs.grow(horizon.facts, horizon.varying)
    return programs


def nothing_attained(columns):
    return -np.inf


def bound_by(horizon, forms, leaves):
    """What the leaves prove of the least of the forms."""
    width = horizon.facts.columns.shape[1]
    about = HorizonFacts(horizon.start, horizon.facts, horizon.zero, forms.padded(width))
    owner = np.zeros(len(leaves.phases), dtype=int)
    branches = Branches(owner, leaves.phases, leaves.multipliers, leaves.weights)
    (found,) = bounds_of(branches, leaf_bounds(about, branches), 1)
    return found


def never(bound, attained):
    return False


CASES = [(n_x, kind) for n_x in (1, 2, 3, 6) for kind in ("box", "polytope")]


@pytest.fixture(scope="module", params=CASES, ids=lambda case: f"{case[0]}-{case[1]}")
def case(request):
    """(loop, X0, horizon, directions, exact largest values, states that attain them)."""
    n_x, kind = request.param
    loop, X0 = switching_loop(n_x, hidden=(4, 3), seed=n_x), initial_set(kind, n_x, seed=n_x)
    directions = np.random.default_rng(n_x).normal(size=(2, n_x))
    return loop, X0, horizon_of(loop, X0), directions, *exact_maxima(loop, X0, STEPS, directions)


def branched(horizon, programs, forms, attained, enough, budget):
    """The leaves of a tree of so many programs."""
    tree = Tree(horizon, programs, forms, attained, enough)
    tree.grow(budget - tree.nodes)
    return tree.found()


def test_the_bound_is_the_exact_maximum(case):
    _, _, horizon, directions, exact, _ = case
    programs, forms = programs_of(horizon), directions @ horizon.state
    for i, value in enumerate(exact):
        row = forms[i : i + 1]
        leaves = branched(horizon, programs, row, nothing_attained, never, budget=5000)
        lower, upper = row.ends(horizon.start)
        assert bound_by(horizon, row, leaves) == pytest.approx(value, abs=1e-6 * (upper - lower)[0])
        assert bound_by(horizon, row, leaves) >= value - 1e-12


def test_some_bound_takes_splits():
    """Else the claim above would be one about linear programs."""
    loop, X0 = switching_loop(3, hidden=(4, 3), seed=3), initial_set("box", 3, seed=3)
    horizon, counts = horizon_of(loop, X0), []
    for row in np.eye(3):
        form = row[None] @ horizon.state
        leaves = branched(horizon, programs_of(horizon), form, nothing_attained, never, budget=5000)
        counts.append((leaves.nodes, len(leaves.phases)))
    assert max(nodes for nodes, _ in counts) > 5
    assert all(nodes == 2 * leaves - 1 for nodes, leaves in counts)


@pytest.mark.parametrize("budget", [1, 3, 9])
def test_a_small_budget_is_kept_and_its_bound_holds(case, budget):
    _, _, horizon, directions, exact, _ = case
    forms = directions @ horizon.state
    previous = forms.ends(horizon.start)[1]
    for i, value in enumerate(exact):
        row, programs = forms[i : i + 1], programs_of(horizon)
        leaves = branched(horizon, programs, row, nothing_attained, never, budget)
        assert leaves.nodes <= budget + 1
        assert value - 1e-12 <= bound_by(horizon, row, leaves) <= previous[i] + 1e-9


def test_trees_that_grow_by_turns_prove_what_each_proves_alone():
    loop, X0 = switching_loop(3, hidden=(4, 3), seed=3), initial_set("box", 3, seed=3)
    horizon = horizon_of(loop, X0)
    forms, programs = [row[None] @ horizon.state for row in np.eye(3)], programs_of(horizon)
    trees = [Tree(horizon, programs, form, nothing_attained, never) for form in forms]
    bounds = []
    while any(tree.is_open for tree in trees):
        before = [tree.nodes for tree in trees]
        for tree in trees:
            tree.grow(4)
        bounds.append([bound_by(horizon, *pair) for pair in zip(forms, found(trees), strict=True)])
        if before == [tree.nodes for tree in trees]:
            break
    assert len(bounds) > 2
    assert np.all(np.diff(bounds, axis=0) <= 1e-9)
    for form, bound in zip(forms, bounds[-1], strict=True):
        alone = branched(horizon, programs_of(horizon), form, nothing_attained, never, 5000)
        assert bound == pytest.approx(bound_by(horizon, form, alone), abs=1e-8)


def found(trees):
    return [tree.found() for tree in trees]


def test_it_stops_where_the_bound_is_enough(case):
    _, _, horizon, directions, exact, _ = case
    row, asked = directions[:1] @ horizon.state, []

    def enough(bound, attained):
        asked.append((bound, attained))
        return attained >= exact[0]

    leaves = branched(horizon, programs_of(horizon), row, lambda _: exact[0], enough, 5000)
    assert leaves.nodes == 1
    assert len(asked) == 1
    assert asked[0][0] >= exact[0] - 1e-9


def test_the_affine_leaf_is_bounded_by_its_form(case):
    _, _, horizon, directions, _, _ = case
    row = directions[:1] @ horizon.state
    leaf = affine_leaf(row, horizon)
    assert leaf.nodes == 0
    found = bound_by(horizon, row, leaf)
    assert found == pytest.approx(row.ends(horizon.start)[1][0], abs=1e-9)
    attained = row.rows[0, 0] + row.columns[0] @ leaf.columns[0, : row.columns.shape[1]]
    assert attained >= found - 1e-9  # its interval may be better than its form


@pytest.fixture(scope="module")
def small():
    """A horizon of few units that switch, with all patterns of their phases."""
    X0 = initial_set("box", 2, seed=10)
    loops = (switching_loop(2, hidden=(5,), seed=seed) for seed in itertools.count(10, 1000))
    found = ((loop, horizon_of(loop, X0)) for loop in loops)
    loop, horizon = next(pair for pair in found if 3 <= len(pair[1].zero) <= 8)
    return loop, X0, horizon, list(itertools.product((0, 1), repeat=len(horizon.zero)))


def by_linprog(horizon, rows, constants, zero):
    """The largest value of the least row; minus infinity if there is none."""
    facts, columns = horizon.facts, horizon.facts.columns.shape[1]
    held = np.isin(np.arange(len(facts.rows)), list(zero))
    F, f = np.c_[facts.columns, np.zeros(len(facts.rows))], facts.rows[:, 0]
    least = np.c_[-rows, np.ones(len(rows))]
    found = linprog(
        -np.eye(1, columns + 1, columns)[0],
        np.vstack([-F[~held], least]),
        np.concatenate([f[~held], constants]),
        F[held] if held.any() else None,
        -f[held] if held.any() else None,
        bounds=[(-1, 1)] * columns + [(None, None)],
    )
    return -found.fun if found.status == 0 else -np.inf


def test_every_pattern_of_phases_is_solved_as_by_another_solver(small):
    _, _, horizon, patterns = small
    programs = programs_of(horizon)
    forms = np.array([[1.0, -0.5], [0.2, 1.0]]) @ horizon.state
    counts = {"empty": 0, "solved": 0}
    for rows, pattern in itertools.product((forms[:1], forms), patterns):
        zero = [horizon.zero[i, side] for i, side in enumerate(pattern)]
        vertex = programs.largest(rows.columns, rows.rows[:, 0], zero)
        exact = by_linprog(horizon, rows.columns, rows.rows[:, 0], zero)
        if np.isfinite(exact):
            assert vertex.value == pytest.approx(exact, abs=1e-7)
            counts["solved"] += 1
            continue
        assert vertex.value == -np.inf
        free = np.isin(np.arange(len(horizon.facts.rows)), zero)
        rays = np.outer([1.0, -1.0], vertex.multipliers)
        rays = np.where(free, rays, np.fmax(rays, 0.0))
        columns = horizon.facts.columns.shape[1]
        assert horizon.bounds(forms_of(np.zeros((2, columns)), np.zeros(2)), rays).min() < 0
        counts["empty"] += 1
    assert min(counts.values()) > 2


def test_the_least_of_several_rows_is_largest_over_all_patterns(small):
    _, _, horizon, patterns = small
    forms = np.array([[1.0, -0.5], [-0.8, 1.0], [-0.3, -1.0]]) @ horizon.state
    exact = max(
        by_linprog(
            horizon,
            forms.columns,
            forms.rows[:, 0],
            [horizon.zero[i, side] for i, side in enumerate(pattern)],
        )
        for pattern in patterns
    )
    leaves = branched(horizon, programs_of(horizon), forms, nothing_attained, never, budget=5000)
    assert bound_by(horizon, forms, leaves) == pytest.approx(exact, abs=1e-7)
    single = branched(horizon, programs_of(horizon), forms[:1], nothing_attained, never, 5000)
    assert bound_by(horizon, forms[:1], single) > exact + 1e-3


@pytest.mark.parametrize("kind", ["ellipsoid", "intersection"])
@pytest.mark.costly
def test_round_sets_are_bounded_tightly(kind):
    loop, X0 = switching_loop(2, hidden=(4, 3), seed=2), initial_set(kind, 2, seed=2)
    horizon, programs = (found := horizon_of(loop, X0)), programs_of(found)
    states = initial_states(X0, 40_000, seed=0)
    runs = np.asarray(loop.simulate(states, STEPS))[:, -1]
    for direction in ([1.0, 0.3], [-0.4, 1.0]):
        row = np.array([direction]) @ horizon.state
        leaves = branched(horizon, programs, row, nothing_attained, never, budget=3000)
        attained = runs @ np.array(direction)
        bound, spread = bound_by(horizon, row, leaves), np.ptp(attained)
        assert attained.max() - 1e-9 <= bound <= attained.max() + 2e-2 * spread


def test_multipliers_bound_what_is_attained(case):
    _, _, horizon, directions, exact, worst = case
    programs = programs_of(horizon)
    for i, value in enumerate(exact):
        row = directions[i : i + 1] @ horizon.state
        at = horizon.columns_at(worst[i])
        none = np.full((1, len(horizon.zero)), -1)
        multipliers = attained_multipliers(horizon, programs, row, at, none, value)
        assert multipliers is not None
        facts = horizon.facts.rows[:, 0] + horizon.facts.columns @ at
        assert multipliers @ facts == pytest.approx(0.0, abs=1e-6)
        weighed = row.padded(horizon.facts.columns.shape[1]).columns[0]
        weighed = weighed + multipliers @ horizon.facts.columns
        bound = row.rows[0, 0] + multipliers @ horizon.facts.rows[:, 0] + weighed @ at
        assert bound == pytest.approx(value, abs=1e-6)
        # nothing is left that a unit's own column could gain
        of_units = np.unique(horizon.columns)
        assert abs(weighed[of_units]).max(initial=0.0) <= 1e-6 * abs(row.columns).sum()


def test_what_is_not_the_maximum_has_none(case):
    _, X0, horizon, directions, _, _ = case
    center = np.asarray(X0.bounding_box().center)
    row, none = directions[:1] @ horizon.state, np.full((1, len(horizon.zero)), -1)
    at = horizon.columns_at(center)
    value = float(row.rows[0, 0] + row.columns[0] @ at[: row.columns.shape[1]])
    assert attained_multipliers(horizon, programs_of(horizon), row, at, none, value) is None


def test_what_is_attained_below_the_bound_has_none(case):
    _, _, horizon, directions, exact, worst = case
    row, none = directions[:1] @ horizon.state, np.full((1, len(horizon.zero)), -1)
    at, above = horizon.columns_at(worst[0]), exact[0] + 1e-3 * abs(row.columns).sum()
    assert attained_multipliers(horizon, programs_of(horizon), row, at, none, exact[0]) is not None
    assert attained_multipliers(horizon, programs_of(horizon), row, at, none, above) is None
