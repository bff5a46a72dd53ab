"""The same code on an accelerator: programs go from there to the host."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.closed_loops import closed_loop, random_loop, recursion
from tests.networks import box_region, directions, simulate

pytestmark = pytest.mark.skipif(
    jax.default_backend() == "cpu", reason="needs an accelerator: JAX sees none"
)


@pytest.mark.parametrize("relaxation", [rj.LocalBounds(), rj.PaperQC()], ids=repr)
def test_facets_in_one_batch_have_clarabels_offsets(relaxation):
    data, region = random_loop(3), box_region(3, 0)
    X, template = rj.Polytope(region.A, region.b), rj.Template(directions(3, 0, extra=2))
    ours, theirs = (
        rj.reach_step(closed_loop(data), X, template, relaxation=relaxation, solver=solver)[0].b
        for solver in (rj.InteriorPoint(), rj.Clarabel())
    )
    np.testing.assert_allclose(ours, theirs, atol=1e-5)
    states = np.vstack([region.corners, region.sample(20_000, 0)])
    assert np.all(simulate(data, states, 1)[1] @ template.directions.T <= ours)


def test_networks_in_one_batch_are_those_one_at_a_time():
    loop, box = closed_loop(random_loop(2)), rj.Box([-0.5, -0.5], [0.5, 0.5])

    def offsets(net):
        closed = loop.replace(controller=net)
        return recursion(closed, box, 2, rj.Template.box(2), solver=rj.InteriorPoint()).sets[-1].b

    nets = [jax.tree.map(lambda w, s=s: w * (1 + s), loop.controller) for s in (0.0, 0.1, 0.2)]
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), *nets)
    together = jax.jit(jax.vmap(offsets))(stack)
    np.testing.assert_allclose(together, [offsets(net) for net in nets], atol=1e-6)


def test_gradients_of_a_batch_are_clarabels():
    loop, box = closed_loop(random_loop(2)), rj.Box([-0.5, -0.5], [0.5, 0.5])

    def size(net, solver):
        closed = loop.replace(controller=net)
        tube = recursion(closed, box, 2, rj.Template.box(2), solver=solver)
        return rj.log_widths(tube.sets[-1]).sum()

    stack = jax.tree.map(lambda w: jnp.stack([w, 1.1 * w]), loop.controller)
    ours, theirs = (
        jax.tree.leaves(jax.jit(jax.vmap(jax.grad(size), (0, None)), static_argnums=1)(stack, by))
        for by in (rj.InteriorPoint(), rj.Clarabel())
    )
    scale = max(abs(leaf).max() for leaf in theirs)
    for mine, reference in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(mine, reference, atol=1e-3 * scale)
