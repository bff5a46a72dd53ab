"""Functions that choose by a parameter: units are those of the choice, for these numbers alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.programs.unrolled import unrolled_from_boxes

FORMS = rj.LinearBounds()


def bent_or_smooth(mode, x):
    return jnp.where(mode > 0, jnp.maximum(x, 0.0), jnp.tanh(x))


def scaled_choice(mode, gain, x):
    return gain * bent_or_smooth(mode, x)


def steeper_beyond(s, x):
    return jnp.where(x > s, 2 * x - s, x)


def loop_of(f, parameter):
    """A loop whose state becomes what a function with a parameter makes of it."""
    net = rj.Network(jax.tree_util.Partial(f, jnp.array(parameter)), 1, 1)
    return rj.ClosedLoop(rj.AffinePlant([[0.0]], [[1.0]]), net)


def test_loops_that_differ_in_a_parameter_alone_have_the_units_of_their_own_choices():
    bent, smooth = (loop_of(bent_or_smooth, mode) for mode in (1.0, -1.0))
    X0 = rj.Box([0.2], [1.0])
    for _ in range(2):  # whichever is asked first
        assert not bent.curved
        assert smooth.curved
        for loop, f in ((bent, lambda x: x), (smooth, np.tanh)):
            box = rj.reach(loop, X0, 1, relaxation=FORMS).sets[1].bounding_box()
            assert box.lower[0] <= f(0.2)
            assert f(1.0) <= box.upper[0]
        bent, smooth = (
            smooth.replace(controller=bent.controller),
            bent.replace(controller=smooth.controller),
        )


def test_a_known_controller_beside_a_traced_plant_has_the_units_of_its_choice():
    net = loop_of(bent_or_smooth, -1.0).controller

    def curved(gain):
        loop = rj.ClosedLoop(rj.AffinePlant([[0.0]], gain * jnp.ones((1, 1))), net)
        assert loop.curved
        assert [layer.unit.curved for layer in loop.unit_layers] == [True]
        return gain

    jax.jit(curved)(1.0)


@pytest.mark.parametrize("asked", [False, True])
def test_compiled_forms_have_a_column_for_each_unit_that_they_meet(asked):
    """Traced, the parameter decides nothing: three units are met instead of one."""
    loop = loop_of(steeper_beyond, 1.0)
    if asked:
        assert loop.units == 1
    bounds = unrolled_from_boxes(loop, np.zeros((1, 1)), np.full((1, 1), 2.0), np.ones((3, 1, 1)))
    assert bounds[0, 1, 0, 0] >= 5.0
    assert bounds[0, 2, 0, 0] >= 9.0


def test_derivatives_of_a_function_that_chooses_are_differences():
    X0, template = rj.Box([0.2], [0.8]), rj.Template.box(1)

    def width(gain):
        plant = rj.AffinePlant(jnp.zeros((1, 1)), gain * jnp.ones((1, 1)))
        loop = rj.ClosedLoop(plant, loop_of(bent_or_smooth, -1.0).controller)
        return rj.reach(loop, X0, 2, template, FORMS).sets[2].b.sum()

    step = 1e-5
    expected = (width(1.0 + step) - width(1.0 - step)) / (2 * step)
    assert jax.grad(width)(1.0) == pytest.approx(float(expected), rel=1e-4)


@pytest.mark.parametrize("by", ["programs", "derivatives", "derivatives of a choice"])
def test_choices_that_are_open_where_parameters_are_traced_are_named(by):
    """Programs and derivatives are made in compiled code, where no parameter is known."""
    X0, template = rj.Box([0.2], [1.0]), rj.Template.box(1)
    way = {"relaxation": rj.PaperQC()} if by == "programs" else {}

    def width(mode, gain=1.0):
        plant = rj.AffinePlant([[0.5]], [[1.0]])
        net = rj.Network(jax.tree_util.Partial(scaled_choice, mode, gain), 1, 1)
        return rj.reach(rj.ClosedLoop(plant, net), X0, 2, template, **way).sets[2].b.sum()

    asked = {
        "programs": width,
        "derivatives": lambda mode: jax.grad(lambda gain: width(mode, gain))(1.0),
        "derivatives of a choice": jax.grad(width),
    }
    with pytest.raises(TypeError, match="chooses by a parameter"):
        asked[by](jnp.array(1.0))
