"""The quadrotor's MPC does what its program says, judged by programs and simulations of others.

In the coordinates `(tan(theta), tan(phi), tau)` the feasible plans are a polytope and the cost is
convex. So a linear program decides feasibility, and another certifies that a plan is optimal: no
feasible plan lies in a direction of descent.
"""

import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import linprog, minimize

from experiments.quadrotor import mpc as quadrotor_mpc
from experiments.quadrotor.model import INITIAL_CENTER, INITIAL_RADII
from experiments.quadrotor.mpc import STEEPEST, QuadrotorMPC

G = 9.81
HOVER = np.array([0, 0, G])
# Nothing special: weights that are not the identity, limits that bind within a short horizon.
SHORT = QuadrotorMPC(
    horizon=8,
    period=0.2,
    Q=np.diag([1, 2, 0.5, 0.1, 1, 0.3]) + 0.1,
    R=np.diag([3, 1, 0.2]) + 0.05,
    angle_limit=0.3,
    thrust_limit=11,
    position_limit=0.8,
    velocity_limit=0.9,
)
MPCS = {"paper": QuadrotorMPC(), "short": SHORT, "slow": QuadrotorMPC(velocity_limit=1)}
SPREAD = {"paper": [5, 5, 5, 3, 3, 3], "short": [0.8] * 6, "slow": [2.5, 2.5, 2.5, 1, 1, 1]}


@pytest.fixture(params=MPCS)
def mpc(request):
    return MPCS[request.param]


def states_for(mpc, count, seed=0):
    name = next(name for name, other in MPCS.items() if other is mpc)
    spread = np.array(SPREAD[name])
    return np.random.default_rng(seed).uniform(-spread, spread, (count, 6))


def flown(mpc, x, plan):
    """States `x_0 .. x_N` of the original dynamics in angles, integrated adaptively."""
    states = [x]
    for s_theta, s_phi, tau in plan:
        theta, phi = np.arctan(s_theta), np.arctan(s_phi)
        push = [G * np.tan(theta), -G * np.tan(phi), tau - G]
        answer = solve_ivp(
            lambda _, x, push=push: np.concatenate([x[3:], push]),
            (0, mpc.period),
            states[-1],
            rtol=1e-10,
            atol=1e-12,
        )
        states.append(answer.y[:, -1])
    return np.array(states)


def condensed(mpc, x):
    """`free, map_`: the states `x_1 .. x_N` are `free + map_ @ plan`, from Newton's law by hand."""
    N, h = mpc.horizon, mpc.period
    gains = np.diag([G, -G, 1])
    free, map_ = np.zeros((N, 6)), np.zeros((N, 6, N, 3))
    for k in range(1, N + 1):
        t = k * h
        fall = np.array([0, 0, -G])
        free[k - 1] = np.concatenate([x[:3] + t * x[3:] + t**2 / 2 * fall, x[3:] + t * fall])
        for j in range(k):
            after = t - (j + 0.5) * h  # a push in the middle of its period moves as far
            map_[k - 1, :, j] = np.vstack([h * after * gains, h * gains])
    return free.ravel(), map_.reshape(6 * N, 3 * N)


def polytope(mpc, x):
    """Feasible plans as arguments of `linprog`."""
    free, map_ = condensed(mpc, x)
    highest = np.repeat([mpc.position_limit, mpc.velocity_limit], 3)
    limit = np.tile(highest, mpc.horizon - 1)
    rows, offset = map_[:-6], free[:-6]
    bounded = np.isfinite(limit)
    upper = np.concatenate([(limit - offset)[bounded], (limit + offset)[bounded]])
    steepest = np.tan(mpc.angle_limit)
    bounds = [(-steepest, steepest), (-steepest, steepest), (0, mpc.thrust_limit)] * mpc.horizon
    return {
        "A_ub": np.vstack([rows[bounded], -rows[bounded]]),
        "b_ub": upper,
        "A_eq": map_[-6:],
        "b_eq": -free[-6:],
        "bounds": bounds,
    }


def cost_and_gradient(mpc, x, plan):
    free, map_ = condensed(mpc, x)
    states = (free + map_ @ plan.ravel()).reshape(-1, 6)[:-1]
    angled = np.hstack([np.arctan(plan[:, :2]), plan[:, 2:]]) - HOVER
    slope = np.hstack([1 / (1 + plan[:, :2] ** 2), np.ones((len(plan), 1))])
    cost = x @ mpc.Q @ x + np.sum((states @ mpc.Q) * states) + np.sum((angled @ mpc.R) * angled)
    gradient = 2 * map_[:-6].T @ (states @ mpc.Q).ravel() + (2 * (angled @ mpc.R) * slope).ravel()
    return cost, gradient


def solved(mpc, count, least):
    """States with their plans, of `count` drawn at least `least`."""
    pairs = [(x, plan) for x in states_for(mpc, count) if (plan := mpc.plan(x)) is not None]
    assert len(pairs) >= least
    return pairs


def test_a_plan_flown_with_the_original_dynamics_ends_at_rest_within_all_limits(mpc):
    for start, plan in solved(mpc, 8, 3):
        assert plan.shape == (mpc.horizon, 3)
        assert np.all(abs(np.arctan(plan[:, :2])) <= mpc.angle_limit + 1e-12)
        assert np.all((plan[:, 2] >= 0) & (plan[:, 2] <= mpc.thrust_limit + 1e-12))
        states = flown(mpc, start, plan)
        np.testing.assert_allclose(states[-1], 0, atol=1e-6)
        assert np.all(abs(states[1:, :3]) <= mpc.position_limit + 1e-6)
        assert np.all(abs(states[1:, 3:]) <= mpc.velocity_limit + 1e-6)


def test_no_feasible_plan_lies_in_a_direction_of_descent(mpc):
    for start, plan in solved(mpc, 15, 4):
        _, gradient = cost_and_gradient(mpc, start, plan)
        best = linprog(gradient, **polytope(mpc, start), method="highs")
        assert best.success
        # The polytope is some 10 wide: a plan that is worse by more would show.
        assert gradient @ plan.ravel() <= best.fun + 1e-5 * np.linalg.norm(gradient)


def test_the_gradient_of_the_certificate_is_that_of_the_cost(mpc):
    rng = np.random.default_rng(0)
    x, plan = rng.normal(size=6), 0.2 * rng.normal(size=(mpc.horizon, 3)) + HOVER
    direction = rng.normal(size=plan.shape)
    up, down = (cost_and_gradient(mpc, x, plan + s * 1e-5 * direction)[0] for s in (1, -1))
    _, gradient = cost_and_gradient(mpc, x, plan)
    assert (up - down) / 2e-5 == pytest.approx(gradient @ direction.ravel(), rel=1e-6)


def test_thrust_stops_at_zero_where_more_would_help():
    x, mpc = np.array([0, 0, 3, 0, 0, 6.0]), MPCS["paper"]
    plan = mpc.plan(x)
    assert plan is not None
    assert plan[0, 2] == pytest.approx(0, abs=1e-6)
    _, gradient = cost_and_gradient(mpc, x, plan)
    best = linprog(gradient, **polytope(mpc, x), method="highs")
    assert gradient @ plan.ravel() <= best.fun + 1e-5 * np.linalg.norm(gradient)


def test_another_optimiser_over_condensed_plans_gives_the_same_input():
    for x in 0.8 * states_for(SHORT, 4, seed=5):
        plan, rules = SHORT.plan(x), polytope(SHORT, x)
        assert plan is not None
        answer = minimize(
            lambda u, x=x: cost_and_gradient(SHORT, x, u.reshape(-1, 3)),
            np.tile(HOVER, SHORT.horizon),
            jac=True,
            bounds=rules["bounds"],
            constraints=[
                {"type": "eq", "fun": lambda u, r=rules: r["A_eq"] @ u - r["b_eq"]},
                {"type": "ineq", "fun": lambda u, r=rules: r["b_ub"] - r["A_ub"] @ u},
            ],
            method="SLSQP",
            options={"ftol": 1e-13, "maxiter": 500},
        )
        assert answer.success
        np.testing.assert_allclose(plan[0], answer.x[:3], atol=1e-4)


def test_an_input_is_missing_exactly_where_a_linear_program_has_no_plan(mpc):
    states = states_for(mpc, 25, seed=1) * 1.2
    inputs = mpc.batch(states)
    missing = np.isnan(inputs).any(axis=1)
    expected = [not linprog(np.zeros(3 * mpc.horizon), **polytope(mpc, x)).success for x in states]
    assert missing.tolist() == expected
    assert 0 < missing.sum() < len(states)
    x = states[missing][0]
    assert mpc.plan(x) is None
    assert np.all(np.isnan(mpc(x)))


def test_giving_up_is_not_taken_for_infeasible(mpc, monkeypatch):
    monkeypatch.setattr(quadrotor_mpc, "MOST_ITERATIONS", 1)
    hasty = replace(mpc)
    states = states_for(mpc, 12, seed=1) * 1.2
    for x, u in zip(states, mpc.batch(states), strict=True):
        if np.isnan(u[0]):
            assert hasty.plan(x) is None
        else:
            with pytest.raises(RuntimeError, match="has a plan, but IPOPT ended with Maximum"):
                hasty.plan(x)


def test_an_interruption_inside_ipopt_is_one(mpc, monkeypatch):
    class Swallowing:
        def __call__(self, **_):
            return {}

        def stats(self):
            return {"return_status": "NonIpopt_Exception_Thrown"}

    interrupted = replace(mpc)
    monkeypatch.setitem(vars(interrupted), "_program", (Swallowing(), {}))
    with pytest.raises(KeyboardInterrupt):
        interrupted.plan(np.zeros(6))


def test_the_program_is_convex_up_to_the_steepest_angle_and_not_much_beyond():
    s = np.linspace(0, np.tan(STEEPEST), 1001)
    assert np.all(np.diff(np.arctan(s) ** 2, 2) > 0)
    beyond = np.linspace(0, np.tan(STEEPEST + 0.02), 1001)
    assert not np.all(np.diff(np.arctan(beyond) ** 2, 2) > 0)


def test_the_optimum_hovers_at_the_origin_and_does_not_fall_first():
    mpc = MPCS["paper"]
    np.testing.assert_allclose(mpc(np.zeros(6)), HOVER, atol=1e-6)
    assert mpc(np.array([0, 0, 0.5, 0, 0, 0]))[2] < G < mpc(np.array([0, 0, -0.5, 0, 0, 0]))[2]
    assert mpc(INITIAL_CENTER)[2] > 0.6 * G


def test_with_the_printed_velocity_limits_there_is_no_plan_from_the_initial_set():
    # 4.65 m in 3 s at 1 m/s: the horizon is too short, whatever the controller does.
    corner = INITIAL_CENTER - INITIAL_RADII
    assert np.all(np.isnan(QuadrotorMPC(velocity_limit=1)(corner)))
    assert not np.any(np.isnan(QuadrotorMPC()(corner)))


def test_answers_do_not_depend_on_what_was_asked_before():
    states = states_for(SHORT, 8)
    np.testing.assert_array_equal(SHORT.batch(states), SHORT.batch(states[::-1])[::-1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"horizon": 1}, "horizon must be an integer >= 2"),
        ({"horizon": 2.5}, r"horizon must be an integer >= 2 .* got 2\.5"),
        ({"period": 0}, "period must be above 0, got 0"),
        ({"period": np.inf}, "period must be finite"),
        ({"Q": np.eye(4)}, r"Q must have shape \(6, 6\), got shape \(4, 4\)"),
        ({"Q": -np.eye(6)}, "Q must be symmetric positive semidefinite"),
        ({"R": np.eye(4)}, r"R must have shape \(3, 3\), got shape \(4, 4\)"),
        ({"R": np.zeros((3, 3))}, "R must be symmetric positive definite"),
        ({"angle_limit": 0.7}, r"angle_limit must be in \(0, 0\.65\] rad"),
        ({"angle_limit": 0}, r"angle_limit must be in \(0, 0\.65\] rad"),
        ({"thrust_limit": 9}, "thrust_limit must be above 9.81"),
        ({"position_limit": -1}, "position_limit must be above 0"),
        ({"velocity_limit": np.nan}, "velocity_limit must be above 0"),
    ],
)
def test_bad_arguments_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        QuadrotorMPC(**change)


@pytest.mark.parametrize(
    ("x", "message"),
    [([1, 2], r"x must have shape \(6,\), got"), ([np.nan] * 6, "x must be finite")],
)
def test_a_bad_state_is_named(x, message):
    with pytest.raises(ValueError, match=message):
        SHORT(x)


def test_without_casadi_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "casadi", None)
    mpc = QuadrotorMPC(horizon=3)
    with pytest.raises(ImportError, match=r"reachjax\[experiments\]"):
        mpc(np.zeros(6))
