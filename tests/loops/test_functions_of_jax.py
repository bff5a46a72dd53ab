"""Functions of JAX, one by one, against exact arithmetic: no image is outside of its certified set.

Each is a plant or a controller, which takes a small box of states one step further. The exact
reader, which shares no code with the library, says where its points go; what the library refuses
is told why, and what to do about it.
"""

import inspect
import re
from dataclasses import dataclass, field
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import reachjax as rj
from tests.loops.jax_functions import arithmetic, constants, entries, flow
from tests.oracles.exact import fractions, images

FAMILIES = entries.FAMILIES | arithmetic.FAMILIES | constants.FAMILIES | flow.FAMILIES
LOWER, UPPER = np.array([-0.5, 0.25]), np.array([0.75, 1.0])
DRAWS = 40

ROUNDING = 2.0**-40
"""What a simulation in 64-bit floats may be off by, as a part of one and of what it finds."""


@dataclass
class Counts:
    """What became of functions: how many are accepted, refusals, and sentences on faults."""

    accepted: int = 0
    refused: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)


def points():
    """Corners, points on edges and in the middle, zeros where there are some, and drawn ones."""
    rng = np.random.default_rng(11)
    drawn = rng.uniform(LOWER, UPPER, size=(DRAWS, 2))
    corners = np.stack(np.meshgrid(*zip(LOWER, UPPER, strict=True)), axis=-1).reshape(-1, 2)
    zeros = np.column_stack([np.zeros(3), rng.uniform(LOWER[1], UPPER[1], 3)])
    equal = np.repeat(rng.uniform(LOWER[1], UPPER[0], size=(3, 1)), 2, axis=1)
    return np.vstack([corners, zeros, equal, (LOWER + UPPER)[None] / 2, drawn])


def named(function):
    """Where a function is written."""
    inner = inspect.unwrap(getattr(function, "func", function))
    code = getattr(inner, "__code__", None)
    if code is None:
        return repr(function).splitlines()[0]
    cells = [str(cell.cell_contents) for cell in inner.__closure__ or ()]
    return f"{Path(code.co_filename).name}:{code.co_firstlineno} {' '.join(cells)}".strip()


def sizes(function):
    """How many values a function has; two if it has none."""
    try:
        return np.size(jax.eval_shape(function, jax.ShapeDtypeStruct((2,), float)))
    except Exception:  # what is wrong with it is the library's to say
        return 2


def loop_of(function, as_plant):
    """The loop in which a function says where its states go; they are as many as its values."""
    count = sizes(function)
    size = max(2, count)

    def called(function, x, *_):
        return jnp.ravel(function(x[:2]))

    def widened(function, x, u):
        return jnp.pad(called(function, x), (0, size - count))

    def whole(f):
        is_tree = jax.tree.leaves(function) != [function]
        return Partial(f, function) if is_tree else lambda *given: f(function, *given)

    if as_plant:
        still = rj.Network(lambda x: 0 * x[:1], inputs=size, outputs=1)
        return rj.ClosedLoop(rj.NonlinearPlant(whole(widened), size, 1), still)
    plant = rj.AffinePlant(np.zeros((size, size)), np.eye(size, count))
    return rj.ClosedLoop(plant, rj.Network(whole(called), size, count))


WAYS_OUT = re.compile(
    r"\b(use|write|compute|give|put|multiply|compare|keep|call|choose|pass|must|take)\b"
)
"""What a refusal says if it names something to do."""


def judged(function, as_plant, counts, method=rj.LinearBounds):
    """Compare the certified images of a function with what it is; or see why it has none."""
    name = named(function)
    try:
        loop = loop_of(function, as_plant)
        size = loop.plant.states
        x = np.pad(points(), ((0, 0), (0, size - 2)))
        X0 = rj.Box(x[:4].min(axis=0), x[:4].max(axis=0))
        region = rj.reach(loop, X0, 1, rj.Template.box(size), method()).sets[1]
    except (TypeError, ValueError) as error:
        text = str(error)
        counts.refused.append(f"{name}: {type(error).__name__}: {text}")
        if not re.search(r"\(in |function|Network|Plant|'\w+'", text) or not WAYS_OUT.search(text):
            counts.faults.append(f"{name}: names no way out: {type(error).__name__}: {text}")
        return
    counts.accepted += 1
    values, off = images(function, x[:, :2])
    offsets, rows = fractions(region.b), fractions(region.A)
    values = np.hstack([values, np.zeros((len(values), size - values.shape[1]), int)])
    over = values @ rows.T - offsets
    slack = off * (1 + abs(values).max())
    if (over > slack).any():
        counts.faults.append(f"{name}: outside by {float(over.max()):.3g}")
    if not np.isfinite(region.b).all():
        counts.faults.append(f"{name}: accepted, but bounds are {region.b}")
    simulated = np.asarray(jax.vmap(lambda x: loop.simulate(x, 1)[1])(x))
    beyond = simulated @ region.A.T - region.b - ROUNDING * (1 + abs(simulated).max())
    if (beyond > 0).any():
        counts.faults.append(f"{name}: simulated outside by {beyond.max():.3g}")
