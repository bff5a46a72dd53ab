"""Penalties of differential equations are of sketches, at samples and in between."""

import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.loops.flows.taylor_models import Symbols
from reachjax.methods.problem import Problem
from reachjax.tubes.sketches import sketched
from tests.differences import central_difference, dot

HORIZON, PERIOD = 3, 0.1
SAFE = rj.Box([-0.1, -0.3], [0.33, 0.15])
FIFTH = 5e-6
"""What the fifth derivatives are worth over the horizon: `h^5 / 120` is 8e-8, and they are some 10
to 20 in each of its periods."""


def swinging(stiffness, x, u):
    return jnp.array([x[1], stiffness * jnp.sin(x[0]) - 0.5 * x[1] + u[0]])


def pushed(stiffness, x, u, w):
    return swinging(stiffness, x, u) + w


def by_matrices(stiffness, period):
    A = jnp.array([[0.0, 1.0], [0.0, -0.5]]).at[1, 0].set(stiffness)
    return rj.SampledPlant.affine(A, jnp.array([[0.0], [1.0]]), period=period)


def by_function(stiffness, period, f=swinging, **given):
    return rj.SampledPlant(jax.tree_util.Partial(f, stiffness), 2, 1, period, order=4, **given)


def parts(kind):
    """What a penalty depends on."""
    rng = np.random.default_rng(2)
    net = rj.MLP.from_layers(
        [(rng.normal(size=(4, 2)), rng.normal(size=4)), (rng.normal(size=(1, 4)), [0.2])], rj.Tanh()
    )
    X0 = rj.Box([0.2, -0.1], [0.3, 0.0])
    X0 = rj.with_inputs(X0, [0.1]) if kind == "late" else X0
    return {"net": net, "X0": X0, "stiffness": jnp.array(1.0), "period": jnp.array(PERIOD)}


def loop_of(kind, given):
    stiffness, period = given["stiffness"], given["period"]
    if kind == "matrices":
        return rj.ClosedLoop(by_matrices(stiffness, period), given["net"])
    if kind == "disturbed":
        plant = by_function(stiffness, period, pushed, disturbances=2)
        push = rj.Box([-0.01, -0.05], [0.01, 0.05])
        return rj.ClosedLoop(plant, given["net"], disturbance=push)
    if kind == "steps":
        return rj.ClosedLoop(by_function(stiffness, period, steps=2), given["net"])
    loop = rj.ClosedLoop(by_function(stiffness, period), given["net"])
    return rj.delayed(loop) if kind == "late" else loop


KINDS = [
    "function",
    "matrices",
    *(pytest.param(kind, marks=pytest.mark.costly) for kind in ("disturbed", "steps", "late")),
]


@pytest.mark.parametrize("kind", KINDS)
def test_sets_and_spans_of_a_sketch_are_the_certified_ones_but_for_remainders(kind, monkeypatch):
    """Of steps of the same order and products of the same degree, as compiled code has them."""
    given = parts(kind)
    loop = loop_of(kind, given)
    template = rj.Template.default(loop.states)
    found = sketched(Problem(loop, given["X0"], template, HORIZON), True)
    monkeypatch.setattr(Symbols, "with_higher", property(lambda symbols: symbols))
    by_forms = rj.LinearBounds(programs=False)
    tube = rj.reach(loop, given["X0"], HORIZON, template, relaxation=by_forms)
    left_out = 1e-12 if kind == "matrices" else FIFTH
    assert len(found.spans) == HORIZON
    for one, other in zip(found.sets[1:], tube.sets[1:], strict=True):
        np.testing.assert_allclose(one.b, other.b, rtol=0, atol=left_out)
    for one, other in zip(found.spans, tube.spans, strict=True):
        np.testing.assert_allclose(one.b, other.b, rtol=0, atol=left_out)
        assert np.all(np.asarray(one.b) <= np.asarray(other.b) + left_out / 10)


@pytest.mark.parametrize("kind", ["function", "matrices"])
@pytest.mark.costly
def test_gradients_of_penalties_at_all_times_are_central_differences(kind):
    """By weights, the initial set, a parameter of the equation and the period, each alone."""
    given = parts(kind)

    def penalty(given):
        return rj.specification_penalty(loop_of(kind, given), given["X0"], HORIZON, safe=SAFE)

    both = jax.jit(jax.value_and_grad(penalty), compiler_options=rj.compiler_options())
    value, slopes = both(given)
    assert float(value) == pytest.approx(float(penalty(given)), rel=1e-3)  # which is certified
    rng = np.random.default_rng(0)
    for name in given:
        move = jax.tree.map(jnp.zeros_like, given)
        move[name] = jax.tree.map(
            lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), given[name]
        )
        difference = central_difference(lambda given: both(given)[0], (given,), (move,), 1e-4)
        assert abs(difference) > 1e-3
        assert dot(slopes, move) == pytest.approx(difference, rel=1e-4), name


def scans(jaxpr):
    """The equations of what is done over and over, those within them left aside."""
    for equation in jaxpr.eqns:
        inner = jax.extend.core.jaxprs_in_params(equation.params)
        if equation.primitive.name == "scan":
            yield from inner
        else:
            for each in inner:
                yield from scans(each)


def equations(jaxpr):
    for equation in jaxpr.eqns:
        yield equation
        for each in jax.extend.core.jaxprs_in_params(equation.params):
            yield from equations(each)


def traced(kind, horizon, **asked):
    """A penalty, as it is compiled."""

    def penalty(given):
        loop = loop_of(kind, given)
        return rj.specification_penalty(loop, given["X0"], horizon, **asked)

    return jax.make_jaxpr(penalty)(parts(kind)).jaxpr


def test_a_penalty_at_all_times_proves_nothing_and_does_a_period_once():
    """The equations of the periods are as many however many there are, and none is of bits.

    What happens in between is left out where nobody asks for it.
    """
    sizes = []
    for horizon, asked in ((2, {"safe": SAFE}), (4, {"safe": SAFE}), (2, {"goal": SAFE})):
        found = [[*equations(each)] for each in scans(traced("function", horizon, **asked))]
        names = {equation.primitive.name for each in found for equation in each}
        assert not names & {"bitcast_convert_type", "pure_callback", "io_callback"}
        sizes.append([len(each) for each in found])
    once, again, at_samples = sizes
    assert once == again
    assert sum(at_samples) < 0.9 * sum(once)


def test_exponentials_of_a_plant_of_matrices_are_computed_once_for_all_periods():
    """Products of square matrices of the state, the input and 1 are outside of the periods."""
    found, square = traced("matrices", 3, safe=SAFE), (4, 4)

    def powers(jaxpr):
        return [
            equation
            for equation in equations(jaxpr)
            if equation.primitive.name == "dot_general"
            and all(each.aval.shape == square for each in equation.invars)
        ]

    assert powers(found)
    assert not any(powers(each) for each in scans(found))
