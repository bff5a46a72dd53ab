"""The 6-D quadrotor of Hu, Fazlyab, Morari, Pappas (CDC 2020), section V-B, certified.

A network of two hidden layers imitates a nonlinear MPC that steers the quadrotor to the origin.
Reach-SDP bounds the states of the loop by ellipsoids, and decides whether all states of the initial
one reach a box of positions within one second, ten steps, while position limits hold at all times.
Actuator limits hold by construction: the network's output is projected onto them. The model and the
task, and where they differ from the paper's print, are in `experiments.quadrotor_model`.

    python -m experiments.quadrotor --help
"""

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import rich
from rich.progress import track
from rich.table import Table

import reachjax as rj
from experiments import quadrotor_controller, quadrotor_report, quadrotor_simulation
from experiments.command import at_least_one, blank_table, configure_jax, run_experiment
from experiments.double_integrator import RELAXATIONS
from experiments.imitation import Fit, train_network, training_share
from experiments.quadrotor_model import INPUT_LIMITS, INPUT_NAMES, STEPS, initial_set, plant
from experiments.quadrotor_mpc import QuadrotorMPC
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
        for name in ("training_steps", "simulations"):
            at_least_one(**{f"--{name.replace('_', '-')}": getattr(self, name)})
        if self.samples < 2:
            raise ValueError(f"--samples must be at least 2, but {self.samples} arrived")
        if self.seed < 0:
            raise ValueError(f"--seed must be at least 0, but {self.seed} arrived")
        if not 0 <= self.penalty < math.inf:
            raise ValueError(f"--penalty must be finite and at least 0, but {self.penalty} arrived")
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"--hidden must be numbers of neurons, but {self.hidden} arrived")

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
        quadrotor_controller.use_committed(settings.folder, replacing=usual)
    mpc = quadrotor_controller.teacher(settings.velocity_limits)
    samples = quadrotor_controller.sample(mpc, settings.samples, settings.seed, settings.folder)
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


def loop_with(fit: Fit) -> rj.ClosedLoop:
    """The sampled plant under a network, its output projected onto the actuator limits."""
    return rj.ClosedLoop(plant(), rj.MLP.from_layers(fit.layers), rj.Box(*INPUT_LIMITS))


def closed_loop(settings: Settings) -> rj.ClosedLoop:
    """The loop under the learned controller."""
    return loop_with(learn(settings)[1])


def error_table(mpc: QuadrotorMPC, samples: Samples, fit: Fit, states: np.ndarray) -> Table:
    """How well the network imitates, on held-out samples and where the loop goes."""
    visited = states[:COMPARED, :-1].reshape(-1, states.shape[-1])
    held_out = slice(training_share(samples, VALIDATION), None)
    parts = {
        "held-out samples": (samples.states[held_out], samples.inputs[held_out]),
        f"{COMPARED} trajectories of the loop": (visited, mpc.batch(visited)),
    }
    title = "errors of the projected network: root mean square / largest"
    shown = blank_table(title, "", *INPUT_NAMES)
    for name, (x, u) in parts.items():
        errors = quadrotor_controller.imitation_errors(fit.layers, x, u)
        shown.add_row(name, *(f"{typical:.1e} / {largest:.1e}" for typical, largest in errors.T))
    return shown


def certify(loop: rj.ClosedLoop, states, settings: Settings) -> quadrotor_report.Analysis:
    """The tube of the loop, and the verdict."""
    began = time.perf_counter()
    tube = rj.reach(
        loop,
        initial_set(),
        STEPS,
        rj.EllipsoidTemplate(),
        **RELAXATIONS[settings.relaxation],
        seed=settings.seed,
        progress=lambda steps: track(steps, f"certifying, {settings.relaxation}"),
    )
    seconds = time.perf_counter() - began
    verdict = rj.verify(
        tube,
        goal=None if settings.velocity_limits else quadrotor_report.goal_set(),
        safe=quadrotor_report.safe_set(settings.velocity_limits),
        samples=settings.simulations,
        seed=settings.seed,
    )
    return quadrotor_report.Analysis(settings.relaxation, tube, verdict, states, seconds)


def main(settings: Settings) -> None:
    """Learn, simulate, certify, print, and write the figure and the results."""
    configure_jax(settings.output)
    samples, fit = learn(settings)
    loop = loop_with(fit)
    states = quadrotor_simulation.simulate(
        loop, initial_set(), STEPS, settings.simulations, settings.seed
    )
    mpc = quadrotor_controller.teacher(settings.velocity_limits)
    rich.print(error_table(mpc, samples, fit, states))
    limits = settings.velocity_limits
    rich.print(quadrotor_simulation.table(loop, states, velocity_limits=limits))
    analysis = certify(loop, states, settings)
    rich.print(quadrotor_report.step_table(analysis))
    rich.print(quadrotor_report.position_table(analysis))
    rich.print(quadrotor_report.requirement_table(analysis))
    rich.print(quadrotor_report.NOTE)
    rich.print(f"\n{analysis.verdict}")
    quadrotor_report.draw(analysis, settings.folder / "tubes.png")
    quadrotor_report.write(settings, analysis, settings.folder / "results.json")
    rich.print(f"written: {settings.folder}/tubes.png, results.json, samples.npz and weights.npz")


if __name__ == "__main__":
    run_experiment(main, Settings)
