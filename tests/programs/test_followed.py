"""Forms along the ways of decisions hold whatever the closed law allows, at ties too."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.programs.unrolled import along_ways, unrolled

STEPS, FEW, H = 5, 4, 0.25
BOX = rj.Box([-0.5, -0.5], [0.5, 0.5])
ROWS = np.concatenate([np.eye(2), -np.eye(2), [[1, 1], [-1, -1], [1, -1], [-1, 1]]])
DIRECTIONS = np.tile(ROWS, (STEPS, 1, 1))
SCORES = np.array([[1.0, -1.0], [0.5, 0.25], [-1.0, 0.5]])
PUSHES = np.array([-1.0, 2.0, 1.0])


def relayed(x, u):
    return jnp.stack([x[0] + H * x[1], x[1] - H * jnp.sign(x[0] + x[1])])


def waving(x, u):
    return jnp.stack([x[0] + H * jnp.sin(x[1]), x[1] - H * jnp.where(x[0] > x[1], x[0] + 1, -1.0)])


def picking(x, u):
    push = jnp.array(PUSHES)[jnp.argmax(jnp.array(SCORES) @ x)]
    return jnp.stack([x[0] + H * x[1] * x[0], x[1] + H * push])


def signs(y):
    return (-1.0, 0.0, 1.0) if y == 0 else (np.sign(y),)


def after_relayed(x):
    return [(x[0] + H * x[1], x[1] - H * s) for s in signs(x[0] + x[1])]


def after_waving(x):
    cases = {"above": x[0] + 1, "below": -1.0}
    taken = ["above"] * int(x[0] >= x[1]) + ["below"] * int(x[0] <= x[1])
    return [(x[0] + H * np.sin(x[1]), x[1] - H * cases[each]) for each in taken]


def after_picking(x):
    scores = SCORES @ x
    winners = np.flatnonzero(scores == scores.max())
    return [(x[0] + H * x[1] * x[0], x[1] + H * PUSHES[k]) for k in winners]


LAWS = {
    "a relay": (relayed, after_relayed),
    "branches beside a sine": (waving, after_waving),
    "the best of three": (picking, after_picking),
}


def loop_of(plant):
    net = rj.MLP.from_layers([([[0.0, 0.0]], [0.0])])
    return jax.device_get(rj.ClosedLoop(rj.NonlinearPlant(plant, states=2, inputs=1), net))


def trajectories(law):
    """States after each step, of points anywhere, on surfaces, and next to these."""
    ends = np.linspace(-0.5, 0.5, 9)
    grid = [*itertools.product(ends, ends)]
    beside = [(np.nextafter(a, 1), b) for a, b in grid if a < 0.5]
    drawn = np.random.default_rng(0).uniform(-0.5, 0.5, size=(4000, 2))
    states, found = [*grid, *beside, *map(tuple, drawn)], []
    for _ in range(STEPS):
        states = [after for x in states for after in law(np.array(x))]
        found.append(np.array(states))
    return found


@pytest.mark.parametrize("most", [1, 2, 5, 40])
@pytest.mark.parametrize("name", LAWS)
def test_every_state_is_on_a_way(name, most):
    plant, law = LAWS[name]
    box = jax.device_get(BOX)
    for states, found in zip(
        trajectories(law), along_ways(loop_of(plant), box, box, DIRECTIONS, most=most), strict=True
    ):
        values, offsets = states @ ROWS.T, np.array([way.offsets for way in found])
        inside = (values[:, None] <= offsets + 1e-12).all(axis=2).any(axis=1)
        assert inside.all(), states[~inside][:3]
        assert len(found) <= most


@pytest.mark.parametrize("name", LAWS)
def test_all_ways_together_are_as_wide_as_what_is_simulated(name):
    plant, law = LAWS[name]
    box = jax.device_get(BOX)
    given = loop_of(plant), box, box, DIRECTIONS[:FEW]
    most, room = np.zeros(0), np.zeros(0)
    wide = [each.offsets for each in unrolled(*given)]
    followed = [each.offsets for each in unrolled(*given, most=3**FEW)]  # a sign has three values
    for states, one, all_of_them in zip(trajectories(law)[:FEW], wide, followed, strict=True):
        most = (states @ ROWS.T).max(axis=0)
        assert np.all(all_of_them <= one + 1e-12)
        room = 0.05 * np.ptp(states @ ROWS.T, axis=0)
        assert np.all(all_of_them <= most + room), (all_of_them - most) / room
    assert np.max(wide[-1] - most) > 0.5 * room.max()  # where decisions are any number in between


def test_what_is_not_wanted_is_left_as_it_is():
    box = jax.device_get(BOX)
    given = loop_of(relayed), box, box, DIRECTIONS
    for each, one in zip(
        unrolled(*given, most=8, wanted=np.full(DIRECTIONS.shape[:2], np.inf)),
        unrolled(*given, most=8),
        strict=True,
    ):
        assert np.all(one.offsets <= each.offsets)


def test_a_loop_without_jumps_has_one_way():
    box = jax.device_get(BOX)
    loop = loop_of(lambda x, u: jnp.stack([x[0] + H * jnp.sin(x[1]), jnp.maximum(x[0], 0.0)]))
    for one, other in zip(
        unrolled(loop, box, box, DIRECTIONS),
        along_ways(loop, box, box, DIRECTIONS, most=9),
        strict=True,
    ):
        assert len(other) == 1
        np.testing.assert_array_equal(one.offsets, other[0].offsets)
