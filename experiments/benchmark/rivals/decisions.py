"""Whether a car keeps its distance, from six initial sets: who decides it, and in what time.

Each procedure answers for all sets, one after the other, in a process of its own: so what compiles
falls to the first set, and to the first that is refuted.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

import reachjax as rj
from experiments.benchmark.cases import Settings
from experiments.benchmark.rivals import cruise_control
from experiments.benchmark.rivals.procedures import PROCEDURES, Decision
from experiments.benchmark.rivals.processes import Stopped, from_process
from experiments.benchmark.timing import Timing, each_call
from experiments.task import Task

AHEAD = (0.0, -25.0, -30.7, -30.72, -32.0, -35.0)
"""Metres by which the lead is farther ahead. The distance is kept from the first three sets; from
the others it is not, though it is at first. Somewhere between -30.7 and -30.72 it just is."""


def initial_sets() -> dict[str, Task]:
    """The loop from each initial set, by the name that the table has."""
    return {f"{ahead:+g} m": cruise_control.following(ahead) for ahead in AHEAD}


def margins(sets: dict[str, Task], settings: Settings) -> dict[str, float]:
    """The least room, in metres, that simulated trajectories from each set leave."""
    return {
        name: task.margin(task.simulated(settings.simulations, settings.seed))
        for name, task in sets.items()
    }


def decision_rows(
    method: str, sets: dict[str, Task], rooms: dict[str, float], settings: Settings
) -> list[dict[str, Any]]:
    """A row for each set; where a call takes too long, this set and those after it have no verdict.

    Args:
        method: one of `PROCEDURES`.
        sets: the tasks by their names.
        rooms: what `margins` says of them.
        settings: how often and how long procedures are called.
    """
    calls: dict[str, list[tuple[float, Decision]]] = {name: [] for name in sets}
    problem = None
    try:
        for name, call in from_process(_calls, method, sets, settings, patience=settings.patience):
            calls[name].append(call)
    except Stopped as stopped:
        problem = str(stopped)
    shared = {"method": method, "clock": settings.clock, "problem": problem}
    return [
        {"set": name, "margin": rooms[name]} | shared | _decided(each)
        for name, each in calls.items()
    ]


def _calls(
    method: str, sets: dict[str, Task], settings: Settings
) -> Iterator[tuple[str, tuple[float, Decision]]]:
    for name, task in sets.items():
        for call in each_call(partial(PROCEDURES[method], task, settings), settings):
            yield name, call


def _decided(calls: list[tuple[float, Decision]]) -> dict[str, Any]:
    """The last verdict and the seconds of calls, if there are any."""
    if not calls:
        return {"verdict": None, "programs": None} | Timing(np.nan, [], None).row()
    timing = Timing.of(calls)
    decision: Decision = timing.result
    return {"verdict": decision.verdict.name, "programs": decision.programs} | timing.row()


def totals(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """For each procedure, how many sets it decides, and its seconds for all of them."""
    found = []
    for method in dict.fromkeys(row["method"] for row in rows):
        each = [row for row in rows if row["method"] == method]
        verdicts = [row["verdict"] for row in each]
        programs = [row["programs"] for row in each]
        found.append(
            {
                "method": method,
                "sets": len(each),
                "proved": verdicts.count("PROVED"),
                "refuted": verdicts.count("REFUTED"),
                "programs": None if None in programs else sum(programs),
                "seconds": sum(row["seconds"] for row in each),
                "first": sum(row["first"] for row in each),
                "calls": all(row["calls"] for row in each),
                "problem": each[0]["problem"],
            }
        )
    return found


def contradictions(rows: list[dict[str, Any]]) -> list[str]:
    """Which procedures prove what a simulated trajectory breaks or another procedure refutes."""
    refuted = {row["set"] for row in rows if row["verdict"] == rj.VerdictStatus.REFUTED.name}
    return [
        f"{row['method']} at {row['set']}"
        for row in rows
        if row["verdict"] == rj.VerdictStatus.PROVED.name
        and (row["margin"] < 0 or row["set"] in refuted)
    ]
