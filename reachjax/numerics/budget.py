"""What a call may spend: one clock that every loop asks, and the work of its programs.

A limit is a limit: whatever may take long asks the clock before it begins, or is given what is
left. A part of the time is a budget too, so that nobody takes what others were to have. What was
found when a call is interrupted is not lost.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Self

from reachjax.numerics.checks import real_number


class TimeOverError(Exception):
    """The budget in force is over: whoever put it in force goes on with what there is."""


GRACE = 0.4
"""Seconds that forms, which are solved by nobody, may go on after the end."""


MOST_BYTES = 2**32
"""The memory that one program may take. At `PACE` a larger one takes a minute an iteration."""

PACE = 2e9
"""Operations a second. Measured with one thread: 0.9 to 2.7 in iterations of the interior-point
method with 316 to 1,564 multipliers, 2.4 in Clarabel's with 53 columns."""


class Budget:
    """Seconds until a deadline, and work, of which all parts of a budget spend together.

    Args:
        seconds: from now on; infinite where time is no limit.
        work: what programs may take, in units of whoever spends it.

    Example:
        >>> budget = Budget(3600.0)
        >>> half = budget.share(1 / 2)
        >>> budget.late, 1799 < half.left <= 1800
        (False, True)
        >>> half.spend(2.0), Budget(0.0).late
        (None, True)
    """

    def __init__(self, seconds: float = math.inf, work: float = math.inf):
        self._begun = time.monotonic()
        self._end, self._purse = self._begun + seconds, [work]
        self._stopped = [False]

    @classmethod
    def of(cls, time_limit: float | Self | None, work: float = math.inf) -> Self:
        """The budget of a call with this limit, which begins now; a budget is one already.

        Raises:
            TypeError: the limit is no number.
            ValueError: it is negative.
        """
        if isinstance(time_limit, cls):
            return time_limit
        if time_limit is None:
            return cls(work=work)
        return cls(real_number("time_limit", time_limit, 0.0), work)

    def __repr__(self) -> str:
        return f"Budget(seconds={self.left:.3g}, work={self.work:.3g})"

    def __getstate__(self) -> tuple[float, list[float], list[bool]]:
        """How it is sent to another process, or machine, whose monotonic clock is another one."""
        return time.time() + self.left, self._purse, self._stopped

    def __setstate__(self, state: tuple[float, list[float], list[bool]]) -> None:
        end, self._purse, self._stopped = state
        self._begun = time.monotonic()
        self._end = self._begun + end - time.time()

    @property
    def left(self) -> float:
        """The seconds that are left; zero when the time is over."""
        return 0.0 if self.stopped else max(self._end - time.monotonic(), 0.0)

    @property
    def overrun(self) -> float:
        """The seconds that have passed since the time was over; zero before."""
        return max(time.monotonic() - self._end, 0.0)

    @property
    def elapsed(self) -> float:
        """The seconds since the budget, or this share of one, began."""
        return time.monotonic() - self._begun

    @property
    def late(self) -> bool:
        """Whether the time is over."""
        return self.stopped or time.monotonic() >= self._end

    @property
    def overdue(self) -> bool:
        """Whether the time has been over for so long that what is cheap ends as well."""
        return self.stopped or time.monotonic() >= self._end + GRACE

    @property
    def stopped(self) -> bool:
        """Whether somebody stopped it, or what it is a part of."""
        return self._stopped[0]

    def stop(self) -> None:
        """Let its time be over, and that of all parts of it in this process, at once."""
        self._stopped[0] = True

    @property
    def timed(self) -> bool:
        """Whether time is a limit at all."""
        return math.isfinite(self._end)

    @property
    def limit(self) -> float | None:
        """The seconds that are left as calls take them: None where time is no limit."""
        return self.left if self.timed else None

    @property
    def work(self) -> float:
        """The work that is left."""
        return self._purse[0]

    def with_work(self, work: float) -> Budget:
        """The budget that ends with this one, and has so much work of its own."""
        found = self.share(1.0)
        found._purse = [work]
        return found

    def share(self, part: float) -> Budget:
        """The budget that ends when this part of the time that is left is over.

        Work is spent from the same purse.
        """
        found = Budget()
        found._end = found._begun + part * (self._end - found._begun)
        found._purse = self._purse
        found._stopped = self._stopped
        return found

    def require(self) -> None:
        """Raise an error where the time is over, from deep within what takes long.

        Raises:
            TimeOverError: that is so.
        """
        if self.late:
            raise TimeOverError

    @contextmanager
    def in_force(self) -> Iterator[None]:
        """Let `clock()` be this budget, for solvers, which are given a program and nothing else."""
        token = _IN_FORCE.set(self)
        try:
            yield
        finally:
            _IN_FORCE.reset(token)

    def spend(self, work: float) -> None:
        """Take so much from the work that is left."""
        self._purse[0] -= work

    def grant(self, work: float) -> None:
        """Let so much work be left, at least."""
        self._purse[0] = max(self._purse[0], work)


ENDLESS = Budget()
"""A budget that is never spent."""

_IN_FORCE: ContextVar[Budget] = ContextVar("budget", default=ENDLESS)


def clock() -> Budget:
    """The budget that is in force: without limits where none is."""
    return _IN_FORCE.get()


def require_memory(what: str, numbers: float, operations: float) -> None:
    """Raise an error before work begins that is too large for memory or for the time in force.

    Args:
        what: is about to be solved.
        numbers: of 64 bits that it takes.
        operations: of floats until there is a first iterate.

    Raises:
        MemoryError: it would take more than `MOST_BYTES`.
        TimeOverError: the time would be over before.

    Example:
        >>> require_memory("a program of 10 unknowns", 100.0, 1e4)
        >>> require_memory("a program of 130,816 multipliers", 130_816.0**2, 1e15)
        Traceback (most recent call last):
        MemoryError: a program of 130,816 multipliers would take 128 GiB, and 4 GiB is the most
    """
    if 8 * numbers > MOST_BYTES:
        asked, most = 8 * numbers / 2**30, MOST_BYTES / 2**30
        raise MemoryError(f"{what} would take {asked:.3g} GiB, and {most:.3g} GiB is the most")
    if operations > PACE * clock().left:
        raise TimeOverError


class Interrupted(KeyboardInterrupt):
    """A call was interrupted (Ctrl-C): what was found by then is not lost.

    Its message says how to go on. It can be pickled, as when it comes from another process.

    Attributes:
        found: of `reach` and `ReachTube.extended`, the tube of the steps that were done, also as
            `tube`: `tube.extended(steps)` goes on. Of `reach_partitioned`, the tubes of the cells
            that were done, from which `known=` goes on. Of `winning_set`, a `WinningSet`, from
            which `known=` goes on. Of `largest_set`, the largest set so far, whose `region` is
            where to go on. Of `decide` and `verify`, the verdict so far.
    """

    def __init__(self, message: str, found: Any):
        super().__init__(message)
        self.found = found

    def __reduce__(self) -> tuple[type, tuple[str, Any]]:
        """How it is pickled."""
        return type(self), (str(self), self.found)

    @property
    def tube(self) -> Any:
        """What was found, where that is a tube."""
        return self.found
