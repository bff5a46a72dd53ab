"""How seconds and memory of a facet grow with the number of neurons, solver by solver.

The paper's program of one step, every neuron kept and without `lambda_ij`. Each figure comes from
a process of its own, so that first calls compile and peak memory is that of one solver.
"""

import multiprocessing
import resource
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.table import Table

import reachjax as rj
from experiments import report
from experiments.benchmark.cases import Settings, random_case
from experiments.benchmark.reference import paper_step
from experiments.benchmark.steps import REFERENCE, difference, paper_data, paper_size
from experiments.benchmark.timing import cells, repeated

SOLVERS = {"Clarabel": rj.Clarabel(), "InteriorPoint": rj.InteriorPoint()}
FACETS = 3
LEAST = 40
GROWTH_NOTE = """\
s/facet: median of warm calls;  first: compilation included
MiB: peak, beyond what imports took;  faster: seconds of the first row over
this row's;  diff: worst relative difference of bounds to the first row's
! not all facets solved;  * first call, longer than --patience"""


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
    case, before = random_case(width, settings.seed), peak_memory()
    template, relaxation = rj.Template.regular(FACETS), rj.PaperQC(repeated=False)

    def bounds():
        if name == REFERENCE:
            data = paper_data(case.layers, case.box)
            return paper_step(**data, directions=np.asarray(template.directions))[0], set()
        options = {"relaxation": relaxation, "solver": SOLVERS[name], "samples": 1}
        _, proof = rj.reach_step(case.loop, case.box, template, **options)
        return np.asarray(proof.bounds), {status.name for status in proof.statuses}

    timing = repeated(bounds, settings)
    found, statuses = timing.result
    return {
        "hidden": f"2x{width}",
        "n": paper_size(case.layers),
        "method": name,
        "clock": settings.clock,
        **timing.row(FACETS),
        "memory": peak_memory() - before,
        "bounds": found,
        "statuses": sorted(statuses),
    }


def peak_memory() -> int:
    """The most memory that this process has held, in bytes.

    On Linux `ru_maxrss` begins with what the process held that started this one.
    """
    status = Path("/proc/self/status")
    if status.exists():
        lines = dict(line.split(":", 1) for line in status.read_text().splitlines())
        return 1024 * int(lines["VmHWM"].split()[0])
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def related(rows: list[dict]) -> list[dict]:
    """The rows, with ratio and difference to the reference of the same network."""
    base = {row["n"]: row for row in rows if row["method"] == REFERENCE}
    for row in rows:
        first = base.get(row["n"])
        row["ratio"] = first["seconds"] / row["seconds"] if first else None
        row["difference"] = difference(row["bounds"], first["bounds"]) if first else None
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
    shown, last = [], None
    for row in rows:
        name = ("", "") if row["hidden"] == last else (row["hidden"], row["n"])
        last = row["hidden"]
        away = None if row["method"] == REFERENCE else row["difference"]
        shown.append(
            [
                *name,
                row["method"] + " !" * (not set(row["statuses"]) <= {"SOLVED"}),
                *cells(row),
                f"{row['memory'] / 2**20:.0f}",
                "-" if row["ratio"] is None else f"{row['ratio']:.3g}",
                "-" if away is None else f"{away:.0e}",
            ]
        )
    title = f"one facet, every neuron kept, {rows[0]['clock']} seconds"
    headings = ("s/facet", "first", "MiB", "faster", "diff")
    return report.table(title, ("hidden", "n", "method"), headings, shown)
