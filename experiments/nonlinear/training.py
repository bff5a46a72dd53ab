"""Training on: what the certified sets lack of a specification is a part of the loss."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax

import reachjax as rj
from experiments.command import bar
from experiments.nonlinear.problems import Layers, Problem
from experiments.sampling import Samples

RATE = 5e-4
"""Of Adam."""

IMITATION = 0.05
"""Weight of the mean squared error at the law's samples."""

MARGIN = 0.005
"""How far the sets should be from breaking the specification, in the units of the state."""


@dataclass(frozen=True, eq=False)
class Trained:
    """A network before and after, and the losses in between.

    Attributes:
        layers: after training.
        shortfalls: `(steps,)`, what the certified sets lacked.
        errors: `(steps,)`, mean squared errors at the samples.
    """

    layers: Layers
    shortfalls: np.ndarray
    errors: np.ndarray


def trained_on(
    problem: Problem, layers: Layers, samples: Samples, steps: int, progress: bool = True
) -> Trained:
    """Adam on the shortfall of affine forms, until it is zero or the steps are over."""
    task = problem.task(layers)
    x, u = jnp.asarray(samples.states), jnp.asarray(samples.inputs)
    optimiser = rj.skip_failures(optax.adam(RATE))

    def losses(layers):
        net = problem.network(layers)
        loop = task.loop.replace(controller=net)
        tube = rj.reach(loop, task.X0, task.horizon, task.template, rj.LinearBounds())
        lacking = rj.shortfall(tube, **task.required, margin=MARGIN)
        error = jnp.mean((jax.vmap(net)(x) - u) ** 2)
        return lacking + IMITATION * error, (lacking, error)

    @partial(jax.jit, compiler_options=rj.compiler_options())
    def step(layers, state):
        slope, parts = jax.grad(losses, has_aux=True)(layers)
        updates, state = optimiser.update(slope, state, layers)
        return optax.apply_updates(layers, updates), state, parts

    layers = jax.tree.map(jnp.asarray, layers)
    state, history = optimiser.init(layers), []
    with bar(progress) as shown:
        for _ in shown.track(range(steps), description="training on"):
            before = layers
            layers, state, parts = step(layers, state)
            history.append(parts)
            if float(parts[0]) == 0.0:
                layers = before  # its sets are proved, the next ones are not known yet
                break
    shortfalls, errors = np.array(history).T
    return Trained(jax.tree.map(np.asarray, layers), shortfalls, errors)
