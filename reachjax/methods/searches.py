"""The loop of every search over cells: which are asked about next, who answers, what follows.

A search says what is to be found out next, and what follows from an answer. Answers come from any
method: forms of many cells in one compiled call, programs over one, a whole tube. Who runs them,
workers that die, and progress bars are dealt with here.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Executor
from contextlib import closing
from typing import Any, NamedTuple

from reachjax.methods.cell_jobs import CellJobs
from reachjax.methods.cell_tree import Node
from reachjax.numerics.checks import wrapped

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
