"""Cells that one compiled call decides are decided rightly, whatever the loop."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.numerics.budget import Budget
from reachjax.verdicts.sieve import TOGETHER, Sieve
from reachjax.verdicts.specification import requirements
from tests.closed_loops import closed_loop, random_loop
from tests.disturbed_loops import attacked, double_integrator
from tests.input_polytopes import polygon, polytope_loop

HORIZON = 3


def smooth():
    def f(x, u):
        return jnp.stack([x[0] + 0.1 * x[1], x[1] + 0.1 * jnp.sin(x[0]) + 0.1 * u[0], 0.9 * x[2]])

    net = rj.MLP.from_layers(
        [(0.5 * np.ones((4, 3)), np.zeros(4)), (-np.ones((1, 4)), [0.0])], rj.Tanh()
    )
    return rj.ClosedLoop(rj.NonlinearPlant(f, states=3, inputs=1), net)


def prepared():
    """A loop with a matrix that is computed, and rounded, of parameters alone."""

    def law(p, x):
        return -jax.nn.softplus(p) @ jnp.tanh(x)

    net = rj.Network(jax.tree_util.Partial(law, np.array([[0.3, -0.2]])), 2, 1)
    return rj.ClosedLoop(rj.AffinePlant([[1.0, 0.2], [0.0, 0.9]], [[0.0], [0.2]]), net)


LOOPS = {
    "one state": lambda: closed_loop(random_loop(1, (3,), seed=4)),
    "three states": lambda: closed_loop(random_loop(3, (4, 3), seed=2)),
    "smooth": smooth,
    "disturbed": lambda: double_integrator()[0],
    "polytope of inputs": lambda: polytope_loop(polygon(4)),
    "prepared": prepared,
}


def cells(n, width=0.3):
    rng = np.random.default_rng(0)
    lower = rng.uniform(-1, 1, (TOGETHER - 3, n))
    return [(low, low + rng.choice([0.0, width], n)) for low in lower]


@pytest.mark.parametrize("kind", LOOPS)
@pytest.mark.costly
def test_what_is_decided_of_cells_is_true(kind):
    loop = LOOPS[kind]()
    n = loop.states
    goal, avoid = rj.Ellipsoid(np.zeros(n), 0.7 * np.eye(n)), rj.Box([-0.4] * n, [-0.1] * n)
    wanted = requirements(n, HORIZON, goal=goal, safe=rj.Box([-1.0] * n, [1.0] * n), avoid=[avoid])
    boxes = cells(n)
    decided = []
    for (low, high), found in zip(
        boxes, Sieve(loop, HORIZON, 0, wanted).sifted(boxes), strict=True
    ):
        runs = attacked(loop, rj.Box(low, high), HORIZON, 100)
        rooms = np.array([item.simulated(runs) for item in wanted])
        decided.append((found.proved, found.refuted))
        if found.proved:
            assert (rooms >= 0).all()
        if found.refuted:
            assert (rooms <= 0).any(axis=0).all()
        for item, row in zip(wanted, rooms, strict=True):
            assert found.margins[item.name][item.time] <= row.min() + 1e-12
        assert not (found.proved and found.refuted)
    assert np.any(decided, axis=0).any()


@pytest.mark.parametrize("where", ["weights", "cells"])
def test_what_compiled_code_takes_for_zero_is_not_sifted(where, monkeypatch):
    """`1e-310 x` is not zero: a later layer may multiply it by a large number."""
    monkeypatch.setattr("reachjax.numerics.compilations.CompiledBeside.pays", lambda *_, **__: True)

    def pays(weight, lower):
        net = rj.MLP.from_layers([([[weight]], [0.0]), ([[1e300]], [0.0])])
        loop = rj.ClosedLoop(rj.AffinePlant([[0.5]], [[1.0]]), net)
        sieve = Sieve(loop, 1, 0, requirements(1, 1, safe=rj.Box([-9.0], [9.0])))
        return sieve.pays([(np.array([lower]), np.array([1.0]))], Budget())

    assert pays(1e-300, 0.0)
    assert not (pays(1e-310, 0.0) if where == "weights" else pays(1e-300, 1e-310))


SMALL = np.array([1e-310])


@pytest.mark.parametrize(
    "function",
    [
        lambda x, u: SMALL * x * 1e308 + u,
        lambda x, u: 1e-310 * x * 1e308 + u,
        lambda x, u: jax.jit(lambda y: SMALL * y)(x) * 1e308 + u,
    ],
    ids=["closed over", "written", "in a call"],
)
def test_functions_of_numbers_that_compiled_code_takes_for_zero_are_not_sifted(
    function, monkeypatch
):
    monkeypatch.setattr("reachjax.numerics.compilations.CompiledBeside.pays", lambda *_, **__: True)
    net = rj.MLP.from_layers([([[0.0]], [0.0])])
    loop = rj.ClosedLoop(rj.NonlinearPlant(function, 1, 1), net)
    sieve = Sieve(loop, 1, 0, requirements(1, 1, goal=rj.Box([-1.0], [5e3])))
    assert not sieve.pays([(np.array([1e6]), np.array([2e6]))], Budget())


@pytest.mark.costly
def test_what_is_computed_of_parameters_alone_is_sifted_as_well():
    """It is an argument of the compiled call, which is there as soon as it pays."""
    loop, boxes = LOOPS["prepared"](), cells(2)
    sieve = Sieve(loop, HORIZON, 0, requirements(2, HORIZON, safe=rj.Box([-1.0] * 2, [1.0] * 2)))
    for _ in range(1000):
        if sieve.pays(boxes, Budget()):
            return
        time.sleep(0.05)
    pytest.fail("it was not compiled beside those who asked for it")


@pytest.mark.costly
def test_few_cells_are_bounded_as_many():
    loop = LOOPS["three states"]()
    sieve = Sieve(loop, HORIZON, 0, requirements(3, HORIZON, safe=rj.Box(-np.ones(3), np.ones(3))))
    boxes = cells(3)
    many, few = sieve.sifted(boxes), sieve.sifted(boxes[:2])
    assert [str(one) for one in many[:2]] == [str(one) for one in few]


@pytest.mark.costly
def test_touching_at_first_is_inside():
    loop = LOOPS["one state"]()
    wanted = requirements(1, 1, safe=rj.Box([-1e9], [1e9]))
    wanted[0] = requirements(1, 1, goal={0: rj.Box([-0.1], [0.3])})[0]
    (found,) = Sieve(loop, 1, 0, wanted).sifted([(np.array([-0.1]), np.array([0.3]))])
    assert found.proved
