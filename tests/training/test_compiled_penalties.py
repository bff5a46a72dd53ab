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

    forms = unrolled_at_once
    alone = forms._with_pullback[1], forms._pulled_back[1]
    within = forms._within, forms._with_pullback[0], forms._pulled_back[0]
    before = [[each._cache_size() for each in some] for some in (alone, within)]
    slopes = [jax.grad(penalty)(k * WEIGHTS) for k in (1.0, 1.1)]
    assert all(each._cache_size() <= k + 1 for each, k in zip(alone, before[0], strict=True))
    assert [each._cache_size() for each in within] == before[1]
    np.testing.assert_allclose(jax.jacrev(penalty)(WEIGHTS), slopes[0], rtol=1e-9, atol=1e-12)
    assert not np.allclose(*slopes)
    many = jax.vmap(jax.grad(penalty))(np.stack([WEIGHTS, 1.1 * WEIGHTS]))
    np.testing.assert_allclose(many, np.stack(slopes), rtol=1e-9, atol=1e-12)
    for other in (jax.hessian, jax.jacfwd):
        with pytest.raises(TypeError, match="first derivatives only"):
            other(penalty)(WEIGHTS)


def scaled(scale, gain):
    """A loop `x+ = scale x + gain x`, and the penalty of its sets' sizes."""
    net = rj.MLP.from_layers([([[gain]], [0.0])])
    loop = rj.ClosedLoop(rj.AffinePlant(jnp.array([[1.0]]) * scale, [[1.0]]), net)
    return rj.volume_penalty(loop, rj.Box([1.0], [2.0]), 2, rj.Template.box(1))


def test_a_derivative_within_a_derivative_is_held_or_refused():
    """As JAX has it for other functions, whose code takes no compiler's options."""

    def steered(scale):
        inner = jax.lax.stop_gradient(jax.grad(scaled, 1)(scale, -0.4))
        return scaled(scale, -0.4 + 0.0 * inner)

    expected = jax.jit(jax.grad(scaled))(1.1, -0.4)
    assert float(jax.grad(steered)(1.1)) == pytest.approx(float(expected), rel=1e-12)
    valued = jax.grad(lambda scale: jax.value_and_grad(partial(scaled, scale))(-0.4)[0])
    assert float(valued(1.1)) == pytest.approx(float(expected), rel=1e-12)
    with pytest.raises(TypeError, match="first derivatives only"):
        jax.grad(lambda scale: jax.grad(partial(scaled, scale))(-0.4))(1.1)


def test_a_pullback_may_be_used_in_compiled_code():
    _, pull = jax.vjp(partial(scaled, 1.1), -0.4)
    slope = float(pull(1.0)[0])
    assert float(jax.jit(pull)(1.0)[0]) == pytest.approx(slope, rel=1e-12)
    many = jax.lax.map(lambda above: pull(above)[0], jnp.arange(3.0))
    np.testing.assert_allclose(many, slope * np.arange(3.0), rtol=1e-12)


def test_numbers_that_a_plant_closes_over_have_derivatives():
    def penalty(scale, gain):
        plant = rj.NonlinearPlant(lambda x, u: scale * x + u + 0.1 * jnp.sin(scale * x), 1, 1)
        net = rj.MLP.from_layers([([[gain]], [0.0])])
        return rj.volume_penalty(rj.ClosedLoop(plant, net), rj.Box([1.0], [2.0]), 2)

    slopes = jax.grad(penalty, (0, 1))(1.1, -0.4)
    np.testing.assert_allclose(slopes, jax.jit(jax.grad(penalty, (0, 1)))(1.1, -0.4), rtol=1e-12)


def test_what_is_required_more_than_once_counts_more_than_once():
    """Of one set object too, at the beginning and later, compiled and not."""
    net = rj.MLP.from_layers([([[-0.5]], [0.0])])
    loop = rj.ClosedLoop(rj.AffinePlant([[1.0]], [[1.0]]), net)
    near, far = rj.Box([0.0], [0.2]), rj.Box([0.0], [1.5])
    for asked in (
        {"avoid": {1: [near], range(1, 3): [near]}},
        {"avoid": {range(1, 4): [far], 2: [far]}},
        {"avoid": {0: [far, far]}},
        {"goal": {0: near, 3: near}, "safe": near},
    ):

        def penalty(X0, asked=asked):
            return rj.specification_penalty(loop, X0, 3, rj.Template.box(1), **asked)

        X0 = rj.Box([1.0], [2.0])
        plain = float(penalty(X0))
        assert float(jax.jit(penalty)(X0)) == pytest.approx(plain, rel=1e-9, abs=1e-9)
        assert float(jax.value_and_grad(penalty)(X0)[0]) == pytest.approx(plain, rel=1e-9, abs=1e-9)


def test_times_in_units_of_a_traced_period_are_known_or_an_error():
    """Read by another period a goal would be that of another sample."""

    def plant_of(period):
        return rj.SampledPlant(lambda x, u: -0.1 * x + 0.0 * u, 1, 1, period=period)

    known = plant_of(0.5)

    def penalty(gain, period):
        net = rj.MLP.from_layers([([[gain]], [0.0])])
        plant = known if period is None else plant_of(period)
        loop, X0 = rj.ClosedLoop(plant, net), rj.Box([1.0], [2.0])
        return rj.specification_penalty(loop, X0, 4, goal={1.0: rj.Box([0.0], [0.5])})

    plain = float(penalty(-0.4, 0.5))
    assert plain > 1.0
    assert float(jax.value_and_grad(penalty, 1)(-0.4, 0.5)[0]) == pytest.approx(plain, rel=1e-3)
    assert float(jax.jit(lambda gain: penalty(gain, None))(-0.4)) == pytest.approx(plain, rel=1e-3)
    with pytest.raises(ValueError, match=r"names 1\.0, a time in the plant's units.*name a step"):
        jax.jit(penalty)(-0.4, 0.5)


@pytest.mark.parametrize("spread", [[0.0, 0.0], [0.1, 0.0]], ids=["point", "flat"])
def test_sketches_of_flat_sets_are_not_empty(spread):
    """Bounds of a number by forms and by intervals may miss one another by a rounding."""
    start = rj.Box([0.1, -0.3], np.add([0.1, -0.3], spread))

    def bounds(weights):
        loop = rj.ClosedLoop(FIELD, turning(weights))
        safe = rj.Box([-0.01, -0.01], [0.01, 0.01])
        asked = {"safe": safe, "avoid": [rj.Box([-1.0, -1.0], [1.0, 1.0])]}
        return rj.specification_penalty(loop, start, 12, rj.Template.box(2), **asked)

    loop = rj.ClosedLoop(FIELD, turning(WEIGHTS))
    runs = np.asarray(loop.simulate(start.corners(), 12))
    for value, slopes in (
        jax.value_and_grad(bounds)(WEIGHTS),
        jax.jit(jax.value_and_grad(bounds))(WEIGHTS),
    ):
        assert np.isfinite(value)
        assert np.isfinite(slopes).all()
        assert float(value) >= np.maximum(0.0, abs(runs).max(axis=0) - 0.01).sum()
