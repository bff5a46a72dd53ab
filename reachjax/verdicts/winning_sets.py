"""What is known of the initial states of a box: which win, which lose, and which are undecided."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import ArrayLike, Bool, Float

from reachjax.numerics.checks import Numbers, require_kind, same_size
from reachjax.numerics.flags import lenient
from reachjax.numerics.seals import Seal
from reachjax.sets import Box
from reachjax.tubes.displays import display, picture, table
from reachjax.verdicts.verdict import DecidedCell, Verdict, VerdictStatus, draw_cells

if TYPE_CHECKING:
    from matplotlib.axes import Axes

AT_ONCE = 1000
"""So many points are looked up at a time."""


@dataclasses.dataclass(frozen=True)
class WinningSet:
    """Cells that cover a domain, each of which is proved, refuted or undecided.

    Proved is a cell if the specification surely holds from every state of it, refuted if it surely
    holds from none. Proved cells are an inner estimate of the winning set; all but the refuted ones
    are an outer one. `plot_cells` draws them.

    Attributes:
        domain: the initial states that were asked about.
        cells: they cover it.
        seal: a hash of the question: of the loop, the domain, and what is required of it when.
    """

    domain: Box
    cells: tuple[DecidedCell, ...]
    seal: Seal

    def __repr__(self) -> str:
        return f"WinningSet(cells={len(self.cells)}, states={self.domain.dimension})"

    def __str__(self) -> str:
        lines = [f"{'':10} {'cells':>7} {'volume':>10} {'part':>7}"]
        for status in VerdictStatus:
            size, count = self.volume(status), len(self.of(status))
            part = self._part(status)
            lines.append(f"{status.value:10} {count:7d} {size:10.4g} {part:>7}")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        rows = [
            [status.value, len(self.of(status)), self.volume(status), self._part(status)]
            for status in VerdictStatus
        ]
        drawn = picture(self.plot) if self.domain.dimension > 1 else ""
        return display(repr(self), table(["", "cells", "volume", "part"], rows), drawn)

    def plot(self, ax: Axes | None = None, coordinates: tuple[int, int] = (0, 1)) -> Axes:
        """Draw the cells, see `reachjax.plot_cells`."""
        return draw_cells(self.cells, ax, coordinates)

    def _part(self, status: VerdictStatus) -> str:
        """The part of the domain with this status, whose flat coordinates count for nothing."""
        wide = np.asarray(self.domain.widths) > 0
        sizes = [
            sum(np.prod((cell.upper - cell.lower)[wide]) for cell in cells)
            for cells in (self.of(status), self.cells)
        ]
        return f"{sizes[0] / sizes[1]:.2%}"

    def of(self, status: VerdictStatus) -> tuple[DecidedCell, ...]:
        """The cells of which this is known."""
        return tuple(cell for cell in self.cells if cell.status is status)

    def volume(self, status: VerdictStatus) -> float:
        """The volume of these cells together, in the units of the states."""
        return float(sum(np.prod(cell.upper - cell.lower) for cell in self.of(status)))

    def contains(self, states: Float[ArrayLike, "*batch n"]) -> Bool[np.ndarray, "*batch"]:
        """Which states are in the inner estimate: the specification surely holds from them."""
        return self._in(states, VerdictStatus.PROVED)

    def excludes(self, states: Float[ArrayLike, "*batch n"]) -> Bool[np.ndarray, "*batch"]:
        """Which states are outside of the outer estimate: the specification fails from them."""
        return self._in(states, VerdictStatus.REFUTED)

    def _in(self, states: Float[ArrayLike, "*batch n"], status: VerdictStatus) -> np.ndarray:
        points = np.asarray(Numbers("(n,)", "(batch, n)")(states, "states"))
        same_size(
            "the domain's dimension is",
            "the dimension of states is",
            (self.domain.dimension, points.shape[-1]),
        )
        flat, cells = points.reshape(-1, points.shape[-1]), self.of(status)
        found = np.zeros(len(flat), dtype=bool)
        if cells:
            lower, upper = (
                np.stack([getattr(c, end) for c in cells]) for end in ("lower", "upper")
            )
            for first in range(0, len(flat), AT_ONCE):
                some = flat[first : first + AT_ONCE, None]
                inside = np.all((lower <= some) & (some <= upper), axis=2)
                found[first : first + AT_ONCE] = np.any(inside, axis=1)
        return found.reshape(points.shape[:-1])


@lenient
def plot_cells(
    verdict: Verdict | WinningSet, ax: Axes | None = None, coordinates: tuple[int, int] = (0, 1)
) -> Axes:
    """Draw which cells of an initial set or a domain are proved, refuted and undecided.

    Of sets of more than two dimensions it draws the cells' shadows, the undecided ones above the
    proved ones, and the refuted ones above all.

    Args:
        verdict: of `decide(..., cells=...)` or `winning_set`.
        ax: where to draw; a new figure by default.
        coordinates: the two states to draw, counted from 0: the horizontal axis, then the vertical
            one.

    Raises:
        TypeError: it is no verdict.
        ValueError: it has no cells, or the coordinates are not two of its states.
    """
    expected = "a Verdict, as decide(...) returns it, or a WinningSet"
    require_kind("verdict", verdict, (Verdict, WinningSet), expected)
    if not verdict.cells:
        raise ValueError("verdict has no cells: give decide(..., cells=...) a number of them")
    return draw_cells(verdict.cells, ax, coordinates)
