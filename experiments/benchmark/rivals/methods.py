"""The library, and what a user would pick instead: each bounds the facets of all steps."""

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

import reachjax as rj
from experiments.benchmark.cases import Settings
from experiments.benchmark.reference import basis_sizes, paper_step
from experiments.benchmark.rivals.affine_forms import affine_bounds
from experiments.task import Task
from experiments.tightness.exact import exact_tube
from experiments.tightness.program import Limits

SHARE = 0.9
"""Of the patience, which HiGHS gets: so it still tells what it has found."""

PROGRAM = 0.25
"""The same for one of its programs."""

GAP = 1e-4
"""How close to its bound a maximum of HiGHS has to be, as a part of the facet's range: as close as
`rj.reach` wants its own."""

NEARLY = 1.5
"""The ranges that `rj.reach` measures gaps by are those of its samples, which are smaller or larger
than the widths between what is attained at last."""

LARGEST = 50
"""Entries of the paper's basis up to which its program is stated in cvxpy: a second a facet."""


@dataclass(frozen=True, eq=False)
class Answer:
    """What a method finds out.

    Attributes:
        bounds: `(horizon, m)`, offsets of the facets; NaN where time ran out.
        attained: `(horizon, m)`, values that it knows to be attained; NaN where none is.
        done: `(horizon, m)`, where the method found what it looks for.
    """

    bounds: Float[ndarray, "horizon m"]
    attained: Float[ndarray, "horizon m"]
    done: Bool[ndarray, "horizon m"]

    @classmethod
    def of_bounds(cls, bounds: Float[ndarray, "horizon m"]) -> "Answer":
        """Bounds alone."""
        return cls(bounds, np.full_like(bounds, np.nan), np.isfinite(bounds))


Method = Callable[[Task, Settings], Answer]


def by_default(task: Task, _: Settings) -> Answer:
    """`rj.reach` as it is by itself; done where its gap is closed."""
    found = _of_tube(rj.reach(task.loop, task.X0, task.horizon, task.template))
    open_gaps = found.bounds - found.attained > NEARLY * GAP * task.widths(found.attained) / 2
    return dataclasses.replace(found, done=~open_gaps)


def by_linear_bounds(task: Task, _: Settings) -> Answer:
    """`rj.LinearBounds`."""
    tube = rj.reach(task.loop, task.X0, task.horizon, task.template, rj.LinearBounds())
    return _of_tube(tube)


def _of_tube(tube: rj.ReachTube) -> Answer:
    proofs = [tube.proof(t) for t in range(1, tube.horizon + 1)]
    bounds, attained = (
        np.array([getattr(p, name) for p in proofs]) for name in ("bounds", "witnesses")
    )
    return Answer(bounds, attained, np.isfinite(bounds))


def by_highs(task: Task, settings: Settings) -> Answer:
    """The exact maxima, by mixed-integer programs of the loop unrolled once."""
    limits = Limits(SHARE * settings.patience, PROGRAM * settings.patience)
    found = exact_tube(task.loop, task.X0, task.horizon, task.directions, limits=limits)
    return Answer(found.bounds, found.values, found.within(GAP))


def by_numpy(task: Task, _: Settings) -> Answer:
    """Affine forms."""
    return Answer.of_bounds(affine_bounds(task.loop, task.X0, task.horizon, task.directions))


def by_paper(task: Task, settings: Settings) -> Answer:
    """The paper's recursion, each facet's program stated in cvxpy from nothing."""
    bounds = np.full((task.horizon, len(task.directions)), np.nan)
    X, began = task.X0, time.perf_counter()
    for t, offsets in enumerate(bounds):
        for i, direction in enumerate(task.directions):
            if time.perf_counter() - began > SHARE * settings.patience:
                return Answer.of_bounds(bounds)
            offsets[i] = paper_step(**_paper_data(task, X, t), directions=direction[None])[0][0]
        X = rj.Polytope(task.directions, offsets)
    return Answer.of_bounds(bounds)


def _paper_data(task: Task, X: rj.PolyhedralSet, t: int) -> dict:
    """What `paper_step` takes beside its directions."""
    assert isinstance(task.loop.plant, rj.AffinePlant)
    A, B, c = map(np.asarray, task.loop.plant.at(t))
    set_A, set_b = map(np.asarray, X.facets)
    lower = upper = None
    if task.loop.input_box is not None:
        assert isinstance(task.loop.input_box, rj.Box)
        box = task.loop.input_box.at(t)
        lower, upper = np.asarray(box.lower), np.asarray(box.upper)
    names = ("layers", "A", "B", "c", "u_lower", "u_upper", "set_A", "set_b", "repeated")
    values = (task.layers, A, B, c, lower, upper, set_A, set_b, True)
    return dict(zip(names, values, strict=True))


HIGHS = "HiGHS"
PAPER = "paper, cvxpy"
METHODS: dict[str, Method] = {
    "reach": by_default,
    "LinearBounds": by_linear_bounds,
    HIGHS: by_highs,
    "numpy": by_numpy,
    PAPER: by_paper,
}
"""By the names that tables have, the library first."""


def chosen(task: Task, settings: Settings) -> list[str]:
    """Names of the methods asked for, all without any, that are run on a task.

    Raises:
        ValueError: there is none of a name.
    """
    for name in settings.methods:
        if name not in METHODS:
            raise ValueError(f"--methods must be of {', '.join(METHODS)}, but {name!r} arrived")
    names = [name for name in METHODS if name in (settings.methods or METHODS)]
    entries = sum(basis_sizes(task.layers, task.loop.input_box is not None)) + 1
    return [name for name in names if name != PAPER or entries <= LARGEST]
