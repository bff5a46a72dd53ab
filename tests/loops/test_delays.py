"""Inputs that are late act when they should, in every kind of plant."""

import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.loops.delays import DelayedPlant

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
            assert np.all(np.asarray(span.contains(dense[:, 4 * k : 4 * k + 5], 1e-9)))
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


def in_time():
    """Plants that vary in time, whose last state is an input on its way."""
    A = jnp.stack([jnp.array([[a, 0.0], [0.0, 1.0]]) for a in (0.5, 0.6, 0.7, 0.8)])
    return {
        "function": rj.NonlinearPlant.timed(
            lambda x, u, t: jnp.array([x[0] / 2 + 1e-3 * t + u[0], x[1]]), 2, 1
        ),
        "equation": rj.SampledPlant(
            lambda x, u, t: jnp.array([1e-2 * t - x[0] + u[0], 0.0]), 2, 1, 0.5, clock=True
        ),
        "matrices": rj.AffinePlant(A, [[1.0], [0.0]]),
    }


def late_in_time(kind):
    net = rj.MLP.from_layers([([[0.0, 0.0]], [0.0])])
    return rj.ClosedLoop(DelayedPlant(in_time()[kind], 1), net)


@pytest.mark.parametrize("kind", in_time())
def test_what_is_late_varies_in_time_as_its_plant_does(kind, tmp_path):
    loop, plant, X = late_in_time(kind), in_time()[kind], rj.Box([-1.0, 0.0], [1.0, 0.0])
    assert loop.varies
    assert (loop.steps, loop.plant.clock) == (plant.steps, plant.clock)
    tube, safe = rj.reach(loop, X, 2, rj.Template.box(2)), rj.Box([-5.0, -5.0], [5.0, 5.0])
    tube.save(tmp_path / "a.tube")
    for each in (tube, rj.load(tmp_path / "a.tube", loop, recheck=True)):
        with pytest.raises(ValueError, match="do not vary in time"):
            rj.verify(each, safe=safe, forever=True)


def test_matrices_of_several_times_have_no_later_ones_though_inputs_are_late(tmp_path):
    loop, X = late_in_time("matrices"), rj.Box([-1.0, 0.0], [1.0, 0.0])
    with pytest.raises(ValueError, match="time"):
        rj.reach(loop, X, 5, rj.Template.box(2))
    rj.reach(loop, X, 4, rj.Template.box(2)).save(tmp_path / "a.tube")
    assert rj.load(tmp_path / "a.tube").loop.steps == 4


def test_a_late_plant_that_drifts_is_not_closed_by_a_set_that_it_comes_back_to():
    loop = late_in_time("function")
    drifts = rj.decide(
        loop, rj.Box([-1.0, 0.0], [1.0, 0.0]), 120, safe=rj.Box([-2.0] * 2, [2.0] * 2)
    )
    assert drifts.proved
    assert drifts.recurrence is None
