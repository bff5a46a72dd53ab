"""Six-step tubes and training steps of the double integrator, solver by solver."""

import jax
import numpy as np
from rich.table import Table

import reachjax as rj
from experiments import double_integrator
from experiments.benchmark_cases import Settings
from experiments.benchmark_methods import REFERENCE, repeated
from experiments.command import blank_table
from experiments.double_integrator import INITIAL_BOX, INPUT_BOX, A, B
from experiments.fine_tuning import HORIZON, TEMPLATE, certified_tube
from experiments.reference import paper_step
from experiments.step_cost import StepCost, step_cost

SOLVERS = {"Clarabel": rj.Clarabel(), "InteriorPoint": rj.InteriorPoint(), "Auto": rj.Auto()}
RELAXATIONS = {"PaperQC": rj.PaperQC(), "LocalBounds": rj.LocalBounds()}
LOOPS_NOTE = """\
s/tube: median of warm calls;  first: compilation included
faster: seconds of the relaxation's first row over this row's
area: of the last set;  * first call, longer than --patience"""

Layers = list[tuple[np.ndarray, np.ndarray]]


def controller(settings: Settings) -> Layers:
    """Trained on the MPC with a margin, from its file where it is there."""
    options = double_integrator.Settings(output=settings.output, seed=settings.seed)
    return double_integrator.controller("with margin", options.margin, options).layers


def reference_tube(layers: Layers) -> rj.Polytope:
    """The last set of the paper's relaxation, each facet's program stated in cvxpy from nothing."""
    directions = np.asarray(TEMPLATE(2).directions)
    (lower, upper), (u_lower, u_upper) = INITIAL_BOX, INPUT_BOX
    set_A, set_b = np.vstack([np.eye(2), -np.eye(2)]), np.r_[upper, -lower]
    for _ in range(HORIZON):
        limits = u_lower, u_upper
        data = layers, A, B, np.zeros(2), *limits, set_A, set_b, directions
        set_A, set_b = directions, paper_step(*data, repeated=True)[0]
    return rj.Polytope(set_A, set_b)


def tube_rows(layers: Layers, settings: Settings):
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
            seconds, last = timing.seconds, timing.result
            base = base or seconds
            yield {
                "relaxation": name,
                "method": by,
                "clock": settings.clock,
                "seconds": seconds,
                "first": timing.first,
                "calls": timing.calls,
                "ratio": base / seconds,
                "area": float(last.volume()),
            }


def step_rows(layers: Layers):
    """Rows of the table of training steps, one after the other."""
    for name, solver in SOLVERS.items():
        jax.clear_caches()
        yield name, step_cost(layers, solver)


def tube_table(rows: list[dict]) -> Table:
    """A relaxation and a solver a row."""
    clock = rows[0]["clock"]
    shown = blank_table(f"{HORIZON}-step tube, 8 facets, 2-10-5-1 network, {clock} seconds")
    shown.add_column("relaxation", no_wrap=True)
    shown.add_column("method", no_wrap=True)
    for heading in ("s/tube", "first", "faster", "area"):
        shown.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        numbers = (row["first"], row["ratio"], row["area"])
        seconds = "*" * (not row["calls"]) + f"{row['seconds']:.3g}"
        shown.add_row(row["relaxation"], row["method"], seconds, *map("{:.3g}".format, numbers))
    return shown


def step_table(rows: list[tuple[str, StepCost]]) -> Table:
    """A solver a row."""
    headings = ("solver", "forward", "of it solving", "both", "backward", "first")
    shown = blank_table("log-volume of five certified sets and its gradient, wall seconds")
    for i, heading in enumerate(headings):
        shown.add_column(heading, justify="right" if i else "left", no_wrap=True)
    for name, cost in rows:
        shown.add_row(
            name,
            f"{cost.forward:.3g}",
            "-" if np.isnan(cost.solver) else f"{cost.solver:.3g}",
            f"{cost.both:.3g}",
            f"{cost.backward:+.0%}",
            f"{cost.first:.3g}",
        )
    return shown
