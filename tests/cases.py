"""The table that laws are checked on: a loop, an initial set, a template and a method in each row.

A new loop, set, template or method is one line of its own table, and every law speaks of it. There
are few shapes, since compiling them is what costs, and a tube is computed once in a session.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import reachjax as rj
from tests.activations import Controlled, controlled
from tests.closed_loops import initial_set, random_loop
from tests.disturbed_loops import disturbance_set, disturbed_loop, extremes
from tests.input_polytopes import SETS as INPUTS
from tests.input_polytopes import polytope_loop
from tests.networks import he_network

HORIZON, START, DRAWS = 3, 2, 1500
"""Steps of each tube; the first time of loops that vary in time; states that are simulated."""

ROUNDING = 1e-12
"""Of what is simulated, as a part of its size, or of one."""


@dataclass(frozen=True)
class Loop:
    """A loop of the table.

    Attributes:
        make: the loop.
        initial: the set that it starts from, where a row names none.
        start: the time of that set.
        n: the number of states.
        plain: the same loop in plain numpy, if there is one.
        kept: whether a file keeps it; a function of a user's is given again.
        smooth: whether a unit of it is no piecewise linear one.
        options: of `reach`, beside those of the method.
    """

    make: Callable[[], rj.ClosedLoop]
    initial: Callable[[], rj.AbstractSet]
    start: int = 0
    n: int = 2
    plain: Callable[[], Controlled] | None = None
    kept: bool = True
    smooth: bool = False
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Method:
    """A method of the table.

    Attributes:
        options: of `reach`.
        balls: whether it bounds ellipsoids, too.
        compiled: whether it runs inside `jax.jit`.
        closes: whether it closes the gaps of loops of piecewise linear units.
        cells: whether it cuts the initial set.
        grows: whether its bounds are no smaller of a larger set, whatever is drawn.
    """

    options: dict[str, Any] = field(default_factory=dict)
    balls: bool = False
    compiled: bool = False
    closes: bool = False
    cells: bool = False
    grows: bool = False


# plants -------------------------------------------------------------------------------------------


def sine(p: Any, x: Any, u: Any) -> Any:
    """A pendulum."""
    return jnp.stack([x[0] + 0.1 * x[1], x[1] + 0.1 * (p * jnp.sin(x[0]) - 0.2 * x[1] + u[0])])


def oscillator(p: Any, x: Any, u: Any) -> Any:
    """Products of states, and a cube."""
    return x + 0.1 * jnp.stack([x[1], p * (1 - x[0] ** 2) * x[1] - x[0] ** 3 + u[0]])


def tank(p: Any, x: Any, u: Any) -> Any:
    """Square roots."""
    flows = p * jnp.sqrt(x + 2)
    return x + 0.1 * jnp.stack([u[0] - flows[0], flows[0] - flows[1]])


def quotient(p: Any, x: Any, u: Any) -> Any:
    """A quotient, and an exponential function."""
    return x + 0.1 * jnp.stack([jnp.exp(-x[1]) - 1, p * u[0] / (1 + x[0] ** 2)])


def car(p: Any, x: Any, u: Any) -> Any:
    """Three states: a place, and a heading that is steered less far away."""
    return x + 0.2 * jnp.stack([jnp.cos(x[2]), jnp.sin(x[2]), p * u[0] / (1 + x[0] ** 2)])


def bell(p: Any, x: Any, u: Any) -> Any:
    """One state."""
    return 0.5 * x + jnp.exp(-p * x**2) / 3 + 0.1 * u


def pushed(p: Any, x: Any, u: Any, w: Any) -> Any:
    """The pendulum, with a disturbance."""
    return sine(p, x, u) + 0.05 * w


def relay(p: Any, x: Any, u: Any) -> Any:
    """A relay instead of the input, which the state reads as well."""
    return jnp.stack([x[0] + p * x[1] / 4, x[1] - jnp.sign(x[0] + x[1]) / 4])


def friction(p: Any, x: Any, u: Any) -> Any:
    """Dry friction."""
    return jnp.stack([x[0] + p * x[1] / 4, x[1] - (x[0] + jnp.sign(x[1]) / 2) / 4])


def piloted(p: Any, x: Any, u: Any, w: Any) -> Any:
    """A pilot takes any of three pushes."""
    pushes = [[0.0, -0.25], [0.125, 0.0], [0.0, 0.5]]
    return jnp.stack([x[0] + p * x[1] / 4, x[1] + u[0] / 4]) + rj.one_of(pushes, w)


def advised(p: Any, x: Any, u: Any) -> Any:
    """A place, and which of two advisories it was sent by, as zeros and a one."""
    advisory = jax.nn.one_hot(jnp.argmax(u), 2)
    return jnp.append(p * x[0] / 2 + (advisory[0] - advisory[1]) / 4, advisory)


def swinging(x: Any, u: Any) -> Any:
    """The pendulum's differential equation."""
    return jnp.stack([x[1], jnp.sin(x[0]) - 0.2 * x[1] + u[0]])


def swinging_in_wind(x: Any, u: Any, w: Any) -> Any:
    """The same with a disturbance."""
    return swinging(x, u) + 0.2 * w


def best(x: Any) -> Any:
    """The action of the largest of three scores."""
    scores = jnp.stack([x[0] - x[1], x[0] / 2 + 0.25, x[1]])
    return jnp.array([-0.5, 1.0, 0.25])[jnp.argmax(scores)][None]


def law(p: Any, x: Any) -> Any:
    """A controller that no class of the library is."""
    return -2 * jnp.tanh(p @ x)


def side(x: Any) -> Any:
    """Which of two controllers acts."""
    return (x[0] > 0.1).astype(int)


def last(x: Any) -> Any:
    """Which of two controllers acts: the one of the last advisory."""
    return jnp.argmax(x[1:])


def net(activation: Any = rj.Tanh(), seed: int = 0, n: int = 2) -> rj.MLP:  # noqa: B008  (immutable)
    """So many states, one input."""
    return rj.MLP.from_layers(he_network((n, 4, 3, 1), seed), activation)


def scores(seed: int) -> rj.MLP:
    """Of two advisories, after one of them; seeds 4 and 5 give both at all times."""
    return rj.MLP.from_layers(he_network((3, 4, 2), seed))


def nonlinear(f: Callable, activation: Any = None, n: int = 2, **options: Any) -> rj.ClosedLoop:
    """A plant of a function, under a network of layers."""
    plant = rj.NonlinearPlant(Partial(f, 1.5), n, 1)
    return rj.ClosedLoop(plant, net(activation or rj.Tanh(), n=n), **options)


def of_arrays(n_x: int = 2, seed: int = 3, activation: Any = rj.ReLU(), **options: Any) -> Loop:  # noqa: B008
    """A loop that is simulated in plain numpy, too."""
    start = START if options.get("steps") else 0

    @functools.cache
    def plain() -> Controlled:
        if "skip" in options:
            return controlled(activation, n_x, (4, 3), seed, **options)
        return Controlled(random_loop(n_x, (4, 3), seed, **options), activation)

    return Loop(lambda: plain().loop, lambda: initial_set("box", n_x, n_x), start, n_x, plain)


def disturbed(W: str, V: str, n: int = 2) -> Loop:
    """A loop into which disturbances and noise enter."""
    return Loop(
        lambda: disturbed_loop(n, disturbance_set(W, n), disturbance_set(V, n, seed=3), seed=1),
        lambda: rj.Box(np.full(n, -0.1), np.full(n, 0.4)),
        n=n,
        options={"gap": 0.1},  # no products
    )


def of_functions(make: Callable[[], rj.ClosedLoop], **more: Any) -> Loop:
    """A loop with functions of a user's, or smooth ones, from a small box."""
    small = lambda: rj.Box([0.2, -0.3], [0.4, -0.1])  # noqa: E731
    return Loop(make, **({"initial": small, "kept": False, "smooth": True} | more))


def jumping(make: Callable, size: float = 0.5, smooth: bool = False, **more: Any) -> Loop:
    """A loop that jumps, from around where it does."""
    around = lambda: rj.Box([-size, -0.8 * size], [0.8 * size, size])  # noqa: E731
    given = {"initial": around, "smooth": smooth, "options": {"gap": 1e-2}}
    return of_functions(make, **(given | more))


FILE = "tests/data/networks/torch_tanh.onnx"
UNIT = rj.Box([-1.0], [1.0])
LINE = rj.AffinePlant([[1.0, 0.25], [0.0, 1.0]], [[0.0], [0.25]])

LOOPS = {
    "relu": of_arrays(),
    "leaky": of_arrays(activation=rj.LeakyReLU(0.1)),
    "hard": of_arrays(activation=rj.HardTanh()),
    "residual": of_arrays(skip=True),
    "unlimited": of_arrays(boxed=False),
    "varying": of_arrays(steps=START + HORIZON),
    "hard, one state": of_arrays(1, activation=rj.HardTanh()),
    "leaky, six states": of_arrays(6, activation=rj.LeakyReLU(0.1)),
    "residual, three states": of_arrays(3, skip=True),
    "one state": of_arrays(1),
    "three states": of_arrays(3),
    "six states": of_arrays(6),
    "inputs in a pentagon": Loop(
        lambda: polytope_loop(INPUTS["pentagon"], hidden=(3,), seed=3),
        lambda: rj.Box([-0.6, -0.4], [0.5, 0.7]),
    ),
    "inputs in a cube": Loop(
        lambda: polytope_loop(INPUTS["cube"], seed=1), lambda: rj.Box([-0.6, -0.4], [0.5, 0.7])
    ),
    "disturbed": disturbed("box", "ellipsoid"),
    "disturbed by times": disturbed("varying box", "box"),
    "disturbed in a polytope": disturbed("polytope", "intersection"),
    "disturbed in a ball": disturbed("ellipsoid", "polytope"),
    "disturbed in both": disturbed("intersection", "varying box"),
    "disturbed, one state": disturbed("polytope", "ellipsoid", 1),
    "disturbed, three states": disturbed("box", "intersection", 3),
    "tanh": of_functions(lambda: rj.ClosedLoop(LINE, net()), kept=True),
    "sigmoid": of_functions(lambda: rj.ClosedLoop(LINE, net(rj.Sigmoid()), UNIT), kept=True),
    "of a file": of_functions(
        lambda: rj.ClosedLoop(LINE, rj.Network.from_onnx(FILE), UNIT), kept=True
    ),
    "traced": of_functions(
        lambda: rj.ClosedLoop(LINE, rj.Network(Partial(law, jnp.array([[1.5, 1.0]])), 2, 1), UNIT)
    ),
    "sine": of_functions(lambda: nonlinear(sine, rj.ReLU(), input_box=UNIT)),
    "sine, tanh": of_functions(lambda: nonlinear(sine)),
    "oscillator": of_functions(lambda: nonlinear(oscillator)),
    "oscillator, hard": of_functions(lambda: nonlinear(oscillator, rj.HardTanh())),
    "tank": of_functions(lambda: nonlinear(tank)),
    "car": of_functions(
        lambda: nonlinear(car, rj.ReLU(), 3),
        initial=lambda: rj.Box([0, 0, 0.2], [0.1, 0.2, 0.5]),
        n=3,
    ),
    "bell": of_functions(lambda: nonlinear(bell, n=1), initial=lambda: rj.Box([-1.0], [0.5]), n=1),
    "quotient": of_functions(lambda: nonlinear(quotient, rj.ReLU())),
    "pushed": of_functions(
        lambda: rj.ClosedLoop(
            rj.NonlinearPlant(Partial(pushed, 1.5), 2, 1, disturbances=2),
            net(rj.ReLU()),
            disturbance=rj.Box([-1.0, -0.5], [0.5, 1.0]),
        )
    ),
    "relay": jumping(lambda: nonlinear(relay), smooth=True),
    "friction": jumping(lambda: nonlinear(friction), smooth=True),
    "argmax": jumping(lambda: rj.ClosedLoop(LINE, rj.Network(best, 2, 1))),
    "bang-bang": jumping(lambda: rj.ClosedLoop(LINE, net(rj.Step())), kept=True),
    "switched": jumping(
        lambda: rj.ClosedLoop(LINE, rj.Switched([net(rj.ReLU()), net(rj.ReLU(), 1)], by=side)),
        size=0.15,
    ),
    "piloted": jumping(
        lambda: rj.ClosedLoop(
            rj.NonlinearPlant(Partial(piloted, 1.5), 2, 1, disturbances=3),
            net(rj.ReLU()),
            disturbance=rj.Box(np.zeros(3), np.ones(3)),
        )
    ),
    "advised": jumping(
        lambda: rj.ClosedLoop(
            rj.NonlinearPlant(Partial(advised, 1.5), 3, 2),
            rj.Switched([scores(4), scores(5)], by=last),
        ),
        n=3,
        initial=lambda: rj.Box([-0.5, 1.0, 0.0], [0.4, 1.0, 0.0]),
    ),
    "sampled": of_functions(
        lambda: rj.ClosedLoop(rj.SampledPlant(swinging, 2, 1, period=0.2), net(rj.ReLU()))
    ),
    "sampled, affine": of_functions(
        lambda: rj.ClosedLoop(
            rj.SampledPlant.affine([[0.0, 1.0], [-1.0, -0.2]], [[0.0], [1.0]], period=0.5), net()
        ),
        kept=True,
    ),
    "sampled, pushed": of_functions(
        lambda: rj.ClosedLoop(
            rj.SampledPlant(swinging_in_wind, 2, 1, period=0.2, disturbances=2),
            net(rj.ReLU()),
            disturbance=rj.Box([-1.0, -0.5], [0.5, 1.0]),
        )
    ),
}
"""Loops by name: of every kind of unit, plant, input set and disturbance."""


def narrow(widths: Iterable[float]) -> Callable[[int], rj.Box]:
    """Boxes whose first sides have these widths."""
    low, sizes = np.array([-0.2, 0.3, 0.1, 0.0, 0.2, -0.1]), np.array([*widths, 0.3, 0.2, 0.1, 0.2])
    return lambda n: rj.Box(low[:n], low[:n] + sizes[:n])


SETS = {
    kind: functools.partial(initial_set, kind, seed=2)
    for kind in ("polytope", "simplex", "ellipsoid", "intersection", "far intersection")
} | {
    "flat": narrow([0.6, 0.0]),
    "point": lambda n: rj.Box(0.1 * np.arange(n), 0.1 * np.arange(n)),
    "thin": narrow([0.6, 1e-12]),
    "wide": lambda n: rj.Box(-1.5 * np.ones(n), np.ones(n)),
}
"""Initial sets of so many states, beside those of loops."""


def oblique(n: int) -> np.ndarray:
    """Random directions of so many states."""
    return np.random.default_rng(0).normal(size=(5, n))


VARYING = np.stack([(1.0 + t) * oblique(2) for t in range(HORIZON)])

TEMPLATES: dict[str, Callable[[rj.ClosedLoop, rj.AbstractSet], rj.AbstractTemplate]] = {
    "axes": lambda loop, X0: rj.Template.box(loop.states),
    "octagonal": lambda loop, X0: rj.Template.octagonal(loop.states),
    "random": lambda loop, X0: rj.Template(oblique(loop.states)),
    "varying": lambda loop, X0: rj.Template(VARYING),
    "adapted": lambda loop, X0: rj.Template.adapted(loop, X0, HORIZON, 6, samples=300),
    "ellipsoids": lambda loop, X0: rj.EllipsoidTemplate(),
    "given shape": lambda loop, X0: rj.EllipsoidTemplate([[2.0, 0.5], [0.5, 1.0]]),
    "mixed": lambda loop, X0: rj.MixedTemplate(rj.Template.box(loop.states)),
}
"""What sets look like, for a loop and its initial set."""

ROUND = "ellipsoids", "given shape", "mixed"


def by(relaxation: Any, window: int | None = None, **more: Any) -> Method:
    """A method by what `reach` is given."""
    return Method({"relaxation": relaxation, "window": window}, **more)


METHODS = {
    "default": Method(closes=True),
    "forms": by(rj.LinearBounds(), compiled=True),
    "few programs": by(rj.BranchAndCut(nodes=3, cells=1)),
    "no programs": by(rj.BranchAndCut(nodes=0, cells=1)),
    "one cell": by(rj.BranchAndCut(cells=1), closes=True),
    "twelve cells": by(rj.BranchAndCut(cells=12), cells=True),
    "cells of forms": by(rj.Cells(rj.AffineForms(), 6), cells=True),
    "cells of branches": by(rj.Cells(rj.Branching(rj.BranchAndCut(nodes=20)), 6), cells=True),
    "cells of programs": by(rj.Cells(rj.Recursion(rj.LocalBounds(), 1), 3), cells=True),
    "programs": by(rj.LocalBounds(), 1, balls=True, compiled=True, grows=True),
    "paper": by(rj.PaperQC(), 1, balls=True, compiled=True, grows=True),
    "paper, plain": by(rj.PaperQC(repeated=False), 1, balls=True, compiled=True, grows=True),
    "windows of two": by(rj.LocalBounds(), 2, grows=True),
    "cuts": by(rj.CuttingPlanes(rounds=1), 2),
    "all products": by(rj.AllProducts(), 1, balls=True),
}
"""Methods by name."""


# rows ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """A row of the table; `initial` is the loop's own set where none is named."""

    loop: str
    method: str = "default"
    initial: str = "own"
    template: str = "axes"

    @property
    def name(self) -> str:
        """What it is, in words."""
        usual = {"own", "axes"}
        return "; ".join(each for each in vars(self).values() if each not in usual)

    @property
    def of(self) -> Loop:
        """The line of its loop."""
        return LOOPS[self.loop]

    @property
    def by(self) -> Method:
        """The line of its method."""
        return METHODS[self.method]

    @property
    def continuous(self) -> bool:
        """Whether its plant is a differential equation."""
        return self.loop.startswith("sampled")

    @property
    def round(self) -> bool:
        """Whether its sets are ellipsoids, or in them."""
        return self.template in ROUND

    @property
    def searches_cells(self) -> bool:
        """Whether its bounds are those of cells of the initial set."""
        return self.by.cells or (self.method == "default" and self.of.smooth)

    @property
    def options(self) -> dict[str, Any]:
        """Keyword arguments of `reach`, but the time of the initial set."""
        return {"samples": 100, **self.of.options, **self.by.options}

    @property
    def closed_loop(self) -> rj.ClosedLoop:
        """Its loop."""
        return _loop(self.loop)

    @property
    def X0(self) -> rj.AbstractSet:
        """Its initial set."""
        return _initial(self.loop, self.initial)

    @property
    def shape(self) -> rj.AbstractTemplate:
        """Its template."""
        return TEMPLATES[self.template](self.closed_loop, self.X0)

    @property
    def tube(self) -> rj.ReachTube:
        """Its tube, computed once."""
        return _tube(self)

    @property
    def runs(self) -> np.ndarray:
        """Trajectories `(c, HORIZON + 1, n_x)` that attack it, computed once."""
        return _runs(self.loop, self.initial)

    def reach(self, loop: Any = None, X0: Any = None, steps: int = HORIZON, **more: Any) -> Any:
        """The tube of another loop or set by the same method."""
        loop, X0 = loop or self.closed_loop, X0 or self.X0
        template = more.pop("template", None) or TEMPLATES[self.template](loop, X0)
        options = {"start": self.of.start, **self.options, **more}
        return rj.reach(loop, X0, steps, template, **options)

    def excess(self, region: rj.AbstractSet, states: Any) -> float:
        """By how much states are outside of a set at most, as a part of its size or of one."""
        limits = np.asarray(region.limits)
        beyond = np.asarray(region.bounded_values(jnp.asarray(states))) - limits
        return float(np.max(beyond / np.maximum(1.0, abs(limits))))


@functools.cache
def _loop(name: str) -> rj.ClosedLoop:
    return LOOPS[name].make()


@functools.cache
def _initial(loop: str, kind: str) -> rj.AbstractSet:
    return LOOPS[loop].initial() if kind == "own" else SETS[kind](LOOPS[loop].n)


@functools.cache
def _tube(case: Case) -> rj.ReachTube:
    return case.reach()


@functools.cache
def _runs(name: str, kind: str) -> np.ndarray:
    """From corners, the boundary and the inside, under extreme disturbances and any."""
    of, loop, X0 = LOOPS[name], _loop(name), _initial(name, kind)
    key = jax.random.key(1)
    points = [X0.corners(), X0.sample(key, DRAWS), X0.sample_boundary(key, DRAWS)]
    states = jnp.concatenate([each for each in points if each is not None and len(each)])
    if of.plain is not None:
        return _in_numpy(of.plain(), np.asarray(states), of.start)
    drawn = {
        what: extremes(each, len(states), HORIZON, seed)
        for seed, (what, each) in enumerate(
            {"disturbances": loop.disturbance, "noises": loop.noise}.items()
        )
        if each is not None
    }
    return np.asarray(loop.simulate(states, HORIZON, of.start, **drawn))


def _in_numpy(plain: Controlled, x: np.ndarray, start: int) -> np.ndarray:
    states = [x]
    for t in range(start, start + HORIZON):
        states.append(plain.successors(states[-1], t))
    return np.stack(states, axis=1)


ROUND_ROWS = (
    *itertools.product(["relu"], ["simplex", "ellipsoid", "intersection"], ROUND),
    *itertools.product(["one state", "three states"], ["own", "intersection"], ["mixed"]),
    *itertools.product(["one state", "three states", "six states"], ["ellipsoid"], ["ellipsoids"]),
    *itertools.product(
        ["varying", "inputs in a pentagon", "sine", "sine, tanh", "disturbed"],
        ["own"],
        ["ellipsoids"],
    ),
    ("sine, tanh", "own", "mixed"),
)
"""Loops, sets and templates of ellipsoids."""

BY_PROGRAMS = (
    *("varying", "unlimited", "inputs in a pentagon", "tanh", "sine, tanh", "oscillator", "tank"),
    *("one state", "three states", "six states", "hard", "hard, one state", "leaky, six states"),
    *("residual, three states", "disturbed in a polytope", "pushed"),
)
"""Loops whose tubes are bounded by programs of one step as well."""


def _rows() -> Iterator[Case]:
    for loop, method in itertools.product(LOOPS, ["default", "forms"]):
        yield Case(loop, method)
    for loop, method in itertools.product(["relu", "sine", "disturbed"], METHODS):
        yield Case(loop, method)
    for initial, method in itertools.product(SETS, ["default", "forms", "programs"]):
        yield Case("relu", method, initial)
    for initial in SETS:
        yield Case("sine, tanh", "default", initial)
        yield Case("three states", "forms", initial)
    for initial in ("simplex", "ellipsoid", "intersection"):
        yield Case("disturbed", "default", initial)
    for template, method in itertools.product(TEMPLATES, ["default", "forms", "programs", "paper"]):
        if METHODS[method].balls or template not in ROUND:
            yield Case("relu", method, "own", template)
    yield Case("relu", "paper, plain", "own", "ellipsoids")
    for loop, initial, template in ROUND_ROWS:
        yield Case(loop, "programs", initial, template)
    for loop in BY_PROGRAMS:
        yield Case(loop, "programs")
    yield Case("three states", "programs", "simplex")
    yield Case("disturbed in a ball", "paper")
    for method in ("no programs", "cuts", "paper"):
        yield Case("inputs in a pentagon", method)
    for method in ("few programs", "cells of forms", "cells of branches", "cells of programs"):
        yield Case("pushed", method)
    yield Case("relu", "paper", "ellipsoid", "mixed")
    yield Case("one state", "paper, plain", "ellipsoid", "ellipsoids")
    yield Case("disturbed", "paper", "own", "ellipsoids")
    yield Case("disturbed in a polytope", "windows of two")
    yield Case("leaky", "default", "ellipsoid")
    yield Case("oscillator", "forms", "polytope")
    yield Case("three states", "programs", "own", "random")


CASES = tuple(dict.fromkeys(_rows()))
"""All rows."""

BASIC = (
    *(Case(loop, "forms") for loop in ("relu", "disturbed", "oscillator", "argmax", "sampled")),
    *(Case(loop) for loop in ("relu", "varying", "sine")),
    Case("relu", "programs"),
)
"""Rows of which a law is checked wherever one case of each claim is."""

LONGEST = (
    *(Case("sine, tanh", "default", initial) for initial in ("polytope", "simplex")),
    *(Case("disturbed", method) for method in ("few programs", "no programs", "cuts")),
    *(Case("sine, tanh", "programs", "own", template) for template in ("ellipsoids", "mixed")),
    Case("disturbed in a polytope", "programs"),
    Case("inputs in a pentagon", "no programs"),
    Case("three states", "programs", "own", "mixed"),
    Case("six states", "programs", "ellipsoid", "ellipsoids"),
)
"""Rows that take longest, and whose parts other rows have."""

FEW = Case("relu"), Case("disturbed", "forms"), Case("sampled", "forms")
"""The rows for laws that bound several tubes of each."""


def each(
    where: Callable[[Case], bool] = lambda case: True,
    rows: Iterable[Case] = CASES,
    basic: Iterable[Case] = BASIC,
    every: int = 1,
    longest: pytest.MarkDecorator = pytest.mark.long,
) -> pytest.MarkDecorator:
    """The rows of which a law speaks.

    Args:
        where: which rows.
        rows: out of these.
        basic: those that are taken wherever one case of each claim is.
        every: of laws that bound much anew, whose row is taken besides; a person runs the rest by
            `-m long`.
        longest: which mark those have that take longest.
    """

    def marks(case: Case, number: int) -> list[pytest.MarkDecorator]:
        if case in basic:
            return [pytest.mark.basic]
        if number % every:
            return [pytest.mark.long]
        return [longest] * (case in LONGEST)

    chosen = filter(where, rows)
    found = [
        pytest.param(case, id=case.name, marks=marks(case, number))
        for number, case in enumerate(chosen)
    ]
    return pytest.mark.parametrize("case", found)
