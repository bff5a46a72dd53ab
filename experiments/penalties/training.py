"""One network, trained on for a time with a penalty, and what can be proved of it then.

The loss is that of imitation, in parts of the inputs' variance, plus a penalty: by how much bounds
on the loop's states miss the specification. The bounds are certified ones, or the extremes of
simulated trajectories.
"""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from numpy import ndarray

import reachjax as rj
from experiments import stored
from experiments.imitation import fit, training_share
from experiments.penalties.loops import Layers, StudiedLoop
from experiments.sampling import Samples
from experiments.task import Task

VALIDATION = 0.1
"""Share of the samples that is not trained on."""
DRAWN = 100
"""Trajectories of a penalty on samples, drawn anew at each step."""

Gradient = Callable[[Layers, Array], tuple[Float[Array, ""], Layers]]
"""A penalty and its gradient, from layers and a random key."""


@dataclass(frozen=True)
class Way:
    """A way to train.

    Attributes:
        penalty: its name, a key of `PENALTIES`.
        every: it is computed at one step in so many.
        seconds: of the processor, for all steps but the first of each compiled function.
        learning_rate: of Adam at the start; it decays to 0 along a cosine over these seconds.
        decide: seconds that the verdict, and then the tube, may take.
        simulations: trajectories that look for counterexamples.
    """

    penalty: str
    every: int
    seconds: float
    learning_rate: float
    decide: float
    simulations: int


@dataclass(frozen=True)
class Outcome:
    """What became of one network.

    Attributes:
        error: root mean square error on held-out samples.
        verdict: its name.
        certified: `(horizon, directions)`, widths of the tube in default settings.
        simulated: the same, of the simulated trajectories.
        steps: of training.
        penalised: how many of them had a penalty.
        skipped: how many had no gradient.
        first: seconds of first calls, compilation included; a network trained in the same process
            before this one has paid for it.
        seconds: of the verdict.
    """

    error: float
    verdict: str
    certified: Float[ndarray, "horizon d"]
    simulated: Float[ndarray, "horizon d"]
    steps: int
    penalised: int
    skipped: int
    first: float
    seconds: float


def certified(studied: StudiedLoop, relaxation: rj.AbstractRelaxation) -> Gradient:
    """A penalty on certified sets; that of the default is computed on the host."""

    def penalty(layers: Layers, _: Array) -> Float[Array, ""]:
        task = studied.under(layers)
        return studied.weight * rj.specification_penalty(
            task.loop,
            task.X0,
            task.horizon,
            task.template,
            goal=task.goal,
            safe=task.safe,
            margin=studied.margin,
            relaxation=relaxation,
        )

    gradient = jax.value_and_grad(penalty)
    return gradient if isinstance(relaxation, rj.BranchAndCut) else jax.jit(gradient)


def sampled(studied: StudiedLoop) -> Gradient:
    """The same penalty with extremes of simulated trajectories in place of certified bounds."""

    def missing(states: Float[Array, "c n"], region: rj.PolyhedralSet) -> Float[Array, ""]:
        A, b = region.facets
        norms = jnp.linalg.norm(A, axis=1)
        reached = jnp.max(states @ A.T, axis=0)
        return jnp.sum(jnp.maximum((reached - b) / norms + studied.margin, 0.0))

    def penalty(layers: Layers, key: Array) -> Float[Array, ""]:
        task = studied.under(layers)
        starts = jnp.vstack([task.X0.sample(key, DRAWN), task.X0.center[None]])
        states = task.loop.simulate(starts, task.horizon)
        total = jnp.zeros(())
        if task.goal is not None:
            total += missing(states[:, -1], task.goal)
        if task.safe is not None:
            total += sum(missing(states[:, t], task.safe) for t in range(task.horizon + 1))
        return studied.weight * total

    return jax.jit(jax.value_and_grad(penalty))


def none(_: StudiedLoop) -> Gradient:
    """No penalty."""
    return lambda layers, _: (jnp.zeros(()), jax.tree.map(jnp.zeros_like, layers))


PENALTIES: dict[str, Callable[[StudiedLoop], Gradient]] = {
    "none": none,
    "samples": sampled,
    "LinearBounds": lambda studied: certified(studied, rj.LinearBounds()),
    "LocalBounds": lambda studied: certified(studied, rj.LocalBounds()),
    "default": lambda studied: certified(studied, rj.BranchAndCut()),
}


class Trainer:
    """Networks of one loop trained in one way; what is compiled serves all of them."""

    def __init__(self, studied: StudiedLoop, samples: Samples, way: Way):
        self.studied, self.samples, self.way = studied, samples, way
        split = training_share(samples, VALIDATION)
        x, u = jnp.asarray(samples.states[:split]), jnp.asarray(samples.inputs[:split])
        scale = jnp.var(u, axis=0)
        self.optimizer = rj.skip_failures(optax.scale_by_adam())
        self.penalty = PENALTIES[way.penalty](studied)

        def imitation(layers):
            outputs = jax.vmap(rj.MLP.from_layers(layers))(x)
            return jnp.mean(jnp.sum((outputs - u) ** 2 / scale, axis=1))

        @jax.jit
        def advance(layers, state, penalty, rate):
            gradient = jax.tree.map(jnp.add, jax.grad(imitation)(layers), penalty)
            directions, state = self.optimizer.update(gradient, state)
            return jax.tree.map(lambda w, d: w - rate * d, layers, directions), state

        self.advance = advance

    def run(self, layers: Layers, seed: int, path: Path) -> Outcome:
        """Train on, decide and keep the outcome at `path`, or take it from there."""
        settings = asdict(self.way) | {"seed": seed, "margin": self.studied.margin}
        settings |= {"weight": self.studied.weight}
        kept = stored.load(path, settings)
        if kept is None:
            trained, record = self.trained(layers, seed)
            kept = record | self.decided(trained, seed)
            kept |= {f"W{i}": W for i, (W, _) in enumerate(trained)}
            kept |= {f"b{i}": b for i, (_, b) in enumerate(trained)}
            stored.save(path, settings, **kept)
        named = {name: kept[name] for name in Outcome.__dataclass_fields__}
        return Outcome(**{k: v if np.ndim(v) else np.asarray(v).item() for k, v in named.items()})

    def trained(self, layers: Layers, seed: int) -> tuple[Layers, dict[str, Any]]:
        """The layers when time is up, and what it took."""
        way, keys = self.way, jax.random.split(jax.random.key(seed), 1000)
        now: Any = [(jnp.asarray(W), jnp.asarray(b)) for W, b in layers]
        state = self.optimizer.init(now)
        nothing = jax.tree.map(jnp.zeros_like, now)
        began = time.perf_counter()  # the first calls compile, and count apart
        jax.block_until_ready(self.penalty(now, keys[0]))
        jax.block_until_ready(self.advance(now, state, nothing, 0.0))
        first, step, penalised = time.perf_counter() - began, 0, 0
        began = time.process_time()
        while (share := (time.process_time() - began) / way.seconds) < 1:
            rate = way.learning_rate * 0.5 * (1 + np.cos(np.pi * share))
            gradient = nothing
            if step % way.every == 0:
                _, gradient = self.penalty(now, keys[step % len(keys)])
                penalised += 1
            now, state = jax.block_until_ready(self.advance(now, state, gradient, rate))
            step += 1
        weights = [(np.asarray(W), np.asarray(b)) for W, b in now]
        counts = {"steps": step, "penalised": penalised, "skipped": rj.failures(state)}
        return weights, counts | {"first": first}

    def decided(self, layers: Layers, seed: int) -> dict[str, Any]:
        """Error, verdict, and widths of what is certified and simulated."""
        way, task = self.way, self.studied.under(layers)
        began = time.process_time()
        verdict = rj.decide(
            task.loop,
            task.X0,
            task.horizon,
            **task.required,
            samples=way.simulations,
            time_limit=way.decide,
        )
        seconds = time.process_time() - began
        tube = rj.reach(task.loop, task.X0, task.horizon, task.template, time_limit=way.decide)
        states = task.simulated(way.simulations, seed)[:, 1:]
        return {
            "error": fit(layers, self.samples, VALIDATION).validation_error,
            "verdict": verdict.status.name,
            "certified": np.array([_widths(each, task) for each in tube.sets[1:]]),
            "simulated": np.ptp(states @ task.directions.T, axis=0),
            "seconds": seconds,
        }


def _widths(region: rj.AbstractSet, task: Task) -> Float[ndarray, " d"]:
    """Of a set along each direction."""
    return np.asarray(region.support(task.directions) + region.support(-task.directions))
