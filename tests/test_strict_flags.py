"""Under JAX's strict flags everything works as it does without them."""

from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.methods import propagation

NET = rj.MLP.from_layers([([[0.5, -0.4], [0.2, 0.1]], [0.1, 0.0]), ([[-0.4, 0.3]], [0.05])])
PLANT = rj.AffinePlant([[0.9, 0.2], [-0.1, 0.8]], [[0.0], [0.3]])
LOOP = rj.ClosedLoop(PLANT, NET, rj.Box([-1.0], [1.0]))
BOX = rj.Box([0.2, -0.1], [0.8, 0.3])
BALL = rj.Ellipsoid([0.3, 0.1], [[0.2, 0.05], [0.05, 0.1]])
SETS = {
    "box": BOX,
    "ellipsoid": BALL,
    "polytope": rj.Polytope(
        [[1.0, 0.2], [-1.0, 0.4], [0.1, -1.0], [0.3, 1.0]], [0.9, 0.1, 0.4, 0.5]
    ),
    "intersection": rj.Intersection(BOX, BALL),
}
OCTAGON, SAFE = rj.Template.octagonal(2), rj.Box([-2.0, -2.0], [2.0, 2.0])


@pytest.fixture
def strict():
    before = {
        name: getattr(jax.config, name)
        for name in ("jax_numpy_rank_promotion", "jax_numpy_dtype_promotion")
    }
    jax.config.update("jax_numpy_rank_promotion", "raise")  # in all threads
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    with pytest.raises(ValueError, match="broadcast"):
        jnp.multiply(jnp.ones((2, 3)), jnp.ones(3))
    yield
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.mark.parametrize("kind", SETS)
def test_sets(kind, strict):
    region, points, key = SETS[kind], np.ones((3, 2)), jax.random.key(0)
    assert region.contains(points).shape == (3,)
    assert region.support(points).shape == (3,)
    assert region.bounded_values(points).shape[0] == 3
    assert region.sample(key, 4).shape == (4, 2)
    assert region.bounding_box().dimension == 2
    assert float(region.size()) > 0
    assert np.all(np.isfinite(region.scale()))
    assert float(region.separation(rj.Box([2.0, 2.0], [3.0, 3.0]))) > 0
    assert region.corners().shape[1:] == (2,)


@pytest.mark.parametrize("relaxation", [rj.LinearBounds(), rj.BranchAndCut()])
@pytest.mark.costly
def test_tubes_and_verdicts(relaxation, strict):
    tube = rj.reach(LOOP, BOX, 2, OCTAGON, relaxation, samples=100)
    assert rj.verify(tube, safe=SAFE, goal=BALL.replace(shape=np.eye(2)), samples=100).proved
    assert float(rj.shortfall(tube, safe=SAFE)) == 0
    assert np.isfinite(float(rj.log_volume(tube)))
    assert LOOP.simulate(np.ones((4, 2)), 2).shape == (4, 3, 2)


@pytest.mark.costly
def test_decisions_and_winning_sets(strict):
    assert rj.decide(LOOP, BOX, 2, safe=SAFE, samples=100).proved
    with ThreadPoolExecutor(2) as threads:  # scopes are of one thread
        asked = {"safe": rj.Box([-1.0, -1.0], [1.0, 1.0]), "cells": 20, "executor": threads}
        assert rj.winning_set(LOOP, SAFE, 2, **asked).cells
    assert len(rj.reach_partitioned(LOOP, BOX, 1, OCTAGON, cells=(2, 1)).tubes) == 2


@pytest.mark.costly
def test_penalties(strict):
    def penalty(net):
        loop = LOOP.replace(controller=net)
        return rj.specification_penalty(loop, BOX, 1, OCTAGON, safe=rj.Box([-0.1] * 2, [0.1] * 2))

    value, slope = jax.jit(jax.value_and_grad(penalty))(NET)
    assert float(value) > 0
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slope))


@pytest.mark.costly
def test_functions_of_users_are_as_in_plain_jax(strict):
    """One that keeps to the flags is certified, of another one JAX's error is shown."""
    plant = rj.NonlinearPlant(lambda x, u: 0.5 * x + 0.1 * jnp.sin(x[0]) * u, 2, 1)
    loop = rj.ClosedLoop(plant, NET)
    assert np.isfinite(rj.reach(loop, BOX, 1, OCTAGON, samples=10).sets[1].b).all()
    with pytest.raises(ValueError, match="jax_numpy_rank_promotion"):
        rj.NonlinearPlant(lambda x, u: (jnp.ones((2, 2)) * x).sum(0), 2, 1)


def test_products_have_64_bits_whatever_those_of_users_have():
    """Or nothing would be proved by them: XLA rounds what it multiplies as it is told to."""

    def found():
        compiled = jax.jit(lambda X0: rj.reach(LOOP, X0, 2, OCTAGON, rj.LinearBounds()).sets[-1].b)
        states = np.full((40, 2), 0.3)
        return compiled(BOX), LOOP.simulate(states, 2)

    exact = jax.tree.leaves(found())
    with jax.default_matmul_precision("BF16_BF16_F32"):
        assert float((jnp.ones((2, 2)) @ jnp.full((2, 2), 1 / 3))[0, 0]) != 2 / 3
        for one, other in zip(exact, jax.tree.leaves(found()), strict=True):
            np.testing.assert_array_equal(one, other)
        with pytest.raises(TypeError, match="rounds the numbers that it multiplies"):
            rj.Network(lambda x: jnp.full((1, 2), 1 / 3) @ x, 2, 1)


def test_only_sets_that_are_empty_or_unbounded_cannot_be_used(monkeypatch):
    def failing(*_):
        raise ValueError("out of ink")

    flat = rj.Polytope([[1.0, 0.0], [-1.0, 0.0]], [1.0, 1.0])
    with pytest.raises(ValueError, match=r"X0 cannot be used: the polytope .* is unbounded"):
        rj.reach(LOOP, flat, 1, OCTAGON)
    monkeypatch.setattr(propagation, "Simulations", failing)
    with pytest.raises(ValueError, match=r"^out of ink$"):
        rj.reach(LOOP, BOX, 1, OCTAGON)
