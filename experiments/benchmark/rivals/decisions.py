"""Whether a car keeps its distance, from six initial sets: who decides it, and in what time.

`decide` against `verify` on the tube of `LinearBounds`, affine forms in plain numpy, which can only
prove, and samples, which can only refute. Each answers for all sets in a process of its own.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from rich.table import Table

import reachjax as rj
from experiments import report
from experiments.benchmark.cases import Settings
from experiments.benchmark.rivals import cruise_control
from experiments.benchmark.rivals.affine_forms import affine_bounds
from experiments.benchmark.rivals.processes import Stopped, from_process
from experiments.benchmark.rivals.task import Task
from experiments.benchmark.timing import Timing, cells, each_call

AHEAD = (0.0, -25.0, -30.6, -30.8, -35.0, -45.0)
"""Metres by which the lead is farther ahead, in each initial set."""

UNDECIDED = "-"

Answer = Callable[[Task, Settings], str]


def by_decide(task: Task, _: Settings) -> str:
    """`rj.decide`."""
    return rj.decide(task.loop, task.X0, task.horizon, safe=task.safe).status.name.lower()


def by_tube(task: Task, _: Settings) -> str:
    """`rj.verify` on the tube of `rj.LinearBounds`."""
    tube = rj.reach(task.loop, task.X0, task.horizon, task.template, rj.LinearBounds())
    return rj.verify(tube, safe=task.safe).status.name.lower()


def by_numpy(task: Task, _: Settings) -> str:
    """Affine forms, which prove what they bound: every step but the first set, known by corners."""
    assert task.safe is not None
    A, b = map(np.asarray, task.safe.facets)
    at_first = (task.X0.vertices() @ A.T).max(axis=0)
    bounds = np.vstack([at_first, affine_bounds(task.loop, task.X0, task.horizon, A)])
    return "proved" if np.all(bounds <= b) else UNDECIDED


def by_simulation(task: Task, settings: Settings) -> str:
    """Trajectories, which refute what they break."""
    broken = task.margin(task.simulated(settings.simulations, settings.seed)) < 0
    return "refuted" if broken else UNDECIDED


METHODS: dict[str, Answer] = {
    "decide": by_decide,
    "verify": by_tube,
    "numpy": by_numpy,
    "samples": by_simulation,
}
"""By the names that tables have, the library first."""


def tasks() -> dict[float, Task]:
    """The loop from each initial set, by how far the lead is ahead."""
    return {ahead: cruise_control.following(ahead) for ahead in AHEAD}


def _answers(method: str, sets: dict[float, Task], settings: Settings) -> dict[str, str]:
    return {f"{ahead:+g}": METHODS[method](task, settings) for ahead, task in sets.items()}


def _calls(
    method: str, sets: dict[float, Task], settings: Settings
) -> Iterator[tuple[float, dict[str, str]]]:
    return each_call(partial(_answers, method, sets, settings), settings)


def row(method: str, sets: dict[float, Task], settings: Settings) -> dict[str, Any]:
    """What a method says of every set, and its seconds for all of them together."""
    arguments, calls = (method, sets, settings), []
    try:
        for call in from_process(_calls, *arguments, patience=settings.patience):
            calls.append(call)
    except Stopped:
        if not calls:
            calls = [(settings.patience, dict.fromkeys(map("{:+g}".format, sets), "?"))]
    timing = Timing.of(calls)
    return {"method": method, "answers": timing.result, **timing.row()}


def margins(sets: dict[float, Task], settings: Settings) -> dict[str, float]:
    """The least room that simulated trajectories leave, in metres."""
    return {
        f"{ahead:+g}": task.margin(task.simulated(settings.simulations, settings.seed))
        for ahead, task in sets.items()
    }


def _coloured(word: str) -> str:
    verdict = word.upper()
    return report.coloured(verdict, word) if verdict in report.COLOURS else word


def table(rows: list[dict[str, Any]], rooms: dict[str, float], settings: Settings) -> Table:
    """A row for each method, a column for each set."""
    simulated = ("room", *(f"{room:.2f}" for room in rooms.values()), "", "")
    shown = [simulated, ("",) * len(simulated)]
    for each in rows:
        warm, first = cells(each)
        shown.append((each["method"], *map(_coloured, each["answers"].values()), first, warm))
    title = (
        "is the distance kept? by metres that the lead is ahead; room that\n"
        f"simulations leave, in metres; {settings.clock} seconds for all sets"
    )
    return report.table(title, ("method",), (*rooms, "first", "warm"), shown)
