"""The ways to compute one step that the benchmark compares."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from math import comb
from typing import Any

import jax
import numpy as np
from rich.table import Table

import reachjax as rj
from experiments import report
from experiments.benchmark.cases import Case, Settings
from experiments.benchmark.reference import basis_sizes, paper_step
from experiments.benchmark.timing import CLOCKS, cells, repeated
from experiments.double_integrator.problem import INPUT_BOX, A, B

REFERENCE = "cvxpy per facet"
STEPS_NOTE = """\
n, mult: entries of the basis and multipliers that reach the solver
s/step: all 8 facets, median of warm calls;  first: compilation included
faster: seconds of the first row over this row's
diff: worst relative difference of bounds to the first row (same program)
slack: sum over facets of the bound less the sampled support
~ scaled up from fewer facets;  * first call, longer than --patience"""


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
    directions, data = np.asarray(case.template.directions), paper_data(case.layers, case.box)
    bounds = np.full(len(directions), np.nan)
    clock = CLOCKS[settings.clock]
    began = clock()
    for i in range(settings.reference_facets):
        bounds[i] = paper_step(**data, directions=directions[i : i + 1], repeated=True)[0][0]
        if clock() - began > settings.patience:
            break
    size = paper_size(case.layers)
    units, facets = size - 1 - len(A), len(data["set_b"])
    count = comb(facets, 2) + 3 * units + comb(units, 2)
    return Answer(rj.PaperQC(), size, count, bounds)


def paper_size(layers) -> int:
    """Entries of the paper's basis."""
    return sum(basis_sizes(layers, boxed=True)) + 1


def paper_data(layers, X: rj.PolyhedralSet) -> dict[str, Any]:
    """What `paper_step` takes beside its directions."""
    (u_lower, u_upper), (set_A, set_b) = INPUT_BOX, map(np.asarray, X.facets)
    loop = {"layers": layers, "A": A, "B": B, "c": np.zeros(len(A))}
    return loop | {"u_lower": u_lower, "u_upper": u_upper, "set_A": set_A, "set_b": set_b}


def pipeline(case: Case, relaxation: rj.AbstractRelaxation, solver: rj.AbstractSolver) -> Answer:
    """`reachjax.reach_step`: rows, program, solver, recheck and witnesses."""
    task = case.loop, case.box, case.template
    _, proof = rj.reach_step(*task, relaxation=relaxation, solver=solver)
    assert isinstance(proof, rj.AbstractCertificate)
    size = int(np.sum(proof.program.used))
    multipliers = int(np.any(np.asarray(proof.multipliers) != 0, axis=0).sum())
    statuses = tuple(status.name for status in proof.statuses)
    return Answer(relaxation, size, multipliers, np.asarray(proof.bounds), statuses)


def methods(settings: Settings) -> dict[str, Method]:
    """Every method by its name, the reference first."""
    relaxations = {
        "PaperQC, all kept": rj.PaperQC(),
        "PaperQC, stable out": rj.PaperQC(remove_stable=True),
        "LocalBounds": rj.LocalBounds(),
    }
    solvers = {"Clarabel": rj.Clarabel(), "ours": rj.InteriorPoint()}
    return {REFERENCE: partial(reference, settings=settings)} | {
        f"{name}, {by}": partial(pipeline, relaxation=relaxation, solver=solver)
        for name, relaxation in relaxations.items()
        for by, solver in solvers.items()
    }


def measured(case: Case, named: dict[str, Method], settings: Settings) -> Iterator[dict]:
    """A row for each method: seconds, bounds, and what relates them to those of the first."""
    base = None
    for name, method in named.items():
        jax.clear_caches()
        timing = repeated(partial(method, case), settings)
        answer = timing.result
        row = {
            "case": case.name,
            "clock": settings.clock,
            "method": name,
            "relaxation": repr(answer.relaxation),
            "n": answer.size,
            "multipliers": answer.multipliers,
            "facets": int(np.isfinite(answer.bounds).sum()),
            **timing.row(float(np.mean(np.isfinite(answer.bounds)))),
            "bounds": answer.bounds,
            "statuses": answer.statuses,
            "slack": float(np.sum(answer.bounds - case.support(settings.seed))),
        }
        base = base or row
        same = answer.relaxation == rj.PaperQC()
        row["ratio"] = base["seconds"] / row["seconds"]
        row["difference"] = difference(row["bounds"], base["bounds"]) if same else None
        yield row


def difference(bounds: np.ndarray, others: np.ndarray) -> float:
    """The worst relative difference of bounds, where there are both."""
    return float(np.nanmax(abs(bounds - others) / abs(others)))


def steps_table(rows: list[dict]) -> Table:
    """One case, a method a row."""
    shown = []
    for row in rows:
        seconds, first = cells(row)
        mark = "~" * (row["facets"] < len(row["bounds"]))
        away = "-" if row["difference"] is None or row is rows[0] else f"{row['difference']:.0e}"
        slack = "-" if np.isnan(row["slack"]) else f"{row['slack']:.4f}"
        sizes = row["n"], row["multipliers"]
        shown.append(
            [row["method"], *sizes, mark + seconds, first, f"{row['ratio']:.3g}", away, slack]
        )
    headings = ("n", "mult", "s/step", "first", "faster", "diff", "slack")
    title = f"{rows[0]['case']}, {rows[0]['clock']} seconds"
    return report.table(title, ("method",), headings, shown)
