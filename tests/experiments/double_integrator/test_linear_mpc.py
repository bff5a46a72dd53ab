"""The MPC does what its program says, and its terminal set is what its name says."""

import cvxpy as cp
import numpy as np
import pytest

from experiments.double_integrator.mpc import LinearMPC, maximal_invariant_set

DOUBLE_INTEGRATOR = {
    "A": [[1, 1], [0, 1]],
    "B": [[0.5], [1]],
    "Q": np.eye(2),
    "R": np.eye(1),
    "horizon": 10,
    "state_lower": [-5, -1],
    "state_upper": [5, 1],
    "input_lower": [-1],
    "input_upper": [1],
}
# Three states, two inputs, an unstable mode, boxes that are not symmetric: nothing is special.
LARGER = {
    "A": [[1.1, 0.4, 0], [0, 0.9, 0.3], [0.2, 0, 1]],
    "B": [[0, 1], [0.5, 0], [1, -0.3]],
    "Q": np.diag([1, 2, 0.5]),
    "R": np.diag([1, 0.3]),
    "horizon": 4,
    "state_lower": [-2, -1, -3],
    "state_upper": [1.5, 2, 2],
    "input_lower": [-1, -0.5],
    "input_upper": [0.7, 1],
}


@pytest.fixture(params=[DOUBLE_INTEGRATOR, LARGER], ids=["double integrator", "larger"])
def mpc(request):
    return LinearMPC(**request.param)


def states_in(mpc, count, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(mpc.state_lower, mpc.state_upper, (count, len(mpc.A)))


def in_terminal_set(mpc, states):
    return np.all(states @ mpc.terminal_rows.T <= 1 + 1e-9, axis=1)


def stays_admissible(mpc, states, steps=300):
    """Whether LQR from each state satisfies all constraints, by simulation."""
    good = np.full(len(states), True)
    for _ in range(steps):
        inputs = -states @ mpc.gain.T
        good &= np.all((mpc.state_lower <= states) & (states <= mpc.state_upper), axis=1)
        good &= np.all((mpc.input_lower <= inputs) & (inputs <= mpc.input_upper), axis=1)
        states = states @ mpc.A.T + inputs @ mpc.B.T
    return good


def optimal_input(mpc, x):
    """The MPC's input by an independent program, with states as variables."""
    X = cp.Variable((mpc.horizon + 1, len(mpc.A)))
    U = cp.Variable((mpc.horizon, mpc.B.shape[1]))
    cost = cp.quad_form(X[-1], mpc.terminal_weight)
    constraints = [X[0] == x, mpc.terminal_rows @ X[-1] <= 1]
    for k in range(mpc.horizon):
        cost += cp.quad_form(X[k], mpc.Q) + cp.quad_form(U[k], mpc.R)
        constraints += [X[k + 1] == mpc.A @ X[k] + mpc.B @ U[k]]
        constraints += [mpc.state_lower <= X[k + 1], X[k + 1] <= mpc.state_upper]
        constraints += [mpc.input_lower <= U[k], U[k] <= mpc.input_upper]
    tight = {"tol_gap_abs": 1e-11, "tol_gap_rel": 1e-11, "tol_feas": 1e-11}
    cp.Problem(cp.Minimize(cost), constraints).solve(solver="CLARABEL", **tight)
    return None if U.value is None else U.value[0]


def test_the_terminal_set_is_exactly_where_lqr_stays_admissible(mpc):
    # Invariant, admissible and maximal in one: membership is what simulation says, both ways.
    states = states_in(mpc, 20_000)
    inside = in_terminal_set(mpc, states)
    assert np.array_equal(inside, stays_admissible(mpc, states))
    assert 0 < inside.sum() < len(states)


def test_the_terminal_set_is_invariant(mpc):
    states = states_in(mpc, 20_000)
    states = states[in_terminal_set(mpc, states)]
    successors = states @ (mpc.A - mpc.B @ mpc.gain).T
    assert np.all(in_terminal_set(mpc, successors))


def test_no_row_of_the_terminal_set_is_redundant(mpc):
    for i, row in enumerate(mpc.terminal_rows):
        x = cp.Variable(len(row))
        others = np.delete(mpc.terminal_rows, i, axis=0)
        problem = cp.Problem(cp.Maximize(row @ x), [others @ x <= 1, row @ x <= 2])
        assert problem.solve(solver="CLARABEL") > 1 + 1e-6


def test_repeated_rows_are_dropped_but_one_is_kept():
    box = np.vstack([np.eye(2), -np.eye(2)])
    rows = maximal_invariant_set(0.5 * np.eye(2), np.vstack([box, box, box / 3]))
    np.testing.assert_array_equal(np.unique(rows, axis=0), np.unique(box, axis=0))


def test_the_mpc_is_lqr_inside_the_terminal_set(mpc):
    states = states_in(mpc, 2_000)
    states = states[in_terminal_set(mpc, states)][:100]
    assert len(states) > 20
    np.testing.assert_allclose(mpc.batch(states), -states @ mpc.gain.T, atol=1e-6)


def test_the_plan_satisfies_every_constraint(mpc):
    plans = [(x, plan) for x in states_in(mpc, 200) if (plan := mpc.plan(x)) is not None]
    assert len(plans) > 50
    for start, plan in plans:
        assert plan.shape == (mpc.horizon, mpc.B.shape[1])
        assert np.all((mpc.input_lower - 1e-8 <= plan) & (plan <= mpc.input_upper + 1e-8))
        x = start
        for u in plan:
            x = mpc.A @ x + mpc.B @ u
            assert np.all((mpc.state_lower - 1e-7 <= x) & (x <= mpc.state_upper + 1e-7))
        assert np.all(mpc.terminal_rows @ x <= 1 + 1e-7)


def test_an_independent_program_gives_the_same_input(mpc):
    # Wide enough that some of the states are infeasible.
    for x in 1.3 * states_in(mpc, 15, seed=1):
        expected, u = optimal_input(mpc, x), mpc.input(x)
        assert (expected is None) == (u is None)
        if u is not None:
            np.testing.assert_allclose(u, expected, atol=1e-6)


def test_an_infeasible_state_has_no_input_and_a_nan_in_a_batch():
    mpc = LinearMPC(**DOUBLE_INTEGRATOR)
    assert mpc.input([5, 1]) is None
    inputs = mpc.batch([[0, 0], [5, 1], [1, 0]])
    assert np.isnan(inputs[:, 0]).tolist() == [False, True, False]


def test_a_state_outside_the_constraints_is_steered_back_at_once():
    mpc = LinearMPC(**DOUBLE_INTEGRATOR)
    x = np.array([2.0, -1.2])
    u = mpc.input(x)
    assert u is not None
    assert (mpc.A @ x + mpc.B @ u)[1] >= -1 - 1e-8


def test_answers_do_not_depend_on_what_was_asked_before():
    mpc = LinearMPC(**DOUBLE_INTEGRATOR)
    states = states_in(mpc, 20)
    np.testing.assert_array_equal(mpc.batch(states), mpc.batch(states[::-1])[::-1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"A": np.eye(3)}, r"B must have shape \(3, 1\), got shape \(2, 1\)"),
        ({"A": [1, 2]}, "A must be a matrix, got shape"),
        ({"B": [0.5, 1]}, "B must be a matrix, got shape"),
        ({"Q": np.eye(3)}, r"Q must have shape \(2, 2\), got shape \(3, 3\)"),
        ({"Q": -np.eye(2)}, "Q must be symmetric positive semidefinite, got"),
        ({"R": [[0]]}, "R must be symmetric positive definite, got"),
        ({"A": [[1, np.nan], [0, 1]]}, "A must be finite, got"),
        ({"state_upper": [np.inf, 1]}, "state_upper must be finite, got"),
        ({"horizon": 0}, "horizon must be an integer >= 1, got 0"),
        ({"horizon": 2.5}, r"horizon must be an integer >= 1, got 2\.5"),
        ({"input_lower": [0.1]}, "input_lower and input_upper must have the origin"),
        ({"state_lower": [-5, 2]}, "state_lower and state_upper must have the origin"),
    ],
)
def test_bad_input_is_named(change, message):
    with pytest.raises(ValueError, match=message):
        LinearMPC(**DOUBLE_INTEGRATOR | change)


@pytest.mark.parametrize(
    ("x", "message"),
    [([1, 2, 3], r"x must have shape \(2,\), got shape \(3,\)"), ([np.nan, 0], "x must be finite")],
)
def test_a_bad_state_is_named(x, message):
    with pytest.raises(ValueError, match=message):
        LinearMPC(**DOUBLE_INTEGRATOR).input(x)


def test_an_unstable_matrix_has_no_invariant_set():
    with pytest.raises(ValueError, match="A must be stable"):
        maximal_invariant_set(1.1 * np.eye(1), np.array([[1.0], [-1.0]]), most_steps=20)


def test_an_unbounded_set_is_refused():
    with pytest.raises(ValueError, match="rows must bound every direction"):
        maximal_invariant_set(np.array([[0.5, 0.5], [-0.5, 0.5]]), np.eye(2))
