"""The double integrator of Hu, Fazlyab, Morari, Pappas (CDC 2020), section V-A, certified.

Two networks imitate a linear MPC. The one *as printed* learns from the MPC as the paper states it,
which rides on its state constraint `x_2 >= -1`: a learned copy undershoots. The one *with a margin*
learns from the same MPC with its state constraint tightened. For both, Reach-SDP bounds the states
that are reachable from `[2.5, 3] x [-0.25, 0.25]` in six steps, and decides whether all of them
reach `[-0.25, 0.25]^2` while the state constraint holds at all times.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import rich

import reachjax as rj
from experiments import report
from experiments.analysis import Analysis
from experiments.command import configure_jax, require_options
from experiments.double_integrator import figures
from experiments.double_integrator.problem import (
    GOAL_BOX,
    HORIZON,
    INITIAL_BOX,
    STATE_BOX,
    closed_loop,
    linear_mpc,
    template,
)
from experiments.imitation import Fit, train_network
from experiments.sampling import sample_policy

SOLVERS = {
    "auto": rj.Auto(),
    "clarabel": rj.Clarabel(),
    "interior-point": rj.InteriorPoint(),
    "scs": rj.SCS(),
}


@dataclass(frozen=True)
class Settings:
    """Certify two learned controllers of the double integrator with Reach-SDP.

    Samples, weights, results and the figure are kept under `output`; a second run uses the samples
    and weights again.
    """

    horizon: int = HORIZON
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
        require_options(
            self,
            horizon=1,
            facets=3,
            margin=0,
            samples=2,
            hidden=1,
            training_steps=1,
            penalty=0,
            seed=0,
            simulations=1,
        )
        if not self.margin < 1:
            raise ValueError(f"--margin must be below 1, but {self.margin} arrived")
        if not self.relaxation:
            raise ValueError("--relaxation must name at least one relaxation, but none arrived")


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


def certify(name: str, fit: Fit, relaxation: str, settings: Settings) -> Analysis:
    """The tube of one controller under one relaxation, and the verdict."""
    return Analysis.of(
        name,
        relaxation,
        closed_loop(rj.MLP.from_layers(fit.layers)),
        rj.Box(*INITIAL_BOX),
        settings.horizon,
        template(settings.facets),
        goal=rj.Box(*GOAL_BOX),
        safe=rj.Box(*STATE_BOX),
        simulations=settings.simulations,
        seed=settings.seed,
        solver=SOLVERS[settings.solver],
        samples=settings.simulations,
    )


def main(settings: Settings) -> None:
    """Train, certify, print, and write the figure and the results."""
    configure_jax(settings.output)
    margins = {"as printed": 0.0, "with margin": settings.margin}
    fits = {name: controller(name, margin, settings) for name, margin in margins.items()}
    analyses = [
        [certify(name, fit, relaxation, settings) for name, fit in fits.items()]
        for relaxation in settings.relaxation
    ]
    every = [analysis for pair in analyses for analysis in pair]
    for pair in analyses:
        rich.print(figures.step_table(pair))
    rich.print(figures.verdict_table(every))
    rich.print(figures.NOTE)
    for analysis in analyses[0]:
        rich.print(f"\n[bold]controller {analysis.controller}, {analysis.relaxation}[/bold]")
        rich.print(str(analysis.verdict))
    figures.draw(analyses[0], settings.output / "tubes.png")
    report.write(
        settings.output / "results.json",
        settings,
        imitation={
            name: {"training": fit.training_error, "validation": fit.validation_error}
            for name, fit in fits.items()
        },
        analyses=[each.results() | {"steps": figures.steps(each)} for each in every],
    )
    rich.print(
        f"written: {settings.output}/tubes.png, results.json, and for each controller "
        "samples.npz and weights.npz"
    )
