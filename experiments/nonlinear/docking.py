"""Spacecraft docking in the plane: is the speed limit kept from every state, in forty steps?

    python -m experiments.nonlinear.docking  # one to three minutes on two processes

A chaser of 12 kg moves by the equations of Clohessy and Wiltshire, sampled exactly at a second,
under `tanh` 4-256-256-4-2, which imitates a law. It begins at 70 to 106 m in both coordinates, at
up to 0.28 m/s in both, and must keep `|v| <= 0.2 + 0.002054 |s|`, by half-planes that lie within.

Source: the docking benchmark of Ravaioli, Cunningham, McCarroll, Gangal, Dunlap, Hobbs (2022), in
the form of ARCH-COMP AINNCS, with a network that is trained here.
"""

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read once, when numpy is imported

import jax
import rich
from tqdm import tqdm

import reachjax as rj
from experiments import report
from experiments.benchmark.rivals.processes import workers
from experiments.command import configure_jax, require_options, run_experiment
from experiments.imitation import train_network
from experiments.sampling import Samples

MASS = 12.0
"""Of the chaser, in kg."""

MOTION = 0.001027
"""The mean motion of the target, in 1/s."""

REST, SLOPE = 0.2, 2 * MOTION
"""The speed that is allowed at the target, in m/s, and by how much more at each metre from it."""

HALF_PLANES = 16
"""So many stand for the limit in each direction of the speed: 2 % within it."""

HORIZON = 40
"""Seconds, and steps."""

CENTER = np.array([88.0, 88.0, 0.0, 0.0])
RADII = np.array([18.0, 18.0, 0.28, 0.28])
"""Of the initial set."""


@dataclass(frozen=True)
class Settings:
    """Train a controller that docks, and decide whether it keeps the speed limit."""

    samples: int = 20_000
    """State-input pairs of the law that the network learns from."""
    training_steps: int = 3000
    """Steps of Adam on imitation."""
    processes: int = 2
    """Which cells run on."""
    time_limit: float = 900.0
    """Seconds for the decision."""
    part: float = 1.0
    """Of the initial set's widths, around its corner that is farthest away."""
    output: Path = Path("results/nonlinear")
    """Where everything is written."""

    def __post_init__(self):
        require_options(self, samples=10, training_steps=1, processes=1)
        if not 0 < self.part <= 1:
            raise ValueError(f"--part must be above 0 and at most 1, but {self.part} arrived")


def law(states: Float[ndarray, "c 4"]) -> Float[ndarray, "c 2"]:
    """Forces that bring the velocity to 0.0012/s of the way to the target."""
    return 1.2 * (-0.0012 * states[:, :2] - states[:, 2:])


def learned(settings: Settings) -> rj.MLP:
    """A network that imitates the law, around the initial set and between it and the target."""
    spread = np.array([78.0, 78.0, 0.46, 0.46])
    rng = np.random.default_rng(0)
    states = np.array([70.0, 70.0, 0.0, 0.0]) + rng.uniform(-spread, spread, (settings.samples, 4))
    fit = train_network(
        Samples(states, law(states)),
        (256, 256, 4),
        penalty=1e-4,
        steps=settings.training_steps,
        learning_rate=2e-3,
        restarts=1,
        standardise=True,
        activation="tanh",
        path=settings.output / "docking.npz",
    )
    return rj.MLP.from_layers(fit.layers, rj.Tanh())


def equations() -> tuple[Float[ndarray, "4 4"], Float[ndarray, "4 2"]]:
    """The matrices of Clohessy and Wiltshire."""
    n = MOTION
    A = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [3 * n**2, 0, 0, 2 * n], [0, 0, -2 * n, 0]])
    return A, np.vstack([np.zeros((2, 2)), np.eye(2) / MASS])


def closed(net: rj.AbstractNetwork) -> rj.ClosedLoop:
    """The loop."""
    return rj.ClosedLoop(rj.zero_order_hold(*equations(), period=1.0), net)


def limit() -> rj.Polytope:
    """States that surely keep the limit, where both positions are positive.

    `d . v <= cos(pi / k) (0.2 + 0.002054 e . s)` for unit vectors `d` and `e`: `k` of `d` all
    around, and `e` in the middle of the quadrant, since `e . s <= |s|`.
    """
    angles = np.pi / 4 + 2 * np.pi * (np.arange(HALF_PLANES) + 0.5) / HALF_PLANES
    speeds = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    shorter = np.cos(np.pi / HALF_PLANES)
    towards = np.full((HALF_PLANES, 2), np.sqrt(0.5))
    rows = np.hstack([-SLOPE * shorter * towards, speeds])
    return rj.Polytope(rows, np.full(HALF_PLANES, REST * shorter))


def initial(part: float) -> rj.Box:
    """The part of the initial set around the corner that is farthest away, and fastest."""
    middle = CENTER + RADII * (1 - part)
    return rj.Box(middle - RADII * part, middle + RADII * part)


def room(states: Float[ndarray, "*c 4"]) -> Float[ndarray, "*c"]:
    """By how much states keep the limit itself, in m/s."""
    away, speed = (np.linalg.norm(states[..., part], axis=-1) for part in (slice(2), slice(2, 4)))
    return REST + SLOPE * away - speed


def decided(loop: rj.ClosedLoop, X0: rj.Box, settings: Settings) -> tuple[rj.Verdict, float]:
    """The verdict, and its seconds."""
    options: dict[str, Any] = {"cells": 1_000_000, "time_limit": settings.time_limit}
    options |= {"safe": limit(), "progress": tqdm}
    began = time.perf_counter()
    with workers(settings.processes) as executor:
        verdict = rj.decide(loop, X0, HORIZON, executor=executor, **options)
        return verdict, time.perf_counter() - began


def draw(verdict: rj.Verdict, states: Float[ndarray, "c t 4"], path: Path) -> None:
    """The cells, and speeds over distances beside the limit."""
    figure, ((left, right),) = report.panels(1, 2, (11, 4.2))
    rj.plot_cells(verdict, left, coordinates=(2, 3))
    left.set(xlabel="$v_1$ (m/s)", ylabel="$v_2$ (m/s)")
    away, speed = (np.linalg.norm(states[..., part], axis=-1) for part in (slice(2), slice(2, 4)))
    right.scatter(
        away[:, 1:], speed[:, 1:], s=0.3, color="tab:blue", label="simulated", rasterized=True
    )
    right.scatter(away[:, 0], speed[:, 0], s=0.3, color="black", label="at first", rasterized=True)
    ends = np.array([away.min(), away.max()])
    right.plot(ends, REST + SLOPE * ends, color="tab:red", label="limit")
    right.set(xlabel="distance (m)", ylabel="speed (m/s)")
    above = {"loc": "lower center", "bbox_to_anchor": (0.5, 1), "ncols": 3, "frameon": False}
    right.legend(**above, markerscale=12)
    figure.savefig(path, dpi=150)


def main(settings: Settings) -> None:
    """Train, decide, print, and write a figure and results."""
    configure_jax(settings.output)
    loop, X0 = closed(learned(settings)), initial(settings.part)
    states = np.concatenate([X0.corners(), X0.sample(jax.random.key(0), 2000)])
    states = np.asarray(loop.simulate(states, HORIZON))
    verdict, seconds = decided(loop, X0, settings)
    rich.print(verdict)
    least = float(room(states).min())
    rich.print(f"in {seconds:.0f} s; the least room of simulated states is {least:.3f} m/s")
    draw(verdict, states, settings.output / "docking.png")
    found = {"verdict": verdict.status.name, "seconds": seconds, "cells": len(verdict.cells)}
    report.write(settings.output / "docking.json", settings, results=found | {"room": least})


if __name__ == "__main__":
    run_experiment(main, Settings)
