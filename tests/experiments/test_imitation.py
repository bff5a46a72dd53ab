"""Networks learn what they are shown, and their weights are kept and reused."""

import numpy as np
import pytest

from experiments import imitation
from experiments.imitation import evaluate, train_network
from experiments.sampling import Samples, sample_policy
from tests.experiments.test_sampling import MPC

QUICK = {"hidden": (4, 3), "steps": 500, "restarts": 2, "progress": False}


@pytest.fixture(scope="module")
def samples():
    return sample_policy(MPC, 400, 0, progress=False)


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


def test_standardised_training_does_not_depend_on_units(samples):
    options = QUICK | {"standardise": True, "steps": 200}
    fit = train_network(samples, **options)
    x_scale, x_shift, u_scale, u_shift = np.array([100, 0.01]), np.array([5, -3]), 20, 9.81
    other = Samples(samples.states * x_scale + x_shift, samples.inputs * u_scale + u_shift)
    expected = evaluate(fit.layers, samples.states) * u_scale + u_shift
    found = evaluate(train_network(other, **options).layers, other.states)
    np.testing.assert_allclose(found, expected, atol=0.02)  # single precision, 200 steps
    assert not np.allclose(
        evaluate(train_network(other, **options | {"standardise": False}).layers, other.states),
        expected,
        atol=0.1,
    )


def test_a_constant_coordinate_can_be_standardised(samples):
    states = np.hstack([samples.states, np.full((400, 1), 7.0)])
    fit = train_network(Samples(states, samples.inputs), standardise=True, **QUICK)
    assert np.isfinite(fit.validation_error)


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
        for change in ({"retrain": True}, {"penalty": 0.1}, {"standardise": True}):
            with pytest.raises(AssertionError, match="trained again"):
                train_network(samples, path=path, **QUICK | change)
        with pytest.raises(AssertionError, match="trained again"):
            train_network(Samples(samples.states, -samples.inputs), path=path, **QUICK)
    said = " ".join(capsys.readouterr().out.split())
    assert "other settings (penalty)" in said
    assert "other settings (standardise)" in said
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
