"""The five loops of the study: laws to imitate, and what is asked, four of them at all times."""

import dataclasses
import hashlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy import ndarray

import reachjax as rj
from experiments.benchmark.rivals import cruise_control
from experiments.nonlinear.problems import Problem
from experiments.sampled import problems as sampled
from experiments.sampling import Samples

OBSTACLE = 0.4
"""Half the side of the square around the origin that the navigation avoids, in metres."""

ROOM = 0.01
"""Between what a law attains and what is safe, in parts of how far states move."""

PART = 0.2
"""The margin of training, in parts of the least room that the law has: it stays reachable."""

ERROR = 0.1
"""Of demonstrations, in parts of the deviation of what the law does: nobody shows it exactly, and a
network that is exact in what was shown is no better a copy."""

PERIODS = 40
"""Of the cart-pole, that is two seconds: those in which it may fall."""


def navigation() -> Problem:
    """A point that is accelerated goes round an obstacle, under 4-32-32-2 neurons of `tanh`.

    Its law pulls it to the goal, and to one side as long as it is near the obstacle, which it
    passes so closely that copies do not always keep off.
    """
    period, goal = 0.2, np.array([2.0, 0.0])

    def law(x: Float[ndarray, "c 4"]) -> Float[ndarray, "c 2"]:
        near = np.exp(-np.sum((x[:, :2] + [1.0, 0.0]) ** 2, axis=1))
        pull = 0.8 * (goal - x[:, :2]) - 1.6 * x[:, 2:]
        return pull + 1.85 * near[:, None] * np.array([0.0, 1.0])

    sides = np.kron(np.eye(2, 4), [[1.0], [-1.0]])
    A, B = np.eye(4, k=2), np.eye(4, 2, k=-2)
    plant = rj.SampledPlant.affine(A, B, period=period)
    return Problem(
        "navigation",
        law,
        lower=(-2.6, -0.6, -0.6, -1.0),
        upper=(2.4, 1.4, 2.0, 1.4),
        hidden=(32, 32),
        activation="tanh",
        closed=lambda net: rj.ClosedLoop(plant, net),
        X0=rj.Box([-2.3, -0.1, -0.1, -0.1], [-1.9, 0.3, 0.1, 0.1]),
        horizon=30,
        goal=rj.Box([1.5, -0.5, -0.5, -0.5], [2.5, 0.5, 0.5, 0.5]),
        avoid=(rj.Polytope(sides, [OBSTACLE] * 4),),
    )


def pendulum() -> Problem:
    """The pendulum of `experiments.sampled`, from a larger set."""
    given = sampled.pendulum().problem
    return close(dataclasses.replace(given, X0=rj.Box([-0.35, -0.5], [0.35, 0.5])))


def cartpole() -> Problem:
    """The pole of `experiments.sampled`, from a larger set, for two seconds."""
    given = sampled.cartpole().problem
    goal = rj.Box([-0.4, -0.6, -0.1, -0.4], [0.4, 0.6, 0.1, 0.4])
    X0 = rj.Box([-0.05, -0.05, -0.08, -0.05], [0.05, 0.05, 0.08, 0.05])
    return close(dataclasses.replace(given, X0=X0, horizon=PERIODS, goal=goal))


def quadrotor() -> Problem:
    """The quadrotor of `experiments.sampled`."""
    return close(sampled.quadrotor().problem)


def close(problem: Problem) -> Problem:
    """The problem whose safe set is hardly larger than what its law attains."""
    states = under_law(problem)
    lower, upper = states.min(axis=(0, 1)), states.max(axis=(0, 1))
    room = ROOM * (upper - lower)
    return dataclasses.replace(problem, safe=rj.Box(lower - room, upper + room))


def under_law(problem: Problem) -> Float[ndarray, "c h+1 n"]:
    """States at samples under the law itself, from the corners of the initial set."""
    n, m = problem.X0.dimension, problem.law(np.zeros((1, problem.X0.dimension))).shape[1]
    loop = problem.closed(rj.MLP.from_layers([(np.zeros((m, n)), np.zeros(m))]))
    step = jax.jit(jax.vmap(lambda x, u: loop.moved(x, loop.projected(u))))
    states = [np.unique(np.asarray(problem.X0.corners()), axis=0)]
    for _ in range(problem.horizon):
        states.append(np.asarray(step(states[-1], problem.law(states[-1]))))
    return np.stack(states, axis=1)


def cruise() -> Problem:
    """A car that follows another one, which brakes, decided at samples: seven states, ten ReLUs."""
    period, steps, closer = 0.5, 10, -29.6
    room, stop = cruise_control.ROOM, cruise_control.STANDSTILL
    plant, speed, gap = cruise_control.plant(period), cruise_control.SET_SPEED, 1.4

    def law(x: Float[ndarray, "c 7"]) -> Float[ndarray, "c 1"]:
        fixed = np.full(len(x), speed), np.full(len(x), gap)
        seen = x[:, 4], x @ cruise_control.DISTANCE, x[:, 1] - x[:, 4]
        return cruise_control.law(np.stack([*fixed, *seen], axis=1))

    center = cruise_control.CENTER + closer * np.eye(7)[0]
    return Problem(
        "cruise control",
        law,
        lower=(20.0, 15.0, -2.0, 0.0, 20.0, -2.0, -2.0),
        upper=(140.0, 33.0, 0.0, 40.0, 32.0, 2.0, -2.0),
        hidden=(10,),
        activation="relu",
        closed=lambda net: rj.ClosedLoop(plant, net),
        X0=rj.Box(center - cruise_control.RADII, center + cruise_control.RADII),
        horizon=steps,
        safe=rj.Polytope(-room[None], [-stop]),
    )


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "pendulum": pendulum,
    "navigation": navigation,
    "quadrotor": quadrotor,
    "cart-pole": cartpole,
    "cruise control": cruise,
}


def least_room(problem: Problem) -> float:
    """How far the law itself is from breaking what is required, where it is nearest to that.

    It is measured at samples, from the corners of the initial set, in the units of the state.
    """
    states = under_law(problem)

    def rooms(region: rj.PolyhedralSet, seen: Float[ndarray, "... n"]) -> Float[ndarray, "... m"]:
        C, d, norms = (np.asarray(part) for part in region.facets_in_units())
        return (d - seen @ C.T) / norms

    found = [np.max(-rooms(region, states), axis=-1).min() for region in problem.avoid]
    if problem.goal is not None:
        found.append(rooms(problem.goal, states[:, -1]).min())
    if problem.safe is not None:
        found.append(rooms(problem.safe, states).min())
    return float(min(found))


def margin(problem: Problem) -> float:
    """How far requirements should be from failing in training: a part of the law's least room."""
    return PART * max(0.0, least_room(problem))


def fingerprint(problem: Problem) -> str:
    """A short word that differs where the loop, its law or what is required of it differs.

    Numbers count to nine digits, so that rounding on another machine changes nothing.
    """
    seen, regions = demonstrations(problem, 100, 0), (problem.X0, problem.goal, problem.safe)
    given = [*regions, *problem.avoid]
    facets = [part for region in given if region is not None for part in region.facets]
    words = problem.horizon, problem.hidden, problem.activation, [each is None for each in given]
    found = hashlib.sha256(repr(words).encode())
    for numbers in (seen.states, seen.inputs, under_law(problem), *facets):
        found.update((np.round(np.asarray(numbers), 9) + 0.0).tobytes())
    return found.hexdigest()[:16]


def required(problem: Problem) -> dict[str, Any]:
    """What `rj.train` and `rj.decide` take of a problem."""
    return {"goal": problem.goal, "safe": problem.safe, "avoid": problem.avoid or None}


def demonstrations(problem: Problem, count: int, seed: int) -> Samples:
    """What is shown at so many states: what the law does, but for a normal error."""
    exact = problem.samples(count, seed)
    errors = np.random.default_rng((seed, count)).normal(size=exact.inputs.shape)
    return Samples(exact.states, exact.inputs + ERROR * exact.inputs.std(axis=0) * errors)


def imitation(shown: Samples) -> Callable[..., jnp.ndarray]:
    """The task's loss: the mean squared error beside what is shown, in parts of its variance."""
    x, u = jnp.asarray(shown.states), jnp.asarray(shown.inputs)
    scale = jnp.var(u, axis=0)

    def loss(loop: rj.ClosedLoop, _: object) -> jnp.ndarray:
        found = jax.vmap(loop.controller)(x)
        return jnp.mean(jnp.sum((found - u) ** 2 / scale, axis=1))

    return loss
