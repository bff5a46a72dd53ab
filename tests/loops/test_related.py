"""Numbers that know each other: quotients by norms and by sums, and logarithms of sums.

What bounds say of a numerator and of a denominator is forgotten in their product; what they have in
common is not. Widths are compared with those of samples, and every sample is inside.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.loops.widths import widths
from tests.oracles.exact.exact_reader import images
from tests.oracles.exact.varying import fractions

RNG = np.random.default_rng(0)
WEIGHTS = [jnp.asarray(RNG.normal(size=shape) / 2) for shape in ((6, 2), (6, 6), (1, 6))]


def layer_norm(y):
    return (y - y.mean()) / jnp.sqrt(y.var() + 1e-5)


def rms_norm(y):
    return y / jnp.sqrt(jnp.mean(y * y) + 1e-5)


def huber(v):
    """A friction that is nearly a sign."""
    return -0.3 * v / jnp.sqrt(v * v + 1e-4)


def normed(norm):
    first, second, last = WEIGHTS
    return lambda x: last @ jax.nn.relu(norm(second @ jax.nn.relu(norm(first @ x + 0.3))))


def friction(x, u):
    return jnp.stack([x[0] + 0.1 * x[1], x[1] + 0.1 * (huber(x[1]) - x[0] + u[0])])


def drawn_in(x, u):
    return jnp.stack([x[0] + 0.1 * x[1], x[1] + 0.1 * u[0]])


def of_x(function):
    return lambda x, u: jnp.broadcast_to(function(x), (2,))


def unit_vector(x):
    return x / jnp.sqrt(x @ x + 0.1)


def scaled(s, x, u):
    return s * jax.nn.softmax(s * x + s) + s / (2 + x**2)


AROUND, BESIDE = ([-0.2, -0.2], [0.2, 0.2]), ([0.4, 0.2], [0.6, 0.4])
SMALL = [-0.1] * 2, [0.1] * 2
FORMS = rj.LinearBounds()
CASES = {
    "friction": (friction, AROUND, 4, rj.BranchAndCut(), None, 1.01),
    "friction by forms": (friction, AROUND, 1, FORMS, None, 1.2),
    "layer norm": (drawn_in, BESIDE, 3, rj.BranchAndCut(), normed(layer_norm), 1.01),
    "RMS norm": (drawn_in, SMALL, 2, rj.BranchAndCut(), normed(rms_norm), 1.2),
    "unit vector": (of_x(unit_vector), AROUND, 1, FORMS, None, 1.05),
    "softmax": (of_x(lambda x: jax.nn.softmax(50 * x)), SMALL, 1, FORMS, None, 1.05),
    "logarithm of a sum": (of_x(jax.nn.logsumexp), AROUND, 1, FORMS, None, 1.05),
    "log softmax": (of_x(jax.nn.log_softmax), AROUND, 1, FORMS, None, 1.05),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_quotients_are_bounded_by_what_their_parts_have_in_common(name):
    step, ends, horizon, relaxation, network, most = CASES[name]
    bounds, sampled = widths(step, rj.Box(*ends), relaxation, horizon=horizon, controller=network)
    assert np.all(bounds <= most * sampled), bounds / sampled


@pytest.mark.costly
def test_traced_parameters_beside_a_quotient_are_recorded_alike():
    def bound(scale):
        plant = rj.NonlinearPlant(jax.tree_util.Partial(scaled, scale), 2, 1)
        loop = rj.ClosedLoop(plant, rj.Network(lambda x: -x[:1], inputs=2, outputs=1))
        return rj.reach(loop, rj.Box(*AROUND), 1, rj.Template.box(2), FORMS).sets[1].b

    np.testing.assert_allclose(jax.jit(bound)(1.5), bound(1.5), rtol=1e-9)


def cancelling(x, large):
    """Factors of which few digits are left when they are subtracted: `0.3 x`, and `x`."""
    return jnp.stack([large * x[0] + 0.3 * x[0], large * x[0]])


CANCELLING = {
    "softmax": lambda x: jax.nn.softmax(cancelling(x, 1e10)),
    "softmax of quotients": lambda x: jax.nn.softmax(cancelling(x, 1e10) / 3),
    "logarithm of a sum": lambda x: jax.nn.logsumexp(cancelling(x, 1e10)) - 1e10 * x,
    "twice": lambda x: jax.nn.softmax(jax.nn.log_softmax(cancelling(x, 1e6)) / 3),
    "norm": lambda x: jax.nn.standardize(cancelling(x, 1e10) - 1e10 * x[0], epsilon=1e-2),
    "piecewise": lambda x: jax.nn.relu(jax.nn.log_softmax(0.1 * x + 0.2 * x) + 0.7 * x),
}


@pytest.mark.parametrize("name", CANCELLING)
def test_rounding_of_factors_decides_nothing(name):
    function, ends = CANCELLING[name], np.array([[-0.5, 0.25], [0.75, 1.0]])
    plant = rj.NonlinearPlant(lambda x, u: function(x), 2, 1)
    loop = rj.ClosedLoop(plant, rj.Network(lambda x: 0 * x[:1], inputs=2, outputs=1))
    region = rj.reach(loop, rj.Box(*ends), 1, rj.Template.box(2), FORMS).sets[1]
    x = np.concatenate([ends, RNG.uniform(*ends, size=(30, 2))])
    values, off = images(function, x)
    over = values @ fractions(region.A).T - fractions(region.b)
    assert over.max() <= off * (1 + abs(values).max())


def largest_of_all(x):
    return jnp.exp(x - x.max()) / jnp.exp(x - x.max()).sum()


def of_some(x):
    """A quotient whose exponents have the largest of some numbers taken from them alone."""
    powers = jnp.exp(x - x[:1].max())
    return powers / powers.sum()


def finite_or_zero(x):
    large = 1e10 * jnp.exp(x)
    return jnp.where(jnp.isfinite(large), x, 0.0)


def moderate_multiple(x):
    """A sum of exponentials that cannot overflow, and a multiple of one of them that can."""
    power = jnp.exp(700 * jnp.tanh(x))
    return 1e10 * power / (1 + power)


# a function, where its exponentials overflow or all underflow, and where they do not
BEYOND = {
    "sigmoid": (lambda x: jnp.exp(x) / (1 + jnp.exp(x)), (700.0, 720.0), (-720.0, 600.0)),
    "multiple": (lambda x: 1e10 * jnp.exp(x) / (1 + jnp.exp(x)), (680.0, 700.0), (0.0, 600.0)),
    "softplus": (lambda x: jnp.log(1 + jnp.exp(x)), (700.0, 720.0), (-720.0, 600.0)),
    "log1p": (lambda x: jnp.log1p(jnp.exp(x)), (700.0, 720.0), (-720.0, 600.0)),
    "sum": (lambda x: jnp.exp(x) / (jnp.exp(x) + jnp.exp(x + 1)), (709.0, 709.6), (-9.0, 9.0)),
    "sum of one": (lambda x: jnp.exp(x) / (2 * jnp.exp(x)), (709.0, 709.6), (-9.0, 9.0)),
    "underflow": (lambda x: jnp.log(jnp.exp(x) + jnp.exp(2 * x)), (-800.0, -700.0), (-9.0, 9.0)),
    "zero over zero": (lambda x: jnp.exp(x) / jnp.exp(x).sum(), (-800.0, -700.0), (-9.0, 9.0)),
    "required": (finite_or_zero, (680.0, 700.0), (-9.0, 9.0)),
    "norm": (lambda x: x / jnp.sqrt(1 + x * x), (1e154, 1e156), (-1e6, 1e6)),
    "long norm": (lambda x: x / jnp.sqrt(1e200 + x * x), (1e154, 1e156), (-1e6, 1e6)),
    "norm of two": (lambda x: x / jnp.sqrt(1 + x @ x), (1e154, 1e156), (-1e6, 1e6)),
    "multiple of a norm": (lambda x: 1e250 * x / jnp.sqrt(1 + x * x), (1e60, 1e62), (-9.0, 9.0)),
    "norm, scaled": (lambda x: (1e250 / jnp.sqrt(1e-200 + x * x)) * x, (0.0, 1e-110), (1.0, 2.0)),
    "moderate multiple": (moderate_multiple, (5.0, 6.0), (-0.1, 0.1)),
    "largest of some": (of_some, (-500.0, 500.0), (-9.0, 9.0)),
}


def image(function, ends):
    """The set of the values of a function of two numbers over a square."""
    plant = rj.NonlinearPlant(lambda x, u: function(x), 2, 1)
    loop = rj.ClosedLoop(plant, rj.Network(lambda x: 0 * x[:1], inputs=2, outputs=1))
    lower, upper = (np.full(2, end) for end in ends)
    return rj.reach(loop, rj.Box(lower, upper), 1, rj.Template.box(2), FORMS).sets[1]


@pytest.mark.parametrize("name", BEYOND)
def test_what_overflows_as_jax_computes_it_has_no_bounds(name):
    function, beyond, within = BEYOND[name]
    corners = jnp.array([beyond, beyond[::-1], [beyond[0]] * 2, [beyond[1]] * 2])
    values = jax.vmap(function)(corners)
    assert not np.isfinite(values).all() or np.any(values == 0)
    with pytest.raises(ValueError, match=r"no bounds|overflow"):
        image(function, beyond)
    assert np.isfinite(image(function, within).b).all()


@pytest.mark.parametrize(
    "function", [jax.nn.softmax, jax.nn.logsumexp, jax.nn.log_softmax, jax.nn.softplus,
                 jax.nn.sigmoid, largest_of_all, lambda x: 1 / (1 + jnp.exp(-x))]
)  # fmt: skip
def test_what_is_moderate_as_jax_computes_it_has_bounds_far_out(function):
    whole = image(lambda x: jnp.broadcast_to(function(x), (2,)), (-2000.0, 2000.0))
    assert np.isfinite(whole.b).all()
