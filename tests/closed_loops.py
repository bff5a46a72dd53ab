"""The library's loops from the arrays of `tests.networks`."""

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

import reachjax as rj
from reachjax.programs.horizon import Horizon
from reachjax.programs.windows import Window
from reachjax.proofs.proposal import Proposal
from reachjax.solvers import Facets
from tests.networks import (
    LoopData,
    box_region,
    he_network,
    input_box,
    plant,
    simplex_region,
)

TRAINED = Path(__file__).parent / "data" / "double_integrator_with_margin.npz"


def closed_loop(data: LoopData) -> rj.ClosedLoop:
    """The loop that the arrays describe."""
    return rj.ClosedLoop(
        rj.AffinePlant(data.A, data.B, data.c),
        rj.MLP.from_layers(data.layers),
        input_box=None if data.u_lower is None else rj.Box(data.u_lower, data.u_upper),
    )


def autonomous(A: Any, input_box: rj.Box | None = None) -> rj.ClosedLoop:
    """`x+ = A x`, whatever the controller does: its sets are known exactly."""
    n_x = len(A)
    net = rj.MLP.from_layers([(np.zeros((1, n_x)), np.zeros(1))])
    return rj.ClosedLoop(rj.AffinePlant(A, np.zeros((n_x, 1))), net, input_box)


def own_plant(gain: float = 1.0) -> Any:
    """A class of a user's for `x+ = gain A x + B u`, whose arrays are not those of the proofs."""

    @jax.tree_util.register_dataclass
    @dataclasses.dataclass(frozen=True)
    class OwnPlant(rj.AbstractPlant):
        A: jax.Array
        B: jax.Array

        @property
        def states(self):
            return len(self.A)

        @property
        def inputs(self):
            return self.B.shape[1]

        @property
        def steps(self):
            return None

        @property
        def clock(self):
            return False

        def propagate(self, x, u, t=0, unit=None, w=None):
            return gain * (self.A @ x) + self.B @ u

    return OwnPlant


def double_integrator() -> rj.ClosedLoop:
    """A trained loop of two states, under an input limit of one."""
    data = np.load(TRAINED)
    net = rj.MLP.from_layers([(data[f"W{i}"], data[f"b{i}"]) for i in range(3)])
    plant = rj.AffinePlant([[1.0, 1.0], [0.0, 1.0]], [[0.5], [1.0]])
    return rj.ClosedLoop(plant, net, rj.Box([-1.0], [1.0]))


def random_loop(
    n_x: int,
    hidden: Sequence[int] = (6, 4),
    seed: int = 0,
    boxed: bool = True,
    steps: int | None = None,
    network: Callable = he_network,
) -> LoopData:
    """Arrays of a loop with `n_x` states; with `steps` it is time-varying."""
    n_u = min(n_x, 2)
    box = input_box(n_u, seed, steps) if boxed else (None, None)
    layers = network((n_x, *hidden, n_u), seed)
    return LoopData(layers, *plant(n_x, n_u, seed, steps), *box)


def initial_set(kind: str, n_x: int, seed: int = 0) -> Any:
    """A set of this kind; boxes and ellipsoids are skewed but for the kind `box`."""
    rng, straight = np.random.default_rng(seed), box_region(n_x, seed).corners
    rotated, simplex = box_region(n_x, seed, rotated=True), simplex_region(n_x, seed)
    box = rj.Box(straight.min(axis=0), straight.max(axis=0))
    L = 0.3 * rng.normal(size=(n_x, n_x)) + 0.1 * np.eye(n_x)
    ball = rj.Ellipsoid(box.center, L @ L.T)
    around = ball.bounding_box()
    middle, far = around.center[0], around.center[0] + 0.2 * around.widths[0]
    return {
        "box": box,
        "polytope": rj.Polytope(rotated.A, rotated.b),
        "simplex": rj.Polytope(simplex.A, simplex.b),  # the middle of its box is outside
        "ellipsoid": ball,
        "intersection": rj.Intersection(around.replace(upper=around.upper.at[0].set(middle)), ball),
        "far intersection": rj.Intersection(
            around.replace(lower=around.lower.at[0].set(far)), ball
        ),
    }[kind]


def switching_loop(
    n_x: int,
    activation: Any = rj.ReLU(),  # noqa: B008  (immutable)
    seed: int = 0,
    hidden: Sequence[int] = (5, 4),
    residual: bool = False,
    **options: Any,
) -> rj.ClosedLoop:
    """The loop of `random_loop`, with units of this kind."""
    loop = closed_loop(random_loop(n_x, hidden, seed, **options))
    net = loop.controller.replace(activation=activation)
    skip = 0.3 * np.ones((net.outputs, n_x))
    return loop.replace(controller=rj.Residual(net, skip) if residual else net)


def that_switches(
    made: Callable[[int], rj.ClosedLoop], X0: rj.AbstractSet, seed: int, start: int = 0
) -> rj.ClosedLoop:
    """The first of the loops of seeds a thousand apart of which two units or more switch."""

    def switches(loop: rj.ClosedLoop) -> bool:
        horizon = Horizon(*on_host(loop, X0), start)
        horizon.advance()
        return len(horizon.zero) >= 2

    return next(filter(switches, map(made, itertools.count(seed, 1000))))


def on_host(loop: rj.ClosedLoop, X0: rj.AbstractSet) -> tuple[Any, Any, Any]:
    """The loop, the set and the box around it as numpy arrays."""
    return jax.device_get((loop, X0, X0.bounding_box()))


def recursion(
    loop: rj.ClosedLoop,
    X0: rj.AbstractSet,
    horizon: int,
    template: rj.AbstractTemplate,
    relaxation: rj.AbstractRelaxation = rj.LocalBounds(),  # noqa: B008  (immutable)
    **options: Any,
) -> rj.ReachTube:
    """The paper's recursion with local bounds: one small program a facet, also inside `jax.jit`."""
    return rj.reach(loop, X0, horizon, template, relaxation, 1, **options)


def one_step(
    loop: rj.ClosedLoop,
    X: rj.AbstractSet,
    template: rj.AbstractTemplate,
    relaxation: rj.AbstractRelaxation = rj.LocalBounds(),  # noqa: B008  (immutable)
    **options: Any,
) -> tuple[Any, Any]:
    """A step of `recursion`."""
    return rj.reach_step(loop, X, template, relaxation=relaxation, **options)


def proposal_of(solver: rj.AbstractSolver, program: Any, goal: Any = None) -> Proposal:
    """What a solver proposes for a goal; for the offsets of a program's facets if none is given."""
    return solver.solve(program, Facets(program.objective.mid) if goal is None else goal)


def step_program(loop, X, box, directions, t, relaxation):
    """Theorem 1 for every facet of the successors of `X` at time `t`: a window of one step."""
    window = Window.beginning(loop, X, box, t, relaxation)
    return window.extended(loop, X, box).program(directions, relaxation)
