"""What the interior-point method's answers are worth: agreement, and many products.

    python -m experiments.interior_point agreement | products

`agreement`: random loops, degenerate ones among them, against Clarabel and simulated successors.
`products`: programs that grow by the products of facts which the last moment matrix violates most.
`benchmark growth` measures its speed.
"""

import os
from dataclasses import dataclass
from itertools import product
from typing import Literal

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read once, when numpy is imported

import jax
import numpy as np
import rich
import tyro
from rich.progress import track

import reachjax as rj
from experiments.benchmark_cases import he_network
from experiments.command import at_least_one, blank_table, run_experiment
from reachjax.programs.lmi import Program
from reachjax.programs.relaxations import Products
from reachjax.programs.windows import step_program
from reachjax.proofs.accepted import accepted_offsets
from reachjax.proofs.recheck import interval_offsets
from reachjax.proofs.witnesses import initial_states

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
    facets: int = 2
    """Of each network there."""
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
        counts = ("facets", "programs", "rounds", "batch", "seeds")
        at_least_one(**{f"--{name}": getattr(self, name) for name in counts})
        at_least_one(**{"--widths": min(self.widths, default=0)})
        if not 0 < self.radius < np.inf:
            raise ValueError(f"--radius must be positive, but {self.radius} arrived")


def program_of(loop: rj.ClosedLoop, box: rj.Box, relaxation, directions) -> Program:
    """The program of one step, on the host."""
    return jax.device_get(step_program(loop, box, box, directions, 0, relaxation))


def random_step(seed: int) -> tuple[rj.ClosedLoop, rj.Box, np.ndarray, rj.AbstractRelaxation]:
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
    directions = np.vstack([np.eye(n_x), -np.eye(n_x), rng.normal(size=(1, n_x))])[-3:]
    return loop, rj.Box(lower, lower + width), directions, RELAXATIONS[seed % len(RELAXATIONS)]


def agreement(settings: Settings) -> None:
    """Statuses, differences to Clarabel's solved facets, and bounds less simulated supports."""
    ours, theirs = rj.InteriorPoint(), rj.Clarabel()
    rows: dict[str, list] = {"with interior": [], "flat": [], "thin (1e-6)": []}
    for seed in track(range(settings.programs), "programs"):
        loop, box, directions, relaxation = random_step(seed)
        program = program_of(loop, box, relaxation, directions)
        width = float(box.upper[0] - box.lower[0])
        kind = "flat" if width == 0 else "thin (1e-6)" if width < THIN else "with interior"
        states = initial_states(box, 2000, seed)
        attained = np.asarray(loop.simulate(states, 1)[:, 1] @ directions.T).max(axis=0)
        size = np.maximum(interval_offsets(program) - program.objective.mid[:, -1], 1e-9)
        found, other = ours.solve(program), theirs.solve(program)
        bounds, reference = (accepted_offsets(program, each)[0] for each in (found, other))
        parts = (
            *(each.statuses == rj.SolverStatus.SOLVED for each in (found, other)),
            abs(found.offsets - other.offsets) / size,
            (bounds - reference) / size,
            bounds - attained,
        )
        rows[kind] += list(zip(*parts, strict=True))
    shown = blank_table(f"{settings.programs} programs: InteriorPoint and Clarabel")
    headings = ("sets", "facets", "solved", "Clarabel", "optima", "looser", "> 1e-5", "support")
    for i, heading in enumerate(headings):
        shown.add_column(heading, justify="right" if i else "left", no_wrap=True)
    for kind, found in rows.items():
        if found:
            shown.add_row(kind, *_summary(*map(np.array, zip(*found, strict=True))))
    rich.print(shown)
    rich.print(AGREEMENT_NOTE)


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


def with_violated(program: Program, moment: np.ndarray, batch: int) -> Program | None:
    """The program and the products of facts that a moment matrix violates most."""
    facts, old = program.facts.mid, program.products
    norms = np.linalg.norm(facts, axis=1)
    facts = facts / np.where(norms > 0, norms, 1.0)[:, None]
    i, j = np.triu_indices(len(facts), 1)
    values = (facts @ moment @ facts.T)[i, j]
    known = set(zip(old.left.tolist(), old.right.tolist(), strict=True))
    order = [k for k in np.argsort(values)[: 8 * batch] if values[k] < -1e-6]
    new = [k for k in order if (i[k], j[k]) not in known][:batch]
    products = Products(
        left=np.r_[old.left, i[new]],
        right=np.r_[old.right, j[new]],
        sign=np.r_[old.sign, np.ones(len(new))],
        multiplier=np.r_[old.multiplier, len(old.free) + np.arange(len(new))],
        free=np.r_[old.free, np.zeros(len(new), dtype=bool)],
    )
    return program.replace(products=products) if new else None


def grown(program: Program, solver: rj.AbstractSolver, settings: Settings, name: str) -> list:
    """Gap, whether the optimum is borne out, and status, round after round."""
    found, seconds = [], 0.0
    for _ in range(settings.rounds):
        solution = solver.solve(program)
        moment = np.asarray(solution.moments[0])
        bounds, optimal = accepted_offsets(program, solution)
        attained = float(program.objective.mid[0] @ moment[:, -1])
        gap = abs(float(bounds[0]) - attained) / (1 + abs(attained))
        found.append((gap, bool(optimal[0]), int(solution.statuses[0])))
        seconds += float(solution.seconds[0])
        following = with_violated(program, moment, settings.batch)
        if following is None:
            break
        program = following
    size, count = int(program.used.sum()), len(program.products.free)
    gaps = " ".join(f"{gap:.0e}" for gap, *_ in found)
    rich.print(f"{name} n {size} products {count}: {seconds:.1f} s, gaps {gaps}")
    return found


def products(settings: Settings) -> None:
    """Rounds of violated products on wide sets: low-rank optimal faces, ever more multipliers."""
    solver, merits = rj.InteriorPoint(), []
    for width, seed in product(settings.widths, range(settings.seeds)):
        rng = np.random.default_rng(seed)
        net = rj.MLP.from_layers(he_network((2, width, width, 1), seed))
        plant = rj.AffinePlant(0.6 * rng.normal(size=(2, 2)), rng.normal(size=(2, 1)))
        loop = rj.ClosedLoop(plant, net)
        box = rj.Box(-settings.radius * np.ones(2), settings.radius * np.ones(2))
        for facet in np.eye(2)[: settings.facets]:
            program = program_of(loop, box, rj.LocalBounds(repeated=False), facet[None])
            merits += grown(program, solver, settings, f"2x{width}")
    gaps, optimal, statuses = map(np.array, zip(*merits, strict=True))
    solved = int((statuses == rj.SolverStatus.SOLVED).sum())
    rich.print(
        f"{len(gaps)} programs: solved {solved}, gap up to 1e-6: {int((gaps <= 1e-6).sum())}"
    )
    rich.print(f"largest gap {gaps.max():.1e}; optimum borne out {int(optimal.sum())}")


def main(settings: Settings) -> None:
    """Run one study and print what it found."""
    jax.config.update("jax_enable_x64", True)
    {"agreement": agreement, "products": products}[settings.study](settings)


if __name__ == "__main__":
    run_experiment(main, Settings, "nothing is kept")
