"""The 6-D quadrotor of Hu, Fazlyab, Morari, Pappas (CDC 2020), section V-B, certified.

A network of two hidden layers imitates a nonlinear MPC that steers the quadrotor to the origin.
Reach-SDP bounds the states of the loop by ellipsoids, and decides whether all states of the initial
one reach a box of positions within one second, ten steps, while position limits hold at all times.
Actuator limits hold by construction: the network's output is projected onto them. The model and the
task, and where they differ from the paper's print, are in `experiments.quadrotor.model`.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import rich
from rich.table import Table

import reachjax as rj
from experiments import report
from experiments.analysis import Analysis
from experiments.command import configure_jax, require_options
from experiments.imitation import Fit, train_network, training_share
from experiments.quadrotor import controller, figures, simulation
from experiments.quadrotor.model import (
    INPUT_NAMES,
    STEPS,
    goal_set,
    initial_set,
    loop_with,
    safe_set,
)
from experiments.quadrotor.mpc import QuadrotorMPC
from experiments.sampling import Samples

VALIDATION = 0.1
"""Share of the samples that is not trained on."""
COMPARED = 20
"""Trajectories of the loop along which the network is compared with the MPC."""


@dataclass(frozen=True)
class Settings:
    """Learn the quadrotor's controller, simulate the loop, and certify it with Reach-SDP.

    Samples, weights, results and the figure are kept under `output`; samples and weights are first
    copies of those that come with the experiment, made anew when settings differ from theirs.
    """

    relaxation: Literal["local-bounds", "paper-repeated", "paper"] = "local-bounds"
    """Which products of facts are used; "paper" leaves out lambda_ij. The paper's two keep every
    neuron in the program: seconds a step, minutes with lambda_ij, and here far too loose."""
    samples: int = 4531
    """State-input pairs of the MPC that the network learns from."""
    hidden: tuple[int, ...] = (32, 32)
    """Neurons of each hidden layer."""
    training_steps: int = 10_000
    """Steps of Adam."""
    penalty: float = 1e-4
    """Weight of the squared weights in the training loss: a low gain keeps relaxations tight."""
    seed: int = 0
    """Of samples, initial weights and simulated trajectories."""
    simulations: int = 100_000
    """Trajectories simulated, half of them from the boundary of the initial set."""
    velocity_limits: bool = False
    """Keep the paper's `|v| <= 1` in place of the goal, which they put out of reach: another MPC,
    sampled first (minutes)."""
    resample: bool = False
    """Solve the MPC for all samples (minutes) and train on these, in a folder `resampled`."""
    retrain: bool = False
    """Train again although the weights are there."""
    output: Path = Path("results/quadrotor")
    """Where everything is written."""

    def __post_init__(self):
        require_options(
            self, samples=2, hidden=1, training_steps=1, penalty=0, seed=0, simulations=1
        )

    @property
    def folder(self) -> Path:
        """Where samples and weights are, and where results go."""
        folder = self.output / "velocity_limits" if self.velocity_limits else self.output
        return folder / "resampled" if self.resample else folder


def learn(settings: Settings) -> tuple[Samples, Fit]:
    """The samples and the network fitted to them, stored ones where there are."""
    if settings.folder == settings.output:
        learned = ("samples", "hidden", "training_steps", "penalty", "seed")
        usual = all(getattr(settings, name) == getattr(Settings, name) for name in learned)
        controller.use_committed(settings.folder, replacing=usual)
    mpc = controller.teacher(settings.velocity_limits)
    samples = controller.sample(mpc, settings.samples, settings.seed, settings.folder)
    fit = train_network(
        samples,
        settings.hidden,
        settings.seed,
        penalty=settings.penalty,
        steps=settings.training_steps,
        validation=VALIDATION,
        standardise=True,
        path=settings.folder / "weights.npz",
        retrain=settings.retrain,
    )
    return samples, fit


def closed_loop(settings: Settings) -> rj.ClosedLoop:
    """The loop under the learned controller."""
    return loop_with(learn(settings)[1].layers)


def error_table(mpc: QuadrotorMPC, samples: Samples, fit: Fit, states: np.ndarray) -> Table:
    """How well the network imitates, on held-out samples and where the loop goes."""
    visited = states[:COMPARED, :-1].reshape(-1, states.shape[-1])
    held_out = slice(training_share(samples, VALIDATION), None)
    parts = {
        "held-out samples": (samples.states[held_out], samples.inputs[held_out]),
        f"{COMPARED} trajectories of the loop": (visited, mpc.batch(visited)),
    }
    rows = []
    for name, (x, u) in parts.items():
        errors = controller.imitation_errors(fit.layers, x, u)
        rows.append([name, *(f"{typical:.1e} / {largest:.1e}" for typical, largest in errors.T)])
    title = "errors of the projected network: root mean square / largest"
    return report.table(title, ("",), INPUT_NAMES, rows)


def certify(loop: rj.ClosedLoop, states: np.ndarray, settings: Settings) -> Analysis:
    """The tube of the loop, and the verdict."""
    limited = settings.velocity_limits
    return Analysis.of(
        "learned",
        settings.relaxation,
        loop,
        initial_set(),
        STEPS,
        rj.EllipsoidTemplate(),
        goal=None if limited else goal_set(),
        safe=safe_set(limited),
        simulations=settings.simulations,
        seed=settings.seed,
        states=states,
    )


def main(settings: Settings) -> None:
    """Learn, simulate, certify, print, and write the figure and the results."""
    configure_jax(settings.output)
    samples, fit = learn(settings)
    loop, limited = loop_with(fit.layers), settings.velocity_limits
    count, seed = settings.simulations, settings.seed
    states = simulation.simulate(loop, initial_set(), STEPS, count, seed)
    rich.print(error_table(controller.teacher(limited), samples, fit, states))
    found = simulation.extremes(loop, states, velocity_limits=limited)
    rich.print(simulation.table("simulation", "simulated", found))
    analysis = certify(loop, states, settings)
    rich.print(figures.step_table(analysis))
    rich.print(figures.position_table(analysis))
    rich.print(figures.requirement_table(analysis))
    rich.print(figures.NOTE)
    rich.print(f"\n{analysis.verdict}")
    figures.draw(analysis, settings.folder / "tubes.png")
    report.write(settings.folder / "results.json", settings, **figures.results(analysis))
    rich.print(f"written: {settings.folder}/tubes.png, results.json, samples.npz and weights.npz")
