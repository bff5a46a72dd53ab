"""A controller may jump, as its input is held; a differential equation may not."""

import itertools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj

PERIOD, STEPS = 0.25, 4


def signed(x, u):
    return jnp.stack([x[1], -jnp.sign(x[0]) + u[0]])


def chosen(x, u):
    return jnp.stack([jnp.where(x[1] > 0, x[1], 1.0), u[0]])


def branched(x, u):
    return jnp.stack([x[1], jax.lax.cond(x[0] > 0, jnp.sin, lambda y: 2 * y - 1, u[0])])


def rounded(x, u):
    return jnp.stack([x[1], jnp.floor(x[0]) + u[0]])


def picked(x, u):
    return jnp.stack([x[1], jnp.array([1.0, 0.0, -1.0])[jnp.argmax(jnp.stack([x[0], x[1], u[0]]))]])


@pytest.mark.parametrize("f", [signed, chosen, branched, rounded, picked])
def test_a_differential_equation_that_jumps_is_refused_by_its_line(f):
    line = rf"jumps \(in {f.__name__}\b.*{re.escape('test_jumps_in_time.py')}:\d+\)"
    with pytest.raises(TypeError, match=line):
        rj.SampledPlant(f, states=2, inputs=1, period=PERIOD)


def push(x):
    return -jnp.sign(x[:1] + x[1:])


def pushes(x):
    """All that the closed law allows."""
    y = x[0] + x[1]
    return (-1.0, 0.0, 1.0) if y == 0 else (-np.sign(y),)


@pytest.fixture(scope="module")
def loop():
    plant = rj.SampledPlant(lambda x, u: jnp.stack([x[1], u[0]]), 2, 1, PERIOD)
    return rj.ClosedLoop(plant, rj.Network(push, 2, 1))


X0 = rj.Box([-0.25, -0.25], [0.25, 0.25])
"""Its diagonal is the surface on which the push changes."""


def trajectories():
    """States at quarters of periods, from points on the surface and beside it; all are exact."""
    ends = np.linspace(-0.25, 0.25, 9)
    states = [tuple(x) for x in itertools.product(ends, ends)]
    found = []
    for _ in range(STEPS):
        pairs = [(x, u) for x in states for u in pushes(x)]
        for part in (0.25, 0.5, 0.75, 1.0):
            t = part * PERIOD
            after = [(x[0] + t * x[1] + t * t * u / 2, x[1] + t * u) for x, u in pairs]
            found.append(np.array(after))
        states = list(set(after))
    return found


def test_a_double_integrator_that_is_banged_is_proved_at_all_times(loop):
    most = max(abs(each[:, 0]).max() for each in trajectories())
    wide, narrow = (
        rj.Polytope.between([-end, -9.0], [end, 9.0]) for end in (1.05 * most, 0.95 * most)
    )
    proved = rj.decide(loop, X0, STEPS, safe=wide)
    assert proved.proved, proved
    refuted = rj.decide(loop, X0, STEPS, safe=narrow)
    assert refuted.refuted, refuted


def test_all_that_the_closed_law_allows_between_samples_is_in_the_spans(loop):
    tube = rj.reach(loop, X0, STEPS, rj.Template.octagonal(2))
    for k, span in enumerate(tube.spans):
        for states in trajectories()[4 * k : 4 * k + 4]:
            A, b = map(np.asarray, span.facets)
            assert np.all(states @ A.T <= b + 1e-12)
