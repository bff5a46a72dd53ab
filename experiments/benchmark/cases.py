"""What the benchmark measures: its options, and networks with sets of states."""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Literal

import jax
import numpy as np
import tyro
from jaxtyping import ArrayLike, Float
from numpy import ndarray

import reachjax as rj
from experiments.command import require_options
from experiments.double_integrator import study as double_integrator
from experiments.double_integrator.problem import INITIAL_BOX, closed_loop, template

RANDOM_BOX = np.array([[0.25, -0.25], [0.75, 0.25]])  # the size of the paper's X_0, near the kinks

Study = Literal["steps", "growth", "loops", "rivals", "decisions", "limits", "smooth"]


@dataclass(frozen=True)
class Settings:
    """Time Reach-SDP: cvxpy rebuilt for every facet, and other rivals, against this library.

    Trained weights and results are kept under `output`.
    """

    study: tyro.conf.Positional[Study] = "steps"
    """One step of several networks; one facet as networks grow; tubes and training steps; tubes
    beside those of what a user would pick instead; verdicts beside the same; calls that must end in
    time; smooth loops beside what is asked of them."""

    widths: tuple[int, ...] = (10, 20, 32)
    """`steps`: neurons in each of the two hidden layers, one network a width."""
    networks: tuple[Literal["trained", "random"], ...] = ("trained", "random")
    """Trained on the MPC with the paper's initial set, or He-initialised near its kinks."""
    growth: tuple[int, ...] = (4, 10, 20, 32, 64, 100, 200)
    """`growth`: neurons in each of the two hidden layers; bases have 13 to 405 entries."""
    reference_width: int = 32
    """`growth`: cvxpy and Clarabel are timed up to this width."""
    reference_facets: int = 8
    """At most so many are timed with cvxpy rebuilt; fewer are scaled up to 8."""
    loops: tuple[str, ...] = ()
    """`rivals`, `limits`, `smooth`: names of loops as the table has them; all without any."""
    folder: Path | None = None
    """`smooth`: a clone of the competition's repository, whose networks are read; rows whose
    networks are not there are left out."""
    methods: tuple[str, ...] = ()
    """`rivals`, `limits`: names of methods as the table has them; all without any."""
    limit: float = 5.0
    """`limits`: seconds that each call is given."""
    simulations: int = 20_000
    """`rivals`, `smooth`: trajectories whose largest values bounds are compared with; `decisions`:
    those that tell what a set's margin is, and that samples refute by."""
    repetitions: int = 3
    """Warm calls of which the median is taken."""
    patience: float = 60.0
    """Seconds after which a method is not called again, and cvxpy rebuilt for no more facets;
    `rivals`, `decisions`, `limits`: after which a call is ended."""
    clock: Literal["wall", "cpu"] = "wall"
    """What a second is; with one thread, the processor's own are immune to other jobs."""
    samples: int = 500
    """State-input pairs of the MPC that a network is trained on."""
    training_steps: int = 2000
    """Steps of Adam."""
    seed: int = 0
    """Of samples, weights and simulated states."""
    output: Path = Path("results/benchmark")
    """Where everything is written."""

    def __post_init__(self):
        counts = ("widths", "growth", "reference_facets", "training_steps", "simulations")
        sizes = ("repetitions", "patience", "reference_width", "seed")
        require_options(self, **dict.fromkeys(counts, 1), samples=2, **dict.fromkeys(sizes, 0))
        if self.folder is not None and not self.folder.is_dir():
            raise ValueError(f"--folder must be a folder, but {self.folder} arrived")
        if not self.networks:
            raise ValueError("--networks must name at least one kind, but none arrived")


@dataclass(frozen=True, eq=False)
class Case:
    """A network, and the box of states that it starts from."""

    name: str
    layers: list[tuple[np.ndarray, np.ndarray]]
    initial: np.ndarray

    @cached_property
    def loop(self) -> rj.ClosedLoop:
        """The double integrator with this controller."""
        return closed_loop(rj.MLP.from_layers(self.layers))

    @cached_property
    def box(self) -> rj.Box:
        """The states that it starts from."""
        return rj.Box(*self.initial)

    @cached_property
    def template(self) -> rj.Template:
        """The paper's eight facets."""
        return template()

    def support(self, seed: int, count: int = 20_000) -> Float[ndarray, " m"]:
        """The largest simulated value of each facet: no bound can be smaller."""
        return attained(self.loop, self.box, self.template.directions, count, seed)


def attained(
    loop: rj.ClosedLoop, box: rj.Box, directions: ArrayLike, count: int, seed: int
) -> Float[ndarray, " m"]:
    """The largest values of some directions one step after `count` states and a box's corners."""
    states = np.vstack([box.vertices(), box.sample(jax.random.key(seed), count)])
    states = np.clip(states, box.lower, box.upper)  # corners and samples are rounded
    return np.asarray(loop.simulate(states, 1)[:, 1] @ np.asarray(directions).T).max(axis=0)


def cases(settings: Settings) -> list[Case]:
    """The networks, trained ones from their files where they are there."""
    found = []
    for width in settings.widths:
        if "trained" in settings.networks:
            name = f"trained 2x{width}"
            training = double_integrator.Settings(
                hidden=(width, width),
                samples=settings.samples,
                training_steps=settings.training_steps,
                seed=settings.seed,
                output=settings.output,
            )
            fit = double_integrator.controller(name, training.margin, training)
            found.append(Case(name, fit.layers, INITIAL_BOX))
        if "random" in settings.networks:
            found.append(random_case(width, settings.seed))
    return found


def random_case(width: int, seed: int) -> Case:
    """Random weights, and a set on which most neurons switch."""
    return Case(f"random 2x{width}", he_network((2, width, width, 1), seed), RANDOM_BOX)


def he_network(sizes: tuple[int, ...], seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """He-initialised weights and small biases."""
    rng = np.random.default_rng(seed)
    return [
        (rng.normal(size=(out, into)) * np.sqrt(2 / into), 0.1 * rng.normal(size=out))
        for into, out in pairwise(sizes)
    ]
