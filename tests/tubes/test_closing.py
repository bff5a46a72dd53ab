"""Long horizons end where states come into a set that they come back to; what is said holds."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.loops.units import evaluate
from reachjax.verdicts import closing

LATER = 1000
"""Steps of simulation, beyond what any proof looks at."""

STILL = rj.MLP.from_layers([([[0.0, 0.0]], [0.0])])
X0 = rj.Box([0.3, -0.1], [0.4, 0.1])


def turning(growth, push=None):
    """A rotation by 0.3 that grows or shrinks."""
    c, s = growth * np.cos(0.3), growth * np.sin(0.3)
    plant = rj.AffinePlant([[c, -s], [s, c]], [[0.0], [1.0]], E=None if push is None else np.eye(2))
    return rj.ClosedLoop(plant, STILL, disturbance=push)


def swinging():
    """A pendulum that is slowed down."""

    def f(x, u):
        return jnp.array([x[1], -2 * jnp.sin(x[0]) - 1.5 * x[1] + u[0]])

    law = rj.Network(lambda x: -jnp.tanh(x[1:]), 2, 1)
    return rj.ClosedLoop(rj.SampledPlant(f, 2, 1, 0.1), law)


def attacked(verdict, loop, begun, region, item):
    """Attack what a verdict says of all later times: a long simulation, from the set it names."""
    found = verdict.recurrence
    assert found is not None
    assert found.proved
    runs = loop.simulate(jnp.concatenate([begun.corners(), begun.sample(item, 200)]), LATER)
    assert found.region.contains(runs[:, found.step], 1e-9).all()
    S = found.region
    inner = loop.simulate(jnp.concatenate([S.corners(), S.sample(item, 200)]), found.period)
    assert S.contains(inner[:, -1], 1e-9).all()
    return runs


def test_a_sampled_pendulum_is_safe_for_ever():
    loop, safe = swinging(), rj.Box([-0.5, -0.6], [0.5, 0.6])
    verdict = rj.decide(loop, X0, 1000, safe=safe)
    assert verdict.proved
    assert verdict.recurrence.step + verdict.recurrence.period < 500
    assert "for ever: in a set at t = " in str(verdict)
    runs = attacked(verdict, loop, X0, safe, jax.random.key(0))
    assert safe.contains(runs, 1e-9).all()
    assert np.all(np.isfinite(verdict.margins["safe"]))


@pytest.mark.parametrize("cells", [None, [2, 1]], ids=["whole", "cells"])
def test_what_is_required_of_later_times_only_is_proved_from_where_it_closes(cells):
    loop, small = swinging(), rj.Box([-0.01, -0.01], [0.01, 0.01])
    verdict = rj.decide(loop, X0, 400, goal={(30.0, 40.0): small}, cells=cells)
    assert verdict.proved
    runs = attacked(verdict, loop, X0, small, jax.random.key(0))
    assert small.contains(runs[:, 300:], 1e-9).all()


def test_a_set_that_is_not_come_back_to_is_begun_from_again(monkeypatch):
    loop, goal = turning(0.99), rj.Box([-0.2, -0.2], [0.2, 0.2])
    monkeypatch.setattr(closing, "periods", lambda loop, candidate: [])
    verdict = rj.decide(loop, X0, 120, goal=goal, cells=[1, 1])
    assert verdict.proved
    assert verdict.recurrence is None


def test_what_leaves_after_the_horizon_is_proved_until_then_and_not_for_ever():
    loop, safe = turning(1.0005), rj.Box([-0.5, -0.5], [0.5, 0.5])
    verdict = rj.decide(loop, X0, 100, safe=safe)
    assert verdict.proved
    assert verdict.recurrence is None


def test_what_is_required_at_one_late_time_is_not_missed():
    loop = turning(0.97)
    end = np.asarray(loop.simulate(jnp.array([0.35, 0.0]), 110))[-1]
    there = rj.Box(end - 1e-3, end + 1e-3)
    verdict = rj.decide(loop, X0, 110, avoid={110: [there]})
    assert verdict.refuted
    assert verdict.counterexample.time == 110
    beside = rj.Box(end + 0.2, end + 0.3)
    assert rj.decide(loop, X0, 110, avoid={110: [beside]}).proved


def test_disturbances_that_never_end_are_in_the_set():
    push = rj.Box([-0.01, -0.02], [0.02, 0.01])
    loop, safe = turning(0.9, push), rj.Box([-1.0, -1.0], [1.0, 1.0])
    verdict = rj.decide(loop, X0, 200, safe=safe)
    assert verdict.proved
    runs = attacked(verdict, loop, X0, safe, jax.random.key(0))
    assert safe.contains(runs, 1e-9).all()
    S, period = verdict.recurrence.region, verdict.recurrence.period
    begun = np.repeat(np.asarray(S.corners()), 50, axis=0)
    rng = np.random.default_rng(0)
    extreme = np.where(rng.uniform(size=(len(begun), period, 2)) > 0.5, push.upper, push.lower)
    runs = loop.simulate(begun, period, disturbances=extreme)
    assert S.contains(runs[:, -1], 1e-9).all()


@pytest.mark.costly
@pytest.mark.parametrize(
    "seed", [*range(4), *(pytest.param(k, marks=pytest.mark.long) for k in range(4, 8))]
)
def test_sets_and_periods_of_any_kind_prove_nothing_false(seed, monkeypatch):
    """A growing spiral breaks what is required at the end; no set makes that a proof."""
    rng = np.random.default_rng(seed)
    loop, n = turning(1.01), 2

    def any_set(loop, runs, step, wider):
        center, radii = 0.3 * rng.normal(size=n), rng.exponential(size=n)
        normals = np.concatenate([np.eye(n), -np.eye(n)])
        region = rj.Box(center - radii, center + radii)
        yield closing.Candidate(step, region, normals, center, np.tile(radii, 2))

    monkeypatch.setattr(closing, "sets_around", any_set)
    monkeypatch.setattr(closing, "periods", lambda loop, S: rng.integers(1, 40, size=2).tolist())
    size = 0.4 * 1.01**130 + 0.1
    safe = rj.Box([-size] * n, [size] * n)
    verdict = rj.decide(loop, X0, 120, safe=safe)
    assert verdict.proved
    assert verdict.recurrence is None
    assert not rj.decide(loop, X0, 200, safe=safe).proved


def test_a_loop_that_varies_in_time_is_done_step_by_step():
    A = np.stack([0.9 * np.eye(2)] * 100 + [1.02 * np.eye(2)] * 50)
    loop = rj.ClosedLoop(rj.AffinePlant(A, np.zeros((2, 1))), STILL)
    verdict = rj.decide(loop, X0, 150, safe=rj.Box([-1.0, -1.0], [1.0, 1.0]))
    assert verdict.proved
    assert verdict.recurrence is None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Drifting(rj.AffinePlant):
    """A plant that is pushed once it is late, and inherits that it has no clock."""

    def propagate(self, x, u, t=0, unit=evaluate, w=None):
        return super().propagate(x, u, t, unit, w) + np.full(2, 1e-3) * (t > 170)


class Still(Drifting):
    """A plant of that kind that says that it has none."""

    @property
    def clock(self) -> bool:
        return False


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Gusty(rj.AffinePlant):
    """A plant that disturbances enter once it is late."""

    def entering(self, t):
        return self.E * (t >= 600)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Widening(rj.Box):
    """Limits of inputs that widen."""

    def at(self, t):
        return rj.Box(self.lower * (1 + t), self.upper * (1 + t))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Tired(rj.ClosedLoop):
    """A loop that sees less and less."""

    def measured(self, x, t=0, unit=evaluate, v=None):
        return super().measured(x, t, unit, v) * 0.9**t


class Named(rj.AffinePlant):
    """A plant with another name, and no step of its own."""

    def told(self) -> str:
        return "a plant"


def test_what_a_user_derives_from_parts_of_a_loop_may_vary_in_time():
    """Whatever it changes of them; a name alone is no change."""
    still = rj.MLP.from_layers([([[0.0]], [0.0])])
    gust = rj.Box([-1.0], [1.0])
    gusty = rj.ClosedLoop(Gusty([[0.5]], [[0.0]], E=[[3.0]]), still, disturbance=gust)
    assert gusty.varies
    with pytest.raises(ValueError, match="must not vary in time"):
        rj.delayed(gusty)
    tube, safe = rj.reach(gusty, rj.Box([-0.1], [0.1]), 3), rj.Box([-9.0], [9.0])
    with pytest.raises(ValueError, match="var"):
        rj.verify(tube, safe=safe, forever=True)
    plant = rj.AffinePlant([[0.5]], [[1.0]])
    assert rj.ClosedLoop(plant, still, Widening([-1.0], [1.0])).varies
    assert Tired(plant, still).varies
    assert not rj.ClosedLoop(Named([[0.5]], [[1.0]]), still, rj.Box([-1.0], [1.0])).varies


def test_an_interrupted_search_for_a_set_halfway_tells_nothing_of_its_cells(monkeypatch):
    """They are of another set, and for other requirements."""

    def interrupted(*_):
        raise rj.Interrupted("its cells need not be decided again", None)

    monkeypatch.setattr(closing, "_for_ever", interrupted)
    loop = rj.ClosedLoop(rj.AffinePlant(0.9 * np.eye(2), np.zeros((2, 1))), STILL)
    with pytest.raises(rj.Interrupted, match="is the verdict so far") as raised:
        rj.decide(loop, X0, 200, safe=rj.Box([-1.0, -1.0], [1.0, 1.0]))
    assert raised.value.found.cells == ()
    assert not raised.value.found.proved


def test_a_plant_that_steps_in_a_way_of_its_own_may_have_a_clock():
    """What the class above says is not believed of it; nor are its inputs made late."""
    given = 0.9 * np.eye(2), np.zeros((2, 1))
    for plant, varies in ((rj.AffinePlant, False), (Drifting, True), (Still, False)):
        loop = rj.ClosedLoop(plant(*given), STILL)
        assert loop.varies is varies
    loop = rj.ClosedLoop(Drifting(*given), STILL)
    with pytest.raises(ValueError, match="must not vary in time"):
        rj.delayed(loop)
    assert rj.decide(loop, X0, 200, safe=rj.Box([-1.0, -1.0], [1.0, 1.0])).recurrence is None
