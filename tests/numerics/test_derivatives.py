"""Bounds have first derivatives in reverse mode; others are refused before anything is computed."""

import jax
import pytest

import reachjax as rj
from reachjax.numerics.derivatives import ONLY_FIRST, first_order
from reachjax.tubes import propagation
from tests.closed_loops import autonomous


def second(f):
    return jax.grad(jax.grad(f))


@pytest.mark.parametrize(
    "of", [jax.jacfwd, jax.hessian, second, lambda f: jax.jit(jax.hessian(f)), jax.vmap]
)
def test_only_first_derivatives_in_reverse_mode_are_had(of, monkeypatch):
    computed = []

    def unreached(*_, **__):
        computed.append(True)
        raise RuntimeError("computed")

    monkeypatch.setattr(propagation, "_following", unreached)
    loop = autonomous([[0.5]])

    def penalty(end):
        return rj.volume_penalty(loop, rj.Box(0 * end, end), 1, rj.Template.box(1))

    if of is jax.vmap:  # what is refused is the derivative
        with pytest.raises(RuntimeError, match="computed"):
            jax.jacrev(lambda end: jax.vmap(penalty)(end[None]))(jax.numpy.ones(1))
        return
    with pytest.raises(TypeError, match=r"take jax.grad, jax.vjp or jax.jacrev once"):
        of(lambda number: penalty(jax.numpy.full(1, number)))(1.0)
    assert not computed


def test_first_derivatives_pass_through_all_that_maps_and_compiles():
    def squared(x):
        return first_order(x) ** 2

    assert float(jax.jit(jax.grad(squared))(3.0)) == 6.0
    assert jax.vmap(jax.grad(squared))(jax.numpy.arange(3.0)).tolist() == [0.0, 2.0, 4.0]
    assert float(jax.grad(lambda x: jax.checkpoint(jax.jit(squared))(x))(3.0)) == 6.0
    with pytest.raises(TypeError) as caught:
        second(squared)(3.0)
    assert str(caught.value) == ONLY_FIRST
