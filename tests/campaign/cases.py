"""A case: everything drawn from one seed and its number, and the Python that rebuilds it."""

from dataclasses import dataclass

import numpy as np

from tests.campaign.architectures import Architecture, architecture
from tests.campaign.faults import FAULTS
from tests.campaign.oracle import Loop
from tests.campaign.random_loops import Scales, random_loop, random_scales
from tests.campaign.random_regions import Initial, literal, random_region

SAMPLES = 16
HEADER = """\
import jax; jax.config.update("jax_enable_x64", True)
import numpy as np, reachjax as rj"""

REAL = {
    "rj.Auto()": 0.4,
    "rj.Clarabel()": 0.2,
    "rj.Clarabel(max_iterations=4)": 0.06,
    "rj.Clarabel(tolerance=1e-3)": 0.06,
    "rj.SCS(1e-5, 2000)": 0.06,
    "rj.SCS(1e-3, 20)": 0.02,
}
INTERIOR = {
    "rj.InteriorPoint()": 0.5,
    "rj.InteriorPoint(max_iterations=5)": 0.2,
    "rj.Auto(limit=0)": 0.3,
}
FAULTY = 0.2
"""The part of cases whose solver fails."""

BRANCHED = {
    "rj.BranchAndCut()": 0.4,
    "rj.BranchAndCut(nodes=0)": 0.12,
    "rj.BranchAndCut(nodes=3)": 0.2,
    "rj.BranchAndCut(products_by=rj.CuttingPlanes(rounds=0))": 0.2,
    "rj.BranchAndCut(remove_stable=False)": 0.08,
}
OPTIONS = {
    "": 0.5,
    ", gap=0.0": 0.1,
    ", gap=1e-2": 0.2,
    ", time_limit=0.0": 0.1,
    ", time_limit=0.01": 0.05,
    ", gap=0.0, time_limit=0.1": 0.05,
}
OF_BRANCHES, OF_FORMS = 0.42, 0.06
"""The parts of cases with `BranchAndCut` and with `LinearBounds`, whatever their architecture."""

ROUND_FACETS = 0.1
"""The part of those cases in which a template with ellipsoids stays."""


@dataclass(frozen=True)
class Case:
    """One loop, set, template, relaxation, window and solver.

    Attributes:
        number: of the case.
        seed: of the campaign.
        shapes: its architecture.
        loop: plain arrays of the loop.
        initial: plain arrays of the initial set.
        scales: how large its numbers are.
        units: the kinds of units.
        parts: Python for `loop`, `X0`, `template`, `relaxation` and `solver`.
        window: of the tube.
        fault: of the solver; None if it is a real one.
        every: each so many-th answer is spoilt.
        options: further arguments of `reach`, in Python.
    """

    number: int
    seed: int
    shapes: Architecture
    loop: Loop
    initial: Initial
    scales: Scales
    units: tuple[str, ...]
    parts: dict[str, str]
    window: int | None
    fault: str | None
    every: int = 1
    options: str = ""

    @property
    def branched(self) -> bool:
        """Whether its relaxation is `BranchAndCut`."""
        return "BranchAndCut" in self.parts["relaxation"]

    @property
    def nonempty(self) -> bool:
        """Whether a point of its initial set is known."""
        return self.initial.inner is not None

    @property
    def tried(self) -> dict[str, str]:
        """What it is, by kind of thing."""
        return {
            "architecture": self.shapes.name,
            "set": self.initial.kind,
            "template": self.parts["template"].split("([[")[0].split("(loop")[0],
            "relaxation": self.parts["relaxation"],
            "window": str(self.window),
            "options": self.options.removeprefix(", ") or "none",
            "solver": self.parts["solver"] if self.fault is None else "faulty",
            "fault": str(self.fault),
            "scales": self.scales.kind,
            "time": "varying" if self.shapes.varying else "constant",
        }

    @property
    def rng(self) -> np.random.Generator:
        """What points and thresholds are drawn from."""
        return np.random.default_rng([self.seed, self.number, 1])

    @property
    def reach(self) -> str:
        """Python that computes the tube."""
        return (
            f"rj.reach(loop, X0, {self.shapes.horizon}, template, relaxation, {self.window}, "
            f"solver, start={self.loop.start}, samples={SAMPLES}{self.options})"
        )

    @property
    def script(self) -> list[str]:
        """Lines that rebuild the case."""
        lines = HEADER.splitlines()
        if self.fault is not None:
            lines.append("from tests.campaign.faults import Faulty")
        return [*lines, *(f"{name} = {value}" for name, value in self.parts.items())]


def drawn(number: int, seed: int = 0) -> Case:
    """The case of a number."""
    rng = np.random.default_rng([seed, number])
    shapes = architecture(number)
    assert isinstance(shapes, Architecture)  # others are drawn by `kinds`
    scales = random_scales(rng, shapes.states, shapes.inputs)
    initial = random_region(rng, shapes.region, scales.states, shapes.facets)
    region = initial.region
    if region.center is not None:
        middle = region.center
    elif initial.inner is not None:
        middle = initial.inner.astype(float)
    else:
        middle = np.zeros(shapes.states)
    loop, loop_text, units = random_loop(rng, shapes, scales, middle)
    sizes = np.diag(scales.states**2) if rng.random() < 0.7 else np.eye(shapes.states)
    template = shapes.template.format(
        n=shapes.states, horizon=shapes.horizon, start=loop.start, shape=literal(sizes)
    )
    real = INTERIOR if shapes.interior else REAL
    weights = np.array(list(real.values()))
    solver, fault, every = str(rng.choice(list(real), p=weights / weights.sum())), None, 1
    if rng.random() < FAULTY:
        fault = str(rng.choice(list(FAULTS)))
        every = int(rng.choice([1, 1, 3]))
        solver = f"Faulty({solver}, {fault!r}, {rng.integers(1000)}, {every})"
    parts = {
        "loop": loop_text,
        "X0": initial.expression,
        "template": template,
        "relaxation": str(rng.choice(list(shapes.relaxations))),
        "solver": solver,
    }
    window = shapes.windows[rng.integers(len(shapes.windows))]
    window, options = _horizon_wide(np.random.default_rng([seed, number, 2]), parts, window)
    units = tuple(units)
    return Case(
        number, seed, shapes, loop, initial, scales, units, parts, window, fault, every, options
    )


def _horizon_wide(
    rng: np.random.Generator, parts: dict[str, str], window: int | None
) -> tuple[int | None, str]:
    """In a part of the cases a relaxation over the whole horizon, with facets; else nothing new.

    Returns:
        The window, and further arguments of `reach`.
    """
    chance = rng.random()
    if chance >= OF_BRANCHES + OF_FORMS:
        return window, ""
    drawn, options = (
        str(rng.choice(list(some), p=list(some.values()))) for some in (BRANCHED, OPTIONS)
    )
    by_forms = chance >= OF_BRANCHES
    if "Ellipsoid" in parts["template"] or "Mixed" in parts["template"]:
        if not by_forms and rng.random() < ROUND_FACETS:
            parts["relaxation"] = drawn
            return 1, ""
        parts["template"] = "rj.Template.box(X0.dimension)"
    parts["relaxation"] = "rj.LinearBounds()" if by_forms else drawn
    return None, "" if by_forms else options
