"""The loop of every search over cells: which are asked about next, who answers, what follows.

A search says what is to be found out next, and what follows from an answer. Answers come from any
method: forms of many cells in one compiled call, programs over one, a whole tube. Who runs them,
workers that die, and progress bars are dealt with here.

A worker may die, and an executor with it. Cells that were in flight are taken back then, and
bounded once more in the calling process, as are all that come after them.
"""

from __future__ import annotations

import abc
import importlib.util
import pickle
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from concurrent.futures import wait as wait_for
from contextlib import closing
from functools import lru_cache
from typing import Any, Generic, NamedTuple, TypeVar

import jax

from reachjax.methods.cell_tree import Node
from reachjax.numerics.checks import wrapped

WORKERS = 4
"""How many an executor has that does not say it."""

Kept = TypeVar("Kept")

UNSENT = pickle.PicklingError, AttributeError, TypeError
"""How it is said that a value cannot be packed."""


class UnsentError(TypeError):
    """An executor's other processes cannot be sent a job."""


DEAD = "KilledWorker", "CommClosedError", "FutureCancelledError"
"""What dask calls workers that have died: its classes are not imported for their names."""


class _Job(NamedTuple, Generic[Kept]):
    """A job, and what it is of."""

    kept: Kept
    function: Callable[..., Any]
    given: tuple[Any, ...]


def _answered(job: bytes, rest: bytes) -> bytes:
    """The answer to a job, wherever it is, in 64-bit floats."""
    with jax.enable_x64(True):
        function, first = _unpacked(job)
        return _dumps(function(first, *pickle.loads(rest)))


def _dumps(value: Any) -> bytes:
    """A value packed: functions that stand in no module as what they are, by what dask brings."""
    try:
        return pickle.dumps(value)
    except UNSENT:
        if importlib.util.find_spec("cloudpickle") is None:
            raise
        return importlib.import_module("cloudpickle").dumps(value)


@lru_cache(maxsize=4)
def _unpacked(job: bytes) -> tuple[Callable[..., Any], Any]:
    """The function of a job and its first argument: what was recorded of that serves many jobs."""
    return pickle.loads(job)


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
        self._executor = executor
        self._running: dict[Future, _Job[Kept]] = {}
        self.workers = 1 if executor is None else getattr(executor, "_max_workers", WORKERS)
        self.most = 1 if executor is None else ahead * self.workers

    def __len__(self) -> int:
        return len(self._running)

    def submit(self, kept: Kept, function: Callable[..., Any], *given: Any) -> None:
        """Begin a job; without an executor it is done once it is asked for."""
        future: Future = Future()
        if self._executor is not None:
            sent = self._packed(function, given)
            try:
                future = self._executor.submit(*sent)
            except BrokenExecutor as error:
                self._give_up(error)
        self._running[future] = _Job(kept, function, given)

    def _packed(self, function: Callable[..., Any], given: tuple[Any, ...]) -> tuple[Any, ...]:
        """What an executor is sent: of threads the job, of others what needs no 64-bit floats.

        Processes may have none before the job asks for them, and would round arrays of JAX.

        Raises:
            UnsentError: a process would be sent a function that is none of a module.
        """
        if isinstance(self._executor, ThreadPoolExecutor):
            return function, *given
        first, *rest = given
        dumps = pickle.dumps if isinstance(self._executor, ProcessPoolExecutor) else _dumps
        try:
            return _answered, dumps((function, first)), dumps(rest)
        except UNSENT as error:
            raise UnsentError(
                "executor sends the loop to other processes, but a function that is a lambda or "
                f"stands within another one cannot be sent ({error}): define it at the top of a "
                "module, or take threads (ThreadPoolExecutor) or dask (client.get_executor())"
            ) from None

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
                answer = future.result()
                return pickle.loads(answer) if isinstance(answer, bytes) else answer
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


Bar = Callable[[Iterable[Any]], Iterable[Any]]
"""Wraps an iteration over cells, such as `tqdm.tqdm`."""


class Question(NamedTuple):
    """Something to be found out of some cells.

    Attributes:
        nodes: the cells.
        function: that finds it out, wherever it runs.
        given: its arguments.
    """

    nodes: list[Node]
    function: Callable[..., Any]
    given: tuple[Any, ...]


class AbstractSearch(abc.ABC):
    """What is sought by cells.

    Attributes:
        ahead: how many questions an executor is given for each of its workers.
    """

    ahead: int = 1

    @property
    def ended(self) -> bool:
        """Whether nothing more is to be found out, whatever was asked."""
        return False

    @abc.abstractmethod
    def question(self, asked: int, workers: int) -> Question | None:
        """What is to be found out next; None if nothing is, or what comes next rests on answers.

        Args:
            asked: how many questions are open.
            workers: how many are answered at a time.
        """

    @abc.abstractmethod
    def answered(self, question: Question, answer: Any) -> Any:
        """Note what follows from an answer; what is returned, a progress bar sees."""

    def run(self, executor: Executor | None = None, progress: Bar | None = None) -> None:
        """Ask until nothing more is to be found out, or a progress bar ends.

        Args:
            executor: answers; None: this process, one question after the other.
            progress: wraps the iteration over answers.
        """
        with closing(self._answers(executor)) as answers:
            for _ in wrapped(progress, answers):
                if self.ended:
                    break

    def _answers(self, executor: Executor | None) -> Generator[Any, None, None]:
        jobs = CellJobs[Question](executor, self.ahead)
        try:
            while not self.ended:
                while len(jobs) < jobs.most:
                    question = self.question(len(jobs), jobs.workers)
                    if question is None:
                        break
                    jobs.submit(question, question.function, *question.given)
                if not len(jobs):
                    return
                for question, answer in jobs.finished():
                    yield self.answered(question, answer)
        finally:
            jobs.cancelled()
