"""What a training step with a volume penalty costs, and where the time goes."""

import statistics
import time
from dataclasses import dataclass

import jax
import numpy as np

import reachjax as rj
from experiments.verified_training.fine_tuning import certified_tube

HORIZON = 5
REPETITIONS = 15


@dataclass(frozen=True)
class StepCost:
    """Medians over `REPETITIONS` runs of compiled code, forward and both passes by turns.

    Attributes:
        first: seconds of the first call of value and gradient, compilation included.
        forward: seconds of the value.
        both: seconds of value and gradient.
        solver: seconds of the forward pass inside cvxpy and the solver.
    """

    first: float
    forward: float
    both: float
    solver: float

    @property
    def backward(self) -> float:
        """The gradient's cost over the value's."""
        return self.both / self.forward - 1


def step_cost(layers, solver: rj.AbstractSolver) -> StepCost:
    """Time the mean log-volume of five certified sets of eight facets, and its gradient."""
    net = rj.MLP.from_layers(layers)

    def size(net):
        tube = certified_tube(net, HORIZON, solver=solver)
        seconds = sum(tube.proof(t).seconds.sum() for t in range(1, HORIZON + 1))
        return rj.log_volume(tube) / HORIZON, seconds

    value = jax.jit(size)
    gradient = jax.jit(jax.value_and_grad(size, has_aux=True))

    def seconds(function) -> float:
        began = time.perf_counter()
        jax.block_until_ready(function(net))
        return time.perf_counter() - began

    first = seconds(gradient)
    seconds(value)
    forward, both, solving = [], [], []
    for _ in range(REPETITIONS):
        forward.append(seconds(value))
        both.append(seconds(gradient))
        solving.append(float(np.asarray(value(net)[1])))
    return StepCost(first, *map(statistics.median, (forward, both, solving)))
