"""Six-step tubes and training steps of the double integrator, solver by solver."""

from collections.abc import Iterator

import jax
import numpy as np
from rich.table import Table

import reachjax as rj
from experiments import report
from experiments.benchmark.cases import Settings
from experiments.benchmark.reference import paper_step
from experiments.benchmark.steps import REFERENCE, paper_data
from experiments.benchmark.timing import cells, repeated
from experiments.double_integrator import study as double_integrator
from experiments.double_integrator.problem import HORIZON, INITIAL_BOX, template
from experiments.layers import Layers
from experiments.verified_training.fine_tuning import certified_tube
from experiments.verified_training.step_cost import StepCost, step_cost

SOLVERS = {"Clarabel": rj.Clarabel(), "InteriorPoint": rj.InteriorPoint(), "Auto": rj.Auto()}
RELAXATIONS = {"PaperQC": rj.PaperQC(), "LocalBounds": rj.LocalBounds()}
LOOPS_NOTE = """\
s/tube: median of warm calls;  first: compilation included
faster: seconds of the relaxation's first row over this row's
area: of the last set;  * first call, longer than --patience"""


def controller(settings: Settings) -> Layers:
    """Trained on the MPC with a margin, from its file where it is there."""
    options = double_integrator.Settings(output=settings.output, seed=settings.seed)
    return double_integrator.controller("with margin", options.margin, options).layers


def reference_tube(layers: Layers) -> rj.PolyhedralSet:
    """The last set of the paper's relaxation, each facet's program stated in cvxpy from nothing."""
    directions, X = np.asarray(template().directions), rj.Box(*INITIAL_BOX)
    for _ in range(HORIZON):
        data = paper_data(layers, X)
        X = rj.Polytope(directions, paper_step(**data, directions=directions, repeated=True)[0])
    return X


def tube_rows(layers: Layers, settings: Settings) -> Iterator[dict]:
    """Rows of the table of tubes, one after the other."""
    net = rj.MLP.from_layers(layers)
    for name, relaxation in RELAXATIONS.items():
        ways = {
            by: lambda r=relaxation, s=solver: certified_tube(net, relaxation=r, solver=s).sets[-1]
            for by, solver in SOLVERS.items()
        }
        if name == "PaperQC":
            ways = {REFERENCE: lambda: reference_tube(layers)} | ways
        base = None
        for by, way in ways.items():
            jax.clear_caches()
            timing = repeated(way, settings)
            base = base or timing.seconds
            row = {"relaxation": name, "method": by, "clock": settings.clock} | timing.row()
            area = float(timing.result.volume())
            yield row | {"ratio": base / timing.seconds, "area": area}


def step_rows(layers: Layers) -> Iterator[tuple[str, StepCost]]:
    """Rows of the table of training steps, one after the other."""
    for name, solver in SOLVERS.items():
        jax.clear_caches()
        yield name, step_cost(layers, solver)


def tube_table(rows: list[dict]) -> Table:
    """A relaxation and a solver a row."""
    shown = [
        (row["relaxation"], row["method"], *cells(row), f"{row['ratio']:.3g}", f"{row['area']:.3g}")
        for row in rows
    ]
    title = f"{HORIZON}-step tube, 8 facets, 2-10-5-1 network, {rows[0]['clock']} seconds"
    headings = ("s/tube", "first", "faster", "area")
    return report.table(title, ("relaxation", "method"), headings, shown)


def step_table(rows: list[tuple[str, StepCost]]) -> Table:
    """A solver a row."""
    shown = [
        (
            name,
            f"{cost.forward:.3g}",
            "-" if np.isnan(cost.solver) else f"{cost.solver:.3g}",
            f"{cost.both:.3g}",
            f"{cost.backward:+.0%}",
            f"{cost.first:.3g}",
        )
        for name, cost in rows
    ]
    headings = ("forward", "of it solving", "both", "backward", "first")
    title = "log-volume of five certified sets and its gradient, wall seconds"
    return report.table(title, ("solver",), headings, shown)
