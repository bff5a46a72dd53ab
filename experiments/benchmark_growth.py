"""How seconds and memory of a facet grow with the number of neurons, solver by solver.

The paper's program of one step, every neuron kept and without `lambda_ij`. Each figure comes from
a process of its own, so that first calls compile and peak memory is that of one solver.
"""

import multiprocessing
import resource
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from operator import itemgetter
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.table import Table

import reachjax as rj
from experiments.benchmark_cases import Settings, random_case
from experiments.benchmark_methods import CLOCKS, REFERENCE, paper_data, repeated, timed
from experiments.command import blank_table
from experiments.operations import operations
from experiments.reference import paper_step
from reachjax.programs.lmi import Program
from reachjax.programs.trimming import trimmed
from reachjax.programs.windows import step_program
from reachjax.proofs.accepted import accepted_offsets
from reachjax.solvers.arrangement import arranged, cut
from reachjax.solvers.facets import solve_facets
from reachjax.solvers.primal_dual import start, step

SOLVERS = {"Clarabel": rj.Clarabel(), "InteriorPoint": rj.InteriorPoint()}
FACETS = 2
LEAST = 40
MATRIX = 1024
"""The size of the matrices whose product shows the machine's rate."""
GROWTH_NOTE = """\
s/facet: median of warm calls;  first: compilation included;  it: iterations
MiB: peak, beyond what imports took;  faster: seconds of the first row over
this row's;  diff: worst relative difference of bounds to the first row's
rate: arithmetic of products and factorisations a second, over that of a
1024 x 1024 product;  ! not all facets solved;  * first call, longer than
--patience.  cvxpy states its program each time; ours gets its rows."""


def jobs(settings: Settings) -> list[tuple[int, str]]:
    """Widths of two hidden layers, and what solves; the slow ones on small networks only."""
    names = {width: [*SOLVERS] for width in settings.growth}
    for width in settings.growth:
        if width > settings.reference_width:
            names[width].remove("Clarabel")
        else:
            names[width].insert(0, REFERENCE)
    return [(width, name) for width in settings.growth for name in names[width]]


def in_new_process(function: Callable[..., dict], *arguments: Any) -> dict:
    """What a function returns there."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def grown(width: int, name: str, settings: Settings) -> dict:
    """One row of the table."""
    jax.config.update("jax_enable_x64", True)
    case, before = random_case(width, settings.seed), _peak()
    directions = case.template.directions[:FACETS]
    box = rj.Box(*case.initial)
    relaxation = rj.PaperQC(repeated=False)
    program = jax.device_get(step_program(case.loop, box, box, directions, 0, relaxation))

    def bounds():
        if name == REFERENCE:
            return paper_step(**paper_data(case), directions=np.asarray(directions))[0], set()
        solution = SOLVERS[name].solve(program)
        statuses = {rj.SolverStatus(int(code)).name for code in solution.statuses}
        return accepted_offsets(program, solution)[0], statuses

    timing = repeated(bounds, settings)
    found, statuses = timing.result
    row = {
        "hidden": f"2x{width}",
        "n": int(program.used.sum()),
        "method": name,
        "clock": settings.clock,
        "seconds": timing.seconds / FACETS,
        "first": timing.first / FACETS,
        "calls": timing.calls,
        "memory": _peak() - before,
        "bounds": found,
        "statuses": sorted(statuses),
    }
    return row | (_rates(program) if name == "InteriorPoint" else {})


def _peak() -> int:
    """The most memory that this process has held, in bytes.

    On Linux `ru_maxrss` begins with what the process held that started this one.
    """
    status = Path("/proc/self/status")
    if status.exists():
        lines = dict(line.split(":", 1) for line in status.read_text().splitlines())
        return 1024 * int(lines["VmHWM"].split()[0])
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _rates(program: Program) -> dict:
    """Iterations of a facet, its operations a second, and those of a large matrix product."""
    layout = cut(arranged(trimmed(program), program.products))
    generators, rows = jax.device_put((layout.generators, layout.objective))
    solver, solve = rj.InteriorPoint(), jax.jit(solve_facets)

    def facets():
        found = solve(generators, rows, solver.tolerance, solver.max_iterations)
        return jax.block_until_ready(found)

    facets()
    seconds, found = min((timed(facets, CLOCKS["wall"]) for _ in range(3)), key=itemgetter(0))
    count = operations(step, generators, rows[0], start(generators))
    matrix, product = jnp.ones((MATRIX, MATRIX)), jax.jit(jnp.matmul)

    def multiply():
        return jax.block_until_ready(product(matrix, matrix))

    multiply()
    best = min(timed(multiply, CLOCKS["wall"])[0] for _ in range(10))
    return {
        "iterations": float(np.mean(found.iterations)),
        "rate": float(np.sum(found.iterations)) * count / seconds,
        "best_rate": 2 * MATRIX**3 / best,
    }


def related(rows: list[dict]) -> list[dict]:
    """The rows, with ratio and difference to the reference of the same network."""
    base = {row["n"]: row for row in rows if row["method"] == REFERENCE}
    for row in rows:
        first = base.get(row["n"])
        row["ratio"] = first["seconds"] / row["seconds"] if first else None
        row["difference"] = (
            float(np.max(np.abs(row["bounds"] - first["bounds"]) / np.abs(first["bounds"])))
            if first
            else None
        )
    return rows


def exponent(rows: list[dict], least: int = LEAST) -> float:
    """The slope of the logarithm of seconds over that of `n`, of the interior-point method.

    Calls take some milliseconds however small a program is, so it is that from `least` on.
    """
    warm = [row for row in rows if row["method"] == "InteriorPoint" and row["calls"]]
    logs = np.log([[row["n"], row["seconds"]] for row in warm if row["n"] >= least])
    return float(np.polyfit(logs[:, 0], logs[:, 1], 1)[0]) if len(logs) > 1 else np.nan


def growth_table(rows: list[dict]) -> Table:
    """A network and a method a row."""
    shown = blank_table(f"one facet, every neuron kept, {rows[0]['clock']} seconds")
    shown.add_column("hidden", no_wrap=True)
    shown.add_column("n", justify="right")
    shown.add_column("method", no_wrap=True)
    for heading in ("s/facet", "first", "MiB", "faster", "diff", "it", "rate"):
        shown.add_column(heading, justify="right", no_wrap=True)
    last = None
    for row in rows:
        name = ("", "") if row["hidden"] == last else (row["hidden"], str(row["n"]))
        last = row["hidden"]
        shown.add_row(
            *name,
            row["method"] + " !" * (not set(row["statuses"]) <= {"SOLVED"}),
            "*" * (not row["calls"]) + f"{row['seconds']:.3g}",
            f"{row['first']:.3g}",
            f"{row['memory'] / 2**20:.0f}",
            _or_dash("{:.3g}", row["ratio"]),
            _or_dash("{:.0e}", row["difference"] if row["method"] != REFERENCE else None),
            _or_dash("{:.0f}", row.get("iterations")),
            _or_dash("{:.0%}", row["rate"] / row["best_rate"] if "rate" in row else None),
        )
    return shown


def _or_dash(form: str, value: float | None) -> str:
    return "-" if value is None else form.format(value)
