"""The ways to compute one step that the benchmark compares, and how each is timed."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import comb

import jax
import numpy as np

import reachjax as rj
from experiments.benchmark_cases import Case, Settings
from experiments.double_integrator import INPUT_BOX, A, B
from experiments.reference import basis_sizes, paper_step
from reachjax.solvers.compact import compact

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
