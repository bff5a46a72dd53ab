"""Loops that jump: whatever the closed law allows lies in their sets, on the surfaces and beside.

Numbers are small multiples of powers of two, so that trajectories are exact fractions.
"""

import itertools
from fractions import Fraction

import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.methods.cells import Cells

STEPS, H = 3, Fraction(1, 4)


def signs(y):
    """All that a sign may be."""
    return (-1, 0, 1) if y == 0 else (1,) if y > 0 else (-1,)


def steps(y):
    """All that a step may be."""
    return (0, 1) if y == 0 else (int(y > 0),)


def nearest(y):
    """Whole numbers that are as near as any."""
    return {(y + Fraction(1, 2)) // 1, -((Fraction(1, 2) - y) // 1)}


def relay(x):
    return [(x[0] + H * x[1], x[1] - s * H) for s in signs(x[0] + x[1])]


def thermostat(x):
    """Colder than 0 it turns on, warmer than 1 off; else it stays as it is."""
    cold, warm = steps(-x[0]), steps(x[0] - 1)
    after = {1 if c else 0 if w else x[1] for c in cold for w in warm}
    return [(x[0] + H * (on - Fraction(1, 2) - x[0] / 4), on) for on in after]


def friction(x):
    return [(x[0] + H * x[1], x[1] - H * (x[0] + s / Fraction(2))) for s in signs(x[1])]


def quantised(x):
    u = max(Fraction(-1), min(Fraction(1), -x[0] - x[1]))
    return [(x[0] + H * x[1], x[1] + H * n / 4) for n in nearest(4 * u)]


def best(x):
    scores = (x[0] - x[1], x[0] / 2 + Fraction(1, 4), x[1])
    winners = [k for k, score in enumerate(scores) if score == max(scores)]
    return [(x[0] + H * x[1], x[1] + H * (-1, 2, 1)[k]) for k in winners]


h = float(H)
LAWS = {
    "a relay": (
        lambda x, u: jnp.stack([x[0] + h * x[1], x[1] - h * jnp.sign(x[0] + x[1])]),
        relay, ([-0.5, -0.5], [0.5, 0.5]),
    ),
    "a thermostat": (
        lambda x, u: jnp.stack([x[0] + h * (u[0] - 0.5 - x[0] / 4), u[0]]),
        thermostat, ([-0.5, 0.0], [1.5, 0.0]),
    ),
    "friction": (
        lambda x, u: jnp.stack([x[0] + h * x[1], x[1] - h * (x[0] + jnp.sign(x[1]) / 2)]),
        friction, ([-0.5, -0.5], [0.5, 0.5]),
    ),
    "a quantised input": (
        lambda x, u: jnp.stack(
            [x[0] + h * x[1], x[1] + h * jnp.round(4 * jnp.clip(-x[0] - x[1], -1, 1)) / 4]
        ),
        quantised, ([-0.25, -0.25], [0.25, 0.25]),
    ),
    "the best of three": (
        lambda x, u: jnp.stack([x[0] + h * x[1], x[1] + h * jnp.array([-1.0, 2.0, 1.0])[
            jnp.argmax(jnp.stack([x[0] - x[1], x[0] / 2 + 0.25, x[1]]))]]),
        best, ([-0.5, -0.5], [0.5, 0.5]),
    ),
}  # fmt: skip


def loop_of(name):
    def controller(x):
        return jnp.where(x[:1] < 0, 1.0, jnp.where(x[:1] > 1, 0.0, x[1:]))

    plant = rj.NonlinearPlant(LAWS[name][0], states=2, inputs=1)
    return rj.ClosedLoop(plant, rj.Network(controller, 2, 1))


def starting(lower, upper):
    """A grid of fractions, whose points are on surfaces or not, and points next to these."""
    axes = [
        sorted({Fraction(a) + (Fraction(b) - Fraction(a)) * Fraction(k, 8) for k in range(9)})
        for a, b in zip(lower, upper, strict=True)
    ]
    tiny, points = Fraction(1, 2**60), []
    for x in itertools.product(*axes):
        for shift in (-tiny, Fraction(0), tiny):
            moved = (x[0] + shift, x[1])
            if lower[0] <= moved[0] <= upper[0]:
                points.append(moved)
    return points


ALONG_WAYS = Cells(most=3)

METHODS = {
    "forms": rj.LinearBounds(),
    "branches": rj.BranchAndCut(),
    "forms along ways": ALONG_WAYS,
}


@pytest.mark.parametrize("relaxation", METHODS.values(), ids=METHODS.keys())
@pytest.mark.parametrize("name", LAWS)
def test_all_that_the_closed_law_allows_is_in_the_sets(name, relaxation):
    _, law, ends = LAWS[name]
    tube = rj.reach(loop_of(name), rj.Box(*ends), STEPS, rj.Template.octagonal(2),
                    relaxation=relaxation, gap=1e-3)  # fmt: skip
    states = set(starting(*ends))
    for t in range(1, STEPS + 1):
        states = {after for x in states for after in law(x)}
        A, b = (
            np.vectorize(Fraction, otypes=[object])(np.asarray(part))
            for part in tube.sets[t].facets
        )
        points = np.array(sorted(states), object)
        if len(points) > 4000:  # exact numbers take their time
            keep = np.random.default_rng(t).choice(len(points), 4000, replace=False)
            points = points[keep]
            states = {tuple(x) for x in points}
        assert np.all((points @ A.T).max(axis=0) <= b), t


@pytest.mark.parametrize("name", LAWS)
def test_verdicts_are_those_of_the_extremes(name):
    _, law, ends = LAWS[name]
    states = set(starting(*ends))
    for _ in range(2):
        states = {after for x in states for after in law(x)}
    most = float(max(x[0] for x in states))
    loop, X0 = loop_of(name), rj.Box(*ends)
    wide, narrow = (rj.Box([-9.0, -9.0], [most + by, 9.0]) for by in (0.01, -0.01))
    assert rj.decide(loop, X0, 2, goal=wide).status is rj.VerdictStatus.PROVED
    assert rj.decide(loop, X0, 2, goal=narrow).status is rj.VerdictStatus.REFUTED


LONG = 6
"""Steps in which a thermostat switches both ways."""

ROOM = rj.Box([1.25, 0.0], [1.75, 0.0])
"""Temperatures of a room whose heating is off."""


def heated(low, high, on):
    """Temperatures after a step, and whether it is heated: from below 1 on, up to 2."""
    one, two = Fraction(1), Fraction(2)
    parts = (low, min(high, one), 1), (max(low, two), high, 0), (max(low, one), min(high, two), on)
    return [(low * 3 / 4 + on, high * 3 / 4 + on, on) for low, high, on in parts if low <= high]


def thermostat_loop():
    def keeps(x):
        return jnp.where(x[:1] < 1, 1.0, jnp.where(x[:1] > 2, 0.0, x[1:]))

    plant = rj.NonlinearPlant(lambda x, u: jnp.append(x[:1] * 3 / 4 + u, u), 2, 1)
    return rj.ClosedLoop(plant, rj.Network(keeps, 2, 1))


@pytest.mark.parametrize("side", [0, 1], ids=["cold", "warm"])
def test_a_relay_whose_state_keeps_its_mode_is_decided_both_ways(side):
    spans = [(Fraction(ROOM.lower[0].item()), Fraction(ROOM.upper[0].item()), 0)]
    every = [*spans]
    for _ in range(LONG):
        spans = [after for span in spans for after in heated(*span)]
        every += spans
    assert {on for *_, on in every} == {0, 1}
    attained = float((max if side else min)(span[side] for span in every))
    for by, status in ((0.01, "PROVED"), (-0.01, "REFUTED")):
        ends = np.array([[-9.0, -9.0], [9.0, 9.0]])
        ends[side, 0] = attained + (by if side else -by)
        verdict = rj.decide(thermostat_loop(), ROOM, LONG, safe=rj.Box(*ends))
        assert verdict.status.name == status


@pytest.mark.costly
def test_a_bound_is_closed_by_states_of_the_set_alone():
    # two decisions that are nearly one: to win both by as much leads far out of the set
    def f(x):
        ahead, behind = x[0] - x[1] > 0, (1 + 1e-9) * x[1] - x[0] > 0
        extra = 0.3 * (x[0] > 0.9) + 1e-3 * (ahead.astype(float) + behind)
        return jnp.array([x[0] + x[1] + extra, 0.0 * x[1]])

    plant = rj.AffinePlant(np.zeros((2, 2)), np.eye(2))
    X0 = rj.Polytope([[1.0, 0.5], [0.5, 1.0], [-1.0, 0.0], [0.0, -1.0]], [1.05, 1.05, 1.0, 1.0])
    loop = rj.ClosedLoop(plant, rj.Network(f, 2, 2))
    proof = rj.reach(loop, X0, 1, rj.Template.box(2), samples=300).proof(1)
    solved = np.array([each is rj.SolverStatus.SOLVED for each in proof.statuses])
    half = np.tile(proof.bounds[:2] + proof.bounds[2:], 2) / 2
    assert (np.asarray(proof.gaps) <= 1e-4 * half + 1e-9)[solved].all()
    inside = X0.contains(np.asarray(proof.witness_states), 1e-9)
    assert np.asarray(inside).all()
