"""What each method makes of a task, in what time, and how tight that is: the rows of the table."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from experiments.benchmark.cases import Settings
from experiments.benchmark.rivals.methods import HIGHS, METHODS, Answer
from experiments.benchmark.rivals.processes import Stopped, from_process
from experiments.benchmark.timing import Timing, each_call
from experiments.task import Task

CERTIFIED = ("reach", "LinearBounds")
"""Methods whose bounds have to hold whatever rounding did."""

TOLERANCE = 1e-9
"""What a bound may lack of a simulated value, for the simulation's rounding, as a part of it."""


@dataclass(frozen=True, eq=False)
class Run:
    """A method on a task, in a process of its own.

    Attributes:
        method: its name.
        timing: of its calls; None if the first one did not end.
        problem: why there are fewer calls than asked for, if there are.
    """

    method: str
    timing: Timing | None
    problem: str | None = None

    @classmethod
    def of(cls, task: Task, method: str, settings: Settings) -> "Run":
        """The calls that patience allows."""
        calls, problem = [], None
        try:
            arguments = task, method, settings
            for call in from_process(_calls, *arguments, patience=settings.patience):
                calls.append(call)
        except Stopped as stopped:
            problem = str(stopped)
        return cls(method, Timing.of(calls) if calls else None, problem)

    @property
    def answer(self) -> Answer | None:
        """What the last call found."""
        return self.timing and self.timing.result

    @property
    def finished(self) -> bool:
        """Whether it found all that it looked for."""
        return self.answer is not None and bool(self.answer.done.all())


def _calls(task: Task, method: str, settings: Settings) -> Iterator[tuple[float, Answer]]:
    return each_call(partial(METHODS[method], task, settings), settings)


def known_maxima(
    states: Float[ndarray, "c horizon+1 n_x"], task: Task, runs: list[Run]
) -> Float[ndarray, "horizon m"]:
    """The largest values of the facets that any trajectory is known to attain."""
    attained = [run.answer.attained for run in runs if run.answer]
    return np.nanmax([task.support(states), *attained], axis=0)


def rows(name: str, task: Task, runs: list[Run], settings: Settings) -> list[dict[str, Any]]:
    """A row for each method, with what relates it to HiGHS and to what trajectories attain."""
    states = task.simulated(settings.simulations, settings.seed)
    known = known_maxima(states, task, runs)
    highs = next((run for run in runs if run.method == HIGHS), None)
    shared = {
        "loop": name,
        "horizon": task.horizon,
        "facets": len(task.directions),
        "margin": task.margin(states),
        "clock": settings.clock,
    }
    return [
        shared
        | _seconds(run, settings)
        | {"ratio": _ratio(run, highs), "problem": run.problem}
        | _tightness(run, task, known)
        for run in runs
    ]


def _seconds(run: Run, settings: Settings) -> dict[str, Any]:
    """Of calls; patience where not even the first one ended."""
    timing = run.timing or Timing(settings.patience, [], None)
    return {"method": run.method, "finished": run.finished, **timing.row()}


def _ratio(run: Run, highs: Run | None) -> str:
    """Its warm seconds over those of HiGHS, with a sign where one of them did not finish."""
    if run.timing is None or highs is None or highs.timing is None:
        return "-"
    signs = {(True, True): "", (True, False): "<", (False, True): ">", (False, False): None}
    sign = signs[run.finished, highs.finished]
    return "-" if sign is None else f"{sign}{run.timing.seconds / highs.timing.seconds:.2g}"


def _tightness(run: Run, task: Task, known: Float[ndarray, "horizon m"]) -> dict[str, Any]:
    """How far bounds are from what is attained."""
    if run.answer is None:
        return {"done": 0.0, "size": np.nan, "gap": np.nan, "slack": np.nan, "bounds": None}
    bounds, moving = run.answer.bounds, task.moving(known)
    beyond = (bounds - known)[moving] / task.widths(known)[moving]
    slack = (bounds - known) / abs(known).max(axis=1, keepdims=True)
    bounded = np.isfinite(bounds)
    return {
        "done": float(run.answer.done.mean()),
        "size": size(task, bounds[-1], known[-1]),
        "gap": float(np.median(beyond[np.isfinite(beyond)])) if bounded[moving].any() else np.nan,
        "slack": float(slack[bounded].min()) if bounded.any() else np.nan,
        "bounds": bounds,
    }


def size(task: Task, bounds: Float[ndarray, " m"], known: Float[ndarray, " m"]) -> float:
    """A set over the tightest known one: in area, or in the worst of its widths; NaN if unknown."""
    if not np.isfinite(bounds).all():
        return np.nan
    if task.template.dimension == 2:
        found, tightest = (task.template.polytope(jnp.asarray(each)) for each in (bounds, known))
        return float(found.volume() / tightest.volume())
    moving = task.moving(known[None])[0]
    found, tightest = (task.widths(each[None])[0, moving] for each in (bounds, known))
    return float((found / tightest).max())


def unsound(rows: list[dict[str, Any]]) -> list[str]:
    """Which certified bounds are below a value that is attained, by more than rounding."""
    return [
        f"{row['method']} on {row['loop']}"
        for row in rows
        if row["method"] in CERTIFIED and row["slack"] < -TOLERANCE
    ]
