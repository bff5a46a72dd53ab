"""What underflows is not zero: a number that vanishes may be multiplied by a large one later."""

from fractions import Fraction

import jax
import numpy as np
import pytest

import reachjax as rj
from reachjax.loops.flows.taylor_models import TaylorModels
from reachjax.loops.tracing.limits import Limits
from reachjax.numerics.pytrees import unchecked
from reachjax.numerics.rounding import Ball
from reachjax.programs.affine import AffineForms
from reachjax.programs.initial import InitialColumns

SILENT = rj.MLP.from_layers([([[0.0]], [0.0])])
X0 = rj.Box([1e-200], [2e-200])


def affine(factor):
    return rj.ClosedLoop(rj.AffinePlant([[factor]], [[1.0]]), SILENT)


def layers(*factors, activation=rj.ReLU()):  # noqa: B008  (immutable)
    net = rj.MLP.from_layers([([[factor]], [0.0]) for factor in factors], activation)
    return rj.ClosedLoop(rj.AffinePlant([[0.0]], [[1.0]]), net)


def function(f):
    return rj.ClosedLoop(rj.NonlinearPlant(f, states=1, inputs=1), SILENT)


LOOPS = {
    "vanishes": (affine(1e-200), 0.0),
    "vanishes in a layer": (layers(1e-200, 1e300), 0.0),
    "comes back": (layers(1e-200, 1e300, 1e100), 0.5),
    "comes back from a smooth layer": (layers(1e-200, 1e300, 1e100, activation=rj.Tanh()), 0.5),
    "comes back from a square": (function(lambda x, u: x * x * 1e300 * 1e100 + 0 * u), 0.5),
    "comes back from a factor": (function(lambda x, u: 1e-200 * x * 1e300 * 1e100 + 0 * u), 0.5),
}
"""Loops of which exact numbers are above a limit, and floats are zero."""


@pytest.mark.parametrize("kind", LOOPS)
def test_nothing_is_proved_of_what_underflows(kind):
    loop, limit = LOOPS[kind]
    verdict = rj.decide(loop, X0, 1, goal=rj.Box([-1.0], [limit]), time_limit=5.0)
    assert not verdict.proved


def test_what_contracts_below_all_floats_is_not_zero():
    verdict = rj.decide(affine(2.0**-120), rj.Box([1.0], [2.0]), 10, goal=rj.Box([-1.0], [0.0]))
    assert not verdict.proved
    assert rj.decide(affine(0.5), rj.Box([0.0], [0.0]), 3, goal=rj.Box([0.0], [0.0])).proved


def of_kind(kind, numbers):
    """Known numbers, up to nothing."""
    if kind == "intervals":
        return Ball.exact(numbers)
    if kind == "limits":
        return Limits(numbers, numbers)
    if kind == "models":
        return TaylorModels.of(Ball.exact(numbers))
    box = unchecked(rj.Box, lower=numbers, upper=numbers)  # of numpy's, if these are
    return AffineForms.beginning(InitialColumns.of(box, box))


def ends_of(number):
    if isinstance(number, Ball):
        return number.lower, number.upper
    if isinstance(number, Limits):
        return number.least, number.most
    return number.ends() if isinstance(number, TaylorModels) else number.ends_by_interval()


WAYS = [(kind, compiled) for kind in ("intervals", "models", "forms") for compiled in (False, True)]


@pytest.mark.parametrize(("kind", "compiled"), [*WAYS, ("limits", False)])
def test_products_of_any_sizes_are_held(kind, compiled):
    """Exact products and their sums are between the ends that are said."""

    def ends(matrix, numbers):
        return ends_of(matrix @ of_kind(kind, numbers))

    rng, found = np.random.default_rng(3), jax.jit(ends) if compiled else ends
    for _ in range(20):
        sizes = 2.0 ** rng.integers(-700, 300, size=(5, 1))
        matrix, numbers = rng.normal(size=(5, 4)) * sizes, rng.normal(size=4) * 2.0**-400
        matrix[rng.integers(5), rng.integers(4)] = 0.0
        lower, upper = map(np.asarray, found(matrix, numbers))
        for row, low, high in zip(matrix.tolist(), lower.tolist(), upper.tolist(), strict=True):
            exact = sum(Fraction(a) * Fraction(x) for a, x in zip(row, numbers, strict=True))
            assert Fraction(low) <= exact <= Fraction(high)


@pytest.mark.parametrize("scale", [1.0, 2.0**-535, 2.0**-900, 2.0**500])
def test_polynomials_are_bounded_at_any_scale(scale):
    """Of one symbol the largest value is known: it does not depend on the unit."""
    box = jax.device_get(rj.Box([-1.0], [1.0]))
    start = InitialColumns.of(box, box, True)
    w = np.linspace(-1, 1, 2001)
    rows = np.random.default_rng(1).normal(size=(20, 2)) * [2.0, 1.0]
    _, upper = start.curved_ends(rows * scale)
    attained = (rows[:, :1] * w + rows[:, 1:] * (2 * w**2 - 1)).max(axis=1)
    assert np.all(upper / scale >= attained - 1e-12)
    assert np.all(upper / scale <= attained + 1e-5)
