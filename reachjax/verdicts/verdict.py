"""What is known of a specification: it is proved, refuted, or neither.

*Proved*: every state is surely where it must be, and the margins say by how much. *Refuted*: a
simulated trajectory breaks the specification, and is given. *Unknown*: the sets are too large to
prove it, and no trajectory breaks it; margins of both kinds say how far apart they are. Margins are
distances in the units of the state.

Of the initial states of a box, a winning set says which win, which lose, and which are undecided.
"""

from __future__ import annotations

import dataclasses
import enum
import html
import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Bool, Float

from reachjax.numerics.archives import writable
from reachjax.numerics.checks import Numbers, require_double_precision, require_kind, same_size
from reachjax.numerics.flags import lenient
from reachjax.numerics.seals import Seal
from reachjax.programs.followed import OpenDecision
from reachjax.proofs.certificates import AbstractProof, told
from reachjax.proofs.proposal import AS_ASKED, SolverStatus
from reachjax.sets import AbstractSet, Box, PolyhedralSet
from reachjax.sets.pictures import draw_boxes
from reachjax.tubes.displays import display, picture, table
from reachjax.tubes.saving import keep
from reachjax.verdicts.grounds import Asked, Closing, Grounds

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class VerdictStatus(enum.Enum):
    """What is known of a specification."""

    PROVED = "proved"
    REFUTED = "refuted"
    UNKNOWN = "unknown"


@dataclasses.dataclass(frozen=True)
class Counterexample:
    """A simulated trajectory that breaks a specification.

    Attributes:
        requirement: which part it breaks: `goal`, `safe` or `avoid[i]`.
        time: when.
        violation: by how much, in the units of the state.
        states: `(horizon + 1, n_x)`, the whole trajectory.
        inputs: `(horizon, n_u)`.
        disturbances: `(horizon, n_w)`; None of a loop without.
        noises: `(horizon, n_x)`; None of a loop without.
        instant: when, in the plant's units of time, of a differential equation: it may be in
            between the sample at `time` and the one before.
        lower: `(time + 1, n_x)`, the exact trajectory at samples is above, rounding accounted for,
        upper: `(time + 1, n_x)`, and below. In between samples the last row is of `instant`.
        region: the set that states must be in, or be out of.
        decision: of a loop that jumps, by how much the closest of the decisions on the trajectory
            wins up to `time`: the size of what is compared with zero, more than its rounding.
    """

    requirement: str
    time: int
    violation: float
    states: Float[np.ndarray, "h+1 n_x"]
    inputs: Float[np.ndarray, "h n_u"]
    disturbances: Float[np.ndarray, "h n_w"] | None = None
    noises: Float[np.ndarray, "h n_x"] | None = None
    instant: float | None = None
    decision: float | None = None
    lower: Float[np.ndarray, "t n_x"] | None = None
    upper: Float[np.ndarray, "t n_x"] | None = None
    region: AbstractSet | None = None

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the trajectory as JSON, which anybody can check.

        Numbers are those of the computer, to the last bit, as Python and others read decimals.

        Args:
            path: of the file; one that is there is replaced.

        Raises:
            OSError: it cannot be written.
        """
        count, required = self.time, _as_numbers(self.region, self.requirement)
        parts = {
            "initial_state": self.states[0],
            "inputs": self.inputs[:count],
            "disturbances": None if self.disturbances is None else self.disturbances[:count],
            "noises": None if self.noises is None else self.noises[:count],
            "states": self.states[: count + 1],
            "lower": self.lower,
            "upper": self.upper,
        }
        told = {name: None if part is None else part.tolist() for name, part in parts.items()}
        said = {"requirement": self.requirement, "sample": count, "instant": self.instant}
        content = said | {"violation": self.violation, "required": required} | told
        writable("path", path).write_text(json.dumps(content, indent=1, allow_nan=False))


def _as_numbers(region: AbstractSet | None, requirement: str) -> dict[str, Any]:
    """A set as a user would write it, and whether states must be in it."""
    found: dict[str, Any] = {"inside": not requirement.startswith("avoid")}
    flat, ball = (None, None) if region is None else region.parts
    if ball is not None:
        found |= {"center": ball.center.tolist(), "shape": ball.shape.tolist()}
    if flat is not None:
        A, b = map(np.asarray, flat.facets)
        found |= {"normals": A.tolist(), "offsets": b.tolist()}
    return found


class DecidedCell(NamedTuple):
    """What is known of one cell of an initial set, or of a domain.

    Attributes:
        lower: `(n_x,)`, of its box.
        upper: `(n_x,)`.
        status: of the cell alone. Refuted is, in a verdict, one in which a counterexample begins;
            in a winning set, one from every state of which the specification fails.
        margin: the smallest certified one.
    """

    lower: Float[np.ndarray, " n_x"]
    upper: Float[np.ndarray, " n_x"]
    status: VerdictStatus
    margin: float


CELL_COLORS = {
    VerdictStatus.PROVED: "tab:green",
    VerdictStatus.UNKNOWN: "tab:gray",
    VerdictStatus.REFUTED: "tab:red",
}


def draw_cells(
    cells: Sequence[DecidedCell], ax: Axes | None = None, coordinates: tuple[int, int] = (0, 1)
) -> Axes:
    """Draw cells by their statuses: the proved below the undecided, these below the refuted."""
    groups = {}
    for status, color in CELL_COLORS.items():
        # white edges would hide cells as narrow as those at a boundary
        edge = color if status is VerdictStatus.UNKNOWN else "white"
        groups[status.value] = color, edge, [cell for cell in cells if cell.status is status]
    return draw_boxes(groups, ax, coordinates)


@dataclasses.dataclass(frozen=True)
class Recurrence:
    """A set that states come into, and come back to: what holds until then holds for ever.

    Attributes:
        step: when every state is in the set.
        period: after how many steps every state of the set is in it again.
        region: the set.
        margin: by how much they are inside; negative, by how much that fails to be proved.
        proved: whether that is proved, and what is required in between.
    """

    step: int
    period: int
    region: PolyhedralSet
    margin: float
    proved: bool


class KeptVerdict(NamedTuple):
    """What a file keeps of a verdict.

    Attributes:
        asked: what it is about.
        status: proved, refuted or unknown.
        counterexample: the trajectory, when refuted.
        grounds: what proves it anew.
    """

    asked: Asked
    status: VerdictStatus
    counterexample: Counterexample | None
    grounds: Grounds | Closing | None

    @property
    def verdict(self) -> Verdict:
        """The verdict, of whose margins nothing is known before they are proved anew."""
        times = self.asked.horizon + 1
        margins = {item.name: np.full(times, np.nan) for item in self.asked.required}
        for item in self.asked.required:
            margins[item.name][item.time] = -np.inf
        simulated = {name: np.full(times, np.nan) for name in margins}
        given = self.status, margins, simulated, self.counterexample
        return Verdict(*given, asked=self.asked, grounds=self.grounds)


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What is known of a specification, part by part.

    Attributes:
        status: proved, refuted or unknown.
        margins: for each requirement `(horizon + 1,)`, the certified margin at each time; NaN where
            nothing is required, minus infinity where nothing is known. Negative: not proved. Sets
            to be avoided are called `avoid[0]`, `avoid[1]`, ... in the order in which they are
            given, those of a mapping one after the other.
        simulated: the same for the sampled trajectories. Negative: broken.
        counterexample: the trajectory, when refuted.
        ends: how many of the bounds that it rests on ended in which way: those that are not
            `SOLVED` hold, but may be loose.
        certificates: of a verdict without a tube, what each requirement that is proved rests on,
            by its name and its time.
        cells: of a decision by cells, what is known of each, see `plot_cells`.
        recurrence: of a statement for all time, what it rests on, or what came nearest to that; of
            a verdict that was read from a file, once it is proved anew.
        asked: of a verdict without a tube, what it is about.
        grounds: of one that is proved without a tube, what proves it anew.
        decisions: of a loop that jumps, those that may go either way over the initial set, or over
            cells of it that are not proved.
    """

    status: VerdictStatus
    margins: dict[str, Float[np.ndarray, " h+1"]]
    simulated: dict[str, Float[np.ndarray, " h+1"]]
    counterexample: Counterexample | None = None
    ends: Mapping[SolverStatus, int] = dataclasses.field(default_factory=dict)
    certificates: Mapping[tuple[str, int], AbstractProof] = dataclasses.field(default_factory=dict)
    cells: tuple[DecidedCell, ...] = ()
    recurrence: Recurrence | None = None
    asked: Asked | None = None
    grounds: Grounds | Closing | None = None
    decisions: tuple[OpenDecision, ...] = ()

    @property
    def proved(self) -> bool:
        """Whether every state surely is where it must be."""
        return self.status is VerdictStatus.PROVED

    @property
    def refuted(self) -> bool:
        """Whether a trajectory surely breaks the specification."""
        return self.status is VerdictStatus.REFUTED

    @property
    def unknown(self) -> bool:
        """Whether neither is known."""
        return self.status is VerdictStatus.UNKNOWN

    @property
    def unsolved(self) -> int:
        """How many of the bounds that it rests on are not as tight as was asked for."""
        return sum(count for status, count in self.ends.items() if status not in AS_ASKED)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Keep a verdict of `decide` in a file, from which `reachjax.load` reads it.

        With what it rests on, so that `reachjax.load(path, recheck=True)` proves it anew without a
        search. A loop with a function that a user wrote cannot be kept: it is left out, and has to
        be given again to `load`.

        Args:
            path: of the file; one that is there is replaced.

        Raises:
            OSError: it cannot be written.
            ValueError: it rests on a tube, which is to be saved instead.

        Example:
            >>> import pathlib, tempfile
            >>> from reachjax import MLP, AffinePlant, Box, ClosedLoop, decide, load
            >>> loop = ClosedLoop(AffinePlant([[0.5]], [[1.0]]), MLP.from_layers([([[0]], [0])]))
            >>> path = pathlib.Path(tempfile.mkdtemp()) / "stable.verdict"
            >>> decide(loop, Box([1.0], [2.0]), 3, goal=Box([0.0], [0.5])).save(path)
            >>> load(path, recheck=True).status.name
            'PROVED'
        """
        if self.asked is None:
            raise ValueError("a verdict that rests on a tube is not kept in a file: save the tube")
        kept = KeptVerdict(self.asked, self.status, self.counterexample, self.grounds)
        keep(writable("path", path), kept, self.asked.loop)

    def __bool__(self) -> bool:
        raise TypeError("a verdict has three values: use verdict.proved, .refuted or .unknown")

    def _simulated_at(self, name: str) -> tuple[float, int | str]:
        """The smallest simulated margin, and when; where a trajectory refutes it, that one's."""
        example = self.counterexample
        if example is not None and example.requirement == name:
            return -example.violation, example.time
        return _least_at(self.simulated[name])

    def _repr_html_(self) -> str:
        rows = [
            [name, *_least_at(_known(self.margins[name])), *self._simulated_at(name)]
            for name in self.margins
        ]
        head = ["requirement", "certified margin", "at t", "simulated margin", "at t"]
        said = str(self).splitlines()[1 + len(rows) :]
        notes = "".join(f"<p>{html.escape(line.strip())}</p>" for line in said)
        return display(self.status.name, table(head, rows) + notes, picture(self._drawn))

    def _drawn(self, ax: Axes) -> None:
        """Draw the cells, or the margins over time."""
        if self.cells and len(self.cells[0].lower) > 1:
            draw_cells(self.cells, ax)
            return
        for k, name in enumerate(self.margins):
            times = np.arange(len(self.margins[name]))
            ax.plot(times, self.margins[name], "o-", color=f"C{k}", label=f"{name}, certified")
            ax.plot(times, self.simulated[name], "x:", color=f"C{k}", label=f"{name}, simulated")
        ax.axhline(0.0, color="black", linewidth=0.8)
        ax.set(xlabel="t", ylabel="margin")
        ax.legend(fontsize="small")

    def __str__(self) -> str:
        lines = [self.status.name]
        for name, margins in self.margins.items():
            lines.append(
                f"  {name}: certified margin {_certified(margins)}, "
                f"simulated margin {_smallest(*self._simulated_at(name))}"
            )
        if self.counterexample is not None:
            e = self.counterexample
            lines.append(
                f"  counterexample: from {np.round(e.states[0], 4).tolist()} it breaks "
                f"{e.requirement} at t = {e.time} by {e.violation:.4g}{_drawn(e)}"
            )
            if e.decision is not None:
                lines.append(f"    its closest decision wins by {e.decision:.3g}")
        if self.decisions and self.unknown:
            closest = max(self.decisions, key=lambda decision: decision.room)
            lines.append(f"  {len(self.decisions)} decisions stay open; widest {closest}")
        if self.cells:
            counts = [sum(each.status is status for each in self.cells) for status in VerdictStatus]
            proved, refuted, unknown = counts
            lines.append(f"  cells: {proved} proved, {refuted} refuted, {unknown} undecided")
        if self.recurrence is not None:
            lines.append(_described(self.recurrence))
        open_ends = {end: count for end, count in self.ends.items() if end not in AS_ASKED}
        if self.unsolved:
            lines.append(
                f"  {self.unsolved} bounds hold, but may be looser than was asked for: "
                f"{told(open_ends)} (each status has a sentence of advice)"
            )
        return "\n".join(lines)

    __repr__ = __str__


def _least_at(margins: Float[np.ndarray, " h+1"]) -> tuple[float, int | str]:
    """The smallest margin, and when; of none, NaN."""
    if np.isnan(margins).all():
        return np.nan, ""
    t = int(np.nanargmin(margins))
    return float(margins[t]), t


def _smallest(least: float, t: int | str) -> str:
    """A margin with its time, if there is one."""
    return f"{least:+.4g} (smallest, at t = {t})" if np.isfinite(least) else "unknown"


def _certified(margins: Float[np.ndarray, " h+1"]) -> str:
    """The smallest margin, where it is known at every time at which something is required."""
    known, required = np.isfinite(margins).sum(), (~np.isnan(margins)).sum()
    if 0 < known < required:
        return f"known at {known} of {required} times"
    return _smallest(*_least_at(_known(margins)))


def _known(margins: Float[np.ndarray, " h+1"]) -> Float[np.ndarray, " h+1"]:
    """Margins, if they are known wherever something is required; else not a number."""
    return np.where(np.isinf(margins).any(), np.nan, margins)


def _described(found: Recurrence) -> str:
    """At which step states come into a set that they come back to."""
    times = f"at t = {found.step}, and again after {found.period} more steps"
    if found.proved:
        return f"  for ever: in a set {times}, margin {found.margin:+.4g}"
    return f"  not for ever: nearest is a set {times}, certified margin {found.margin:+.4g}"


def _drawn(example: Counterexample) -> str:
    """What a trajectory rests on besides its initial state."""
    parts = {"disturbances": example.disturbances, "noises": example.noises}
    named = [
        f", with {name} {np.round(rows[: example.time], 4).tolist()}"
        for name, rows in parts.items()
        if rows is not None and example.time
    ]
    return "".join(named)


def of_cells(verdicts: list[Verdict]) -> Verdict:
    """What is known of a union of cells: proved if all of them are, refuted if one of them is."""
    broken = [v.counterexample for v in verdicts if v.counterexample is not None]
    proved = all(verdict.status is VerdictStatus.PROVED for verdict in verdicts)
    status = VerdictStatus.PROVED if proved else VerdictStatus.UNKNOWN
    return Verdict(
        status=VerdictStatus.REFUTED if broken else status,
        margins=_least([verdict.margins for verdict in verdicts]),
        simulated=_least([verdict.simulated for verdict in verdicts]),
        counterexample=max(broken, key=lambda example: example.violation, default=None),
        ends=dict(sum((Counter(verdict.ends) for verdict in verdicts), Counter())),
    )


def _least(parts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The smallest of every cell's margins."""
    return {name: np.fmin.reduce([part[name] for part in parts]) for name in parts[0]}


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
        seal: a hash of the question, that is of the loop, the domain, and what is required of it
            when, and of the cells.
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
        require_double_precision()
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
