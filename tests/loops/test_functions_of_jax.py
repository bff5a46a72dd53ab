"""Functions of JAX, one by one, against exact arithmetic: no image is outside of its certified set.

Each is a plant or a controller, which takes a small box of states one step further. The exact
reader, which shares no code with the library, says where its points go; what the library refuses
is told why, and what to do about it.
"""

import inspect
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import reachjax as rj
from tests.loops.jax_functions import arithmetic, constants, entries, flow
from tests.oracles.exact.exact_reader import images
from tests.oracles.exact.varying import fractions

FAMILIES = entries.FAMILIES | arithmetic.FAMILIES | constants.FAMILIES | flow.FAMILIES
LOWER, UPPER = np.array([-0.5, 0.25]), np.array([0.75, 1.0])
DRAWS = 40

ROUNDING = 2.0**-40
"""What a simulation in 64-bit floats may be off by, as a part of one and of what it finds."""


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
    r"\b(use|write|compute|give|put|multiply|compare|keep|leave|choose|must|take|clip|evaluation)\b"
)
"""What a refusal says if it names something to do."""

NAMES = re.compile(r"the primitive '[\w-]+'|(Network|NonlinearPlant)\.f\b| at t = 0 ")
"""What it says if it names what it speaks of: a primitive, the function, or a layer of units."""


def judged(function, as_plant):
    """What became of a function: "accepted", "refused", or a sentence on what is wrong."""
    try:
        loop = loop_of(function, as_plant)
        size = loop.plant.states
        x = np.pad(points(), ((0, 0), (0, size - 2)))
        X0 = rj.Box(x[:4].min(axis=0), x[:4].max(axis=0))
        region = rj.reach(loop, X0, 1, rj.Template.box(size), rj.LinearBounds()).sets[1]
    except Exception as error:
        text, is_own = str(error), type(error).__module__.startswith(("builtins", "reachjax"))
        if not isinstance(error, TypeError | ValueError) or not is_own:
            return f"a foreign error: {error!r}"
        has_way = NAMES.search(text) and WAYS_OUT.search(text)
        return "refused" if has_way else f"no way out: {error!r}"
    values, off = images(function, x[:, :2])
    values = np.hstack([values, np.zeros((len(values), size - values.shape[1]), int)])
    over = (values @ fractions(region.A).T - fractions(region.b)).max()
    if over > off * (1 + abs(values).max()):
        return f"exact images are outside by {float(over):.3g}"
    if not np.isfinite(region.b).all():
        return f"no bounds, and no error: {region.b}"
    simulated = np.asarray(jax.vmap(lambda x: loop.simulate(x, 1)[1])(x))
    over = (simulated @ region.A.T - region.b).max()
    if over > ROUNDING * (1 + abs(simulated).max()):
        return f"simulated states are outside by {over:.3g}"
    return "accepted"


def assert_judged(functions, *wanted):
    """Every one is what is wanted of it; every other one is a plant, the rest are controllers."""
    found = [(named(f), judged(f, k % 2 == 0)) for k, f in enumerate(functions)]
    assert not [each for each in found if each[1] not in wanted]


@pytest.mark.costly
def test_every_fortieth_function_is_inside():
    functions = [f for family in FAMILIES.values() for f in family][::40]
    assert_judged(functions, "accepted")


@pytest.mark.costly
@pytest.mark.parametrize("family", FAMILIES)
def test_images_are_inside(family):
    assert_judged(FAMILIES[family], "accepted")


@pytest.mark.costly
@pytest.mark.parametrize("module", [entries, arithmetic, constants, flow])
def test_what_is_refused_is_told_a_way_out(module):
    """Those that have bounds one day only have to be inside."""
    assert_judged(module.REFUSED, "refused", "accepted")


def test_the_reader_tells_a_wrong_function():
    """A set is only as good as the function that it is of."""
    values, off = images(lambda x: jnp.sin(x) * (1 + 2.0**-52), points())
    others, _ = images(jnp.sin, points())
    assert off > 0
    assert (abs(values - others) > 0).any()
