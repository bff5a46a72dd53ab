"""The ways to compute one step that the benchmark compares, and how each is timed."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import comb
from typing import Any

import jax
import numpy as np

import reachjax as rj
from experiments.benchmark_cases import Case, Settings
from experiments.double_integrator import INPUT_BOX, A, B
from experiments.reference import basis_sizes, paper_step
from reachjax.programs.compact import compact

CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}
REFERENCE = "cvxpy per facet"


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
    directions, data = np.asarray(case.template.directions), paper_data(case)
    bounds = np.full(len(directions), np.nan)
    clock = CLOCKS[settings.clock]
    began = clock()
    for i in range(settings.reference_facets):
        bounds[i] = paper_step(**data, directions=directions[i : i + 1], repeated=True)[0][0]
        if clock() - began > settings.patience:
            break
    size = sum(basis_sizes(case.layers, boxed=True)) + 1
    units, facets = size - 1 - len(A), len(data["set_b"])
    count = comb(facets, 2) + 3 * units + comb(units, 2)
    return Answer(rj.PaperQC(), size, count, bounds)


def paper_data(case: Case) -> dict[str, Any]:
    """What `paper_step` takes beside its directions."""
    (lower, upper), (u_lower, u_upper) = case.initial, INPUT_BOX
    return {
        "layers": case.layers,
        "A": A,
        "B": B,
        "c": np.zeros(len(A)),
        "u_lower": u_lower,
        "u_upper": u_upper,
        "set_A": np.vstack([np.eye(2), -np.eye(2)]),
        "set_b": np.r_[upper, -lower],
    }


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


def measure(case: Case, name: str, method: Method, settings: Settings) -> dict:
    """One row: the first call, the median of the warm calls that patience allows, the bounds."""
    jax.clear_caches()
    timing = repeated(partial(method, case), settings)
    answer = timing.result
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
        "seconds": timing.seconds / share,
        "first": timing.first / share,
        "calls": timing.calls,
        "bounds": answer.bounds,
        "statuses": answer.statuses,
        "slack": float(np.sum(answer.bounds - case.support(settings.seed))),
    }


@dataclass(frozen=True, eq=False)
class Timing:
    """Seconds of the first call, of those after it, and what the last one returned."""

    first: float
    calls: list[float]
    result: Any

    @property
    def seconds(self) -> float:
        """The median of warm calls; of the first one if there are none."""
        return float(np.median(self.calls or [self.first]))


def repeated(call: Callable[[], Any], settings: Settings) -> Timing:
    """The first call, and as many warm ones as patience allows."""
    clock = CLOCKS[settings.clock]
    first, result = timed(call, clock)
    calls: list[float] = []
    while first + sum(calls) < settings.patience and len(calls) < settings.repetitions:
        calls.append(timed(call, clock)[0])
    return Timing(first, calls, result)


def timed(call: Callable[[], Any], clock: Callable[[], float]) -> tuple[float, Any]:
    """Seconds, and what is returned."""
    began = clock()
    result = call()
    return clock() - began, result
