"""What is proved of one loop, how large its sets are, and that no sampled state is outside."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

import reachjax as rj
from experiments.task import Task

METHODS: dict[str, rj.AbstractRelaxation] = {
    "default": rj.BranchAndCut(),
    "LinearBounds": rj.LinearBounds(),
}
"""What sets are computed by: the cheapest proof of each facet, and affine forms alone."""


@dataclass(frozen=True, eq=False)
class Result:
    """Of one loop.

    Attributes:
        tube: of the default method.
        states: `(c, horizon + 1, n)`, simulated.
        verdict: on the specification, from the initial set alone.
        volumes: of each method, certified over simulated box volumes at the last step: sampled
            trajectories, and those that climb.
        widths: of each method, the largest certified over simulated width at any step.
        beyond: of each method, how far a sampled state is outside, in parts of a width.
        seconds: of each method, and of the verdict.
    """

    tube: rj.ReachTube
    states: np.ndarray
    verdict: rj.Verdict
    volumes: dict[str, float]
    widths: dict[str, float]
    beyond: dict[str, float]
    seconds: dict[str, float]

    def numbers(self) -> dict[str, Any]:
        """All that a file of results keeps."""
        names = "volumes", "widths", "beyond", "seconds"
        return {"verdict": self.verdict.status.name} | {name: getattr(self, name) for name in names}


def analysed(task: Task, samples: int, seed: int = 0) -> Result:
    """Bound a loop by all methods, attack the sets, and decide its specification."""
    tubes, seconds = {}, {}
    for name, method in METHODS.items():
        tubes[name], seconds[name] = _timed(
            lambda method=method: rj.reach(
                task.loop, task.X0, task.horizon, task.template, method, samples=1000
            )
        )
    verdict, seconds["verdict"] = _timed(
        lambda: rj.decide(task.loop, task.X0, task.horizon, **task.required)
    )
    states = np.asarray(tubes["default"].simulate(samples, seed))
    climbed = [np.asarray(tubes["default"].proof(t + 1).witnesses) for t in range(task.horizon)]
    support = np.fmax(task.support(states), np.stack(climbed))  # of trajectories too
    wide = task.widths(support)
    ratios, beyond = {}, {}
    for name, tube in tubes.items():
        offsets = np.stack([np.asarray(X.b) for X in tube.sets[1:]])
        ratios[name] = task.widths(offsets) / wide
        beyond[name] = float(((support - offsets) / wide).max())
    volumes = {name: float(np.prod(ratio[-1]) ** 0.5) for name, ratio in ratios.items()}
    widths = {name: float(ratio.max()) for name, ratio in ratios.items()}
    return Result(tubes["default"], states, verdict, volumes, widths, beyond, seconds)


def _timed(compute):
    """The second result, once all is compiled, and its seconds."""
    compute()
    began = time.perf_counter()
    found = compute()
    return found, time.perf_counter() - began
