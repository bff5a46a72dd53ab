"""Loops with disturbances and noise of every kind, and scenarios to attack their bounds with."""

from typing import Any

import jax
import numpy as np

import reachjax as rj
from tests import closed_loops
from tests.closed_loops import closed_loop, random_loop
from tests.networks import simplex_region

STEPS = 3


def disturbance_set(kind: str, n: int, seed: int = 0) -> Any:
    """A set of this kind, about 0.1 wide, with zero in its interior or near."""
    rng = np.random.default_rng(seed)
    low, high = -0.1 * rng.uniform(size=(2, STEPS, n))
    L = 0.05 * rng.normal(size=(n, n)) + 0.03 * np.eye(n)
    simplex = simplex_region(n, seed)
    return {
        "box": rj.Box(low[0], -high[0]),
        "varying box": rj.Box(low, -high),
        "polytope": rj.Polytope(simplex.A, 0.1 * (simplex.b - simplex.A @ simplex.corners.mean(0))),
        "ellipsoid": rj.Ellipsoid(0.05 * rng.normal(size=n), L @ L.T),
        "intersection": rj.Intersection(
            rj.Box(-0.1 * np.ones(n), 0.02 * np.ones(n)),
            rj.Ellipsoid(np.zeros(n), 0.01 * np.eye(n)),
        ),
    }[kind]


def disturbed_loop(n: int, W: Any, V: Any = None, seed: int = 0, **options: Any) -> rj.ClosedLoop:
    """A random loop, into which `W` enters by a random matrix."""
    loop = closed_loop(random_loop(n, (5, 4), seed, **options))
    E = None if W is None else np.random.default_rng(seed).normal(size=(n, W.dimension))
    return loop.replace(plant=loop.plant.replace(E=E), disturbance=W, noise=V)


def double_integrator(w: float = 0.05, v: float = 0.01) -> tuple[rj.ClosedLoop, rj.Box]:
    """A trained loop, both of whose states are pushed and measured with noise, and its states."""
    loop, both = closed_loops.double_integrator(), np.ones(2)
    W, V = (rj.Box(-size * both, size * both) for size in (w, v))
    plant = loop.plant.replace(E=np.eye(2))
    return loop.replace(plant=plant, disturbance=W, noise=V), rj.Box([2.5, -0.25], [3.0, 0.25])


def extremes(W: Any, count: int, steps: int, seed: int, start: int = 0) -> np.ndarray:
    """Points `(count, steps, n)` of a set, most of them corners or on its surface."""
    drawn = []
    for t in range(start, start + steps):
        here, key = W if W.steps is None else W.at(t), jax.random.key(1000 * seed + t)
        rng, surface = np.random.default_rng([seed, t]), here.sample_boundary(key, count)
        ends = np.asarray(here.corners() if surface is None else surface)
        ends = ends if len(ends) else np.asarray(here.sample(key, count))
        ends = ends[rng.integers(len(ends), size=count)]
        drawn.append(np.where(rng.uniform(size=(count, 1)) < 0.7, ends, here.sample(key, count)))
    return np.stack(drawn, axis=1)


def attacked(loop: rj.ClosedLoop, X0: Any, steps: int, count: int = 2000, seed: int = 5) -> Any:
    """Trajectories `(count, steps + 1, n_x)` under disturbances and noise of all kinds."""
    sets = {"disturbances": loop.disturbance, "noises": loop.noise}
    drawn = {
        name: extremes(W, count, steps, seed + i)
        for i, (name, W) in enumerate(sets.items())
        if W is not None
    }
    states = X0.sample(jax.random.key(seed), count)
    return np.asarray(loop.simulate(states, steps, **drawn))
