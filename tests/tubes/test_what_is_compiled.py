"""Nothing of unknown length is compiled: what is large runs in numpy until compiling it pays."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.memory import forget

SMALL = 1000
"""Operations of what may be compiled whatever is left of a limit: a step of a loop in plain
numbers has some hundreds, in intervals or forms many thousands."""


def cart_pole():
    """Four states, a midpoint step of Runge and Kutta, two layers of tanh."""

    def slope(x, u):
        (_, speed, _, rate), sin, cos = x, jnp.sin(x[2]), jnp.cos(x[2])
        pushed = (u[0] + 0.1 * rate**2 * sin - 0.1 * speed) / 1.1
        turned = (9.8 * sin - cos * pushed) / (0.5 * (4 / 3 - 0.1 * cos**2 / 1.1))
        return jnp.array([speed, pushed - 0.05 * turned * cos, rate, turned])

    rng, sizes = np.random.default_rng(0), (4, 16, 16, 1)
    layers = [
        (rng.normal(size=(out, into)) / np.sqrt(into), 0.1 * rng.normal(size=out))
        for into, out in itertools.pairwise(sizes)
    ]
    net = rj.MLP.from_layers(layers, activation=rj.Tanh())
    plant = rj.NonlinearPlant(lambda x, u: x + 0.1 * slope(x + 0.05 * slope(x, u), u), 4, 1)
    return rj.ClosedLoop(plant, net)


def boxes(*halves):
    return [rj.Box([-half] * 4, [half] * 4) for half in halves]


@pytest.fixture
def operations(monkeypatch):
    """The numbers of operations of what JAX has XLA compile during a test, kept or not."""
    from jax._src import compiler

    counts, compiled = [], compiler.compile_or_get_cached

    def counted(backend, module, *given, **options):
        counts.append(str(module).count(" = "))
        return compiled(backend, module, *given, **options)

    monkeypatch.setattr(compiler, "compile_or_get_cached", counted)
    forget()
    return counts


@pytest.mark.costly
def test_nothing_large_is_compiled_for_a_counterexample(operations):
    X0, safe = boxes(0.1, 0.105)
    found = rj.decide(cart_pole(), X0, 5, safe=safe)
    assert found.status is rj.VerdictStatus.REFUTED
    assert 0 < max(operations) < SMALL


@pytest.mark.parametrize("call", ["decide", "winning_set"])
@pytest.mark.costly
def test_nothing_large_is_compiled_for_cells_under_a_limit(operations, call):
    X0, safe = boxes(0.1, 0.5)  # 64 cells are enough for a compiled call
    if call == "decide":
        rj.decide(cart_pole(), X0, 5, safe=safe, cells=[4, 2, 4, 2], time_limit=3.0)
    else:
        rj.winning_set(cart_pole(), X0, 5, safe=safe, cells=64, time_limit=3.0)
    assert 0 < max(operations) < SMALL


@pytest.mark.costly
def test_nothing_large_is_compiled_for_the_largest_set(operations):
    X0, safe = boxes(0.01, 0.05)
    found = rj.largest_set(cart_pole(), X0, 2, safe=safe, rounds=2, time_limit=60.0)
    assert found.verdict.status is rj.VerdictStatus.PROVED
    assert 0 < max(operations) < SMALL
