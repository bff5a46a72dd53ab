"""Seconds of one Reach-SDP step, and the bounds they buy, method by method in one run.

One step of the double integrator with its input box and the paper's eight facets, for networks
with two hidden layers: some trained on the MPC and started from the paper's small initial set, some
with random weights and a set of the same size where most of their neurons switch. All methods run
one after the other in this process, with one BLAS thread and one thread for Clarabel, so their
ratios mean more than their seconds.

    python -m experiments.benchmark --help
"""

import dataclasses
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from math import comb
from pathlib import Path
from typing import Literal

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read once, when numpy is imported
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("RAYON_NUM_THREADS", "1")  # Clarabel's

import jax
import numpy as np
import rich
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

import reachjax as rj
from experiments import double_integrator
from experiments.command import blank_table, require_folder, run_experiment
from experiments.double_integrator import INITIAL_BOX, INPUT_BOX, A, B
from experiments.reference import basis_sizes, paper_step
from reachjax.solvers.compact import compact
from reachjax.witnesses import initial_states

RANDOM_BOX = np.array([[0.25, -0.25], [0.75, 0.25]])  # the size of the paper's X_0, near the kinks
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "RAYON_NUM_THREADS")
CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}
REFERENCE = "cvxpy per facet"
NOTE = """\
n, mult: entries of the basis and multipliers that reach the solver
s/step: all 8 facets, median of warm calls;  first: compilation included
faster: seconds of the first row over this row's
diff: worst relative difference of bounds to the first row (same program)
slack: sum over facets of the bound less the sampled support
~ scaled up from fewer facets;  * first call, longer than --patience"""


@dataclass(frozen=True)
class Settings:
    """Time one step of Reach-SDP: cvxpy rebuilt for every facet against this library.

    Trained weights and `benchmark.json` are kept under `output`.
    """

    widths: tuple[int, ...] = (10, 20, 32)
    """Neurons in each of the two hidden layers, one network a width."""
    networks: tuple[Literal["trained", "random"], ...] = ("trained", "random")
    """Trained on the MPC with the paper's initial set, or He-initialised near its kinks."""
    reference_facets: int = 8
    """At most so many are timed with cvxpy rebuilt; fewer are scaled up to 8."""
    repetitions: int = 3
    """Warm calls of which the median is taken."""
    patience: float = 40.0
    """Seconds after which a method is not called again, and cvxpy rebuilt for no more facets."""
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


@dataclass(frozen=True, eq=False)
class Case:
    """A network, and the box of states that it starts from."""

    name: str
    layers: list[tuple[np.ndarray, np.ndarray]]
    initial: np.ndarray

    @cached_property
    def loop(self) -> rj.ClosedLoop:
        """The double integrator with this controller."""
        return rj.ClosedLoop(
            rj.AffinePlant(A, B), rj.MLP.from_layers(self.layers), input_box=rj.Box(*INPUT_BOX)
        )

    @cached_property
    def template(self) -> rj.Template:
        """The paper's eight facets."""
        return rj.Template.octagonal(2)

    def support(self, seed: int, count: int = 20_000) -> np.ndarray:
        """The largest simulated value of each facet: no bound can be smaller."""
        states = initial_states(rj.Box(*self.initial), count, seed)
        return np.asarray(self.loop.simulate(states, 1)[:, 1] @ self.template.directions.T).max(0)


@dataclass(frozen=True, eq=False)
class Answer:
    """What a method found: `bounds` of the facets it was asked for, NaN for the others."""

    relaxation: rj.AbstractRelaxation
    size: int
    multipliers: int
    bounds: np.ndarray
    statuses: tuple[str, ...] = ()


Method = Callable[[Case], Answer]


def reference(case: Case, settings: Settings) -> Answer:
    """The paper's program, stated in cvxpy from nothing for one facet after another.

    It stops after `reference_facets` of them, or after the first that ends beyond `patience`.
    """
    directions = np.asarray(case.template.directions)
    (lower, upper), (u_lower, u_upper) = case.initial, INPUT_BOX
    set_A, set_b = np.vstack([np.eye(2), -np.eye(2)]), np.r_[upper, -lower]
    data = (case.layers, A, B, np.zeros(len(A)), u_lower, u_upper, set_A, set_b)
    bounds = np.full(len(directions), np.nan)
    clock = CLOCKS[settings.clock]
    began = clock()
    for i in range(settings.reference_facets):
        bounds[i] = paper_step(*data, directions[i : i + 1], repeated=True)[0][0]
        if clock() - began > settings.patience:
            break
    size = sum(basis_sizes(case.layers, boxed=True)) + 1
    units = size - 1 - len(lower)
    count = comb(len(set_b), 2) + 3 * units + comb(units, 2)
    return Answer(rj.PaperQC(), size, count, bounds)


def pipeline(case: Case, relaxation: rj.AbstractRelaxation, solver: rj.AbstractSolver) -> Answer:
    """`reachjax.reach_step`: rows, program, solver, recheck and witnesses."""
    box = rj.Box(*case.initial)
    _, proof = rj.reach_step(case.loop, box, case.template, relaxation=relaxation, solver=solver)
    program = compact(proof.program)
    statuses = tuple(status.name for status in proof.statuses)
    bounds = np.asarray(proof.bounds)
    return Answer(relaxation, len(program.columns), len(program.kept), bounds, statuses)


def methods(settings: Settings) -> dict[str, Method]:
    """Every method by its name, the reference first."""
    clarabel = rj.Clarabel()
    return {
        REFERENCE: partial(reference, settings=settings),
        "PaperQC, all kept": partial(pipeline, relaxation=rj.PaperQC(), solver=clarabel),
        "PaperQC, stable out": partial(
            pipeline, relaxation=rj.PaperQC(remove_stable=True), solver=clarabel
        ),
        "LocalBounds": partial(pipeline, relaxation=rj.LocalBounds(), solver=clarabel),
    }


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
            layers = he_network((2, width, width, 1), settings.seed)
            found.append(Case(f"random 2x{width}", layers, RANDOM_BOX))
    return found


def he_network(sizes: tuple[int, ...], seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """He-initialised weights and small biases."""
    rng = np.random.default_rng(seed)
    return [
        (rng.normal(size=(out, into)) * np.sqrt(2 / into), 0.1 * rng.normal(size=out))
        for into, out in pairwise(sizes)
    ]


def measure(case: Case, name: str, method: Method, settings: Settings) -> dict:
    """One row: the first call, the median of the warm calls that patience allows, the bounds."""
    jax.clear_caches()
    clock = CLOCKS[settings.clock]
    first, answer = _timed(method, case, clock)
    calls: list[float] = []
    while first + sum(calls) < settings.patience and len(calls) < settings.repetitions:
        calls.append(_timed(method, case, clock)[0])
    share = float(np.mean(np.isfinite(answer.bounds)))
    return {
        "case": case.name,
        "clock": settings.clock,
        "method": name,
        "relaxation": repr(answer.relaxation),
        "same_program": answer.relaxation == rj.PaperQC(),
        "n": answer.size,
        "multipliers": answer.multipliers,
        "facets": int(np.isfinite(answer.bounds).sum()),
        "seconds": float(np.median(calls or [first])) / share,
        "first": first / share,
        "calls": calls,
        "bounds": answer.bounds,
        "statuses": answer.statuses,
        "slack": float(np.sum(answer.bounds - case.support(settings.seed))),
    }


def _timed(method: Method, case: Case, clock: Callable[[], float]) -> tuple[float, Answer]:
    began = clock()
    answer = method(case)
    return clock() - began, answer


def compare(rows: list[dict]) -> list[dict]:
    """The rows of one case, with what relates them to the first: ratio and difference."""
    base = rows[0]
    for row in rows:
        away = np.abs(row["bounds"] - base["bounds"]) / np.abs(base["bounds"])
        row["ratio"] = base["seconds"] / row["seconds"]
        row["difference"] = float(np.nanmax(away)) if row["same_program"] else None
    return rows


def table(rows: list[dict]) -> Table:
    """One case, a method a row."""
    title = f"{rows[0]['case']}, {rows[0]['clock']} seconds"
    shown = blank_table(title)
    shown.add_column("method", no_wrap=True)
    for heading in ("n", "mult", "s/step", "first", "faster", "diff", "slack"):
        shown.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        mark = ("~" if row["facets"] < len(row["bounds"]) else "") + "*" * (not row["calls"])
        shown.add_row(
            row["method"],
            *(str(row["n"]), str(row["multipliers"])),
            *(f"{mark}{row['seconds']:.3g}", f"{row['first']:.3g}", f"{row['ratio']:.3g}"),
            "-" if row["difference"] is None or row is rows[0] else f"{row['difference']:.0e}",
            "-" if np.isnan(row["slack"]) else f"{row['slack']:.4f}",
        )
    return shown


def write(settings: Settings, results: list[list[dict]]) -> Path:
    """Settings, threads and every row, as JSON."""
    content = {
        "settings": dataclasses.asdict(settings) | {"output": str(settings.output)},
        "threads": {name: os.environ.get(name) for name in THREADS} | {"cores": os.cpu_count()},
        "rows": [
            {key: _plain(value) for key, value in row.items()} for rows in results for row in rows
        ],
    }
    path = settings.output / "benchmark.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1))
    return path


def _plain(value):
    """JSON has no NaN: a facet that was not asked for is null."""
    if isinstance(value, np.ndarray):
        return [_plain(entry) for entry in value.tolist()]
    return None if isinstance(value, float) and np.isnan(value) else value


def main(settings: Settings) -> None:
    """Measure every method on every network; each table is printed as soon as it is complete."""
    require_folder(settings.output)
    jax.config.update("jax_enable_x64", True)
    results, networks, named = [], cases(settings), methods(settings)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), transient=True) as bar:
        task = bar.add_task("", total=len(networks) * len(named))
        for case in networks:
            rows = []
            for name, method in named.items():
                bar.update(task, description=f"{case.name}: {name}")
                rows.append(measure(case, name, method, settings))
                bar.advance(task)
            results.append(compare(rows))
            bar.console.print(table(results[-1]))
            write(settings, results)
    rich.print(NOTE)
    rich.print(f"written: {write(settings, results)}")


if __name__ == "__main__":
    run_experiment(main, Settings)
