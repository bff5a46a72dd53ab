"""Verdicts: at samples of plants that one step of Runge-Kutta samples, and at all times."""

import functools
import os
import time
from collections.abc import Callable, Iterator
from typing import Any

import reachjax as rj
from experiments.benchmark.cases import Settings
from experiments.benchmark.rivals.processes import workers
from experiments.benchmark.smooth import loops
from experiments.benchmark.smooth.rows import Figures, Row
from experiments.competition.instances import Instance
from experiments.sampled.problems import STRIDE, car

CELLS = 10_000
"""Into so many an initial set may be halved."""

AGAIN = 120.0
"""A decision that took longer, in seconds, is not made again."""

Read = Callable[[str, Settings], tuple[Instance, rj.ClosedLoop]]


def decided(
    title: str, read: Read, discrete: bool, options: dict[str, Any], settings: Settings
) -> Iterator[Figures]:
    """Verdict and seconds of the first decision, and the seconds of another one.

    Args:
        title: of the instance.
        read: how its loop is made.
        discrete: whether the plant is sampled by one step of Runge-Kutta, as if it were exact.
        options: of `rj.decide`.
        settings: of the benchmark.
    """
    instance, loop = read(title, settings)
    if discrete:
        loop = loops.at_samples(loop)
    given = loop, instance.X0, instance.horizon
    with workers(os.cpu_count() or 1) as executor:
        asked = {**instance.required, **options, "executor": executor}
        yield from twice(functools.partial(rj.decide, *given, **asked))


def twice(decide: Callable[[], rj.Verdict]) -> Iterator[Figures]:
    """What a decision says, and its seconds, the second time where that is soon there."""
    began = time.perf_counter()
    verdict = decide()
    first = time.perf_counter() - began
    yield {"verdict": verdict.status.name, "first, s": first, "cells": max(len(verdict.cells), 1)}
    if first < AGAIN:
        began = time.perf_counter()
        decide()
        yield {"warm, s": time.perf_counter() - began}


def between(settings: Settings) -> Iterator[Figures]:
    """A car that drives through a wall between two samples."""
    sampled = car()
    given, loop = sampled.problem, sampled.loop(loops.learned(sampled, "car", settings))
    assert sampled.discrete is not None
    discrete = loop.replace(plant=sampled.discrete)
    found = rj.decide(discrete, given.X0, given.horizon, **sampled.required)
    yield {"at samples": found.status.name}
    began = time.perf_counter()
    verdict = rj.decide(loop, given.X0, given.horizon, **sampled.required)
    yield {"verdict": verdict.status.name, "first, s": time.perf_counter() - began}
    example = verdict.counterexample
    if example is not None and example.instant is not None:
        instant = float(example.instant)
        yield {"instant, s": instant, "instant, periods": instant / STRIDE}


def _row(
    loop: str,
    name: str,
    title: str,
    seconds: float,
    *,
    warm: float | None = None,
    verdict: str = "PROVED",
    trained: bool = False,
    discrete: bool = True,
    **options: Any,
) -> Row:
    read = loops.stand_in if trained else loops.read
    asked = {"verdict": verdict, "first, s": seconds, "warm, s": warm, "cells": None}
    measure = functools.partial(decided, title, read, discrete, options)
    return Row(loop, name, asked, measure, () if trained else (title,))


AT_ALL_TIMES = {
    "single pendulum": (loops.SINGLE, 8.0),
    "cruise control": (loops.CRUISE, 8.0),
    "TORA, tanh": (loops.OSCILLATOR, 8.0),
    "double pendulum": (loops.DOUBLE, 60.0),
    "navigation": (loops.NAVIGATION, 90.0),
}

ROWS = (
    _row("double", "double pendulum, full set, 20 periods", loops.DOUBLE, 60.0, cells=CELLS),
    _row("navigation", "navigation, obstacle and goal", loops.NAVIGATION, 60.0, cells=CELLS),
    _row(
        "quadrotor",
        "12 states, altitude after 50 periods",
        loops.QUADROTOR,
        600.0,
        trained=True,
        cells=CELLS,
        time_limit=600.0,
    ),
    _row(
        "airplane",
        "12 states, time_limit=20",
        loops.AIRPLANE,
        5.0,
        verdict="REFUTED",
        time_limit=20.0,
    ),
    *(
        _row("proved", name, title, most, warm=most / 3, discrete=False)
        for name, (title, most) in AT_ALL_TIMES.items()
    ),
    Row(
        "between",
        "a car through a wall between two samples",
        {
            "at samples": "PROVED",
            "verdict": "REFUTED",
            "first, s": None,
            "instant, s": None,
            "instant, periods": None,
        },
        between,
    ),
)
