"""Inputs that are late act when they should, in every kind of plant."""

import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj

RATE, H = 0.5, 0.25
NET = rj.MLP.from_layers([([[-0.4, -0.2]], [0.1])])
X0 = rj.Box([0.9, -0.1], [1.0, 0.1])
A, B, E = np.array([[0.0, 1.0], [-1.0, -0.2]]), np.array([[0.0], [1.0]]), np.array([[0.1], [0.0]])
PUSH = rj.Box([-0.2], [0.3])


def field(x, u, w):
    return A @ x + B @ u + E @ w


def loops():
    """A linear motion under four kinds of plants, of which two pairs are the same."""
    step = np.eye(2) + H * A, H * B
    plants = (
        rj.AffinePlant(*step, E=H * E),
        rj.NonlinearPlant(lambda x, u, w: x + H * field(x, u, w), 2, 1, 1),
        rj.SampledPlant.affine(A, B, period=H, E=E, held=True),
        rj.SampledPlant(field, 2, 1, H, 1, held=True),
    )
    return [rj.ClosedLoop(plant, NET, disturbance=PUSH) for plant in plants]


IDS = "affine", "function", "matrices", "equation"


@pytest.mark.parametrize("loop", loops(), ids=IDS)
@pytest.mark.parametrize("periods", [1, 3])
def test_what_acts_is_the_input_of_so_many_periods_before(loop, periods):
    late, rng = rj.delayed(loop, periods), np.random.default_rng(0)
    waiting = [rng.normal(size=1) for _ in range(periods)]
    x, w = rng.normal(size=2), rng.uniform(-0.2, 0.3, size=(8, 1))
    runs = late.simulate(jnp.concatenate([x, *waiting]), 8, disturbances=w)
    for t in range(8):
        np.testing.assert_allclose(runs[t], jnp.concatenate([x, *waiting]), atol=1e-9)
        waiting.append(np.asarray(NET(jnp.asarray(x))))
        x = np.asarray(loop.plant.propagate(jnp.asarray(x), waiting.pop(0), t, w=w[t]))


@pytest.mark.parametrize("loop", loops(), ids=IDS)
def test_sets_of_late_loops_hold_what_they_do_at_all_times(loop):
    late, begun = rj.delayed(loop), rj.with_inputs(X0, [0.5])
    tube = rj.reach(late, begun, 4, rj.Template.box(3), relaxation=rj.LinearBounds())
    rng = np.random.default_rng(1)
    first = np.asarray(begun.corners())[rng.integers(8, size=40)]
    w = rng.choice([-0.2, 0.3], size=(40, 4, 1))
    runs = np.asarray(late.simulate(first, 4, disturbances=w))
    for k in range(5):
        assert np.all(np.asarray(tube.sets[k].contains(runs[:, k], 1e-9)))
    if late.plant.continuous:
        dense = np.asarray(late.simulate(first, 4, disturbances=w, parts=4))
        for k, span in enumerate(tube.spans):
            assert np.all(np.asarray(span.contains(dense[:, 4 * k + 1 : 4 * k + 5], 1e-9)))
    widths = np.asarray(tube.sets[4].bounding_box().widths) / np.ptp(runs[:, 4], axis=0)
    assert np.all(widths < 2)


@pytest.mark.parametrize("loop", loops()[2:], ids=IDS[2:])
def test_what_is_late_is_decided_at_all_times(loop):
    late, begun = rj.delayed(loop), rj.with_inputs(X0, [-8.0])  # it brakes, a period long
    wide = rj.with_inputs(rj.Box([-9.0, -9.0], [9.0, 9.0]), 1)
    assert rj.decide(late, begun, 3, safe=wide).proved
    slow = rj.with_inputs(rj.Box([-9.0, -1.0], [9.0, 1.0]), 1)
    verdict = rj.decide(late, begun, 3, safe=slow)
    assert verdict.refuted
    assert verdict.counterexample.instant > 0


def test_errors_of_delays_name_what_is_wrong():
    noisy = loops()[0].replace(noise=rj.Box([-0.1, -0.1], [0.1, 0.1]))
    with pytest.raises(ValueError, match="nor have noise"):
        rj.delayed(noisy)
    with pytest.raises(ValueError, match="periods"):
        rj.delayed(loops()[0], 0)
    with pytest.raises(TypeError, match="region must be a Box"):
        rj.with_inputs(rj.Ellipsoid([0.0], [[1.0]]), 1)
