"""Controllers that are trained to be verifiable, against the same ones trained plainly.

Networks imitate the double integrator's MPC as the paper prints it, which rides on its constraint
`x_2 >= -1`: plain copies undershoot. Each is then trained on for equally many steps in three ways:
*plain*; with a penalty on what its certified sets lack of the *specification*; with that and a
penalty on their *volume*. Compared are imitation errors, verdicts, and areas of the certified sets
and of simulated hulls: the latter tell whether the loop improved, or only the relaxation's slack.
"""

import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import rich

import reachjax as rj
from experiments import report
from experiments.command import bar, configure_jax, require_options
from experiments.double_integrator.problem import linear_mpc
from experiments.double_integrator.study import Settings as Teacher
from experiments.imitation import train_networks
from experiments.sampling import Samples, sample_policy
from experiments.verified_training import figures
from experiments.verified_training.fine_tuning import Outcome, Tuning, run
from experiments.verified_training.step_cost import step_cost


@dataclass(frozen=True)
class Settings:
    """Train controllers of the double integrator with and without penalties, and certify them.

    Everything is kept under `output`; an interrupted run continues with what is there.
    """

    seeds: int = 10
    """Networks, from different random weights."""
    samples: int = Teacher.samples
    """State-input pairs of the MPC that each network learns from."""
    hidden: tuple[int, ...] = Teacher.hidden
    """Neurons of each hidden layer."""
    pretraining_steps: int = Teacher.training_steps
    """Steps of Adam on imitation alone, before the three ways part."""
    steps: int = 800
    """Steps of Adam with penalties, or without."""
    every: int = 10
    """Penalties are computed at one step in so many."""
    learning_rate: float = 1e-3
    """Of these steps; it decays to 0 along a cosine."""
    specification: float = 0.1
    """Weight of what the certified sets lack of the specification."""
    margin: float = 0.005
    """How far they should be from breaking it."""
    volume: float = 0.002
    """Weight of their mean log-volume."""
    decay: float = Teacher.penalty
    """Weight of the squared weights."""
    goals: tuple[float, ...] = (0.25, 0.15, 0.1, 0.08, 0.07, 0.06, 0.05, 0.04)
    """Half-widths of goal boxes to verify as well."""
    simulations: int = 10_000
    """Trajectories simulated for hulls, witnesses and counterexamples."""
    seed: int = 0
    """Of samples and initial weights."""
    workers: int = os.cpu_count() or 1
    """Processes side by side."""
    output: Path = Path("results/verified_training")
    """Where everything is written."""

    def __post_init__(self):
        counts = ("seeds", "hidden", "pretraining_steps", "steps", "every", "simulations")
        positive = ("learning_rate", "specification", "volume", "goals")
        least = dict.fromkeys((*counts, "workers"), 1)
        least |= {"samples": 10, "margin": 0, "decay": 0, "seed": 0}
        require_options(self, *positive, **least)


def ways(settings: Settings) -> dict[str, Tuning]:
    """The three ways to train on."""
    plain = Tuning(
        steps=settings.steps,
        learning_rate=settings.learning_rate,
        every=settings.every,
        specification=0.0,
        margin=settings.margin,
        volume=0.0,
        decay=settings.decay,
        simulations=settings.simulations,
        goals=settings.goals,
    )
    specification = replace(plain, specification=settings.specification)
    return {
        "plain": plain,
        "specification": specification,
        "volume": replace(specification, volume=settings.volume),
    }


def train_on(networks, samples: Samples, settings: Settings) -> dict[str, list[Outcome]]:
    """Every network in every way, in processes side by side."""
    pool = ProcessPoolExecutor(
        settings.workers,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=configure_jax,
        initargs=(settings.output,),
    )
    with bar() as shown, pool:
        jobs = {
            pool.submit(run, layers, samples, tuning, settings.output / way / f"{k}.npz"): (way, k)
            for way, tuning in ways(settings).items()
            for k, layers in enumerate(networks)
        }
        task = shown.add_task("training on and certifying", total=len(jobs))
        try:
            for done in as_completed(jobs):
                done.result()
                shown.advance(task)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    outcomes = {job: done.result() for done, job in jobs.items()}
    return {way: [outcomes[way, k] for k in range(len(networks))] for way in ways(settings)}


def main(settings: Settings) -> None:
    """Sample, train, certify, print, and write figures and results."""
    configure_jax(settings.output)
    mpc = linear_mpc(margin=0.0)
    lower, upper = mpc.state_lower, mpc.state_upper
    path = settings.output / "samples.npz"
    samples = sample_policy(
        mpc, settings.samples, settings.seed, lower=lower, upper=upper, path=path
    )
    fits = train_networks(
        samples,
        settings.hidden,
        settings.seed,
        penalty=settings.decay,
        steps=settings.pretraining_steps,
        restarts=settings.seeds,
        path=settings.output / "networks.npz",
    )
    outcomes = train_on([fit.layers for fit in fits], samples, settings)
    rich.print("timing training steps, about a minute ...")
    cost = step_cost(fits[0].layers, rj.Auto())
    for table in figures.tables(outcomes, settings.goals, cost):
        rich.print(table)
    rich.print("drawing ...")
    figures.draw_tubes(outcomes, settings.output / "tubes.png")
    figures.draw_seeds(outcomes, settings.output / "seeds.png")
    report.write(
        settings.output / "results.json",
        settings,
        outcomes={way: [each.results() for each in group] for way, group in outcomes.items()},
        cost=asdict(cost),
    )
    rich.print(f"written: {settings.output}/tubes.png, seeds.png, results.json and the networks")
