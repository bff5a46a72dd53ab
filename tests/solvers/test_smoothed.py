"""Offsets on the central path at a chosen weight: proved, looser, and without kinks."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.loops import closed_loop, random_loop
from tests.networks import box_region, directions, simulate
from tests.solvers.test_differentiable import along, planar, relative_error
from tests.solvers.test_differentiable import value as planar_value


def smoothed(weight):
    return rj.InteriorPoint(smoothing=weight)


@pytest.mark.parametrize("weight", [1e-2, 1e-4])
def test_the_gradient_is_the_central_difference(weight):
    args, f = planar(0), partial(planar_value, solver=smoothed(weight))
    gradient = jax.grad(f, argnums=(0, 1))(*args)
    for part in ("weights", "A", "initial set", "input limits"):
        assert relative_error(f, args, gradient, along(part, *args, 0), 1e-3) <= 1e-3


@pytest.mark.parametrize("weight", [1e-1, 1e-3, 1e-5])
def test_offsets_are_sound_and_looser_by_the_weight_times_what_is_weighed(weight):
    data, region = random_loop(3), box_region(3, 0)
    loop, template = closed_loop(data), rj.Template(directions(3, 0, extra=2))
    X = rj.Polytope(region.A, region.b)
    following, certificate = rj.reach_step(loop, X, template, solver=smoothed(weight))
    best, _ = rj.reach_step(loop, X, template, solver=rj.Clarabel())
    states = np.vstack([region.corners, region.sample(20_000, 0)])
    assert np.all(following.contains(simulate(data, states, 1)[1]))
    assert np.all(following.b >= best.b - 1e-7)
    program = certificate.program
    unit = np.linalg.norm(program.objective.mid[:, :-1], axis=1)
    count = len(program.transform) + len(program.products.free)
    assert np.all(following.b <= best.b + 2 * weight * unit * count + 1e-7)
    assert np.all(certificate.recheck() <= following.b + 1e-9)


def test_a_kink_is_gone():
    """The offset of `x_1 + a x_2` over a box has one at `a = 0`, of slopes -1 and 1."""
    box = rj.Box([-1.0, -1.0], [1.0, 1.0])
    net = rj.MLP.from_layers([([[0.0, 0.0]], [0.0])])

    def offset(a, solver):
        loop = rj.ClosedLoop(rj.AffinePlant(jnp.array([[1.0, a], [0.0, 1.0]]), [[0.0], [0.0]]), net)
        return rj.reach(loop, box, 1, rj.Template.box(2), solver=solver).sets[1].b[0]

    smooth = partial(offset, solver=smoothed(1e-2))
    h = 1e-4
    for a in (0.0, 1e-3, 3e-2):
        slope = (smooth(a + h) - smooth(a - h)) / (2 * h)
        assert float(jax.grad(smooth)(a)) == pytest.approx(float(slope), abs=1e-5)
    assert float(jax.grad(smooth)(0.0)) == pytest.approx(0.0, abs=1e-6)
    assert offset(h, rj.Clarabel()) - offset(0.0, rj.Clarabel()) > 0.9 * h


def test_compiled_and_batched_smooth_offsets_agree():
    loop, X0 = planar(0)
    f = partial(planar_value, solver=smoothed(1e-3))
    nets = [jax.tree.map(lambda w, s=s: w * (1 + s), loop.controller) for s in (0.0, 0.1)]
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), *nets)

    def of(net):
        return f(loop.replace(controller=net), X0)

    single = [of(net) for net in nets]
    np.testing.assert_allclose(jax.jit(jax.vmap(of))(stack), single, rtol=1e-9)


def test_what_is_no_number_gives_none():
    loop, X0 = planar(0)
    astray = jax.tree.map(lambda w: np.nan * w, loop.controller)

    def f(net):
        return planar_value(loop.replace(controller=net), X0, solver=smoothed(1e-3))

    value, gradient = jax.jit(jax.value_and_grad(f))(astray)
    assert np.isnan(value)
    assert all(np.isnan(leaf).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize(
    ("smoothing", "error"), [(-1.0, ValueError), ("little", TypeError), (np.nan, ValueError)]
)
def test_a_weight_that_is_none_is_refused(smoothing, error):
    with pytest.raises(error, match=r"InteriorPoint\.smoothing"):
        rj.InteriorPoint(smoothing=smoothing)
