"""Bounds have first derivatives in reverse mode; others are refused before anything is computed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.methods import propagation
from reachjax.numerics.derivatives import ONLY_FIRST, first_order, moved_by
from reachjax.tubes import sketches
from tests.closed_loops import autonomous


def second(f):
    return jax.grad(jax.grad(f))


@pytest.fixture
def penalty(monkeypatch):
    """A penalty that says so when something is computed."""

    def computed(*_, **__):
        raise RuntimeError("it is being computed")

    monkeypatch.setattr(propagation, "method_of", computed)
    monkeypatch.setattr(sketches, "unrolled_at_once", computed)
    loop = autonomous([[0.5]])

    def of(number):
        X0 = rj.Box(np.zeros(1), jnp.reshape(number, 1))
        return rj.volume_penalty(loop, X0, 1, rj.Template.box(1))

    return of


@pytest.mark.parametrize("of", [jax.jacfwd, jax.hessian, second, lambda f: jax.jit(jax.hessian(f))])
def test_only_first_derivatives_in_reverse_mode_are_had(of, penalty):
    with pytest.raises(TypeError, match=r"take jax.grad, jax.vjp or jax.jacrev once"):
        of(penalty)(1.0)


@pytest.mark.parametrize("of", [jax.grad, jax.jacrev, lambda f: jax.grad(jax.jit(f))])
def test_first_derivatives_in_reverse_mode_are_begun(of, penalty):
    with pytest.raises(RuntimeError, match="it is being computed"):
        of(penalty)(1.0)
    with pytest.raises(RuntimeError, match="it is being computed"):
        jax.vmap(of(penalty))(jnp.ones(2))


def test_first_derivatives_pass_through_all_that_maps_and_compiles():
    def squared(x):
        return first_order(x) ** 2

    assert float(jax.jit(jax.grad(squared))(3.0)) == 6.0
    assert jax.vmap(jax.grad(squared))(jnp.arange(3.0)).tolist() == [0.0, 2.0, 4.0]
    assert float(jax.grad(jax.checkpoint(jax.jit(squared)))(3.0)) == 6.0
    with pytest.raises(TypeError) as caught:
        second(squared)(3.0)
    assert str(caught.value) == ONLY_FIRST


def test_what_moves_out_of_the_numbers_has_no_derivative():
    known = jnp.array([1.0, 2.0])
    value, back = jax.vjp(lambda x: moved_by(known, jnp.exp(x)), jnp.array([0.5, 1e3]))
    np.testing.assert_array_equal(value, known)
    np.testing.assert_allclose(back(jnp.array([3.0, 0.0]))[0][0], 3 * np.exp(0.5))
    assert np.isnan(back(jnp.array([3.0, 1.0]))[0][1])
