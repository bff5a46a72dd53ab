"""The double integrator of Hu, Fazlyab, Morari, Pappas (CDC 2020), section V-A, certified.

Two networks imitate a linear MPC. The one *as printed* learns from the MPC as the paper states it,
which rides on its state constraint `x_2 >= -1`: a learned copy undershoots. The one *with a margin*
learns from the same MPC with its state constraint tightened. For both, Reach-SDP bounds the states
that are reachable from `[2.5, 3] x [-0.25, 0.25]` in six steps, and decides whether all of them
reach `[-0.25, 0.25]^2` while the state constraint holds at all times.

    python -m experiments.double_integrator --help
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import rich
from rich.progress import track

import reachjax as rj
from experiments import report
from experiments.command import configure_jax, run_experiment
from experiments.imitation import Fit, train_network
from experiments.mpc import LinearMPC
from experiments.sampling import sample_policy

RELAXATIONS = {
    "cutting-planes": {"relaxation": rj.CuttingPlanes(), "window": None},
    "local-bounds": {"relaxation": rj.LocalBounds(), "window": 1},
    "paper-repeated": {"relaxation": rj.PaperQC(repeated=True), "window": 1},
    "paper": {"relaxation": rj.PaperQC(repeated=False), "window": 1},
}
SOLVERS = {
    "auto": rj.Auto(),
    "clarabel": rj.Clarabel(),
    "interior-point": rj.InteriorPoint(),
    "scs": rj.SCS(),
}
A, B = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])
STATE_BOX = np.array([[-5.0, -1.0], [5.0, 1.0]])
INPUT_BOX = np.array([[-1.0], [1.0]])
INITIAL_BOX = np.array([[2.5, -0.25], [3.0, 0.25]])
GOAL_BOX = np.array([[-0.25, -0.25], [0.25, 0.25]])


@dataclass(frozen=True)
class Settings:
    """Certify two learned controllers of the double integrator with Reach-SDP.

    Samples, weights, results and the figure are kept under `output`; a second run uses the samples
    and weights again.
    """

    horizon: int = 6
    """Steps N after which the goal must be reached."""
    facets: int = 8
    """Facets of every set: 8 are the paper's, another number gives equal angles."""
    relaxation: tuple[Literal["cutting-planes", "local-bounds", "paper-repeated", "paper"], ...] = (
        "cutting-planes",
        "local-bounds",
        "paper-repeated",
        "paper",
    )
    """Which relaxations to compare; the figure shows the first. Cutting planes reach back to the
    initial set, the others one step; "paper" leaves out lambda_ij."""
    solver: Literal["auto", "clarabel", "interior-point", "scs"] = "auto"
    """What solves the semidefinite programs."""
    margin: float = 0.2
    """How far the second controller's MPC stays from the state constraint."""
    samples: int = 2420
    """State-input pairs of the MPC that each network learns from."""
    hidden: tuple[int, ...] = (10, 5)
    """Neurons of each hidden layer."""
    training_steps: int = 20_000
    """Steps of Adam."""
    penalty: float = 1e-4
    """Weight of the squared weights in the training loss: a low gain keeps relaxations tight."""
    seed: int = 0
    """Of samples, initial weights and simulated trajectories."""
    simulations: int = 20_000
    """Trajectories simulated for hulls, witnesses and counterexamples."""
    retrain: bool = False
    """Train again although the weights are there."""
    output: Path = Path("results/double_integrator")
    """Where everything is written."""

    def __post_init__(self):
        at_least = {
            "horizon": 1,
            "facets": 3,
            "samples": 2,
            "training_steps": 1,
            "simulations": 1,
            "seed": 0,
        }
        for name, least in at_least.items():
            if getattr(self, name) < least:
                raise ValueError(
                    f"--{name.replace('_', '-')} must be at least {least}, "
                    f"but {getattr(self, name)} arrived"
                )
        if not 0 <= self.margin < 1:
            raise ValueError(f"--margin must be in [0, 1), but {self.margin} arrived")
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"--hidden must be numbers of neurons, but {self.hidden} arrived")
        if not self.relaxation:
            raise ValueError("--relaxation must name at least one relaxation, but none arrived")


def linear_mpc(margin: float) -> LinearMPC:
    """The paper's MPC with its state constraint tightened by `margin`."""
    return LinearMPC(
        A,
        B,
        Q=np.eye(2),
        R=np.eye(1),
        horizon=10,
        state_lower=STATE_BOX[0] + margin,
        state_upper=STATE_BOX[1] - margin,
        input_lower=INPUT_BOX[0],
        input_upper=INPUT_BOX[1],
    )


def controller(name: str, margin: float, settings: Settings) -> Fit:
    """Sample the MPC whose state constraint is tightened by `margin`, and fit a network to it."""
    rich.print(f"[bold]controller {name}[/bold]")
    folder = settings.output / name.replace(" ", "_")
    samples = sample_policy(
        linear_mpc(margin),
        settings.samples,
        settings.seed,
        lower=STATE_BOX[0],
        upper=STATE_BOX[1],
        path=folder / "samples.npz",
    )
    return train_network(
        samples,
        settings.hidden,
        settings.seed,
        penalty=settings.penalty,
        steps=settings.training_steps,
        path=folder / "weights.npz",
        retrain=settings.retrain,
    )


def certify(name: str, fit: Fit, relaxation: str, settings: Settings) -> report.Analysis:
    """The tube of one controller under one relaxation, and the verdict."""
    plant, net = rj.AffinePlant(A, B), rj.MLP.from_layers(fit.layers)
    loop = rj.ClosedLoop(plant, net, input_box=rj.Box(*INPUT_BOX))
    eight = settings.facets == 8
    template = rj.Template.octagonal(2) if eight else rj.Template.regular(settings.facets)
    began = time.perf_counter()
    tube = rj.reach(
        loop,
        rj.Box(*INITIAL_BOX),
        settings.horizon,
        template,
        **RELAXATIONS[relaxation],
        solver=SOLVERS[settings.solver],
        samples=settings.simulations,
        seed=settings.seed,
        progress=lambda steps: track(steps, f"{relaxation}, controller {name}"),
    )
    seconds = time.perf_counter() - began
    verdict = rj.verify(
        tube,
        goal=rj.Box(*GOAL_BOX),
        safe=rj.Box(*STATE_BOX),
        samples=settings.simulations,
        seed=settings.seed,
    )
    states = np.asarray(tube.simulate(settings.simulations, settings.seed))
    return report.Analysis(name, relaxation, tube, verdict, states, seconds)


def main(settings: Settings) -> None:
    """Train, certify, print, and write the figure and the results."""
    configure_jax(settings.output)
    margins = {"as printed": 0.0, "with margin": settings.margin}
    fits = {name: controller(name, margin, settings) for name, margin in margins.items()}
    analyses = [
        [certify(name, fit, relaxation, settings) for name, fit in fits.items()]
        for relaxation in settings.relaxation
    ]
    for pair in analyses:
        rich.print(report.step_table(pair))
    rich.print(report.verdict_table([analysis for pair in analyses for analysis in pair]))
    rich.print(report.NOTE)
    for analysis in analyses[0]:
        rich.print(f"\n[bold]controller {analysis.controller}, {analysis.relaxation}[/bold]")
        rich.print(str(analysis.verdict))
    report.draw(analyses[0], GOAL_BOX, STATE_BOX, settings.output / "tubes.png")
    report.write(settings, fits, analyses, settings.output / "results.json")
    rich.print(
        f"written: {settings.output}/tubes.png, results.json, and for each controller "
        "samples.npz and weights.npz"
    )


if __name__ == "__main__":
    run_experiment(main, Settings)
