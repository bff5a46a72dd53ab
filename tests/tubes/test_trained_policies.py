"""A mountain car and a cart-pole under trained policies: the action of the largest score."""

from pathlib import Path

import jax
import numpy as np
import pytest

import reachjax as rj
from experiments.nonlinear.choices import INITIAL, PERIODS, closed, widths

KEPT = Path(__file__).parents[1] / "data" / "discrete_policies.npz"
"""As `python -m experiments.nonlinear.actions` trains them."""

SAMPLES, SECONDS = 40_000, 60.0


@pytest.fixture(scope="module", params=INITIAL)
def bounded(request):
    """A loop, its samples, and its sets."""
    name, X0 = request.param, rj.Box(*INITIAL[request.param])
    with np.load(KEPT) as kept:
        layers = [(kept[f"{name} {k} weight"], kept[f"{name} {k} bias"]) for k in range(3)]
    loop = closed(name, layers)
    states = np.asarray(loop.simulate(X0.sample(jax.random.key(1), SAMPLES), PERIODS))
    template = rj.Template.box(loop.states)
    return loop, states, rj.reach(loop, X0, PERIODS, template, time_limit=SECONDS)


@pytest.mark.long
def test_sets_hold_all_samples_and_are_hardly_wider(bounded):
    _, states, tube = bounded
    for t, X in enumerate(tube.sets):
        assert np.all(np.asarray(X.contains(states[:, t], 1e-12)))
    assert np.all(widths(tube, states) <= 1.05)


@pytest.mark.long
def test_they_are_decided_a_little_beside_what_is_attained(bounded):
    loop, states, tube = bounded
    reached, X0 = states[:, -1], tube.sets[0]
    half = np.ptp(reached, axis=0) / 2
    for part, status in ((0.05, "PROVED"), (-0.05, "REFUTED")):
        goal = rj.Box(reached.min(axis=0) - part * half, reached.max(axis=0) + part * half)
        verdict = rj.decide(loop, X0, PERIODS, goal=goal, time_limit=SECONDS)
        assert verdict.status.name == status, verdict
