"""Cells that are bounded by an executor, or one after the other where there is none.

A worker may die, and an executor with it. Cells that were in flight are taken back then, and
bounded once more in the calling process, as are all that come after them.
"""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
)
from concurrent.futures import wait as wait_for
from typing import Any, Generic, NamedTuple, TypeVar

WORKERS = 4
"""How many an executor has that does not say it."""

Kept = TypeVar("Kept")

DEAD = "KilledWorker", "CommClosedError", "FutureCancelledError"
"""What dask calls workers that have died: its classes are not imported for their names."""


class _Job(NamedTuple, Generic[Kept]):
    """A job, and what it is of."""

    kept: Kept
    function: Callable[..., Any]
    given: tuple[Any, ...]


class CellJobs(Generic[Kept]):
    """Jobs that run, each with the cells that it is of.

    Args:
        executor: runs them; None: here.
        ahead: how many it is given for each of its workers.

    Attributes:
        workers: how many jobs run at a time.
        most: how many there may be at a time.
    """

    def __init__(self, executor: Executor | None, ahead: int):
        self._executor, self._sent = executor, False
        self._running: dict[Future, _Job[Kept]] = {}
        self.workers = 1 if executor is None else getattr(executor, "_max_workers", WORKERS)
        self.most = 1 if executor is None else ahead * self.workers

    def __len__(self) -> int:
        return len(self._running)

    def submit(self, kept: Kept, function: Callable[..., Any], *given: Any) -> None:
        """Begin a job; without an executor it is done once it is asked for."""
        future: Future = Future()
        if self._executor is not None:
            self._require_sent(function, given)
            try:
                future = self._executor.submit(function, *given)
            except BrokenExecutor as error:
                self._give_up(error)
        self._running[future] = _Job(kept, function, given)

    def _require_sent(self, function: Callable[..., Any], given: tuple[Any, ...]) -> None:
        """Raise an error where processes would be sent what cannot travel; of the first job.

        Raises:
            TypeError: a function is none of a module.
        """
        if self._sent or not isinstance(self._executor, ProcessPoolExecutor):
            return
        try:
            pickle.dumps((function, given))
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise TypeError(
                "executor sends the loop to other processes, but a function that is a lambda or "
                f"stands within another one cannot be sent ({error}): define it at the top of a "
                "module, or take threads (ThreadPoolExecutor) or dask (client.get_executor())"
            ) from None
        self._sent = True

    def finished(self) -> Iterator[tuple[Kept, Any]]:
        """The jobs that are done, with their results, once there are any.

        A job stays among those that run until there is a result.
        """
        if self._executor is None:
            done = list(self._running)[:1]
        else:
            done, _ = wait_for(self._running, return_when=FIRST_COMPLETED)
        for future in done:
            job = self._running[future]
            result = self._result(future, job)
            del self._running[future]
            yield job.kept, result

    def _result(self, future: Future, job: _Job[Kept]) -> Any:
        """The result of a job, here if it has none from elsewhere."""
        if self._executor is not None or future.done():
            try:
                return future.result()
            except (BrokenExecutor, CancelledError) as error:
                self._give_up(error)
            except Exception as error:
                if type(error).__name__ not in DEAD:
                    raise
                self._warn(error)  # dask has others
        return job.function(*job.given)

    def _give_up(self, error: BaseException) -> None:
        """Go on in this process."""
        if self._executor is not None:
            self._warn(error)
        self._executor, self.most, self.workers = None, 1, 1

    @staticmethod
    def _warn(error: BaseException) -> None:
        reason = str(error) or type(error).__name__
        warnings.warn(
            f"a worker of the executor has died ({reason}): nothing that was decided is lost, and "
            "cells that it was given are bounded in this process",
            RuntimeWarning,
            stacklevel=2,
        )

    def cancelled(self) -> list[Kept]:
        """The cells of jobs that are left, none of which runs any more than it must."""
        left = [job.kept for job in self._running.values()]
        for future in self._running:
            future.cancel()
        self._running.clear()
        return left
