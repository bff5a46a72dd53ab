"""What is known of a specification: it is proved, refuted, or neither.

*Proved*: every state is surely where it must be, and the margins say by how much. *Refuted*: a
simulated trajectory breaks the specification, and is given. *Unknown*: the sets are too large to
prove it, and no trajectory breaks it; margins of both kinds say how far apart they are. Margins are
distances in the units of the state.
"""

from __future__ import annotations

import dataclasses
import enum
import html
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from reachjax.programs.followed import OpenDecision
from reachjax.proofs.certificates import AbstractProof, told
from reachjax.proofs.proposal import AS_ASKED, SolverStatus
from reachjax.sets import PolyhedralSet
from reachjax.sets.pictures import draw_boxes
from reachjax.tubes.displays import display, picture, table

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
        recurrence: of a statement for all time, what it rests on, or what came nearest to that.
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
