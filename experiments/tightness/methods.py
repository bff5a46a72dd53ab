"""The methods that the study of tightness compares, what each certifies, and in what time."""

import hashlib
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Float
from numpy import ndarray

import reachjax as rj
from experiments import stored
from experiments.benchmark.timing import repeated
from experiments.tightness.cases import Group, Settings


@dataclass(frozen=True)
class Method:
    """A relaxation, a window, and cells of the initial set, if it is split."""

    relaxation: rj.AbstractRelaxation
    window: int | None = 1
    cells: int | tuple[int, ...] | None = None

    def tube(self, loop: rj.ClosedLoop, group: Group) -> rj.ReachTube | rj.PartitionedTube:
        """What it certifies of a loop."""
        task = loop, group.X0, group.horizon, group.template, self.relaxation, self.window
        if self.cells is None:
            return rj.reach(*task)
        return rj.reach_partitioned(*task, cells=self.cells)


LIGHT = rj.LocalBounds(repeated=False)
METHODS = {
    "paper": Method(rj.PaperQC()),
    "paper, no lambda": Method(rj.PaperQC(repeated=False)),
    "local bounds": Method(rj.LocalBounds()),
    "local, no lambda": Method(LIGHT),
    "cuts, window 1": Method(rj.CuttingPlanes()),
    "cuts, window 3": Method(rj.CuttingPlanes(), window=3),
    "cuts, one shot": Method(rj.CuttingPlanes(), window=None),
    "grid of cells": Method(LIGHT, cells=(4, 4)),
    "guided cells": Method(LIGHT, cells=16),
}


def chosen(settings: Settings) -> dict[str, Method]:
    """The methods asked for, in the order of the tables.

    Raises:
        ValueError: there is none of this name.
    """
    for name in settings.methods:
        if name not in METHODS:
            raise ValueError(f"--methods must be of {', '.join(METHODS)}, but {name!r} arrived")
    return {name: METHODS[name] for name in METHODS if name in (settings.methods or METHODS)}


@dataclass(frozen=True, eq=False)
class Measurement:
    """What a method certifies of the loops of a group.

    Attributes:
        bounds: offsets of the certified sets.
        witnesses: the largest values that the method knows itself.
        seconds: of each tube, without compilation.
        first: seconds of the first tube, with what it had to compile.
    """

    bounds: Float[ndarray, "loops horizon m"]
    witnesses: Float[ndarray, "loops horizon m"]
    seconds: Float[ndarray, " loops"]
    first: float


def measure(group: Group, name: str, settings: Settings) -> Measurement:
    """What a method certifies, from its file if it is there."""
    method = METHODS[name]
    path = settings.output / "measured" / _file_name(f"{group.name} {name}")
    made_with = fingerprint(group) | {
        "method": repr(method),
        "repetitions": settings.repetitions,
        "patience": settings.patience,
        "clock": settings.clock,
    }
    kept = stored.load(path, made_with)
    if kept is None:
        kept = _measured(group, method, settings)
        stored.save(path, made_with, **kept)
    first = float(kept.pop("first"))
    return Measurement(**kept, first=first)


def fingerprint(group: Group) -> dict[str, Any]:
    """What every result on a group depends on."""
    leaves = jax.tree.leaves((group.loops, group.X0, group.template))
    content = b"".join(np.asarray(leaf).tobytes() for leaf in leaves)
    return {"horizon": group.horizon, "loops": hashlib.sha256(content).hexdigest()}


def _measured(group: Group, method: Method, settings: Settings) -> dict[str, Any]:
    """The loops one after the other."""
    timings = [
        repeated(lambda loop=loop: method.tube(loop, group), settings) for loop in group.loops
    ]
    facets = [_facets(timing.result) for timing in timings]
    bounds, witnesses = (np.array(each) for each in zip(*facets, strict=True))
    return {
        "bounds": bounds,
        "witnesses": witnesses,
        "seconds": np.array([timing.seconds for timing in timings]),
        "first": timings[0].first,
    }


def _facets(tube: rj.ReachTube | rj.PartitionedTube) -> tuple[ndarray, ndarray]:
    """Bounds and witnesses `(horizon, m)`."""
    steps = range(1, tube.horizon + 1)
    if isinstance(tube, rj.PartitionedTube):
        pairs = [(tube.bounds(t), tube.witnesses(t)) for t in steps]
    else:
        pairs = [(tube.proof(t).bounds, tube.proof(t).witnesses) for t in steps]
    bounds, witnesses = zip(*pairs, strict=True)
    return np.array(bounds), np.array(witnesses)


def _file_name(words: str) -> str:
    return f"{words.replace(',', '').replace(' ', '_')}.npz"
