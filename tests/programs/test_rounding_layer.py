"""Rounding is a layer: without it numbers are the same but for rounding, and none of it stays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.numerics.rounding import gamma, is_counted, rounding
from reachjax.programs.unrolled import unrolled_at_once
from tests.networks import directions
from tests.programs.test_merging import pendulum


def cart(x, u):
    s, c = jnp.sin(x[2]), jnp.cos(x[2])
    push = (u[0] + 0.05 * x[3] ** 2 * s) / 1.1
    turn = (9.8 * s - c * push) / (0.5 * (4 / 3 - 0.1 * c**2 / 1.1))
    return x + 0.02 * jnp.array([x[1], push - 0.05 * turn * c / 1.1, x[3], turn])


def loop_of(kind):
    if kind == "pendulum":
        return pendulum()
    rng, n = np.random.default_rng(3), 4 if kind == "cart-pole" else 3
    layers = [(0.5 * rng.normal(size=(5, n)), 0.1 * rng.normal(size=5))]
    layers += [(0.5 * rng.normal(size=(1, 5)), np.zeros(1))]
    activation = rj.ReLU() if kind == "relu" else rj.Sigmoid()
    net = rj.MLP.from_layers(layers, activation=activation)
    if kind == "cart-pole":
        plant = rj.NonlinearPlant(cart, states=4, inputs=1)
    else:
        plant = rj.AffinePlant(0.5 * rng.normal(size=(n, n)), rng.normal(size=(n, 1)))
    X0 = rj.Box(np.full(n, -0.1), np.full(n, 0.2))
    if kind == "ellipsoid":
        return rj.ClosedLoop(plant, net), rj.Ellipsoid(np.zeros(n), 0.01 * np.eye(n))
    box = rj.Box([-0.2], [0.1]) if kind == "relu" else None
    return rj.ClosedLoop(plant, net, box), X0


KINDS = ["pendulum", "relu", "ellipsoid", pytest.param("cart-pole", marks=pytest.mark.costly)]


@pytest.mark.parametrize("kind", KINDS)
def test_sets_without_rounding_are_the_certified_ones_but_for_rounding(kind):
    loop, X0 = loop_of(kind)
    rows = np.broadcast_to(directions(loop.states), (5, *directions(loop.states).shape))

    def total(net, counted):
        given = loop.replace(controller=net), X0, X0.bounding_box(), rows
        found = unrolled_at_once(*given, counted=counted).offsets
        return found[-1].sum(), found

    values = jax.value_and_grad(total, has_aux=True)
    (_, proved), slopes = values(loop.controller, True)
    (_, plain), other = values(loop.controller, False)
    np.testing.assert_allclose(plain, proved, rtol=1e-9, atol=1e-9)
    for one, another in zip(jax.tree.leaves(slopes), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(another, one, rtol=1e-6, atol=1e-8)


def test_what_is_proved_within_a_scope_without_rounding_counts_it():
    """Whatever is compiled within such a scope is found again by those who prove."""
    loop, X0 = pendulum()
    rows = np.broadcast_to(directions(2), (3, *directions(2).shape))
    with rounding(False):
        within = unrolled_at_once(loop, X0, X0, rows).offsets
        assert not is_counted()
    plain = unrolled_at_once(loop, X0, X0, rows, counted=False).offsets
    np.testing.assert_array_equal(within, unrolled_at_once(loop, X0, X0, rows).offsets)
    assert (within >= plain).all()
    assert (within > plain).any()


def test_rounding_counts_again_after_an_error():
    with pytest.raises(ZeroDivisionError), rounding(False):
        1 / 0  # noqa: B018
    assert is_counted()
    assert gamma(1) > 0


def test_penalties_without_rounding_have_no_bits_in_their_graph():
    """Nor seals, nor certificates: a step of training is for numbers alone."""
    loop, X0 = pendulum()
    goal = rj.Box([-0.01, -0.01], [0.01, 0.01])

    def penalty(net):
        given = loop.replace(controller=net), X0, 5, rj.Template.box(2)
        return rj.specification_penalty(*given, goal=goal)

    text = str(jax.make_jaxpr(jax.grad(penalty))(loop.controller))
    assert "bitcast" not in text
    assert "callback" not in text
