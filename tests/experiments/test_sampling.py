"""Samples are the policy's own decisions, kept and reused."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.command import require_folder
from experiments.double_integrator.mpc import LinearMPC
from experiments.sampling import sample_draws, sample_policy

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


def test_states_can_be_drawn_by_any_rule_and_blocks_may_differ_in_size(tmp_path):
    def draw(rng):
        return rng.normal([0, 0], [2, 0.3], (int(rng.integers(1, 9)), 2))

    path, settings = tmp_path / "samples.npz", {"deviation": [2, 0.3]}
    options = {"draw": draw, "settings": settings, "progress": False}
    half = sample_draws(MPC, 20, 3, path=path, **options)
    whole = sample_draws(MPC, 40, 3, path=path, **options)
    np.testing.assert_array_equal(half.states, whole.states[:20])
    np.testing.assert_array_equal(whole.states, sample_draws(MPC, 40, 3, **options).states)
    np.testing.assert_array_equal(whole.inputs, MPC.batch(whole.states))


def test_draws_that_are_never_feasible_are_named():
    with pytest.raises(ValueError, match=r"drawn with centre 50, none was feasible"):
        sample_draws(
            MPC,
            10,
            0,
            draw=lambda rng: rng.normal(50, 1, (5, 2)),
            settings={"centre": 50},
            progress=False,
        )


def test_no_samples_is_an_error():
    with pytest.raises(ValueError, match="count must be at least 1, got 0"):
        sample(0)


@pytest.mark.parametrize("below", ["", "x"])
def test_results_go_to_a_folder_or_the_option_is_named(tmp_path, below):
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(ValueError, match=r"--output must be a folder, but .* arrived"):
        require_folder(file / below)
