"""Equations that know the time: what is enclosed is what happens at that time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj

STILL = rj.MLP.from_layers([([[0.0]], [0.0])])
RATE, H = 3.0, 0.25
PUSHED = rj.Box([-0.1], [0.1])


def forced(x, u, t):
    """The solution from `a` at 0 is `a + sin(3 t) / 3`."""
    return jnp.array([jnp.cos(RATE * t)]) + u


def loops():
    """The same motion, as an equation with parameters and as a step."""
    law = jax.tree_util.Partial(lambda rate, x, u, t: jnp.array([jnp.cos(rate * t)]) + u, RATE)

    def step(x, u, t):
        return x + (jnp.sin(RATE * H * (t + 1)) - jnp.sin(RATE * H * t)) / RATE + u

    plants = [
        rj.SampledPlant(forced, 1, 1, H, clock=True),
        rj.SampledPlant(law, 1, 1, H, clock=True),
        rj.NonlinearPlant.timed(step, 1, 1),
    ]
    return [rj.ClosedLoop(plant, STILL) for plant in plants]


IDS = ["equation", "parameters", "step"]


@pytest.mark.parametrize("loop", loops(), ids=IDS)
def test_sets_are_where_a_forced_motion_is_at_each_time(loop):
    tube = rj.reach(loop, PUSHED, 8, rj.Template.box(1), relaxation=rj.LinearBounds(), start=3)
    offset = np.sin(RATE * H * 3) / RATE
    for k in range(9):
        moved = np.sin(RATE * H * (3 + k)) / RATE - offset
        upper, lower = np.asarray(tube.sets[k].bounding_box().upper), -0.1 + moved
        np.testing.assert_allclose(upper, 0.1 + moved, rtol=0, atol=1e-4)
        assert upper >= 0.1 + moved - 1e-15
        np.testing.assert_allclose(tube.sets[k].bounding_box().lower, lower, rtol=0, atol=1e-4)
    runs = loop.simulate(jnp.array([0.05]), 8, start=3)[:, 0]
    exact = 0.05 + np.sin(RATE * H * (3 + np.arange(9))) / RATE - offset
    np.testing.assert_allclose(runs, exact, atol=1e-8)


@pytest.mark.parametrize("loop", loops()[:2], ids=IDS[:2])
def test_what_a_forced_motion_does_in_between_is_decided(loop):
    period = rj.ClosedLoop(loop.plant.replace(period=np.pi / RATE), STILL)  # as at the start
    safe, wide = rj.Box([-0.3], [0.3]), rj.Box([-0.5], [0.5])
    assert rj.decide(period, PUSHED, 3, goal=safe).proved
    assert rj.decide(period, PUSHED, 3, safe=wide).proved
    verdict = rj.decide(period, PUSHED, 3, safe=safe)
    assert verdict.refuted
    part = verdict.counterexample.instant / float(period.plant.period)
    assert abs(part - round(part)) > 0.1


def test_what_knows_the_time_is_for_no_time_for_ever():
    for loop in loops():
        assert loop.varies
        tube = rj.reach(loop, PUSHED, 1, rj.Template.box(1), relaxation=rj.LinearBounds())
        with pytest.raises(ValueError, match="has a clock"):
            rj.verify(tube, safe=rj.Box([-2.0], [2.0]), forever=True)


def test_a_horizon_of_a_loop_with_a_clock_does_not_close():
    """It seems to come back for a long time, and leaves later."""

    def f(x, u, t):
        return -x + jnp.array([jnp.exp(t - 30.0)])

    loop = rj.ClosedLoop(rj.SampledPlant(f, 1, 1, 0.25, clock=True), STILL)
    safe = rj.Box([-0.2], [0.2])
    assert rj.decide(loop, PUSHED, 104, safe=safe).recurrence is None
    assert rj.decide(loop, PUSHED, 140, safe=safe).refuted


def test_errors_of_clocks_name_the_argument():
    with pytest.raises(TypeError, match=r"SampledPlant\.clock"):
        rj.SampledPlant(forced, 1, 1, H, clock=1)
    with pytest.raises(ValueError, match=r"shape \(1,\)"):
        rj.SampledPlant(lambda x, u, t: jnp.array([x[0], t]), 1, 1, H, clock=True)
    with pytest.raises(ValueError, match="cannot be called"):
        rj.NonlinearPlant.timed(lambda x, u: x, 1, 1)
