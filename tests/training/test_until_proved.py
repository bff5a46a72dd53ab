"""Training until a controller is proved: what it trains on, when it ends, and that it goes on."""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import linen, nnx

import reachjax as rj
from reachjax.loops.units import UnboundedError
from reachjax.training import until_proved
from reachjax.training.worst_cells import worst_cells
from reachjax.verdicts.specification import requirements

PLANT = rj.AffinePlant([[1.0]], [[1.0]])
X0, GOAL = rj.Box([1.0], [2.0]), rj.Box([-0.6], [0.6])
LAYERS = [([[1.0], [-1.0]], [0.0, 0.0]), ([[0.0, 0.1]], [0.0])]
TRACED = []


def task(loop, states):
    TRACED.append(1)
    return 0.01 * jnp.mean(loop.simulate(states, 2) ** 2)


def loop_of(controller=None):
    return rj.ClosedLoop(PLANT, controller or rj.MLP.from_layers(LAYERS))


trained = partial(rj.train, horizon=2, task_loss=task, goal=GOAL, margin=0.02, steps=25, epochs=20)


def leaves(loop):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(loop.controller)]


def test_a_refuted_controller_is_trained_until_it_is_proved():
    loop = loop_of()
    assert rj.decide(loop, X0, 2, goal=GOAL).refuted
    found = trained(loop, X0, optimizer=optax.adam(2e-2))
    assert found.proved
    assert rj.decide(found.loop, X0, 2, goal=GOAL).proved
    statuses = [epoch.status for epoch in found.history.epochs]
    took = statuses.index("PROVED") + 1
    assert set(statuses[took:]) <= {"PROVED"}  # what is proved once stays so
    assert len(statuses) <= 2 * took
    assert leaves(loop)[2].tolist() == LAYERS[1][0]  # what was given is as it was


def gained(w):
    """The loop that multiplies its state by `1 + w`, and how far that is from where it was."""

    def change(loop, states):
        return jnp.mean((jax.vmap(loop.controller)(states) - w * states) ** 2)

    gain = jax.tree_util.Partial(lambda w, x: w * x, jnp.array([w]))
    return loop_of(rj.Network(gain, 1, 1)), change


@pytest.mark.parametrize("seed", range(3))
def test_what_is_proved_is_changed_no_more_than_it_takes(seed):
    """Steps are so long that the first proof is far from the nearest one."""
    rng = np.random.default_rng(seed)
    w, slowest = rng.uniform(-0.3, 0.1), np.sqrt(0.3) - 1  # 2 (1 + w)^2 <= 0.6
    loop, change = gained(w)
    assert rj.decide(loop, X0, 2, goal=GOAL).refuted
    once = {"goal": GOAL, "margin": 0.1, "steps": 3, "weight": 20.0, "optimizer": optax.adam(0.2)}
    found = rj.train(loop, X0, 2, change, **once)
    assert found.proved
    assert rj.decide(found.loop, X0, 2, goal=GOAL).proved
    assert slowest - 0.03 * abs(w - slowest) <= leaves(found.loop)[0][0] <= slowest


def test_a_proved_controller_is_left_as_it_is():
    loop = loop_of(rj.MLP.from_layers([([[-0.6]], [0.0])]))
    found = trained(loop, X0)
    assert (found.proved, len(found.history)) == (True, 0)
    assert leaves(found.loop)[0].tolist() == [[-0.6]]


def test_what_cannot_be_is_not_proved():
    safe = rj.Box([-1.0], [1.5])  # where it begins outside
    found = rj.train(loop_of(), X0, 2, task, safe=safe, steps=3, epochs=2)
    assert found.verdict.refuted
    assert len(found.history) == 2


class Nnx(nnx.Module):
    def __init__(self):
        self.layer = nnx.Linear(1, 1, rngs=nnx.Rngs(0), param_dtype=float)

    def __call__(self, x):
        return 0.1 * self.layer(x)


def of_linen():
    dense = linen.Dense(1, param_dtype=float)
    params = dense.init(jax.random.key(0), jnp.zeros(1))
    return jax.tree_util.Partial(dense.apply, params)


CONTROLLERS = {
    "nnx": Nnx,
    "linen": of_linen,
    "equinox": lambda: eqx.nn.Linear(1, 1, key=jax.random.key(1)),
    "a function of arrays": lambda: jax.tree_util.Partial(lambda w, x: w * x, jnp.array([0.1])),
}


@pytest.mark.parametrize("kind", CONTROLLERS)
def test_any_tree_of_arrays_is_trained(kind):
    loop = loop_of(rj.Network(CONTROLLERS[kind](), 1, 1))
    found = rj.train(
        loop, X0, 2, task, goal=GOAL, margin=0.02, steps=40, optimizer=optax.adam(3e-2)
    )
    assert found.proved
    assert rj.decide(found.loop, X0, 2, goal=GOAL).proved


def test_a_training_goes_on_from_its_file_after_a_proof(tmp_path):
    loop, change = gained(-0.1)
    given = {"goal": GOAL, "margin": 0.1, "steps": 2, "optimizer": optax.adam(0.05)}
    whole = rj.train(loop, X0, 2, change, **given)
    took = [epoch.status for epoch in whole.history.epochs].index("PROVED") + 1
    assert took < len(whole.history)
    path = tmp_path / "gain.training"
    first, second, third = (
        rj.train(loop, X0, 2, change, **given, path=path, epochs=count) for count in (took, 99, 99)
    )
    assert len(first.history) == took
    assert len(second.history) == len(third.history) == len(whole.history)
    for run in (second, third):
        np.testing.assert_array_equal(leaves(run.loop)[0], leaves(whole.loop)[0])
    assert {epoch.status for epoch in whole.history.epochs[took - 1 :]} == {"PROVED"}
    states = X0.sample(jax.random.key(1), 64)
    assert change(whole.loop, states) <= change(first.loop, states)


OPTIMIZERS = {
    "of half precision": lambda: optax.adam(0.05, mu_dtype=jnp.float32),
    "with keys": lambda: optax.chain(optax.add_noise(1e-3, 0.5, jax.random.key(0)), optax.sgd(0.1)),
}


@pytest.mark.parametrize("kind", OPTIMIZERS)
def test_states_of_any_optimizer_are_kept(kind, tmp_path):
    loop, change = gained(-0.1)
    given = {"goal": GOAL, "margin": 0.1, "steps": 2, "optimizer": OPTIMIZERS[kind](), "gain": 0.0}
    whole = rj.train(loop, X0, 2, change, **given, epochs=4)
    for count in (2, 4):
        kept = rj.train(loop, X0, 2, change, **given, epochs=count, path=tmp_path / "any.training")
    np.testing.assert_array_equal(leaves(kept.loop)[0], leaves(whole.loop)[0])
    other = {**given, "optimizer": optax.rmsprop(0.1)}
    with pytest.raises(ValueError, match="by an optimizer of this kind"):
        rj.train(loop, X0, 2, change, **other, path=tmp_path / "any.training")


def test_a_proof_is_in_the_file_before_it_is_led_back(tmp_path, monkeypatch):
    """A process that ends while a proved controller is led back loses nothing."""
    loop, change = gained(-0.1)
    path, asked = tmp_path / "gain.training", until_proved.decide
    given = {"goal": GOAL, "margin": 0.1, "optimizer": optax.adam(0.05), "path": path}
    proofs = []

    def ended(*each, **options):
        if proofs:
            raise MemoryError
        verdict = asked(*each, **options)
        proofs.extend([verdict] * verdict.proved)
        return verdict

    monkeypatch.setattr(until_proved, "decide", ended)
    with pytest.raises(MemoryError):
        rj.train(loop, X0, 2, change, **given)
    monkeypatch.setattr(until_proved, "decide", asked)
    assert rj.train(loop, X0, 2, change, **given, epochs=1).proved


def test_a_file_that_cannot_be_written_does_not_end_a_training(tmp_path, monkeypatch):
    def full(*_):
        raise OSError("no space left")

    monkeypatch.setattr(until_proved, "write_kept", full)
    loop, change = gained(-0.1)
    given = {"goal": GOAL, "margin": 0.1, "optimizer": optax.adam(0.05)}
    with pytest.warns(UserWarning, match="was not written, training goes on: no space left"):
        found = rj.train(loop, X0, 2, change, **given, path=tmp_path / "gain.training")
    assert found.proved


def test_without_a_limit_a_decision_has_the_time_that_it_needs(monkeypatch):
    """Where the objective is zero; here no decision ends within a limit."""
    asked = until_proved.decide

    def endless(*each, time_limit=None, **options):
        verdict = asked(*each, **options)
        unknown = dataclasses.replace(verdict, status=rj.VerdictStatus.UNKNOWN)
        return verdict if time_limit is None else unknown

    monkeypatch.setattr(until_proved, "decide", endless)
    learning = {"optimizer": optax.adam(2e-2), "gain": 1.0}
    assert trained(loop_of(), X0, **learning).proved
    assert not trained(loop_of(), X0, **learning, time_limit=5.0).proved


def test_what_a_file_says_is_proved_is_not_trained_away(tmp_path, monkeypatch):
    """Where there is no time to prove it anew, the controller and its file stay."""
    loop, change = gained(-0.1)
    path = tmp_path / "gain.training"
    given = {"goal": GOAL, "margin": 0.1, "optimizer": optax.adam(0.05), "path": path}
    first = rj.train(loop, X0, 2, change, **given, epochs=3)
    assert first.proved
    longer = tmp_path / "longer.training"
    ended = rj.train(loop, X0, 2, change, **given | {"path": longer}, gain=1.0)
    more = rj.train(loop, X0, 2, change, **given | {"path": longer}, gain=1e-6)
    assert len(more.history) > len(ended.history)  # the gain is that of the call
    kept = path.read_bytes()
    blank = dataclasses.replace(first.verdict, status=rj.VerdictStatus.UNKNOWN)
    asked = []

    def late(*_, time_limit=None, **__):
        asked.append(time_limit)
        return blank

    monkeypatch.setattr(until_proved, "decide", late)
    second = rj.train(loop, X0, 2, change, **given, epochs=9)
    assert (asked, second.proved, len(second.history)) == ([None], False, len(first.history))
    np.testing.assert_array_equal(leaves(second.loop)[0], leaves(first.loop)[0])
    assert path.read_bytes() == kept


def test_an_interrupted_first_decision_returns_the_controller_as_it_was_given(monkeypatch):
    loop = loop_of()
    verdict = rj.decide(loop, X0, 2, goal=GOAL)

    def interrupted(*_, **__):
        raise rj.Interrupted("interrupted", verdict)

    monkeypatch.setattr(until_proved, "decide", interrupted)
    with pytest.raises(rj.Interrupted) as raised:
        trained(loop, X0)
    assert raised.value.found.verdict is verdict
    assert raised.value.found.loop.controller is not None
    assert len(raised.value.found.history) == 0


def test_a_controller_whose_bounds_leave_a_domain_is_trained_all_the_same():
    def divided(x, u):  # its denominator is one half, which bounds over one cell do not see
        y = x + u
        return 0.5 * y / (jnp.sin(4 * y) ** 2 + jnp.cos(4 * y) ** 2 - 0.5)

    loop = loop_of(rj.MLP.from_layers([([[0.0]], [0.0])])).replace(
        plant=rj.NonlinearPlant(divided, 1, 1)
    )
    asked = {"goal": rj.Box([-3.0], [3.0]), "cells": 1}
    with pytest.raises(UnboundedError):
        rj.decide(loop, X0, 2, **asked)
    learning = {"steps": 25, "optimizer": optax.adam(2e-2), "stages": [rj.Stage(rj.Simulated())]}
    with pytest.warns(UserWarning, match="nothing is known of the controller as given: .*bounds"):
        found = rj.train(loop, X0, 2, task, **asked, **learning)
    assert found.history.epochs[0].margin == -np.inf
    assert found.proved


def test_requirements_of_the_initial_set_alone_are_not_trained_for():
    """That the set touches what is safe is no loss: no controller changes it."""
    safe = rj.Box([-2.0], [2.0])
    learning = {"margin": 0.02, "steps": 25, "epochs": 20, "optimizer": optax.adam(2e-2)}
    found = rj.train(loop_of(), X0, 2, task, goal=GOAL, safe=safe, **learning)
    assert found.proved
    assert found.history.epochs[-1].penalty == 0


@pytest.mark.parametrize("gain", [0.0, 1.0])
def test_training_ends_with_the_first_proof_or_goes_on_to_the_end(gain):
    loop, change = gained(-0.3)
    once = {"goal": GOAL, "margin": 0.05, "steps": 2, "optimizer": optax.adam(0.05)}
    found = rj.train(loop, X0, 2, change, **once, gain=gain, epochs=9)
    took = [epoch.status for epoch in found.history.epochs].index("PROVED") + 1
    assert len(found.history) == (took if gain else 9)


def test_what_is_proved_as_it_was_given_is_trained_where_that_is_asked():
    loop, change = gained(-0.3)
    given = loop.replace(controller=gained(-0.6)[0].controller)
    learning = {"goal": GOAL, "steps": 5, "optimizer": optax.adam(0.01), "epochs": 5, "gain": 0.0}
    found = rj.train(given, X0, 2, change, **learning)
    assert (found.proved, len(found.history)) == (True, 5)
    assert leaves(found.loop)[0] > -0.6  # nearer to what the loss is least of


def test_a_training_goes_on_from_its_file(tmp_path):
    slow = {"optimizer": optax.adam(1e-3), "stages": (rj.Stage(rj.Certified(), cells=2),)}
    whole = trained(loop_of(), X0, **slow | {"epochs": 4})
    path = tmp_path / "pendulum.training"
    first = trained(loop_of(), X0, **slow | {"epochs": 2, "path": path})
    second = trained(loop_of(), X0, **slow | {"epochs": 4, "path": path})
    assert [len(run.history) for run in (whole, first, second)] == [4, 2, 4]
    assert not first.proved
    for one, other in zip(leaves(whole.loop), leaves(second.loop), strict=True):
        np.testing.assert_array_equal(one, other)
    assert second.history.epochs[:2] == first.history.epochs
    twice = {"path": path, "goal": {1: rj.Box([-9.0], [9.0]), 2: GOAL}}
    for X, more in ((rj.Box([1.0], [2.5]), {"path": path}), (X0, twice)):
        with pytest.raises(ValueError, match="path must be that of a training of this loop"):
            trained(loop_of(), X, **slow | more)


def test_steps_are_compiled_once_for_all_initial_sets_and_weights():
    same = {"optimizer": optax.sgd(1e-9), "stages": (rj.Stage(rj.Simulated()),), "epochs": 2}
    trained(loop_of(), X0, **same)
    TRACED.clear()
    trained(loop_of(rj.MLP.from_layers([(2 * np.array(W), b) for W, b in LAYERS])), X0, **same)
    trained(loop_of(), rj.Box([1.1], [2.0]), **same)
    assert TRACED == []


@pytest.mark.parametrize("seed", range(3))
def test_cells_to_train_on_are_those_of_which_least_is_proved(seed):
    rng, box = np.random.default_rng(seed), rj.Box([0.0, -1.0, 2.0], [1.0, 1.0, 2.0])
    lower, upper = worst_cells(box, (), 32, 32, rng)
    assert np.prod((upper - lower)[:, :2], axis=1).sum() == pytest.approx(2.0)
    statuses = rng.choice([*rj.VerdictStatus], len(lower))
    parts = zip(lower, upper, statuses, rng.normal(size=len(lower)), strict=True)
    known = [rj.DecidedCell(*each) for each in parts]
    lower, upper = worst_cells(box, known, 32, 32, rng)
    middles = (lower + upper) / 2
    rank = []
    for middle in middles:
        of = [c for c in known if ((c.lower <= middle) & (middle <= c.upper)).all()]
        rank.append(
            (min(c.status is rj.VerdictStatus.PROVED for c in of), min(c.margin for c in of))
        )
    assert rank[:24] == sorted(rank[:24])
    assert np.prod((upper - lower)[:, :2], axis=1).sum() <= 2.0 + 1e-9


A, B = np.array([[0.0, 1.0], [1.0, -0.5]]), np.array([[0.0], [1.0]])
PLANTS = {
    "discrete": lambda: rj.AffinePlant(np.eye(2) + 0.1 * A, 0.1 * B),
    "linear flow": lambda: rj.SampledPlant.affine(A, B, period=0.1),
    "flow": lambda: rj.SampledPlant(
        lambda x, u: jnp.array([x[1], jnp.sin(x[0]) - 0.5 * x[1] + u[0]]), 2, 1, 0.1
    ),
}


@pytest.mark.costly
@pytest.mark.parametrize("kind", PLANTS)
def test_forms_over_a_cell_miss_what_trajectories_from_it_miss(kind):
    """Of sets to be in and to be out of, at all times; the remainder is their difference."""
    rng, plant = np.random.default_rng(0), PLANTS[kind]()
    net = rj.MLP.from_layers(
        [(rng.normal(size=(3, 2)), rng.normal(size=3)), (rng.normal(size=(1, 3)), [0.0])],
        rj.Tanh(),
    )
    loop, steps = rj.ClosedLoop(plant, net), 3
    safe, wall = rj.Box([-0.1, -0.1], [0.1, 0.1]), rj.Box([0.2, -1.0], [0.5, 1.0])
    period = 0.1 if plant.continuous else None
    required = tuple(requirements(2, steps, period, safe=safe, avoid=[wall]))

    @jax.jit
    def both(lower, upper, states):
        batch = rj.TrainingBatch(loop, lower, upper, states, steps, 0, required, 0.3)
        objectives = rj.Certified(), rj.Certified(remainder=1.0), rj.Simulated()
        return [objective(batch) for objective in objectives]

    slopes = jax.jit(jax.grad(lambda *given: both(*given)[0]))
    for _ in range(5):
        lower = rng.uniform(-0.5, 0.5, size=(1, 2))
        upper = lower + rng.uniform(0.0, 0.2, size=(1, 2))
        states = lower + rng.uniform(size=(50, 2)) * (upper - lower)
        certified, wider, simulated = map(float, both(lower, upper, states))
        assert 0 < simulated <= certified * (1 + 1e-9)
        assert certified <= wider
        assert np.isfinite(slopes(lower, upper, states)).all()
    point = rng.uniform(-0.5, 0.5, size=(1, 2))
    certified, wider, simulated = map(float, both(point, point, point.repeat(50, axis=0)))
    assert certified == pytest.approx(wider, rel=1e-4)
    assert certified == pytest.approx(simulated, rel=0.1)


def test_a_history_is_told_and_drawn():
    found = trained(loop_of(), X0, optimizer=optax.adam(2e-2))
    assert str(found.history).count("\n") == min(len(found.history), 12)
    ax = found.history.plot()
    assert [line.get_label() for line in ax.lines][:3] == ["task", "penalty", "cells not proved"]


@pytest.mark.parametrize(
    ("wrong", "error", "match"),
    [
        ({"task_loss": 3.0}, TypeError, "task_loss must be a function"),
        ({"task_loss": lambda loop: 0.0}, TypeError, r"one of \(loop\) arrived.* too many"),
        ({"task_loss": lambda loop, states: states}, ValueError, "task_loss must give one number"),
        ({"stages": (rj.Certified(),)}, TypeError, "stages must be a sequence of type Stage"),
        (
            {"stages": rj.Stage(rj.Certified())},
            TypeError,
            "stages must be a sequence of type Stage",
        ),
        ({"optimizer": {}}, TypeError, "optimizer must be an optax optimiser"),
        ({"X0": rj.Polytope([[1.0], [-1.0]], [2.0, -1.0])}, TypeError, "X0 must be a Box"),
        ({"margin": -1.0}, ValueError, "margin must be finite and at least 0"),
        ({"steps": 0}, ValueError, "steps must be at least 1"),
        ({"loop": loop_of(rj.Network(lambda x: x, 1, 1))}, ValueError, "no floating-point arrays"),
    ],
)
def test_a_wrong_argument_is_named(wrong, error, match):
    given = {"loop": loop_of(), "X0": X0} | wrong
    with pytest.raises(error, match=match):
        trained(given.pop("loop"), given.pop("X0"), **given)
    with pytest.raises(TypeError, match=r"Stage.objective must be a function"):
        rj.Stage(3.0)
