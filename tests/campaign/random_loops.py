"""Random loops: dead, duplicated, saturated and barely switching units, wild scales and offsets."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tests.campaign.architectures import Architecture
from tests.campaign.oracle import Loop
from tests.campaign.random_regions import literal

SPARE = 2
"""A time-varying loop is given for so many more times than the horizon."""


@dataclass(frozen=True)
class Scales:
    """How large a case's numbers are.

    Attributes:
        kind: in words.
        states: `(n,)`, of each coordinate of the state.
        inputs: `(m,)`, of each input.
    """

    kind: str
    states: np.ndarray
    inputs: np.ndarray


def random_scales(rng: np.random.Generator, n: int, m: int) -> Scales:
    """Of order one, one common scale, coordinates of different scales, or extreme ones."""
    kind = str(rng.choice(["one", "common", "mixed", "extreme"], p=[0.35, 0.25, 0.3, 0.1]))
    if kind == "one":
        return Scales(kind, np.ones(n), np.ones(m))
    if kind == "common":
        common = 10 ** rng.uniform(-8, 8)
        return Scales(kind, np.full(n, common), np.full(m, 10 ** rng.uniform(-8, 8)))
    most = 8 if kind == "mixed" else 60
    spread = rng.uniform(-most, most, n)
    if kind == "extreme" and rng.random() < 0.5:
        spread[:] = rng.choice([-60.0, -40.0, 40.0, 60.0])
    return Scales(kind, 10**spread, 10 ** rng.uniform(-most, most, m))


def random_loop(
    rng: np.random.Generator, shapes: Architecture, scales: Scales, middle: np.ndarray
) -> tuple[Loop, str, list[str]]:
    """Plain arrays of a loop, Python that builds it, and the kinds of units that it has.

    Args:
        rng: of everything drawn.
        shapes: of the arrays.
        scales: of states and inputs.
        middle: `(n,)`, a state near which units switch.
    """
    layers, kinds = _network(rng, shapes, scales, middle)
    n, m = shapes.states, shapes.inputs
    s, r = scales.states, scales.inputs
    times = shapes.horizon + SPARE

    def drawn(name: str, *shape: int) -> np.ndarray:
        base = rng.normal(size=shape)
        if name not in shapes.varying:
            return base
        return base + 0.2 * rng.normal(size=(times, *shape))

    growth = 10 ** rng.uniform(-1, 0.5) if rng.random() < 0.9 else 0.0
    A = growth * drawn("A", n, n) * np.outer(s, 1 / s) / np.sqrt(n)
    B = drawn("B", n, m) * np.outer(s, 1 / r) * rng.choice([0.0, 1e-3, 1.0], p=[0.05, 0.15, 0.8])
    c = drawn("c", n) * s * rng.choice([0.0, 1.0, 1e6], p=[0.3, 0.6, 0.1])
    lower = upper = None
    if shapes.boxed:
        lower, upper = _input_box(rng, drawn("u", m), r)
    start = int(rng.integers(SPARE + 1)) if shapes.varying else 0
    loop = Loop(layers, A, B, c, lower, upper, start)
    pairs = ", ".join(f"({literal(W)}, {literal(b)})" for W, b in layers)
    box = "" if lower is None else f", rj.Box({literal(lower)}, {literal(upper)})"
    plant = f"rj.AffinePlant({literal(A)}, {literal(B)}, {literal(c)})"
    return loop, f"rj.ClosedLoop({plant}, rj.MLP.from_layers([{pairs}]){box})", kinds


def _input_box(
    rng: np.random.Generator, draws: np.ndarray, scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A wide box, one that saturates, one far from zero, or one that is a point."""
    kind = rng.choice(["wide", "tight", "far", "a point"], p=[0.2, 0.6, 0.1, 0.1])
    radius = {"wide": 100.0, "tight": 0.5, "far": 0.5, "a point": 0.0}[kind] * abs(draws) * scale
    center = (5.0 if kind == "far" else 0.1) * draws * scale
    return center - radius, center + radius


def _network(
    rng: np.random.Generator, shapes: Architecture, scales: Scales, middle: np.ndarray
) -> tuple[list, list[str]]:
    """Layers whose units mostly switch near the middle of the set, and others that do not."""
    sizes = (shapes.states, *shapes.hidden, shapes.inputs)
    layers, kinds, x, size = [], [], middle, scales.states
    for k, (into, out) in enumerate(pairwise(sizes)):
        last = k == len(sizes) - 2
        W = rng.normal(size=(out, into)) / size / np.sqrt(into)
        b = 0.3 * rng.normal(size=out) - (W @ x if rng.random() < 0.8 else 0.0)
        for unit in range(0 if last else out):
            kind = str(
                rng.choice(
                    ["plain", "dead", "active", "duplicate", "zero", "at a kink"],
                    p=[0.6, 0.1, 0.1, 0.08, 0.04, 0.08],
                )
            )
            kinds.append(kind)
            if kind in ("dead", "active"):
                b[unit] = -W[unit] @ x + (-50.0 if kind == "dead" else 50.0)
            elif kind == "duplicate":
                W[unit], b[unit] = W[0], b[0]
            elif kind == "zero":
                W[unit], b[unit] = 0.0, rng.choice([0.0, 1.0, -1.0])
            elif kind == "at a kink":
                b[unit] = -(W[unit] @ x)
        if last:
            W, b = W * scales.inputs[:, None], b * scales.inputs
        elif scales.kind != "one" and rng.random() < 0.3:  # a layer of another scale
            factor = 10 ** rng.uniform(-8, 8)
            W, b = W * factor, b * factor
        layers.append((W, b))
        x = np.maximum(W @ x + b, 0.0)
        size = abs(W) @ size
        size[size == 0] = size.max() or 1.0  # a zero unit has none
    return layers, kinds
