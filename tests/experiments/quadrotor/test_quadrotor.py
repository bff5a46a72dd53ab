"""The quadrotor experiment: its samples are the MPC's, its controller does the task, and provably.

Trajectories here are integrated from the original dynamics in angles, apart from the sampled plant
that the library certifies.
"""

import json
from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.integrate import solve_ivp
from scipy.linalg import solve_discrete_are
from scipy.optimize import minimize

import reachjax as rj
from experiments import imitation, report, stored
from experiments.analysis import Analysis
from experiments.imitation import evaluate
from experiments.quadrotor import controller, figures, simulation, study
from experiments.quadrotor.controller import Draws
from experiments.quadrotor.model import (
    GOAL,
    INITIAL_CENTER,
    INPUT_LIMITS,
    POSITION_LIMITS,
    STEPS,
    goal_set,
    initial_set,
    loop_with,
    plant,
    safe_set,
)
from experiments.quadrotor.mpc import QuadrotorMPC
from experiments.quadrotor.study import Settings, certify, closed_loop, learn, main
from tests.closed_loops import recursion
from tests.oracles.reference_local_bounds import local_bounds_ellipsoid_step

G = 9.81
FEW = Draws(starts=1, steps=3)


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """What the defaults give: the committed samples and network, nothing solved or trained."""

    def refuse(*_):
        raise AssertionError("the committed data was not used")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(imitation, "_train", refuse)
        patch.setattr(QuadrotorMPC, "batch", refuse)
        return learn(Settings(output=tmp_path_factory.mktemp("quadrotor")))


@pytest.fixture(scope="module")
def flights(learned):
    loop = loop_with(learned[1].layers)
    states = simulation.simulate(loop, initial_set(), STEPS, 20_000, 7, progress=False)
    return loop, states


@pytest.fixture(scope="module")
def analysis(flights):
    return certify(*flights, Settings(simulations=1000))


def flown(policy, x, steps):
    """The state after each step of the original dynamics under `policy`."""
    states = [x]
    for _ in range(steps):
        s_theta, s_phi, tau = policy(states[-1])
        theta, phi = np.arctan(s_theta), np.arctan(s_phi)

        def rate(_, x, theta=theta, phi=phi, tau=tau):
            return [*x[3:], G * np.tan(theta), -G * np.tan(phi), tau - G]

        answer = solve_ivp(rate, (0, 0.1), states[-1], rtol=1e-10, atol=1e-12)
        states.append(answer.y[:, -1])
    return np.array(states)


def test_the_sampled_plant_is_the_original_dynamics():
    rng = np.random.default_rng(0)
    for x, u in zip(rng.normal(size=(5, 6)), rng.normal(size=(5, 3)), strict=True):
        following = flown(lambda _, u=u: u, x, 1)[1]
        np.testing.assert_allclose(plant().propagate(x, u), following, atol=1e-9)


def test_the_initial_set_is_the_printed_ellipsoid():
    box = initial_set().bounding_box()
    np.testing.assert_allclose(box.upper - box.lower, [0.1] * 3 + [0.02] * 3)
    np.testing.assert_allclose((box.upper + box.lower) / 2, [4.7, 4.7, 3, 0.95, 0, 0])


def test_the_mpc_itself_meets_the_goal():
    start = initial_set().sample_boundary(jax.random.key(1), 3)
    for x in np.asarray(start):
        states = flown(QuadrotorMPC(), x, STEPS)
        assert np.all((GOAL[0] + 0.1 <= states[-1, :3]) & (states[-1, :3] <= GOAL[1] - 0.1))
        assert np.all(abs(states[:, :3]) <= POSITION_LIMITS[1])


def test_stored_samples_are_what_the_mpc_decides(learned):
    samples, _ = learned
    assert samples.states.shape == (4531, 6)
    chosen = np.random.default_rng(0).choice(4531, 40, replace=False)
    again = QuadrotorMPC().batch(samples.states[chosen])
    np.testing.assert_allclose(samples.inputs[chosen], again, atol=1e-5)


def test_stored_samples_are_drawn_as_documented(learned):
    samples, _ = learned
    documented = np.random.Generator(np.random.PCG64([0, 0]))  # whatever the session's seed is
    drawn = Draws()(QuadrotorMPC(), documented)
    assert len(drawn) == 200
    distances = np.linalg.norm(samples.states[:150, None] - drawn[None], axis=2).min(axis=1)
    np.testing.assert_allclose(distances, 0, atol=1e-5)
    # Half of them are near the tube, where a uniform draw puts one in thousands.
    near = np.all(abs(samples.states[:, 1:3] - [4, 2.5]) < [1.5, 1], axis=1)
    assert np.mean(near & (samples.states[:, 0] > 3.2)) > 0.25


def test_the_network_imitates_on_samples_it_was_not_trained_on(learned):
    samples, fit = learned
    assert [W.shape for W, _ in fit.layers] == [(32, 6), (32, 32), (3, 32)]
    typical, _ = controller.imitation_errors(
        fit.layers, samples.states[4078:], samples.inputs[4078:]
    )
    assert np.all(typical < [0.005, 0.005, 0.05])


def test_every_simulated_flight_does_the_task_with_a_margin(flights):
    loop, states = flights
    assert states.shape == (20_000, STEPS + 1, 6)
    assert np.all(initial_set().contains(states[:, 0], 1e-9))
    # Every other one starts on the boundary.
    assert not np.any(initial_set().contains(states[1::2, 0], -1e-9))
    end = states[:, -1, :3]
    assert np.all((GOAL[0] + 0.1 < end) & (end < GOAL[1] - 0.1))
    assert np.all(abs(states[:, :, :3]) < POSITION_LIMITS[1] - 0.1)
    inputs = simulation.inputs_along(loop, states)
    assert inputs.shape == (20_000 * STEPS, 3)
    assert np.all((INPUT_LIMITS[0] - 1e-12 <= inputs) & (inputs <= INPUT_LIMITS[1] + 1e-12))


def test_the_simulated_loop_is_the_network_on_the_original_dynamics(learned, flights):
    _, fit = learned
    _, states = flights
    for simulated in states[:3]:
        expected = flown(
            lambda x: np.clip(evaluate(fit.layers, x[None])[0], *INPUT_LIMITS), simulated[0], STEPS
        )
        np.testing.assert_allclose(simulated, expected, atol=1e-7)


def test_extremes_tell_a_loop_that_breaks_each_requirement():
    class Loop:
        def input(self, x):
            return x[:3]

    states = np.zeros((2, 3, 6))
    states[1, 1, 1], states[0, 2, :3] = 6, [3.9, 3.6, 2]
    found = {
        (requirement, name): simulation.margin(simulated, allowed)
        for requirement, name, simulated, allowed in simulation.extremes(Loop(), states)
    }
    assert found["goal", "p_y"] == pytest.approx(-2.5)  # the other trajectory ends at 0
    assert found["position limits", "p_y"] == pytest.approx(-1)
    assert found["position limits", "p_z"] == pytest.approx(3)
    assert found["actuator limits", "tan(phi)"] == pytest.approx(np.tan(np.pi / 9) - 6)
    assert found["actuator limits", "tau"] == 0
    states[1, 2, 4] = -1.25
    rows = simulation.extremes(Loop(), states, velocity_limits=True)
    assert "goal" not in {row[0] for row in rows}
    assert simulation.margin(*rows[1][2:]) == pytest.approx(-0.25)


def test_no_simulated_state_is_outside_its_ellipsoid_and_none_is_much_too_large(analysis):
    tube = analysis.tube
    starts = 100_000
    states = simulation.simulate(tube.loop, initial_set(), STEPS, starts, seed=11, progress=False)
    for t, region in enumerate(tube.sets):
        values = np.asarray(region.bounded_values(states[:, t]))
        # starts on the boundary are rounded
        assert values.max() <= (1 + 1e-12 if t == 0 else 1), t
        assert values.max() > 0.97, t
    assert analysis.verdict.status is rj.VerdictStatus.PROVED


@pytest.fixture(scope="module")
def stranger():
    """A loop whose network learned a saturated linear-quadratic regulator by quasi-Newton steps."""
    dynamics = plant()
    A, B = np.asarray(dynamics.A), np.asarray(dynamics.B)
    P = solve_discrete_are(A, B, np.eye(6), 100 * np.eye(3))
    K = np.linalg.solve(100 * np.eye(3) + B.T @ P @ B, B.T @ P @ A)
    hover = np.array([0.0, 0.0, G])
    rng = np.random.default_rng(3)
    states = rng.uniform(-1, 1, (2000, 6)) * [5, 5, 3, 2, 2, 2]
    inputs = jnp.asarray(np.clip(hover - states @ K.T, *INPUT_LIMITS))
    sizes = (6, 12, 12, 3)
    start = [(rng.normal(size=(o, i)) * np.sqrt(2 / i), np.zeros(o)) for i, o in pairwise(sizes)]
    flat, layers_of = ravel_pytree(start)

    @jax.jit
    @jax.value_and_grad
    def loss(weights):
        outputs = jax.vmap(rj.MLP.from_layers(layers_of(weights)))(states)
        return jnp.mean((outputs - inputs) ** 2) + 1e-4 * jnp.mean(weights**2)

    found = minimize(loss, np.asarray(flat), jac=True, method="L-BFGS-B", options={"maxiter": 300})
    net = rj.MLP.from_layers(layers_of(jnp.asarray(found.x)))
    return rj.ClosedLoop(dynamics, net, rj.Box(*INPUT_LIMITS))


def test_no_state_of_a_network_trained_elsewhere_is_outside_its_ellipsoid(stranger):
    tube = recursion(stranger, initial_set(), STEPS, rj.EllipsoidTemplate())
    states = simulation.simulate(stranger, initial_set(), STEPS, 100_000, seed=5, progress=False)
    for t, region in enumerate(tube.sets):
        largest = np.asarray(region.bounded_values(states[:, t])).max()
        assert largest <= (1 + 1e-12 if t == 0 else 1), t
    assert np.ptp(np.asarray(jax.vmap(stranger.input)(states[:, 0])), axis=0).max() > 0.01


def test_volumes_are_those_of_an_independent_program(learned, analysis):
    layers = [
        (np.asarray(W, dtype=float), np.asarray(b, dtype=float)) for W, b in learned[1].layers
    ]
    dynamics = (np.asarray(part) for part in (plant().A, plant().B, plant().c))
    step = partial(local_bounds_ellipsoid_step, layers, *dynamics, *INPUT_LIMITS)
    for before, after in pairwise(analysis.tube.sets):
        found = step(np.asarray(before.center), np.asarray(before.shape))
        assert found.status == "optimal"
        volume = np.pi**3 / 6 * np.sqrt(np.linalg.det(found.shape))
        assert after.volume() == pytest.approx(volume, rel=1e-5)


def test_the_report_agrees_with_the_verdict(analysis):
    margins = {
        (requirement, name): simulation.margin(certified, allowed)
        for requirement, name, certified, allowed in figures.requirements(analysis)
    }
    for requirement, reported in (("goal", "goal"), ("safe", "position limits")):
        smallest = min(value for (name, _), value in margins.items() if name == reported)
        expected = np.nanmin(analysis.verdict.margins[requirement])
        assert smallest == pytest.approx(expected, abs=1e-12)
        assert smallest > 0.1
    for row in figures.steps(analysis):
        certified, simulated = (
            np.array(row[f"{kind}_positions"]) for kind in ("certified", "simulated")
        )
        assert np.all((certified[0] < simulated[0]) & (simulated[1] < certified[1]))


def test_goal_and_safe_set_bound_positions_and_on_request_velocities():
    goal, safe = goal_set(), safe_set(velocity_limits=False)
    slow = safe_set(velocity_limits=True)
    states = np.array([[3.9, 3, 2, 9, 9, 9], [3.9, 3.6, 2, 0, 0, 0], [3.9, 3, 5.1, 0, 0, 0]])
    assert goal.contains(states).tolist() == [True, False, False]
    assert safe.contains(states).tolist() == [True, True, False]
    assert slow.contains(states).tolist() == [False, True, False]


@pytest.mark.long
def test_with_velocity_limits_these_replace_the_goal(flights, tmp_path):
    loop, states = flights
    settings = Settings(velocity_limits=True, simulations=1000, output=tmp_path)
    analysis = certify(loop, states, settings)  # the controller that is made for the goal
    assert analysis.verdict.status is rj.VerdictStatus.REFUTED
    assert {row[0] for row in figures.requirements(analysis)} == {
        "velocity limits",
        "position limits",
    }
    figures.draw(analysis, tmp_path / "tubes.png")
    report.write(tmp_path / "results.json", settings, **figures.results(analysis))
    results = json.loads((tmp_path / "results.json").read_text())
    assert np.abs(np.array(results["counterexample"]["states"])[:, 3:]).max() > 1


def test_the_teacher_with_velocity_limits_has_a_plan_within_them():
    mpc = controller.teacher(velocity_limits=True)
    states = flown(mpc, INITIAL_CENTER, STEPS)
    assert np.all(abs(states[1:, 3:]) <= 0.9 + 1e-6)


def test_files_of_other_settings_make_way_for_the_committed_ones_and_are_kept(tmp_path):
    controller.use_committed(tmp_path)
    ours = tmp_path / "weights.npz"
    committed = ours.read_bytes()
    stored.save(ours, {"seed": -1}, W0=np.ones(1))
    other = ours.read_bytes()
    controller.use_committed(tmp_path)
    assert ours.read_bytes() == other
    controller.use_committed(tmp_path, replacing=True)
    assert ours.read_bytes() == committed
    assert (tmp_path / "weights_of_other_settings.npz").read_bytes() == other


@pytest.mark.parametrize("velocity_limits", [False, True])
def test_new_samples_never_overwrite_the_committed_ones(tmp_path, velocity_limits):
    settings = Settings(output=tmp_path, velocity_limits=velocity_limits)
    anew = Settings(output=tmp_path, velocity_limits=velocity_limits, resample=True)
    assert anew.folder == settings.folder / "resampled"


def test_an_interrupted_resampling_continues(tmp_path, monkeypatch):
    def sample(folder):
        return controller.sample(QuadrotorMPC(), 15, 0, folder, draws=FEW, progress=False)

    whole = sample(tmp_path / "whole")
    draw, drawn = Draws.__call__, []

    def interrupted(self, mpc, rng):
        drawn.append(1)
        if len(drawn) == 2:
            raise KeyboardInterrupt
        return draw(self, mpc, rng)

    monkeypatch.setattr(Draws, "__call__", interrupted)
    with pytest.raises(KeyboardInterrupt):
        sample(tmp_path / "parts")
    resumed = sample(tmp_path / "parts")
    np.testing.assert_array_equal(resumed.states, whole.states)
    np.testing.assert_array_equal(resumed.inputs, whole.inputs)
    drawn.clear()
    sample(tmp_path / "whole")
    assert not drawn


def certify_one_step(loop, states, settings):
    """Quickly, for a controller about which nothing is claimed."""
    tube = recursion(loop, initial_set(), 1, rj.EllipsoidTemplate())
    verdict = rj.verify(tube, goal=goal_set(), samples=100)
    return Analysis("any", settings.relaxation, tube, verdict, states, 0.0)


@pytest.mark.long
def test_the_command_uses_the_committed_data_and_never_changes_it(tmp_path, capsys, monkeypatch):
    def untrained(*_):
        sizes = [6, 32, 32, 3]
        return [(np.zeros((4, o, i)), np.zeros((4, o))) for i, o in pairwise(sizes)]

    monkeypatch.setattr(study, "COMPARED", 1)
    monkeypatch.setattr(imitation, "_train", untrained)
    committed = controller.DATA / "weights.npz"
    before = committed.read_bytes()
    main(Settings(simulations=200, output=tmp_path))
    said = capsys.readouterr().out
    assert "other settings" not in said
    assert (tmp_path / "weights.npz").read_bytes() == before
    for word in ("goal", "position limits", "actuator limits", "held-out samples"):
        assert word in said
    assert "PROVED" in said
    assert "actuator limits: hold by construction" in said
    written = {path.name for path in tmp_path.glob("*.*")}
    assert written == {"samples.npz", "weights.npz", "tubes.png", "results.json"}
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["verdict"] == "PROVED"
    assert [step["step"] for step in results["steps"]] == list(range(1, STEPS + 1))
    assert all(0 < step["simulated"] <= 1 for step in results["steps"])
    assert results["certified_margins"]["goal p_x"] > 0.1
    monkeypatch.setattr(study, "certify", certify_one_step)
    main(Settings(simulations=200, training_steps=1, output=tmp_path))
    assert "other settings (steps)" in " ".join(capsys.readouterr().out.split())
    assert committed.read_bytes() == before
    assert (tmp_path / "weights.npz").read_bytes() != before


def test_the_loop_is_made_from_the_settings(tmp_path, learned):
    loop = closed_loop(Settings(output=tmp_path))
    assert isinstance(loop, rj.ClosedLoop)
    expected = np.clip(evaluate(learned[1].layers, INITIAL_CENTER[None])[0], *INPUT_LIMITS)
    np.testing.assert_allclose(loop.input(INITIAL_CENTER), expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"samples": 1}, "--samples must be finite and at least 2, but 1 arrived"),
        ({"training_steps": 0}, "--training-steps must be finite and at least 1, but 0 arrived"),
        ({"simulations": 0}, "--simulations must be finite and at least 1, but 0 arrived"),
        ({"hidden": (32, 0)}, "--hidden must be finite and at least 1"),
        ({"penalty": -1.0}, "--penalty must be finite and at least 0"),
        ({"seed": -1}, "--seed must be finite and at least 0"),
    ],
)
def test_bad_settings_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        Settings(**change)
