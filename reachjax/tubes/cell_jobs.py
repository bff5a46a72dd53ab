"""Cells that are bounded by an executor, or one after the other where there is none."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from typing import Any, Generic, TypeVar

WORKERS = 4
"""How many an executor has that does not say it."""

Kept = TypeVar("Kept")


class CellJobs(Generic[Kept]):
    """Jobs that run, each with the cells that it is of.

    Args:
        executor: runs them; None: here.
        ahead: how many it is given for each of its workers.

    Attributes:
        most: how many there may be at a time.
    """

    def __init__(self, executor: Executor | None, ahead: int):
        self._executor = executor
        self._running: dict[Future, Kept] = {}
        self.most = 1 if executor is None else ahead * getattr(executor, "_max_workers", WORKERS)

    def __len__(self) -> int:
        return len(self._running)

    def submit(self, kept: Kept, function: Callable[..., Any], *given: Any) -> None:
        """Begin a job; without an executor it is done at once."""
        if self._executor is None:
            future: Future = Future()
            future.set_result(function(*given))
        else:
            future = self._executor.submit(function, *given)
        self._running[future] = kept

    def finished(self) -> Iterator[tuple[Kept, Any]]:
        """Those that are done, with their results, once there are any."""
        done, _ = wait(self._running, return_when=FIRST_COMPLETED)
        for future in done:
            yield self._running.pop(future), future.result()

    def cancelled(self) -> list[Kept]:
        """What is left, none of which runs any more than it must."""
        left = list(self._running.values())
        for future in self._running:
            future.cancel()
        self._running.clear()
        return left
