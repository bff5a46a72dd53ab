"""Samples are the policy's own decisions, and both samples and weights are kept and reused."""

from dataclasses import replace

import numpy as np
import pytest

from experiments import imitation
from experiments.imitation import Samples, evaluate, sample_policy, train_network
from experiments.mpc import LinearMPC

MPC = LinearMPC(
    A=np.array([[1.0, 1], [0, 1]]),
    B=np.array([[0.5], [1]]),
    Q=np.eye(2),
    R=np.eye(1),
    horizon=5,
    state_lower=np.array([-5.0, -1]),
    state_upper=np.array([5.0, 1]),
    input_lower=np.array([-1.0]),
    input_upper=np.array([1.0]),
)
QUICK = {"hidden": (4, 3), "steps": 500, "restarts": 2, "progress": False}


def sample(count, seed=0, mpc=MPC, **options):
    return sample_policy(mpc, count, seed, progress=False, **options)


@pytest.fixture
def solved(monkeypatch):
    """Counts the states that the MPC is asked about."""
    counts = []
    batch = LinearMPC.batch

    def counting(self, states, progress=False):
        counts.append(len(states))
        return batch(self, states, progress)

    monkeypatch.setattr(LinearMPC, "batch", counting)
    return counts


@pytest.fixture(scope="module")
def samples():
    return sample(400)


def test_samples_are_feasible_decisions_of_the_mpc(samples):
    assert samples.states.shape == (400, 2)
    assert np.all((MPC.state_lower <= samples.states) & (samples.states <= MPC.state_upper))
    np.testing.assert_array_equal(samples.inputs, MPC.batch(samples.states))
    assert not np.any(np.isnan(samples.inputs))


def test_samples_cover_the_feasible_region_evenly(samples):
    # By rejection: as many in the left half as in the right, of a symmetric region.
    assert abs(np.mean(samples.states[:, 0] > 0) - 0.5) < 0.1


def test_a_seed_gives_the_same_samples_and_another_seed_others(samples):
    np.testing.assert_array_equal(sample(400).states, samples.states)
    assert not np.array_equal(sample(400, seed=1).states, samples.states)


def test_the_box_of_the_samples_can_differ_from_the_constraints():
    tightened = replace(MPC, state_lower=[-5, -0.8], state_upper=[5, 0.8])
    states = sample(200, mpc=tightened, lower=[1, -1], upper=[2, 1]).states
    assert states[:, 0].min() >= 1
    assert states[:, 1].min() < -0.8


def test_an_interrupted_run_loses_nothing(samples, tmp_path, monkeypatch, solved):
    path = tmp_path / "samples.npz"
    count = LinearMPC.batch

    def interrupted(self, states, progress=False):
        if len(solved) == 1:
            raise KeyboardInterrupt
        return count(self, states, progress)

    monkeypatch.setattr(LinearMPC, "batch", interrupted)
    with pytest.raises(KeyboardInterrupt):
        sample(400, path=path)
    monkeypatch.setattr(LinearMPC, "batch", count)
    resumed = sample(400, path=path)
    afterwards = list(solved)
    sample(400)
    assert len(afterwards) == len(solved) - len(afterwards), "a block was solved twice"
    np.testing.assert_array_equal(resumed.states, samples.states)
    np.testing.assert_array_equal(resumed.inputs, samples.inputs)


def test_a_complete_file_is_reused_also_for_fewer_samples(samples, tmp_path, solved):
    path = tmp_path / "new folder" / "samples.npz"
    sample(400, path=path)
    solved.clear()
    np.testing.assert_array_equal(sample(400, path=path).inputs, samples.inputs)
    np.testing.assert_array_equal(sample(100, path=path).inputs, samples.inputs[:100])
    assert not solved


def test_a_file_of_another_mpc_is_replaced_and_it_is_said(tmp_path, capsys):
    path = tmp_path / "samples.npz"
    sample(100, path=path)
    other = replace(MPC, horizon=6)
    fresh = sample(100, mpc=other, path=path)
    assert "other settings (horizon)" in " ".join(capsys.readouterr().out.split())
    np.testing.assert_array_equal(fresh.inputs, sample(100, mpc=other, path=path).inputs)
    assert not capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"lower": [1, 1], "upper": [0, 2]}, "lower <= upper must bound 2 states, got lower"),
        ({"lower": [1]}, "lower <= upper must bound 2 states, got lower"),
        ({"lower": [np.nan, 0]}, "lower <= upper must bound 2 states, got lower"),
        ({"lower": [50, 0], "upper": [51, 1]}, "none was feasible"),
    ],
)
def test_a_bad_box_is_named(options, message):
    with pytest.raises(ValueError, match=message):
        sample(10, **options)


def test_no_samples_is_an_error():
    with pytest.raises(ValueError, match="count must be at least 1, got 0"):
        sample(0)


def test_training_learns_a_function_that_the_network_can_represent():
    states = np.random.default_rng(0).uniform(-1, 1, (300, 2))
    target = np.maximum(states[:, :1] - 0.2, 0) - 0.5 * states[:, 1:]
    fit = train_network(Samples(states, target), (8, 4), steps=4000, penalty=0, progress=False)
    assert fit.training_error < 0.01
    assert fit.validation_error < 0.01


def test_the_layers_are_double_precision_and_the_errors_are_theirs(samples):
    fit = train_network(samples, **QUICK)
    assert [W.shape for W, _ in fit.layers] == [(4, 2), (3, 4), (1, 3)]
    assert all(a.dtype == np.float64 for layer in fit.layers for a in layer)
    errors = (evaluate(fit.layers, samples.states) - samples.inputs)[:, 0]
    # A tenth of the samples, the last, is kept for validation.
    assert fit.training_error == pytest.approx(np.sqrt(np.mean(errors[:360] ** 2)))
    assert fit.validation_error == pytest.approx(np.sqrt(np.mean(errors[360:] ** 2)))


def test_validation_samples_are_not_trained_on(samples):
    inputs = samples.inputs.copy()
    inputs[360:] = 100.0
    spoiled = train_network(Samples(samples.states, inputs), **QUICK | {"restarts": 1})
    honest = train_network(samples, **QUICK | {"restarts": 1})
    np.testing.assert_array_equal(spoiled.layers[0][0], honest.layers[0][0])


def test_a_penalty_makes_the_weights_smaller(samples):
    sizes = []
    for penalty in (0, 1e-2):
        fit = train_network(samples, penalty=penalty, **QUICK)
        sizes.append(sum(np.sum(W**2) for W, _ in fit.layers))
    assert sizes[1] < sizes[0]


def test_training_is_reproducible_and_the_seed_matters(samples):
    one, same, other = (train_network(samples, seed=seed, **QUICK) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one.layers[1][0], same.layers[1][0])
    assert not np.array_equal(one.layers[1][0], other.layers[1][0])


def test_weights_are_reused_until_something_changes(samples, tmp_path, monkeypatch, capsys):
    path = tmp_path / "weights.npz"
    first = train_network(samples, path=path, **QUICK)

    def refuse(*_):
        raise AssertionError("trained again")

    with monkeypatch.context() as patch:
        patch.setattr(imitation, "_train", refuse)
        again = train_network(samples, path=path, **QUICK)
        assert not capsys.readouterr().out
        for change in ({"retrain": True}, {"penalty": 0.1}):
            with pytest.raises(AssertionError, match="trained again"):
                train_network(samples, path=path, **QUICK | change)
        with pytest.raises(AssertionError, match="trained again"):
            train_network(Samples(samples.states, -samples.inputs), path=path, **QUICK)
    said = " ".join(capsys.readouterr().out.split())
    assert "other settings (penalty)" in said
    assert "other settings (samples)" in said
    assert again.validation_error == first.validation_error
    for kept, made in zip(again.layers, first.layers, strict=True):
        np.testing.assert_array_equal(kept[0], made[0])
        np.testing.assert_array_equal(kept[1], made[1])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 0}, "steps must be at least 1, got 0"),
        ({"restarts": 0}, "restarts must be at least 1, got 0"),
        ({"hidden": (10, 0)}, r"hidden\[1\] must be at least 1, got 0"),
        ({"validation": 0.0}, r"validation must leave two sets of 400 samples, got 0\.0"),
        ({"validation": 1.0}, r"validation must leave two sets of 400 samples, got 1\.0"),
    ],
)
def test_bad_training_options_are_named(samples, options, message):
    with pytest.raises(ValueError, match=message):
        train_network(samples, **QUICK | options)
