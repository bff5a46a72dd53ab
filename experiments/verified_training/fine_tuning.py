"""One learned controller, trained on with penalties of what its loop can reach, and certified.

The loss is that of imitation plus, every so many steps, how far the certified sets miss the
specification and how large they are:

    mean_i |pi(x_i) - u_i|^2  +  decay sum_l |W_l|_F^2
        +  specification * shortfall(tube)  +  volume * (mean log-volume of the tube).

A job is a function of plain arrays, so that jobs run in processes of their own.
"""

import hashlib
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Bool, Float
from numpy import ndarray

import reachjax as rj
from experiments import stored
from experiments.analysis import RELAXATIONS
from experiments.double_integrator.figures import hull_area
from experiments.double_integrator.problem import (
    GOAL_BOX,
    HORIZON,
    INITIAL_BOX,
    INPUT_BOX,
    STATE_BOX,
    A,
    B,
    closed_loop,
    template,
)
from experiments.imitation import fit, training_share
from experiments.sampling import Samples

PROBLEM = (A, B, INPUT_BOX, INITIAL_BOX, STATE_BOX, GOAL_BOX)


@dataclass(frozen=True)
class Tuning:
    """How a controller is trained on.

    Attributes:
        steps: of Adam on the full batch.
        learning_rate: at the start; it decays to 0 along a cosine.
        every: the penalties are computed at one step in so many.
        specification: weight of the specification's shortfall.
        margin: how far the sets should be from breaking it, in the units of the state.
        volume: weight of the mean log-volume.
        decay: weight of the squared weights.
        simulations: trajectories for hulls, witnesses and counterexamples.
        goals: half-widths of goal boxes around the origin to verify as well.
    """

    steps: int
    learning_rate: float
    every: int
    specification: float
    margin: float
    volume: float
    decay: float
    simulations: int
    goals: tuple[float, ...]

    @property
    def penalised(self) -> bool:
        """Whether there is a penalty at all."""
        return self.specification > 0 or self.volume > 0


@dataclass(frozen=True)
class Outcome:
    """What became of one controller.

    Attributes:
        layers: the weights.
        imitation: the loss without penalties, step by step.
        penalty: the penalties, weighed, at the steps that have them.
        skipped: how many steps were skipped because a program was not solved.
        step_seconds: the median time of a step with penalties, compilation left out; NaN without.
        training_error: root mean square error on the samples trained on.
        validation_error: the same on the others.
        verdict: of the specification.
        unsolved: facets not solved to tolerance.
        goal_margin: certified, smallest.
        safe_margin: certified, smallest.
        simulated_safe_margin: of the simulated trajectories, smallest.
        areas: of the certified sets at times `1 .. horizon`.
        hulls: of the convex hulls of simulated states.
        goals: for each half-width, whether the goal is proved together with the constraint.
    """

    layers: list[tuple[Float[ndarray, "out in"], Float[ndarray, " out"]]]
    imitation: Float[ndarray, " steps"]
    penalty: Float[ndarray, " penalised"]
    skipped: int
    step_seconds: float
    training_error: float
    validation_error: float
    verdict: str
    unsolved: int
    goal_margin: float
    safe_margin: float
    simulated_safe_margin: float
    areas: Float[ndarray, " horizon"]
    hulls: Float[ndarray, " horizon"]
    goals: Bool[ndarray, " goals"]

    def results(self) -> dict:
        """All but the weights."""
        return {name: value for name, value in asdict(self).items() if name != "layers"}


def certified_tube(net: rj.MLP, horizon: int = HORIZON, **options) -> rj.ReachTube:
    """What is reachable from the paper's initial set, one step at a time."""
    options = RELAXATIONS["local-bounds"] | options
    return rj.reach(closed_loop(net), rj.Box(*INITIAL_BOX), horizon, template(), **options)


def run(layers, samples: Samples, tuning: Tuning, path: Path) -> Outcome:
    """Train, certify and keep the outcome at `path`, or take it from there."""
    parts = [part for layer in layers for part in layer] + [samples.states, samples.inputs]
    start = b"".join(np.ascontiguousarray(part).tobytes() for part in parts)
    settings = asdict(tuning) | {
        "goals": list(tuning.goals),
        "start": hashlib.sha256(start).hexdigest(),
        "problem": [HORIZON, *(part.tolist() for part in PROBLEM), len(template())],
    }
    kept = stored.load(path, settings)
    if kept is None:
        weights, record = _trained(layers, samples, tuning)
        kept = record | _certified(weights, samples, tuning)
        kept |= {f"W{i}": W for i, (W, _) in enumerate(weights)}
        kept |= {f"b{i}": b for i, (_, b) in enumerate(weights)}
        stored.save(path, settings, **kept)
    pairs = [(kept.pop(f"W{i}"), kept.pop(f"b{i}")) for i in range(len(layers))]
    plain = {name: value.tolist() if value.ndim == 0 else value for name, value in kept.items()}
    return Outcome(pairs, **plain)


def _trained(layers, samples: Samples, tuning: Tuning) -> tuple[list, dict]:
    """The weights after `tuning.steps`, and a record of the training."""
    split = training_share(samples, validation=0.1)
    x, u = jnp.asarray(samples.states[:split]), jnp.asarray(samples.inputs[:split])
    schedule = rj.PenaltySchedule(1.0, every=tuning.every)  # the weights are in the penalty
    rate = optax.cosine_decay_schedule(tuning.learning_rate, tuning.steps)
    optimizer = rj.skip_failures(optax.adam(rate))

    def imitation(net):
        errors = jnp.sum((jax.vmap(net)(x) - u) ** 2, axis=1)
        return jnp.mean(errors) + tuning.decay * sum(jnp.sum(W**2) for W, _ in net.layers)

    def penalty(net):
        tube = certified_tube(net)
        missing = rj.shortfall(
            tube, goal=rj.Box(*GOAL_BOX), safe=rj.Box(*STATE_BOX), margin=tuning.margin
        )
        size = rj.log_volume(tube) / HORIZON
        return tuning.specification * missing + tuning.volume * size

    def loss(net, step):
        weighed = schedule.apply(step, penalty, net) if tuning.penalised else jnp.zeros(())
        parts = imitation(net), weighed
        return sum(parts), parts

    @jax.jit
    def advance(net, state, step):
        gradient, parts = jax.grad(loss, has_aux=True)(net, step)
        updates, state = optimizer.update(gradient, state)
        return optax.apply_updates(net, updates), state, parts

    net: Any = rj.MLP.from_layers(layers)
    state, parts, seconds = optimizer.init(net), [], []
    for step in range(tuning.steps):
        began = time.perf_counter()
        net, state, both = advance(net, state, step)
        parts.append(np.asarray(both))
        seconds.append(time.perf_counter() - began)
    computed = np.arange(tuning.steps) % tuning.every == 0
    parts = np.array(parts)
    record = {
        "imitation": parts[:, 0],
        "penalty": parts[computed, 1],
        "skipped": np.array(rj.failures(state)),
        # the first one compiles
        "step_seconds": np.median(np.array(seconds)[computed][1:])
        if tuning.penalised and computed.sum() > 1
        else np.array(np.nan),
    }
    return [(np.asarray(W), np.asarray(b)) for W, b in net.layers], record


def _certified(layers, samples: Samples, tuning: Tuning) -> dict:
    """Errors, verdicts, margins and areas of a controller."""
    tube = certified_tube(rj.MLP.from_layers(layers), samples=tuning.simulations)
    errors, safe = fit(layers, samples), rj.Box(*STATE_BOX)
    verdict = rj.verify(tube, goal=rj.Box(*GOAL_BOX), safe=safe, samples=tuning.simulations)
    states = np.asarray(tube.simulate(tuning.simulations))
    smaller = [
        rj.verify(tube, goal=rj.Box([-half] * 2, [half] * 2), safe=safe, samples=1)
        for half in tuning.goals
    ]
    values = {
        "training_error": errors.training_error,
        "validation_error": errors.validation_error,
        "verdict": verdict.status.name,
        "unsolved": verdict.unsolved,
        "goal_margin": np.nanmin(verdict.margins["goal"]),
        "safe_margin": np.nanmin(verdict.margins["safe"]),
        "simulated_safe_margin": np.nanmin(verdict.simulated["safe"]),
        "areas": [region.volume() for region in tube.sets[1:]],
        "hulls": [hull_area(states[:, t]) for t in range(1, HORIZON + 1)],
        "goals": [each.status is rj.VerdictStatus.PROVED for each in smaller],
    }
    return {name: np.asarray(value) for name, value in values.items()}
