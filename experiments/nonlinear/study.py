"""Four loops that are not affine, certified, and a fifth that is trained until it is proved.

Each controller imitates a law that is written by hand. Sets by the default method and by affine
forms alone are compared with sampled states, which must not be outside; specifications are decided
from the initial set. The pendulum's second network learns a law that is too weak for its goal, and
is trained on with what its certified sets lack of it.
"""

from dataclasses import dataclass
from pathlib import Path

import rich

from experiments import report
from experiments.command import configure_jax, require_options
from experiments.imitation import train_network
from experiments.nonlinear import figures
from experiments.nonlinear.analysis import Result, analysed
from experiments.nonlinear.problems import PROBLEMS, Layers, Problem, pendulum
from experiments.nonlinear.training import trained_on

WEAK, GOAL = (7.5, 3.0), 0.03
"""Gains of a law that does not bring the pendulum into a goal of this half-width."""


@dataclass(frozen=True)
class Settings:
    """Train controllers of nonlinear loops, certify the loops, and train one until it is proved.

    Networks are kept under `output`; an interrupted run continues with what is there.
    """

    loops: tuple[str, ...] = tuple(PROBLEMS)
    """Which ones: pendulum, car, tora, oscillator."""
    samples: int = 5000
    """State-input pairs of the law that each network learns from."""
    training_steps: int = 5000
    """Steps of Adam on imitation."""
    steps: int = 400
    """Steps of Adam on the specification, at most."""
    simulations: int = 40_000
    """Trajectories that attack the certified sets."""
    seed: int = 0
    """Of samples and initial weights."""
    output: Path = Path("results/nonlinear")
    """Where everything is written."""

    def __post_init__(self):
        least = dict.fromkeys(("training_steps", "steps", "simulations"), 1)
        require_options(self, **least, samples=10, seed=0)
        unknown = [name for name in self.loops if name not in PROBLEMS]
        if unknown or not self.loops:
            raise ValueError(f"--loops must be some of {list(PROBLEMS)}, but {unknown} arrived")


def learned(problem: Problem, name: str, settings: Settings) -> Layers:
    """A network that imitates the law."""
    fit = train_network(
        problem.samples(settings.samples, settings.seed),
        problem.hidden,
        settings.seed,
        penalty=1e-5,
        steps=settings.training_steps,
        learning_rate=3e-3,
        restarts=1,
        standardise=True,
        activation=problem.activation,
        path=settings.output / f"{name}.npz",
    )
    return fit.layers


def until_proved(settings: Settings) -> dict[str, Result]:
    """A pendulum whose network is trained on with its specification, before and after."""
    problem = pendulum(GOAL, WEAK)
    layers = learned(problem, "pendulum-weak", settings)
    samples = problem.samples(500, settings.seed + 1)
    trained = trained_on(problem, layers, samples, settings.steps)
    both = {
        name: analysed(problem.task(each), settings.simulations, settings.seed)
        for name, each in (("weak", layers), ("trained", trained.layers))
    }
    path = settings.output / "training.png"
    figures.draw_training(problem, both["weak"], both["trained"], trained, path)
    return both


def main(settings: Settings) -> None:
    """Train, certify, print, and write figures and results."""
    configure_jax(settings.output)
    results = {}
    for name in settings.loops:
        problem = PROBLEMS[name]()
        rich.print(f"{problem.name} ...")
        layers = learned(problem, name, settings)
        results[name] = analysed(problem.task(layers), settings.simulations, settings.seed)
        figures.draw(problem, results[name], settings.output / f"{name}.png")
    trained = until_proved(settings)
    every = results | trained
    rich.print(figures.table(every))
    numbers = {name: result.numbers() for name, result in every.items()}
    report.write(settings.output / "results.json", settings, results=numbers)
    rich.print(f"written: figures, networks and results.json under {settings.output}")
