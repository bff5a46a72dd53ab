"""What the interior-point method's answers are worth: agreement, and many products.

    python -m experiments.benchmark.interior_point agreement | products

`agreement`: random loops, degenerate ones among them, against Clarabel and simulated successors.
`products`: programs that grow by the products of facts which the last moment matrix violates most.
`python -m experiments.benchmark growth` measures its speed.
"""

import os
from dataclasses import dataclass, field
from itertools import product
from typing import Any, Literal

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read once, when numpy is imported

import jax
import numpy as np
import rich
import tyro
from rich.progress import track

import reachjax as rj
from experiments import report
from experiments.benchmark.cases import attained, he_network
from experiments.command import require_options, run_experiment

THIN = 1e-5
AGREEMENT_NOTE = """\
solved, Clarabel: facets that each solves
optima: largest difference of their optimal values where both do
looser: most by which our bound exceeds Clarabel's where it solves, and how
often by more than 1e-5;  both as parts of the interval's radius
support: least bound less simulated support: negative would be unsound"""
RELAXATIONS = (
    *(rj.PaperQC(*flags) for flags in product((False, True), repeat=2)),
    *(rj.LocalBounds(*flags) for flags in product((False, True), repeat=2)),
)


@dataclass(frozen=True)
class Settings:
    """Measure the interior-point method."""

    study: tyro.conf.Positional[Literal["agreement", "products"]]
    """What is measured."""
    widths: tuple[int, ...] = (20, 32)
    """Neurons in each of two hidden layers in `products`."""
    programs: int = 200
    """How many random programs `agreement` solves."""
    rounds: int = 8
    """How often products are added."""
    batch: int = 60
    """How many are added at a time."""
    seeds: int = 3
    """Networks of each width in `products`."""
    radius: float = 2.0
    """Of their set of states."""

    def __post_init__(self):
        counts = ("widths", "programs", "rounds", "batch", "seeds")
        require_options(self, "radius", **dict.fromkeys(counts, 1))


@dataclass(frozen=True, eq=False)
class Recorded(rj.AbstractSolver):
    """A solver, the programs that it was given, and its answers."""

    solver: rj.AbstractSolver
    answers: list[tuple[Any, Any]] = field(default_factory=list)

    def solve(self, program, goal):
        """As the solver does."""
        self.answers.append((program, self.solver.solve(program, goal)))
        return self.answers[-1][1]


def random_step(seed: int) -> tuple[rj.ClosedLoop, rj.Box, rj.Template, rj.AbstractRelaxation]:
    """A small loop, its box (a third of them flat or thin in one direction), facets, relaxation."""
    rng = np.random.default_rng(seed)
    n_x, hidden = int(rng.integers(1, 4)), [(6, 4), (5,), (8, 6)][rng.integers(3)]
    layers = he_network((n_x, *hidden, 1), seed)
    for _, bias in layers[:-1]:
        bias += rng.choice([0.0, 0.0, 20.0, -20.0], p=[0.4, 0.2, 0.2, 0.2]) * (
            np.arange(len(bias)) < rng.integers(len(bias) + 1)
        )
    plant = rj.AffinePlant(0.6 * rng.normal(size=(n_x, n_x)), rng.normal(size=(n_x, 1)))
    limits = rj.Box([-0.5], [0.7]) if rng.integers(2) else None
    lower, width = rng.uniform(-1, 1, n_x), rng.uniform(0.2, 1.0, n_x)
    width[0] *= rng.choice([1.0, 1.0, 0.0, 1e-6])
    loop = rj.ClosedLoop(plant, rj.MLP.from_layers(layers), input_box=limits)
    template = rj.Template(np.vstack([np.eye(n_x), -np.eye(n_x), rng.normal(size=(1, n_x))]))
    return loop, rj.Box(lower, lower + width), template, RELAXATIONS[seed % len(RELAXATIONS)]


def agreement(settings: Settings) -> None:
    """Statuses, differences to Clarabel's solved facets, and bounds less simulated supports."""
    rows: dict[str, list] = {"with interior": [], "flat": [], "thin (1e-6)": []}
    for seed in track(range(settings.programs), "programs"):
        loop, box, template, relaxation = random_step(seed)
        solvers = rj.InteriorPoint(), rj.Clarabel()
        ours, theirs = (_facets(loop, box, template, relaxation, each) for each in solvers)
        width = float(box.upper[0] - box.lower[0])
        kind = "flat" if width == 0 else "thin (1e-6)" if width < THIN else "with interior"
        # the basis is scaled to [-1, 1]
        radius = abs(np.asarray(ours.program.objective.mid)[:, :-1]).sum(axis=1)
        size = np.maximum(radius, 1e-9)
        parts = (
            *(np.asarray(each.codes) == rj.SolverStatus.SOLVED for each in (ours, theirs)),
            abs(ours.solver_offsets - theirs.solver_offsets) / size,
            (ours.bounds - theirs.bounds) / size,
            ours.bounds - attained(loop, box, template.directions, 2000, seed),
        )
        rows[kind] += list(zip(*map(np.asarray, parts), strict=True))
    headings = ("facets", "solved", "Clarabel", "optima", "looser", "> 1e-5", "support")
    shown = [
        (kind, *_summary(*map(np.array, zip(*found, strict=True))))
        for kind, found in rows.items()
        if found
    ]
    title = f"{settings.programs} programs: InteriorPoint and Clarabel"
    rich.print(report.table(title, ("sets",), headings, shown))
    rich.print(AGREEMENT_NOTE)


def _facets(loop, box, template, relaxation, solver) -> rj.Certificate:
    """What one solver proves."""
    options = {"relaxation": relaxation, "solver": solver, "samples": 1}
    proof = rj.reach_step(loop, box, template, **options)[1]
    assert isinstance(proof, rj.Certificate)
    return proof


def _summary(ours, theirs, optima, looser, support) -> tuple[str, ...]:
    """The cells of one row."""
    looser = np.where(theirs, looser, 0.0)
    return (
        *(str(count) for count in (len(ours), ours.sum(), theirs.sum())),
        f"{np.where(ours & theirs, optima, 0.0).max():.0e}",
        f"{looser.max():.0e}",
        str((looser > 1e-5).sum()),
        f"{support.min():.0e}",
    )


def products(settings: Settings) -> None:
    """Rounds of violated products on wide sets: low-rank optimal faces, ever more multipliers."""
    cuts, merits = rj.CuttingPlanes(settings.rounds, settings.batch, gap=0.0), []
    for width, seed in product(settings.widths, range(settings.seeds)):
        rng = np.random.default_rng(seed)
        net = rj.MLP.from_layers(he_network((2, width, width, 1), seed))
        plant = rj.AffinePlant(0.6 * rng.normal(size=(2, 2)), rng.normal(size=(2, 1)))
        box = rj.Box(-settings.radius * np.ones(2), settings.radius * np.ones(2))
        solver, options = Recorded(rj.InteriorPoint()), {"relaxation": cuts, "samples": 1}
        rj.reach_step(rj.ClosedLoop(plant, net), box, rj.Template.box(2), solver=solver, **options)
        found = [_merit(*answer) for answer in solver.answers]
        seconds = sum(float(np.sum(answer.seconds)) for _, answer in solver.answers)
        largest = max(len(program.products.free) for program, _ in solver.answers)
        gaps = " ".join(f"{gap:.0e}" for gap, _ in found)
        rich.print(f"2x{width}, up to {largest} products: {seconds:.1f} s, gaps {gaps}")
        merits += found
    gaps, solved = map(np.array, zip(*merits, strict=True))
    rich.print(f"{len(gaps)} programs: solved {solved.sum()}, gap up to 1e-6: {sum(gaps <= 1e-6)}")
    rich.print(f"largest gap {gaps.max():.1e}")


def _merit(program, answer) -> tuple[float, bool]:
    """The largest gap between optimal values and those of the moments, and whether all is solved.

    The two are primal and dual: they agree where a program is solved.
    """
    objective, moments = np.asarray(program.objective.mid), np.asarray(answer.moments)
    values = np.einsum("fi,fi->f", objective, moments[:, :, -1])
    gaps = abs(np.asarray(answer.unknowns)[:, 0] - values) / (1 + abs(values))
    return float(gaps.max()), bool(np.all(answer.statuses == rj.SolverStatus.SOLVED))


def main(settings: Settings) -> None:
    """Run one study and print what it found."""
    jax.config.update("jax_enable_x64", True)
    {"agreement": agreement, "products": products}[settings.study](settings)


if __name__ == "__main__":
    run_experiment(main, Settings, "nothing is kept")
