"""Law: states and inputs in other units give the same sets to rounding, and the same verdicts."""

import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import reachjax as rj
from tests.cases import FEW, HORIZON, Case, each, swinging

UNITS = {
    "powers of two": np.array([2.0**7, 2.0**-9]),
    "like ones": np.array([1e3, 1e3]),
    "unlike ones": np.array([1e4, 1e-3]),
    "far ones": np.array([1e-8, 1e6]),
    "small ones": np.array([1e-10, 1e-10]),
    "large ones": np.array([1e6, 1e6]),
}
"""Factors of the two states."""

INPUT = 1e3
"""The factor of inputs."""


def plant_in(plant, D, e):
    """A plant whose states are `D x` and whose inputs are `e u`."""
    if isinstance(plant, rj.AffinePlant):
        A, B, c, E = plant.A, plant.B, plant.c, plant.E
        return plant.replace(
            A=D[:, None] * A / D,
            B=D[:, None] * B / e,
            c=D * c,
            E=None if E is None else D[:, None] * E,
        )
    return rj.NonlinearPlant(Partial(_moved, plant, jnp.asarray(D), jnp.asarray(e)), 2, 1)


def _moved(plant, D, e, x, u):
    return D * plant.propagate(x / D, u / e)


def net_in(net, D, e):
    """A network of the states `D x` whose outputs are `e u`."""
    if not isinstance(net, rj.MLP):
        return rj.Network(
            Partial(_turned, net, jnp.asarray(D), jnp.asarray(e)), net.inputs, net.outputs
        )
    (W, b), *inner, (V, c) = net.layers
    return net.replace(layers=((W / D, b), *inner, (V * e, c * e)))


def _turned(net, D, e, x):
    return e * net(x / D)


def set_in(X, D):
    """The set of `D x` for `x` in a set."""
    if isinstance(X, rj.Box):
        return rj.Box(X.lower * D, X.upper * D)
    if isinstance(X, rj.Polytope):
        return rj.Polytope(X.A / D, X.b)
    if isinstance(X, rj.Ellipsoid):
        return rj.Ellipsoid(D * X.center, D[:, None] * X.shape * D)
    return rj.Intersection(set_in(X.polytope, D), set_in(X.ellipsoid, D))


def loop_in(loop, D, e):
    """A loop in other units; disturbances and noise stay as they are, but for noise's units."""
    inputs = (
        None if loop.input_box is None else set_in(loop.input_box, np.full(loop.plant.inputs, e))
    )
    noise = None if loop.noise is None else set_in(loop.noise, D)
    plant, net = plant_in(loop.plant, D, e), net_in(loop.controller, D, e)
    return rj.ClosedLoop(plant, net, inputs, disturbance=loop.disturbance, noise=noise)


ACCURACY = {"default": 2e-4, "forms": 1e-7, "programs": 1e-5, "paper": 1e-5}
"""By a part of a set's width: of rounding, of what may stay open, and of what solvers leave.

A case that asks for a gap of its own may leave that much open, in any units.
"""

ROWS = (
    *(Case(loop, "forms") for loop in ("relu", "leaky", "unlimited", "disturbed", "tanh", "sine")),
    *(Case(loop, "forms") for loop in ("oscillator", "tank", "quotient", "friction", "argmax")),
    *(Case("relu", "forms", initial) for initial in ("polytope", "ellipsoid", "intersection")),
    *(Case(loop) for loop in ("relu", "sigmoid", "sine, tanh", "disturbed by times")),
    *(Case("relu", method) for method in ("programs", "paper")),
)


@each(rows=ROWS, basic=FEW)
@pytest.mark.parametrize("units", UNITS)
def test_other_units_give_the_same_sets_and_verdicts(case, units):
    D = UNITS[units]
    loop, X0 = loop_in(case.closed_loop, D, INPUT), set_in(case.X0, D)
    template = rj.Template(np.asarray(case.shape.directions) / D)
    tube = case.reach(loop, X0, template=template)
    accuracy = case.options.get("gap", ACCURACY[case.method])
    for k in range(1, HORIZON + 1):
        values = np.asarray(case.tube.sets[k].bounded_values(case.runs[:, k]))
        size = accuracy * (np.ptp(values, axis=0).max() + 1e-3 * abs(values).max())
        assert np.all(abs(tube.sets[k].limits - case.tube.sets[k].limits) <= size)
    runs = case.runs.reshape(-1, 2)
    middle, half = (runs.max(0) + runs.min(0)) / 2, np.ptp(runs, axis=0) / 2
    for part in (3.0, 0.9):
        safe = rj.Box(middle - part * half, middle + part * half)
        plain, other = (
            rj.verify(each_tube, safe=region, samples=50)
            for each_tube, region in ((case.tube, safe), (tube, set_in(safe, D)))
        )
        assert plain.status is other.status


@pytest.mark.costly
@pytest.mark.parametrize("units", UNITS)
@pytest.mark.parametrize("initial", ["own", "ellipsoid"])
def test_ellipsoids_have_the_same_volumes_in_other_units(initial, units):
    D, case = UNITS[units], Case("relu", "programs", initial, "ellipsoids")
    tube = case.reach(loop_in(case.closed_loop, D, INPUT), set_in(case.X0, D))
    for k in range(1, HORIZON + 1):
        volumes = [rj.log_volume(each_tube.sets[k]) for each_tube in (tube, case.tube)]
        assert float(volumes[0] - np.log(D).sum()) == pytest.approx(float(volumes[1]), abs=1e-3)


@pytest.mark.parametrize("period", [1e-3, 0.2, 1e3])
def test_other_units_of_time_give_the_same_sets(period):
    """`x' = f(x, u)` for a period is `x' = f(x, u) r / period` for another one."""
    case = Case("sampled", "forms")
    f = Partial(_faster, case.closed_loop.plant.period / period)
    plant = rj.SampledPlant(f, 2, 1, period=period)
    tube = case.reach(case.closed_loop.replace(plant=plant))
    for k in range(1, HORIZON + 1):
        np.testing.assert_allclose(tube.sets[k].limits, case.tube.sets[k].limits, atol=1e-6)


def _faster(factor, x, u):
    return factor * swinging(x, u)
