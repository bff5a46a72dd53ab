"""Penalties are the same functions inside and outside of `jax.jit`, whatever is traced."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.programs.unrolled import unrolled_at_once
from reachjax.verdicts.specification import requirements

CORNERS = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
ROUND = rj.Ellipsoid([0.3, 0.1], [[0.2, 0.05], [0.05, 0.1]])
OCTAGON = rj.Template.octagonal(2).directions
SLANTED = [[1.0, 0.2], [-1.0, 0.4], [0.1, -1.0], [0.3, 1.0]]

REACHED = {
    "box": rj.Box([0.2, -0.1], [0.8, 0.3]),
    "polytope": rj.Polytope(SLANTED, [0.9, 0.1, 0.4, 0.5]),
    "facets along the axes": rj.Polytope(CORNERS, [0.8, 0.3, -0.2, 0.1]),
    "idle facet": rj.Polytope(np.vstack([CORNERS, [[1.0, 1.0]]]), [0.8, 0.3, -0.2, 0.1, 1.5]),
    "zonotope": rj.Polytope(OCTAGON, [1.0, 0.1, 0.5, 0.2, 0.8, 0.3, 1.1, 0.1]),
    "ellipsoid": ROUND,
    "intersection": rj.Intersection(rj.Box([0.1, -0.2], [0.5, 0.5]), ROUND),
}
SLOW = "box", "ellipsoid", "intersection"
"""Their derivatives take a while to be compiled; of a box the rest of this file speaks as well."""

REGIONS = {
    "box": rj.Box([0.3, -0.2], [0.7, 0.25]),
    "polytope": rj.Polytope(OCTAGON, np.full(len(OCTAGON), 0.4)),
    "triangle": rj.Polytope([[1.0, 0.3], [-0.2, 1.0], [-0.5, -1.0]], [0.7, 0.3, 0.2]),
    "ellipsoid": rj.Ellipsoid([0.4, 0.0], [[0.06, 0.02], [0.02, 0.05]]),
}


def alike(one, other):
    assert jax.tree.structure(one) == jax.tree.structure(other)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-8, atol=1e-9), one, other)


def margins(reached, regions=REGIONS):
    """Of being in each set and of staying out of it."""
    asked = [requirements(2, 1, goal={1: one}, avoid={1: [one]}) for one in regions.values()]
    return [item.compared_with(reached, by_offsets=True).margins for both in asked for item in both]


@pytest.mark.parametrize(
    "kind",
    [pytest.param(kind, marks=[pytest.mark.costly] * (kind in SLOW)) for kind in REACHED],
)
@pytest.mark.costly
def test_margins_and_their_slopes_are_the_same_in_compiled_code(kind):
    reached = REACHED[kind]

    def both(reached):
        return margins(reached), jax.jacrev(margins)(reached)

    plain = margins(reached), both(reached)[1]
    alike(both(reached), plain)
    alike(jax.jit(both)(reached), plain)
    alike(jax.jit(lambda: margins(reached))(), plain[0])


@pytest.mark.parametrize("name", REGIONS)
def test_sets_that_are_made_in_compiled_code_are_required_there(name):
    parts = jax.tree.map(np.asarray, jax.tree.leaves(REGIONS[name]))
    made = jax.jit(lambda: margins(REACHED["box"], {name: type(REGIONS[name])(*parts)}))()
    alike(made, margins(REACHED["box"], {name: REGIONS[name]}))


@pytest.mark.parametrize("kind", ["goal", "safe", "avoid"])
@pytest.mark.costly
def test_an_ellipsoid_is_required_in_compiled_code(kind):
    ball, X0, template = rj.Ellipsoid([0.0], [[1.0]]), rj.Box([0.5], [2.0]), rj.Template.box(1)

    def penalty(net):
        loop = rj.ClosedLoop(rj.AffinePlant([[1.0]], [[1.0]]), net)
        asked = {kind: [ball] if kind == "avoid" else ball}
        return rj.specification_penalty(loop, X0, 1, template, **asked, margin=0.1)

    net = rj.MLP.from_layers([([[-0.5]], [0.0])])
    assert penalty(net) > 0
    alike(jax.jit(jax.value_and_grad(penalty))(net), jax.value_and_grad(penalty)(net))


@pytest.mark.parametrize("X0", [REACHED["box"], REACHED["polytope"]], ids=["box", "polytope"])
@pytest.mark.costly
def test_penalties_are_the_same_whatever_is_traced(X0):
    """An obstacle over the middle of the box is deeper in it than its axes' gaps say."""
    plant = rj.AffinePlant([[0.9, 0.2], [-0.1, 0.8]], [[0.0], [0.3]])
    obstacle = rj.Box([0.3, 0.0], [0.7, 0.25])

    def penalty(net, X0):
        loop, template = rj.ClosedLoop(plant, net), rj.Template.box(2)
        return rj.specification_penalty(loop, X0, 1, template, avoid=[obstacle], safe=obstacle)

    net = rj.MLP.from_layers([([[0.5, -0.4]], [0.1]), ([[-0.4]], [0.05])])
    plain = float(penalty(net, X0))
    assert float(jax.jit(penalty)(net, X0)) == pytest.approx(plain, rel=1e-9)
    assert float(jax.jit(lambda net: penalty(net, X0))(net)) == pytest.approx(plain, rel=1e-9)
    assert float(jax.value_and_grad(penalty)(net, X0)[0]) == pytest.approx(plain, rel=1e-9)


def turning(weights):
    """A network whose loop turns, and comes near a square that is to be avoided."""
    return rj.MLP.from_layers([(weights, [0.1, -0.2]), ([[0.4, -0.3]], [0.0])], rj.Tanh())


FIELD = rj.NonlinearPlant(lambda x, u: x + 0.2 * jnp.array([x[1], u[0] - jnp.sin(x[0])]), 2, 1)
START, STEPS = rj.Box([-0.1, 0.2], [0.1, 0.4]), 3
ASKED = {
    "goal": {1: rj.Box([-1.0, -1.0], [0.1, 0.3]), 3: rj.Box([-1.0, -1.0], [0.3, 0.3])},
    "safe": rj.Polytope(SLANTED, [0.2, 0.1, 0.4, 0.5]),
    "avoid": {range(1, 4): [rj.Box([0.1, 0.1], [0.3, 0.3])], 2: [REGIONS["triangle"]]},
}
WEIGHTS = np.array([[1.0, 0.3], [-0.4, 0.8]])

TEMPLATES = {
    "one": rj.Template.octagonal(2),
    "for each step": rj.Template(np.stack([OCTAGON, 2.0 * OCTAGON, OCTAGON])),
}


@pytest.mark.parametrize("kind", TEMPLATES)
def test_a_penalty_of_all_steps_at_once_is_the_sum_over_them(kind):
    """Compiled and not, with its gradient, whatever sets differ in."""
    template = TEMPLATES[kind]

    def penalty(weights):
        loop = rj.ClosedLoop(FIELD, turning(weights))
        return rj.specification_penalty(loop, START, STEPS, template, **ASKED)

    loop = rj.ClosedLoop(FIELD, turning(WEIGHTS))
    tube = rj.reach(loop, START, STEPS, template, rj.LinearBounds(programs=False))
    value, slopes = jax.value_and_grad(penalty)(WEIGHTS)
    assert float(value) == pytest.approx(float(rj.shortfall(tube, **ASKED)), rel=1e-9)
    compiled, others = jax.jit(jax.value_and_grad(penalty))(WEIGHTS)
    assert float(compiled) == pytest.approx(float(value), rel=1e-12)
    np.testing.assert_allclose(others, slopes, rtol=1e-9, atol=1e-12)


def test_derivatives_outside_of_compiled_code_are_compiled_once_and_apart():
    """What JAX would compile for them by itself takes twice as long, and twice as much memory."""

    def penalty(weights):
        loop = rj.ClosedLoop(FIELD, turning(weights))
        return rj.volume_penalty(loop, START, STEPS, TEMPLATES["one"])

    within, before = (
        unrolled_at_once._within._cache_size(),
        unrolled_at_once._with_pullback._cache_size(),
    )
    slopes = [jax.grad(penalty)(k * WEIGHTS) for k in (1.0, 1.1)]
    assert unrolled_at_once._within._cache_size() == within
    assert unrolled_at_once._with_pullback._cache_size() <= before + 1
    assert not np.allclose(*slopes)
    many = jax.vmap(jax.grad(penalty))(np.stack([WEIGHTS, 1.1 * WEIGHTS]))
    np.testing.assert_allclose(many, np.stack(slopes), rtol=1e-9, atol=1e-12)
    for other in (jax.hessian, jax.jacfwd):
        with pytest.raises(TypeError, match="first derivatives only"):
            other(penalty)(WEIGHTS)
