"""Interrupted calls: what was found by then is not lost."""

from __future__ import annotations

from typing import Any


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
