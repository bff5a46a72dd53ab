"""Affine forms of a loop that jumps, along every way in which its decisions may go.

Over a set on which a decision is open, forms hold its outcome for any number between its cases, and
what follows from that is worth little. So forms are made of both: where the input `y` of a unit
that jumps may have either sign, a **way** forks into one on which `y >= 0` is a fact, and one on
which `-y >= 0` is. Both hold the tie, so together they leave out no trajectory of the closed law.
On either way the unit has one value. Facts are forms too, so with multipliers `lambda >= 0`

    r . eta  <=  (r + sum_i lambda_i p_i) . eta

for each row `r` on all states of the way, which is bounded over all columns (weak duality); and a
way has no states if that is negative of `r = 0`. It holds whatever found the multipliers.

Everything here is numpy on the host.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float
from scipy.optimize import linprog

from reachjax.loops import ClosedLoop
from reachjax.loops.units import AbstractUnit
from reachjax.numerics.rounding import TINY
from reachjax.programs.affine import AffineForms, joined
from reachjax.programs.affine_steps import UnitForms, step_forms
from reachjax.programs.flows import Between
from reachjax.programs.initial import Ends, InitialColumns, met
from reachjax.sets import Box

Signs = dict[tuple[int, int], tuple[bool, float]]
"""By layer and number, whether an input of a step's units is not negative, or is not positive, and
how far it might be on both sides."""


class OpenDecision(NamedTuple):
    """A decision that may go either way.

    Attributes:
        time: when.
        line: where a user wrote it, if that is known.
        room: what is compared is between minus so much and so much, or more.
    """

    time: int
    line: str
    room: float

    def __str__(self) -> str:
        ends = f"{-self.room:.3g} and {self.room:.3g}"
        return f"at t = {self.time}{self.line}, of numbers between {ends}"


class Way(NamedTuple):
    """One way in which decisions go, so far.

    Attributes:
        state: forms of the state.
        facts: what is known of its columns: these rows are never negative.
        units: of the last step.
        free: columns of disturbances, of each step.
        spans: what is in between the last two samples, if that is wanted.
        open: decisions of the last step that may go either way, or did until it forked.
    """

    state: AffineForms
    facts: AffineForms
    units: tuple[UnitForms, ...] = ()
    free: tuple[np.ndarray, ...] = ()
    spans: tuple[Between, ...] = ()
    open: tuple[OpenDecision, ...] = ()

    def bounds(
        self, rows: AffineForms, start: InitialColumns, wanted: Float[np.ndarray, " k"]
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k n"]]:
        """Upper bounds of forms on the way, and the columns where facts attain them; else NaN.

        Those that are no larger than what is wanted are left as they are.

        Raises:
            NoStatesError: there are no states on the way.
        """
        upper = rows.ends(start, cut=True)[1]
        at = np.full(rows.columns.shape, np.nan)
        high = np.flatnonzero(upper > wanted)
        if len(self.facts) and len(high):
            better, there = self._by_facts(rows[high], start)
            upper = upper.copy()
            upper[high] = np.fmin(upper[high], better)
            at[high] = there[:, : at.shape[1]]
        return upper, at

    def on_a_side(self, y: AffineForms, above: bool) -> Way:
        """The way on which a number is not negative, or not positive.

        What comes next adds columns after those of the number.
        """
        width, more = y.columns.shape[1], (y if above else -y) + TINY
        facts = joined([self.facts.padded(width), more.padded(self.facts.columns.shape[1])])
        return self._replace(facts=facts, state=self.state.padded(facts.columns.shape[1]))

    def _by_facts(
        self, rows: AffineForms, start: InitialColumns
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k n"]]:
        """What facts make of upper bounds of forms, and the columns where they are attained."""
        facts = self.facts
        found = _largest(rows, facts)
        if found is None:
            slack = _largest(AffineForms(np.zeros((1, 2)), np.zeros((1, 2))), facts, least=True)
            if slack is not None and _weighed(None, facts, slack[0], start)[0] < 0:
                raise NoStatesError
            return np.full(len(rows), np.inf), np.full(rows.columns.shape, np.nan)
        return _weighed(rows, facts, found[0], start), found[1]


class NoStatesError(Exception):
    """There are no states on a way."""


class _ForkError(Exception):
    """A decision is open.

    Args:
        place: of its input, by layer and number.
        input: the form of that.
        room: how far it may be on both sides.
    """

    def __init__(self, place: tuple[int, int], input: AffineForms, room: float):
        super().__init__(place)
        self.place, self.input, self.room = place, input, room


def ways(
    loop: ClosedLoop,
    start: InitialColumns,
    steps: int,
    t: int = 0,
    most: int = 1,
    spans: bool = False,
    slopes: Float[np.ndarray, "N units"] | None = None,
    known: Sequence[Box] | None = None,
) -> Iterator[list[Way]]:
    """All ways in which decisions go, after each step; none where none has states.

    Args:
        loop: of numpy arrays.
        start: what the first columns are.
        steps: how many.
        t: the time of the initial set.
        most: how many ways there may be; where there would be more, decisions stay open.
        spans: whether what is in between the samples is wanted, of a differential equation.
        slopes: of lines for the units of each step, of which any are sound; None for good ones.
        known: boxes that surely hold the states after each step, where they are known.
    """
    none = AffineForms(np.zeros((0, 2)), np.zeros((0, 2)))
    found = [Way(AffineForms.beginning(start), none)]
    for k in range(steps):
        given = {
            "t": t + k,
            "before": k,
            "slopes": None if slopes is None else slopes[k],
            "known": None if known is None else known[k],
        }
        after: list[Way] = []
        for number, way in enumerate(found):
            left = most - len(after) - (len(found) - number)
            after += _followed(loop, start, way, left, spans, given)
        found = after
        yield found


def _followed(
    loop: ClosedLoop,
    start: InitialColumns,
    way: Way,
    left: int,
    spans: bool,
    given: dict[str, Any],
) -> list[Way]:
    """The ways that one way forks into in a step, so many more than one at most."""
    found, waiting = list[Way](), list[tuple[Way, Signs]]([(way, {})])
    while waiting:
        way, signs = waiting.pop()
        try:
            found.append(_advanced(loop, start, way, signs, left > 0, spans, given))
        except _ForkError as fork:
            for above in (False, True):
                known = signs | {fork.place: (above, fork.room)}
                waiting.append((way.on_a_side(fork.input, above), known))
            left -= 1
        except NoStatesError:
            left += 1
    return found


def _advanced(
    loop: ClosedLoop,
    start: InitialColumns,
    way: Way,
    signs: Signs,
    forks: bool,
    spans: bool,
    given: dict[str, Any],
) -> Way:
    """A way after one step more, on which decisions have these signs.

    Raises:
        NoStatesError: no states have.
        _ForkError: another decision is open.
    """
    here, still_open = way, list[OpenDecision]()
    compared = list[tuple[AffineForms, AbstractUnit, dict[int, bool]]]()

    def ranges(
        unit: AbstractUnit | None, y: AffineForms, ends: Ends, found: Sequence[UnitForms]
    ) -> Ends:
        nonlocal here
        if unit is None or unit.curved or unit.free or not (unit.jumps or len(here.facts)):
            return ends
        lower, upper = np.array(ends[0]), np.array(ends[1])
        inexact = np.flatnonzero(np.tile(unit.open(lower, upper), unit.inputs))
        if len(inexact) and len(here.facts):
            inputs, known = y[inexact], (lower[inexact], upper[inexact])
            both = joined([inputs, -inputs])
            most, least = np.split(here.bounds(both, start, np.full(len(both), -np.inf))[0], 2)
            lower[inexact], upper[inexact] = met(known, (-least, most))
        if not unit.jumps:
            return lower, upper
        layer = len(found)
        held = dict[int, bool]()
        compared.append((y, unit, held))
        for (at, entry), (above, size) in signs.items():
            if at != layer:
                continue
            still_open.append(OpenDecision(given["t"], unit.line, size))
            if (upper[entry] <= -TINY) if above else (lower[entry] >= TINY):
                raise NoStatesError
            here, held[entry] = here.on_a_side(y[entry : entry + 1], above), above
        for other, before, known in compared:
            if other is y:
                held.update((k, v) for k, v in known.items() if unit.implied(before, v))
        for entry, above in held.items():
            if above:
                lower[entry] = max(lower[entry], TINY)
                upper[entry] = max(lower[entry], upper[entry])
            else:
                upper[entry] = min(upper[entry], -TINY)
                lower[entry] = min(lower[entry], upper[entry])
        undecided = np.flatnonzero(unit.open(lower, upper))
        room = np.fmin(-lower, upper)[undecided]
        if len(undecided) and forks and np.isfinite(room).all():
            entry = int(undecided[room.argmax()])
            raise _ForkError((layer, entry), y[entry : entry + 1], float(room.max()))
        still_open.extend(OpenDecision(given["t"], unit.line, each) for each in room.tolist())
        return lower, upper

    found: list[Between] | None = [] if spans else None
    with np.errstate(all="ignore"):  # what overflows ends as infinity or NaN, which is no bound
        state, units, _ = step_forms(
            loop, way.state, start=start, ranges=ranges, spans=found, **given
        )
    drawn = [layer.places for layer in units if layer.unit.free]
    free = (*way.free, np.concatenate([np.zeros(0, int), *drawn]))
    width = state.columns.shape[1]
    facts = here.facts.padded(width)
    return Way(state, facts, units, free, tuple(found or ()), tuple(still_open))


def _weighed(
    rows: AffineForms | None,
    facts: AffineForms,
    multipliers: Float[np.ndarray, "k m"],
    start: InitialColumns,
) -> Float[np.ndarray, " k"]:
    """Upper bounds of forms, or of zero, by multipliers that are not negative."""
    with np.errstate(all="ignore"):
        weighed = multipliers @ facts
        if rows is not None:
            width = max(rows.columns.shape[1], facts.columns.shape[1])
            weighed = rows.padded(width) + weighed.padded(width)
        return weighed.ends_by_form(start)[1]


def _largest(
    rows: AffineForms, facts: AffineForms, least: bool = False
) -> tuple[Float[np.ndarray, "k m"], Float[np.ndarray, "k n"]] | None:
    """Multipliers of facts that bound each form from above, and where; None if nothing says that.

    Args:
        rows: the forms.
        facts: what is known.
        least: whether instead the least of the facts is to be largest, whose multipliers show that
            not all of them can hold, if that is so.
    """
    count, width = len(rows), max(rows.columns.shape[1], facts.columns.shape[1])
    G, c = facts.padded(width).columns, facts.rows[:, 0]
    used = np.flatnonzero(G.any(axis=0))
    size = np.fmax(abs(G).max(axis=1, initial=0.0), abs(c))
    size = np.where(size > 0, size, 1.0)
    G, c = G[:, used] / size[:, None], c / size
    objective = rows.padded(width).columns
    scale = abs(objective).max(axis=1, initial=0.0)
    scale = np.where(scale > 0, scale, 1.0)
    cost, limits = -(objective[:, used] / scale[:, None]), (-1.0, 1.0)
    if not (np.isfinite(G).all() and np.isfinite(c).all() and np.isfinite(cost).all()):
        return None
    if not len(used):  # facts are of rounding alone
        return least * np.eye(1, len(c), int(c.argmin())) + np.zeros((count, len(c))), np.sign(
            objective
        )
    if least:
        G = np.concatenate([G, -np.ones((len(G), 1))], axis=1)
        given: Any = np.r_[np.zeros(len(used)), -1.0], -G, c
        limits = [*[limits] * len(used), (None, None)]
    else:
        given = cost.ravel(), sp.kron(sp.eye_array(count), -G, format="csr"), np.tile(c, count)
    result = linprog(*given, bounds=limits, method="highs")
    if result.status != 0:
        return None
    duals = np.fmax(-result.ineqlin.marginals.reshape(count, len(c)), 0.0)
    at = np.sign(objective)
    at[:, used] = result.x[: count * len(used)].reshape(count, len(used))
    return duals * scale[:, None] / size, at


def open_decisions(layers: Sequence[UnitForms], t: int) -> tuple[OpenDecision, ...]:
    """The decisions of a step that may go either way."""
    found = list[OpenDecision]()
    for layer in layers:
        if layer.unit.jumps:
            room = np.fmin(-layer.lower, layer.upper)[layer.unit.open(layer.lower, layer.upper)]
            found += [OpenDecision(t, layer.unit.line, each) for each in room.tolist()]
    return tuple(found)
