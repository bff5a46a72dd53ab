"""A loop certified: its tube under one relaxation, the verdict, and simulated states beside it."""

import time
from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from rich.progress import track

import reachjax as rj

RELAXATIONS = {
    "cutting-planes": {"relaxation": rj.CuttingPlanes(), "window": None},
    "local-bounds": {"relaxation": rj.LocalBounds(), "window": 1},
    "paper-repeated": {"relaxation": rj.PaperQC(repeated=True), "window": 1},
    "paper": {"relaxation": rj.PaperQC(repeated=False), "window": 1},
}
"""Cutting planes reach back to the initial set, the others one step."""


@dataclass(frozen=True, eq=False)
class Analysis:
    """A certified tube of the loop under one controller and one relaxation.

    Attributes:
        controller: its name.
        relaxation: its name.
        tube: what is certified.
        verdict: of the specification.
        states: simulated ones, to compare with.
        seconds: of the tube.
    """

    controller: str
    relaxation: str
    tube: rj.ReachTube
    verdict: rj.Verdict
    states: Float[ndarray, "count steps+1 n_x"]
    seconds: float

    @classmethod
    def of(
        cls,
        controller: str,
        relaxation: str,
        loop: rj.ClosedLoop,
        *task: Any,
        goal: rj.PolyhedralSet | None,
        safe: rj.PolyhedralSet,
        simulations: int,
        seed: int,
        states: Float[ndarray, "count steps+1 n_x"] | None = None,
        **options: Any,
    ) -> Self:
        """Certify, verify, and simulate.

        Args:
            controller: its name.
            relaxation: one of `RELAXATIONS`.
            loop: the closed loop.
            task: initial set, horizon and template, as `reachjax.tubes.reach` takes them.
            goal: where the last states must be, if anywhere.
            safe: where all states must be.
            simulations: trajectories that look for a counterexample.
            seed: of simulated trajectories.
            states: simulated ones, made here without.
            options: others of `reachjax.tubes.reach`.
        """
        began = time.perf_counter()
        tube = rj.reach(
            loop,
            *task,
            **RELAXATIONS[relaxation],
            seed=seed,
            progress=lambda steps: track(steps, f"{relaxation}, controller {controller}"),
            **options,
        )
        seconds = time.perf_counter() - began
        verdict = rj.verify(tube, goal=goal, safe=safe, samples=simulations, seed=seed)
        if states is None:
            states = np.asarray(tube.simulate(simulations, seed))
        return cls(controller, relaxation, tube, verdict, states, seconds)

    def results(self) -> dict:
        """Names, verdict, margins, and the trajectory that refutes, if there is one."""
        verdict, example = self.verdict, self.verdict.counterexample
        margins = {"margins": verdict.margins, "simulated": verdict.simulated}
        return {
            "controller": self.controller,
            "relaxation": self.relaxation,
            "verdict": verdict.status.name,
            **{name: _smallest(values) for name, values in margins.items()},
            "counterexample": None if example is None else asdict(example),
            "seconds": self.seconds,
        }


def _smallest(margins) -> dict[str, float]:
    return {name: float(np.nanmin(values)) for name, values in margins.items()}
