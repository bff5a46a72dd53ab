"""Sets that touch the edge of a domain exactly do not leave it; those that leave it are refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.special import xlogy

import reachjax as rj
from reachjax.loops.units import UnboundedError
from tests.loops.widths import widths

UNIT, AROUND = rj.Box([0.0], [1.0]), rj.Box([-1.0, -1.0], [1.0, 1.0])
FORMS = rj.LinearBounds()

TOUCHING = {
    "root": (jnp.sqrt, UNIT, 1.001),
    "half a power": (lambda x: x**0.5, UNIT, 1.001),
    "two and a half": (lambda x: x**2.5, UNIT, 1.1),
    "arcsine": (jnp.arcsin, UNIT, 1.001),
    "arccosine": (lambda x: jnp.arccos(1 - 2 * x), UNIT, 1.001),
    "x log x": (lambda x: xlogy(x, x), UNIT, 1.1),
    "logarithm": (jnp.log1p, UNIT, 1.001),
    "root of a rectifier": (lambda x: jnp.sqrt(jax.nn.relu(x - 0.5)), UNIT, 1.001),
    "power of a size": (lambda x: jnp.abs(x - 0.5) ** 1.5, UNIT, 1.2),
    "root of what is chosen": (lambda x: jnp.where(x > 0, jnp.sqrt(x), 0.0), UNIT, 1.001),
    "length": (lambda x: jnp.sqrt(x[:1] ** 2 + x[1:] ** 2) * jnp.ones(2), AROUND, 1.01),
}  # fmt: skip


@pytest.mark.parametrize("name", TOUCHING)
def test_a_set_may_touch_the_edge_of_a_domain(name):
    function, X0, most = TOUCHING[name]
    for options in ((FORMS,), ()):
        bounds, sampled = widths(lambda x, u: function(x), X0, *options)
        assert np.all(bounds <= most * sampled), (options, bounds / sampled)


@pytest.mark.costly
def test_also_after_several_steps_and_beside_what_is_drawn():
    plant = rj.NonlinearPlant(
        lambda x, u, w: jnp.stack([0.5 * jnp.sqrt(x[0]), x[0] + 0.1 * w[0] + u[0]]), 2, 1, 1
    )
    loop = rj.ClosedLoop(
        plant,
        rj.MLP.from_layers([([[0.0, 0.1]], [0.0])]),
        rj.Polytope([[1.0], [-1.0]], [1.0, 1.0]),
        disturbance=rj.Box([-1.0], [1.0]),
        noise=rj.Box([-0.1, -0.1], [0.1, 0.1]),
    )
    X0 = rj.Box([0.0, -1.0], [1.0, 1.0])
    tube = rj.reach(loop, X0, 3, rj.Template.box(2), FORMS)
    np.testing.assert_allclose(tube.sets[3].b[:2], [0.5 ** (2 - 1 / 4), 0.0], rtol=1e-3, atol=1e-3)
    assert rj.decide(loop, X0, 2, safe=rj.Box([-1.0, -3.0], [1.0, 3.0])).status.name == "PROVED"


@pytest.mark.parametrize("least", [-1e-16, -1e-300])
def test_a_set_that_leaves_a_domain_by_however_little_is_refused(least):
    loop = rj.ClosedLoop(
        rj.NonlinearPlant(lambda x, u: jnp.sqrt(x), 1, 1), rj.Network(lambda x: 0 * x, 1, 1)
    )
    with pytest.raises(UnboundedError, match=r"Sqrt.* has inputs in \[-"):
        rj.reach(loop, rj.Box([least], [1.0]), 1, rj.Template.box(1), FORMS)


def test_a_smooth_controller_touches_the_edge_of_its_domain():
    # its inputs are those of this step, however many columns there are
    loop = rj.ClosedLoop(rj.AffinePlant([[0.0]], [[0.25]]), rj.Network(jnp.sqrt, 1, 1))
    for options in ((FORMS,), ()):
        tube = rj.reach(loop, rj.Box([0.0], [1.0]), 1, rj.Template.box(1), *options)
        np.testing.assert_allclose(tube.sets[1].b, [0.25, 0.0], atol=1e-3)
        assert tube.sets[1].b[0] >= 0.25
