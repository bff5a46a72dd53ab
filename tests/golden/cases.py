"""The cases: two of each architecture of the campaign, with a real solver and no limit of time,
and rows of the table of laws, for the kinds of loops and methods that the campaign does not draw.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import reachjax as rj
from tests.campaign import cases, kinds
from tests.campaign.architectures import BLOCK, EVERY
from tests.cases import HORIZON, Case

EACH = 2
"""So many cases of an architecture; the first of them is differentiated, too."""

KEPT = (
    "line, linear 104",
    "small, adapted 426",
    "tanh, affine 201",
    "relu, disturbed 251",
    "six 380",
    "quotients 900",
    "unicycle 925",
    "hard, products 976",
    "leaky, traced 951",
    "relu, round 1051",
    "linear, octagonal 301",
    "argmax; forms",
    "sampled; forms",
)
"""Cases of which nothing is compiled: what is said of them is kept beside the tests."""

ROWS = (
    *(Case(loop, "forms") for loop in ("argmax", "friction", "sampled", "sampled, pushed")),
    *(Case(loop) for loop in ("relay", "bang-bang", "oscillator, hard", "sampled, affine")),
    *(Case("sine", f"cells of {inner}") for inner in ("forms", "branches", "programs")),
)
"""Jumps, differential equations, products of signals, and cells of every method."""

DRAWS = 60
ROOM = 0.05
"""By this part of what trajectories visit a requirement is larger than it."""


@dataclass(frozen=True)
class Golden:
    """A case, as Python evaluates it.

    Attributes:
        name: of the architecture, and the number of the case.
        parts: a loop, an initial set, a template, a relaxation and a solver.
        horizon: the number of steps.
        start: the time of the initial set.
        options: further arguments of `reach`.
        differentiated: whether its derivative is kept.
    """

    name: str
    parts: dict[str, Any]
    horizon: int
    start: int
    options: dict[str, Any]
    differentiated: bool

    def reach(self, X0: Any, **more: Any) -> rj.ReachTube:
        """The tube from an initial set."""
        loop, template = self.parts["loop"], self.parts["template"]
        options = {"start": self.start, **self.options, **more}
        return rj.reach(loop, X0, self.horizon, template, **options)


def every() -> Iterator[Golden]:
    """All of them, in order."""
    for place, shapes in enumerate(EVERY):
        numbers = range(place * BLOCK, (place + 1) * BLOCK)
        some = (_of_kind if isinstance(shapes, kinds.Kind) else _of_chain)(numbers, shapes)
        for count, each in zip(range(EACH), some, strict=False):
            yield replace(each, differentiated=count == 0)
    for row in ROWS:
        parts = {"loop": row.closed_loop, "X0": row.X0, "template": row.shape}
        yield Golden(row.name, parts, HORIZON, row.of.start, row.options, row.method == "forms")


def _of_chain(numbers: range, shapes: Any) -> Iterator[Golden]:
    """Those of a chain of ReLUs under an affine plant."""
    for number in numbers:
        case = cases.drawn(number)
        slow = case.fault is not None or "SCS" in case.parts["solver"]
        if slow or "time_limit" in case.options or not case.nonempty:
            continue
        names: dict[str, Any] = {"rj": rj, "np": np}
        for name, expression in case.parts.items():
            names[name] = eval(expression, names)
        gap = eval(f"dict({case.options.removeprefix(', ')})")
        options = {name: names[name] for name in ("relaxation", "solver")}
        options |= {"window": case.window, "samples": cases.SAMPLES, **gap}
        parts = {name: names[name] for name in ("loop", "X0", "template")}
        name = f"{shapes.name} {number}"
        yield Golden(name, parts, shapes.horizon, case.loop.start, options, False)


def _of_kind(numbers: range, kind: kinds.Kind) -> Iterator[Golden]:
    """Those of any other loop."""
    for number in numbers:
        case = kinds.drawn(kind, number)
        parts = {"loop": case.loop, "X0": case.X0, "template": kind.template(kind.states)}
        options = {**case.options, "time_limit": None}
        yield Golden(f"{kind.name} {number}", parts, kind.horizon, 0, options, False)


def required(tube: rj.ReachTube) -> rj.Box:
    """A box a little larger than what trajectories visit."""
    runs = np.asarray(tube.simulate(DRAWS, seed=0))
    runs = runs.reshape(-1, runs.shape[-1])
    lower, upper = runs.min(axis=0), runs.max(axis=0)
    room = ROOM * (upper - lower) + 1e-6 * (1 + abs(lower) + abs(upper))
    return rj.Box(lower - room, upper + room)
