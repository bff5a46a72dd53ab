"""Seconds of a call: of the first one, which compiles, and of warm ones."""

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np

CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}


class Patience(Protocol):
    """How long calls are repeated: the options of any study that times something."""

    @property
    def repetitions(self) -> int:
        """Warm calls at most."""
        ...

    @property
    def patience(self) -> float:
        """Seconds after which there is no further call."""
        ...

    @property
    def clock(self) -> str:
        """What a second is: one of `CLOCKS`."""
        ...


@dataclass(frozen=True, eq=False)
class Timing:
    """Seconds of the first call, of those after it, and what the last one returned."""

    first: float
    calls: list[float]
    result: Any

    @classmethod
    def of(cls, calls: Iterable[tuple[float, Any]]) -> Self:
        """Seconds and results of calls, one after the other; at least one."""
        seconds, results = zip(*calls, strict=True)
        return cls(seconds[0], list(seconds[1:]), results[-1])

    @property
    def seconds(self) -> float:
        """The median of warm calls; of the first one if there are none."""
        return float(np.median(self.calls or [self.first]))

    def row(self, parts: float = 1.0) -> dict[str, Any]:
        """What rows of results say of it: seconds of one of so many parts of a call."""
        seconds = {"seconds": self.seconds / parts, "first": self.first / parts}
        return seconds | {"calls": self.calls}


def cells(row: dict[str, Any]) -> tuple[str, str]:
    """Seconds of a row and of its first call, with a star where no call was warm."""
    return "*" * (not row["calls"]) + f"{row['seconds']:.3g}", f"{row['first']:.3g}"


def repeated(call: Callable[[], Any], settings: Patience) -> Timing:
    """The first call, and as many warm ones as patience allows."""
    return Timing.of(each_call(call, settings))


def each_call(call: Callable[[], Any], settings: Patience) -> Iterator[tuple[float, Any]]:
    """Seconds and result of the first call and of each warm one, as they are there."""
    clock, spent = CLOCKS[settings.clock], 0.0
    for number in range(1 + settings.repetitions):
        if number and spent >= settings.patience:
            return
        began = clock()
        result = call()
        seconds = clock() - began
        spent += seconds
        yield seconds, result
