"""Loops beyond chains of ReLUs: smooth units and plants, disturbances, polytopes of inputs.

Each is written once, over any namespace of functions: JAX's for the library, numpy's in longdouble
for a search, and mpmath's for a judgement in so many digits that rounding has no say.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import pairwise, product
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mpmath
import numpy as np

import reachjax as rj
from tests.campaign import functions
from tests.campaign.functions import by_cases, masses, switched, switched_waves
from tests.campaign.oracle import WIDE, Region, exact
from tests.input_polytopes import exact_multipliers

HEADER = """\
import jax; jax.config.update("jax_enable_x64", True)
import reachjax as rj"""
DIGITS = 60
FUNCTIONS = ("sin", "cos", "tanh", "exp", "log", "sqrt")


def _entrywise(function: Callable) -> Callable:
    """A function of a number as one of arrays too; of a number it gives a number, no array."""
    of_arrays = np.vectorize(function, otypes=[object])
    return lambda y: of_arrays(y) if isinstance(y, np.ndarray) else function(y)


EXACT = SimpleNamespace(
    **{name: _entrywise(getattr(mpmath, name)) for name in FUNCTIONS},
    arctan=_entrywise(mpmath.atan),
    maximum=np.maximum,
    minimum=np.minimum,
    stack=np.stack,
)
"""The functions of numpy on arrays of mpmath's numbers."""


def digits(values: Any) -> np.ndarray:
    """The same numbers as mpmath's."""
    flat = [mpmath.mpf(value) for value in np.asarray(values, float).ravel().tolist()]
    found = np.empty(len(flat), dtype=object)
    found[:] = flat
    return found.reshape(np.shape(values))


def sigmoid(m: Any, y: Any) -> Any:
    """`1 / (1 + exp(-y))`."""
    return 1 / (1 + m.exp(-y))


UNITS: dict[str, Callable] = {
    "relu": lambda m, y: m.maximum(y, 0 * y),
    "leaky": lambda m, y: m.maximum(y, y / 8),
    "hard": lambda m, y: m.minimum(m.maximum(y, -1 + 0 * y), 1 + 0 * y),
    "tanh": lambda m, y: m.tanh(y),
    "sigmoid": sigmoid,
    "arctan": lambda m, y: m.arctan(y),
}
ACTIVATIONS = {
    "relu": rj.ReLU(),
    "leaky": rj.LeakyReLU(0.125),
    "hard": rj.HardTanh(),
    "tanh": rj.Tanh(),
    "sigmoid": rj.Sigmoid(),
}
"""Those of a chain of layers; a network of others is traced."""


def affine(m: Any, x: Any, u: Any, w: Any, p: dict[str, Any]) -> Any:
    """`A x + B u + E w`, `w` nothing or a vector."""
    nothing = 0 if w is None else p["E"] @ w
    return p["A"] @ x + p["B"] @ u + nothing


def sine(m: Any, x: Any, u: Any, w: Any, p: dict[str, Any]) -> Any:
    """A pendulum, pushed."""
    push = 0 if w is None else w[0]
    return m.stack([x[0] + x[1] / 8, x[1] + p["a"][0] * m.sin(x[0]) + p["a"][1] * u[0] + push])


def products(m: Any, x: Any, u: Any, w: Any, p: dict[str, Any]) -> Any:
    """A Van der Pol oscillator, with a cube."""
    a = p["a"]
    bent = a[0] * (1 - x[0] * x[0]) * x[1] - a[1] * x[0] * x[0] * x[0]
    return m.stack([x[0] + x[1] / 8, x[1] + bent + a[2] * u[0]])


def coupled(m: Any, x: Any, u: Any, w: Any, p: dict[str, Any]) -> Any:
    """Products of factors of unlike sizes, of the state and of the input, pushed."""
    a, push = p["a"], 0 if w is None else w[0]
    bent = a[0] * (4096 * x[0]) * (m.sin(x[1]) / 4096) - a[1] * x[1] * u[0]
    return m.stack([x[0] + x[1] / 8, x[1] + bent + a[2] * u[0] + push])


def quotients(m: Any, x: Any, u: Any, w: Any, p: dict[str, Any]) -> Any:
    """Every other function: quotients, roots, logarithms, exponentials."""
    a = p["a"]
    first = x[0] * a[0] + m.sqrt(2 + x[1] * x[1]) - m.log(3 + x[0] * x[0])
    second = a[1] * x[1] / (2 + m.exp(-x[0])) + m.arctan(x[1]) * a[2] + u[0]
    return m.stack([first, second])


def unicycle(m: Any, x: Any, u: Any, w: Any, p: dict[str, Any]) -> Any:
    """A vehicle of a speed, turned by its input."""
    v = p["a"][0]
    return m.stack([x[0] + v * m.cos(x[2]), x[1] + v * m.sin(x[2]), x[2] + p["a"][1] * u[0]])


@dataclass(frozen=True)
class Kind:
    """What a loop of this kind is made of.

    Attributes:
        name: of it.
        step: the plant.
        unit: of the network.
        states: of the plant.
        hidden: neurons of each layer.
        inputs: of the plant.
        template: of the sets.
        initial: the kinds of initial sets.
        disturbed: the kinds of sets of disturbances; none if there are none.
        pushes: how many numbers disturb a plant that is not affine.
        noisy: whether states are measured with noise.
        facets: of a polytope of inputs; 0 for a box.
        skips: whether the network is traced, with a connection that skips it.
        horizon: the number of steps.
        columns: what old columns of forms are merged into, from a box; 0 where that is not tried.
        period: of a plant in continuous time, of which `step` is the field; 0 in discrete time.
        jumps: whether decisions of the plant are tied in the middle of the initial box.
        advised: whether the two last states, a one and a zero, say which of two networks acts.
    """

    name: str
    step: Callable
    unit: str
    states: int = 2
    hidden: tuple[int, ...] = (3,)
    inputs: int = 1
    template: Callable[[int], rj.AbstractTemplate] = rj.Template.box
    initial: tuple[str, ...] = ("box", "flat", "point", "polytope")
    disturbed: tuple[str, ...] = ()
    pushes: int = 1
    noisy: bool = False
    facets: int = 0
    skips: bool = False
    horizon: int = 2
    columns: int = 0
    period: float = 0.0
    jumps: bool = False
    advised: bool = False

    @property
    def loop(self) -> tuple:
        """What cases must share for the compiled code of their loops to be the same."""
        return (self.name,)


BOXES, ROUND = ("box", "varying", "polytope"), ("ellipsoid", "box")
EDGED = ("box", "flat", "point")
OCTAGONAL, PAIRS = rj.Template.octagonal, rj.Template.regular

KINDS = (
    Kind("tanh, affine", affine, "tanh", template=OCTAGONAL, horizon=3),
    Kind("sine, disturbed", sine, "tanh", disturbed=("box",), noisy=True),
    Kind("relu, disturbed", affine, "relu", disturbed=BOXES, noisy=True, hidden=(4, 3)),
    Kind("relu, polytope", affine, "relu", inputs=2, facets=4, hidden=(4,)),
    Kind("sigmoid, affine", affine, "sigmoid", hidden=(3, 2), horizon=3),
    Kind("sine", sine, "tanh", hidden=(3, 3), horizon=3, initial=("box", "ellipsoid", "polytope")),
    Kind("products", products, "relu", template=OCTAGONAL),
    Kind("quotients", quotients, "sigmoid"),
    Kind("unicycle", unicycle, "relu", states=3, hidden=(4,)),
    Kind("leaky, traced", affine, "leaky", skips=True, hidden=(4,), horizon=3),
    Kind("hard, products", products, "hard", skips=True),
    Kind("arctan, traced", sine, "arctan", skips=True, hidden=(3, 2)),
    Kind("tanh, polytope", affine, "tanh", inputs=2, facets=3, disturbed=("box",)),
    Kind("relu, round", affine, "relu", disturbed=ROUND, initial=("ellipsoid", "box"), horizon=3),
    Kind("by cases", by_cases, "tanh"),
    Kind("masses", masses, "relu", hidden=(4,)),
    Kind("tanh, to balls", affine, "tanh", template=lambda n: rj.EllipsoidTemplate(), horizon=1),
    Kind(
        "products, disturbed", coupled, "tanh", disturbed=("box",), noisy=True, horizon=4, columns=8
    ),
    Kind("long", sine, "tanh", disturbed=("box",), noisy=True, horizon=24, columns=16),
    Kind("sine, sampled", sine, "tanh", horizon=3, period=0.0625),
    Kind("products, sampled", products, "relu", disturbed=("box",), period=0.125),
    Kind("quotients, sampled", quotients, "sigmoid", period=0.0625, noisy=True),
    Kind("unicycle, sampled", unicycle, "relu", states=3, hidden=(4,), period=0.125),
    Kind("switched", switched, "relu", initial=EDGED, template=OCTAGONAL, jumps=True),
    Kind("switched waves", switched_waves, "tanh", initial=EDGED, jumps=True),
    Kind("piloted", functions.piloted, "relu", disturbed=("box",), pushes=3),
    Kind("advised", functions.advised, "relu", states=3, initial=EDGED, advised=True, horizon=3),
)


COLUMNS = 8
"""Results that are extrapolated: of order 16."""


def flowed(rate: Callable[[Any], Any], x: Any, h: float) -> Any:
    """The solution of `x' = rate(x)` after a time, by midpoints, in the digits of `x`."""
    rows: list[Any] = []
    for row in range(COLUMNS):
        count = 2 * (row + 1)
        part = (0 * x[0] + h) / count
        last, here = x, x + rate(x) * part  # a number of mpmath's after the array: it multiplies
        for _ in range(count - 1):
            last, here = here, last + rate(here) * (2 * part)
        column = (last + here + rate(here) * part) / 2
        for k in range(row):
            own, other = count**2, (count - 2 * (k + 1)) ** 2
            rows[k], column = column, (own * column - other * rows[k]) / (own - other)
        rows.append(column)
    return rows[-1]


@dataclass(frozen=True)
class KindCase:
    """One loop, its initial set, and how its states are computed without the library.

    Attributes:
        kind: of the loop.
        number: of the case.
        seed: of the campaign.
        loop: the library's.
        X0: its initial set.
        parameters: of the plant, by name.
        layers: pairs `(W, b)`.
        inputs: what they are projected onto: the ends of a box, or normals and offsets.
        region: the kind of initial set.
        options: of `reach`.
        known: trajectories in sixty digits that were asked for, which are asked for again.
    """

    kind: Kind
    number: int
    seed: int
    loop: rj.ClosedLoop
    X0: Any
    parameters: dict[str, np.ndarray]
    layers: list[tuple[np.ndarray, np.ndarray]]
    inputs: tuple[np.ndarray, np.ndarray]
    region: str
    options: dict[str, Any] = field(default_factory=dict)
    known: dict[Any, np.ndarray] = field(default_factory=dict, repr=False, compare=False)

    nonempty = True

    @property
    def rng(self) -> np.random.Generator:
        """What points and thresholds are drawn from."""
        return np.random.default_rng([self.seed, self.number, 1])

    @property
    def tried(self) -> dict[str, str]:
        """What it is, by kind of thing."""
        drawn = {"disturbance": self.loop.disturbance, "inputs": self.loop.input_box}
        named = {name: type(one).__name__ for name, one in drawn.items()}
        relaxation = str(self.options["relaxation"])
        kind = {"architecture": self.kind.name, "set": f"{self.region}, of other kinds"}
        gap = f"gap={self.options['gap']:g}, time_limit=0.4"
        return {**kind, **named, "relaxation": relaxation, "options": gap}

    @property
    def script(self) -> list[str]:
        """Lines that rebuild the case."""
        lines = [*HEADER.splitlines(), "from tests.campaign.architectures import architecture"]
        lines.append("from tests.campaign.kinds import drawn")
        return [*lines, f"case = drawn(architecture({self.number}), {self.number}, {self.seed})"]

    def states(self, x: np.ndarray, w: Any, v: Any, given: Callable, m: Any) -> np.ndarray:
        """The trajectory `(horizon + 1, n)` of one state, over a namespace.

        Args:
            x: the state.
            w: `(horizon, n_w)`, or None.
            v: `(horizon, n)`, or None.
            given: what numbers become.
            m: functions.
        """
        p = {name: given(value) for name, value in self.parameters.items()}
        layers = [(given(W), given(b)) for W, b in self.layers]
        found, x = [given(x)], given(x)
        for t in range(self.kind.horizon):
            seen = x if v is None else x + given(v[t])
            u = _network(m, seen, layers, self.kind)
            u = self._projected(u, given)
            pushed = None if w is None else given(w[t])

            def step(x: Any, u: Any = u, pushed: Any = pushed) -> Any:
                return self.kind.step(m, x, u, pushed, p)

            x = flowed(step, x, self.kind.period) if self.kind.period else step(x)
            found.append(x)
        return np.stack(found)

    def _projected(self, u: np.ndarray, given: Callable) -> np.ndarray:
        if not self.kind.facets:
            lower, upper = map(given, self.inputs)
            return np.minimum(np.maximum(u, lower), upper)
        C, d = self.inputs
        if given is digits:
            y = exact(C) @ _fractions(u) - exact(d)
            moved = exact(C).T @ exact_multipliers(C, y)[0]
            return u - np.array([mpmath.mpf(a.numerator) / a.denominator for a in moved])
        return _nearest(u, C, d)

    def room(self, x: Any, w: Any, v: Any, region: Region, t: int) -> list[Any]:
        """`b - A x`, and `1 - (x - q)' Q^-1 (x - q)`, of a trajectory at a time, in sixty digits.

        What is negative by less than rounding of these counts as zero.
        """
        with mpmath.workdps(DIGITS):
            found, state = [], self._in_digits(x, w, v)[t]
            if region.A is not None:
                found += list(digits(region.b) - digits(region.A) @ state)
            if region.center is not None:
                away = mpmath.matrix(list(state - digits(region.center)))
                shape = mpmath.matrix(digits(region.shape).tolist())
                found.append(1 - (away.T * mpmath.lu_solve(shape, away))[0])
            least = mpmath.mpf(10) ** (25 - DIGITS)
            return [max(each, 0) if abs(each) < least else each for each in found]

    def _in_digits(self, *drawn: Any) -> np.ndarray:
        """The trajectory of one scenario in so many digits, computed once."""
        key = tuple(None if part is None else np.asarray(part, float).tobytes() for part in drawn)
        if key not in self.known:
            self.known[key] = self.states(*drawn, digits, EXACT)
        return self.known[key]


def _fractions(values: np.ndarray) -> np.ndarray:
    """Fractions beside mpmath's numbers, equal to them."""
    found = np.empty(len(values), dtype=object)
    for k, value in enumerate(values):
        sign, whole, power, _ = value._mpf_
        number = exact(np.array(0.0))[()] + int(whole) * (-1 if sign else 1)
        found[k] = number * 2**power if power >= 0 else number / 2**-power
    return found


def _nearest(u: np.ndarray, C: np.ndarray, d: np.ndarray) -> np.ndarray:
    """The nearest point of a polygon that holds zero, in longdouble: all its faces are tried."""
    best, away = u, WIDE(np.inf)
    if np.all(C @ u <= d):
        return u
    for k, row in enumerate(C):
        foot = u - row * ((row @ u - d[k]) / (row @ row))
        if np.all(C @ foot <= d + 1e-15) and (gap := ((foot - u) ** 2).sum()) < away:
            best, away = foot, gap
    for i, j in product(range(len(C)), repeat=2):
        if i < j and abs(np.linalg.det(C[[i, j]])) > 1e-9:
            corner = np.linalg.solve(C[[i, j]], d[[i, j]]).astype(WIDE)
            if np.all(C @ corner <= d + 1e-12) and (gap := ((corner - u) ** 2).sum()) < away:
                best, away = corner, gap
    return best


def _network(m: Any, x: Any, layers: Sequence[tuple[Any, Any]], kind: Kind) -> Any:
    y = x
    for W, b in layers[:-1]:
        y = UNITS[kind.unit](m, W @ y + b)
    W, b = layers[-1]
    u = W @ y + b - (x[:1] / 4 if kind.skips else 0)
    return u * functions.of(m).best(x[-2:], SIGNS) if kind.advised else u


SIGNS = (1, -1)
"""Of the outputs of two networks that are else the same."""


def _after_advisories(layers: Any, kind: Kind) -> rj.Network:
    """Of two networks the one that the last advisory says."""
    *inner, (W, b) = layers
    nets = [
        rj.MLP.from_layers([*inner, (sign * W, sign * b)], ACTIVATIONS[kind.unit]) for sign in SIGNS
    ]
    return rj.Switched(nets, by=_last_advisory)


def _last_advisory(x: Any) -> Any:
    return jnp.argmax(x[-2:])


def _traced_network(layers: Any, x: Any, kind: Kind) -> Any:
    return _network(jnp, x, layers, kind)


def _traced_plant(p: Any, *given: Any, kind: Kind) -> Any:
    x, u, *w = given
    return kind.step(jnp, x, u, w[0] if w else None, p)


@cache
def _functions(kind: Kind) -> tuple[Callable, Callable]:
    """The functions of a kind, which are the same ones for all of its cases."""
    return partial(_traced_network, kind=kind), partial(_traced_plant, kind=kind)


def drawn(kind: Kind, number: int, seed: int = 0) -> KindCase:
    """The case of a number.

    Example:
        >>> case = drawn(KINDS[0], 3)
        >>> case.loop.states, case.kind.name
        (2, 'tanh, affine')
    """
    rng = np.random.default_rng([seed, number])
    n, n_u = kind.states, kind.inputs
    layers = [
        (rng.normal(size=(k, j)) * 10 ** rng.uniform(-1, 0.5), 0.5 * rng.normal(size=k))
        for j, k in pairwise((n, *kind.hidden, n_u))
    ]
    n_w = n if kind.step is affine else kind.pushes
    p = {"a": rng.normal(size=3) * 10 ** rng.uniform(-1.5, 0.3, size=3)}
    if kind.step is affine:
        p["A"] = np.eye(n) + rng.normal(size=(n, n)) * 10 ** rng.uniform(-2, 0)
        p["B"] = rng.normal(size=(n, n_u))
        p["E"] = rng.normal(size=(n, n_w))
    W = _disturbances(kind, n_w, rng) if kind.disturbed else None
    noise = rj.Box(*_ends(rng, n, 0.02)) if kind.noisy else None
    inputs, allowed = _inputs(kind, rng)
    region = str(rng.choice(kind.initial))
    X0 = _initial(region, n, rng)
    if kind.advised:
        X0 = _with_advisory(X0, rng)
    if kind.jumps:
        p["at"] = np.array(X0.center[:1])
    network, step = _functions(kind)
    net: Any = (
        rj.Network(jax.tree_util.Partial(network, layers), n, n_u)
        if kind.skips or kind.unit not in ACTIVATIONS
        else rj.MLP.from_layers(layers, ACTIVATIONS[kind.unit])
    )
    if kind.advised:
        net = _after_advisories(layers, kind)
    if kind.step is affine:
        plant: Any = rj.AffinePlant(p["A"], p["B"], E=p["E"] if W is not None else None)
    else:
        f = jax.tree_util.Partial(step, p)
        drawn_from = n_w if W is not None else 0
        plant = rj.NonlinearPlant(f, n, n_u, disturbances=drawn_from)
        if kind.period:
            plant = rj.SampledPlant(f, n, n_u, kind.period, disturbances=drawn_from, held=True)
    loop = rj.ClosedLoop(plant, net, allowed, disturbance=W, noise=noise)
    gap = float(rng.choice([1e-4, 1e-2, 0.1]))
    relaxation: Any = rj.BranchAndCut(nodes=int(rng.choice([0, 3, 40])))
    if rng.random() < 0.25:
        relaxation = rj.LinearBounds()
    elif rng.random() < 0.1 and kind.disturbed != ROUND and not kind.period:
        relaxation = rj.LocalBounds()
    window = None
    if "balls" in kind.name:
        relaxation, window = rj.LocalBounds(), 1
    options = {"relaxation": relaxation, "gap": gap, "time_limit": 0.4, "window": window}
    return KindCase(kind, number, seed, loop, X0, p, layers, inputs, region, options)


def _ends(rng: np.random.Generator, n: int, size: float) -> np.ndarray:
    return size * 10 ** rng.uniform(-2, 0) * rng.uniform(size=(2, n)) * np.array([[-1.0], [1.0]])


def _disturbances(kind: Kind, n: int, rng: np.random.Generator) -> Any:
    which, (lower, upper) = str(rng.choice(kind.disturbed)), _ends(rng, n, 0.1)
    if which == "box":
        return rj.Box(lower, upper)
    if which == "varying":
        scale = rng.uniform(size=(kind.horizon, 1))
        return rj.Box(scale * lower, scale * upper)
    if which == "polytope":
        rows = np.vstack([-np.eye(n), np.eye(n), np.ones((1, n))])
        return rj.Polytope(rows, np.hstack([-lower, upper, 0.7 * upper.sum()]))
    return rj.Ellipsoid(np.zeros(n), np.diag(upper**2) + 1e-9 * np.eye(n))


def _inputs(kind: Kind, rng: np.random.Generator) -> tuple[Any, Any]:
    if not kind.facets:
        lower, upper = _ends(rng, kind.inputs, 10.0)
        return (lower, upper), rj.Box(lower, upper)
    angles = rng.uniform(0, 6) + 2 * np.pi * np.arange(kind.facets) / kind.facets
    C = np.stack([np.cos(angles), np.sin(angles)], axis=1) * rng.uniform(0.5, 2, (kind.facets, 1))
    d = rng.uniform(0.05, 1, kind.facets)
    return (C, d), rj.Polytope(C, d)


def _initial(region: str, n: int, rng: np.random.Generator) -> Any:
    center, radii = rng.normal(size=n), 10 ** rng.uniform(-3, -0.3, size=n)
    if region == "flat":
        radii[rng.integers(n)] = 0.0
    elif region == "point":
        radii[:] = 0.0
    if region == "ellipsoid":
        L = rng.normal(size=(n, n)) * radii.max() + 1e-3 * np.eye(n)
        return rj.Ellipsoid(center, L @ L.T)
    if region == "polytope":
        axes = np.linalg.qr(rng.normal(size=(n, n)))[0]
        rows = np.vstack([axes, -axes, np.ones((1, n))])
        offsets = np.hstack([radii, radii, 0.5 * radii.min()]) + rows @ center
        return rj.Polytope(rows, offsets)
    return rj.Box(center - radii, center + radii)


def _with_advisory(X0: rj.Box, rng: np.random.Generator) -> rj.Box:
    """A box whose two last entries are a one and a zero, or anything between."""
    known = [(1.0, 1.0), (0.0, 0.0)]
    last = [known, known[::-1], [(0.0, 1.0)] * 2][rng.integers(3)]
    ends = zip((X0.lower, X0.upper), np.transpose(last), strict=True)
    return rj.Box(*(np.append(end[:-2], own) for end, own in ends))
