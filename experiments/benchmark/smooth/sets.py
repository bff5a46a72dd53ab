"""How soon the largest set and the winning set of a planar quadrotor are under way."""

import functools
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import reachjax as rj
from experiments.benchmark.cases import Settings
from experiments.benchmark.smooth import loops
from experiments.benchmark.smooth.rows import Figures, Row
from experiments.sampled.problems import quadrotor

PERIODS = 60
LIMIT = 300.0
"""Seconds after which there is no progress to wait for."""


class UnderWay(Exception):  # noqa: N818
    """The first progress is there."""


def first_progress(search: Callable[..., Any], settings: Settings) -> Iterator[Figures]:
    """Seconds until a search says for the first time that something is done."""
    sampled = quadrotor()
    loop = loops.at_samples(sampled.loop(loops.learned(sampled, "quadrotor", settings)))

    def seen(items: Iterable[Any]) -> Iterator[Any]:
        for _ in items:
            raise UnderWay
        yield from ()

    given, options = (loop, sampled.problem.X0, PERIODS), {"safe": sampled.problem.safe}
    began = time.perf_counter()
    said = "without progress"
    try:
        search(*given, **options, time_limit=LIMIT, progress=seen)
    except UnderWay:
        said = "under way"
    yield {"search": said, "first progress, s": time.perf_counter() - began}


ROWS = tuple(
    Row(
        "sets",
        f"{search.__name__}, planar quadrotor, {PERIODS} periods",
        {"first progress, s": 5.0, "search": "under way"},
        functools.partial(first_progress, search),
    )
    for search in (rj.largest_set, rj.winning_set)
)
