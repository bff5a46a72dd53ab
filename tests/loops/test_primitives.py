"""Primitives of JAX as steps and units: their values, their intervals, and what has neither."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from jax import lax

import reachjax as rj
from reachjax.loops.units import UnboundedError
from tests.loops.traced import LOWER, UPPER, assert_sound, interval, network

A = jnp.array([[2.0, -1.0], [0.5, 3.0]])
Partial = jax.tree_util.Partial


WEIGHTS = np.arange(24.0).reshape(2, 3, 4) - 11.5
SIDES = np.array([[1.0, -2.0], [0.5, 3.0], [-1.0, 0.25]])


def cube(x):
    """Entries `(2, 3, 4)` that depend on `x`."""
    return jnp.einsum("i,ji,k->ijk", x, SIDES, WEIGHTS[0, 0])


def counted(x):
    return lax.while_loop(lambda c: c[0] < 3, lambda c: (c[0] + 1, 0.5 * jnp.sin(c[1])), (0, x))[1]


def compared_on_the_way(x):
    return lax.scan(lambda c, w: (c * 0.5, c > 0), x, jnp.arange(3.0))[0]


def printing(x):
    jax.debug.print("{}", x)
    return 2 * x


FUNCTIONS = {
    "gather that fills": lambda x: x.at[jnp.array([5, 0])].get(mode="fill", fill_value=7.0),
    "set": lambda x: jnp.ones(3).at[jnp.array([2, 0])].set(2 * x),
    "set to a constant": lambda x: x.at[0].set(3.0),
    "add": lambda x: x.at[jnp.array([1, 1])].add(jnp.array([x[0], 2.0])),
    "add constants": lambda x: x.at[1].add(3.0),
    "multiply": lambda x: x.at[1].multiply(2.0),
    "multiply values": lambda x: x.at[1].multiply(x[0]),
    "update": lambda x: lax.dynamic_update_slice(x, 2 * x[1:], (0,)),
    "tile": lambda x: jnp.tile(x, 2),
    "pad": lambda x: jnp.pad(x, (0, 1), constant_values=1.5),
    "softmax": jax.nn.softmax,
    "log softmax": jax.nn.log_softmax,
    "log sum exp": lambda x: jax.nn.logsumexp(x)[None],
    "largest from below": lambda x: jnp.max(x, initial=-jnp.inf)[None],
    "clip without end": lambda x: jnp.clip(x, 0.0, jnp.inf),
    "clip without beginning": lambda x: lax.clamp(-jnp.inf, x, 1.0),
    "limits of some": lambda x: jnp.maximum(x, jnp.array([-jnp.inf, 0.25])),
    "of no entries": lambda x: x * jnp.prod(x[:0]) + jnp.max(x[:0], initial=2.0),
    "powers of no entries": lambda x: x + jnp.cumprod(x[:0] ** jnp.zeros(0)).sum(),
    **{
        f"contraction {axes}": lambda x, axes=axes: jnp.einsum(axes, WEIGHTS, cube(x)).ravel()
        for axes in ("ijk,ijk->", "ijk,ijl->kl", "ijk,ljk->il", "ijk,ljm->mkil", "ijk,iml->ijmkl")
    },
    "contraction from the right": lambda x: jnp.einsum("ijk,ljk->il", cube(x), WEIGHTS).ravel(),
    "batches from the right": lambda x: jnp.einsum("ijk,ilk->ijl", cube(x), WEIGHTS).ravel(),
    "contraction with a vector": lambda x: jnp.dot(x, np.array([2.0, -0.5]))[None],
    "contraction with a parameter": Partial(
        lambda p, x: jnp.tensordot(cube(x), p, [1, 0]).ravel(), SIDES
    ),
    "sums along axes": lambda x: cube(x).sum(axis=(2, 0)),
    "relu of a constant": lambda x: jax.nn.relu(A) @ x,
    "relu of a parameter": Partial(lambda p, x: jax.nn.relu(p) @ x, A),
    "norm": lambda x: jnp.linalg.norm(x)[None],
    "root of a size": lambda x: jnp.sqrt(jnp.abs(x)),
    "root of a square": lambda x: jnp.sqrt(x[:1] ** 2),
    "deviation": lambda x: jnp.std(x)[None],
    "power of a size": lambda x: jnp.abs(x) ** 1.5,
    "negative power": lambda x: (x + 3) ** -3,
    "known base": lambda x: 2.0**x + jnp.array([3.0, 0.5]) ** x,
    "powers by entry": lambda x: (x + 2) ** jnp.array([2.0, 3.0]),
    "hyperbolic": lambda x: jnp.concatenate([jnp.sinh(x), jnp.cosh(x)]),
    "angle": lambda x: jnp.arctan2(x[:1], x[1:] + 3),
    "angle on the left": lambda x: jnp.arctan2(x[1:] + 1, x[:1] - 2),
    "angle below": lambda x: jnp.arctan2(x[1:] - 2, x[:1]),
    "angle of a constant": lambda x: jnp.arctan2(jnp.array([1.0, 2.0]), x),
    "angle of an exponential": lambda x: jnp.arctan2(x, jnp.exp(x)),
    "angle from a constant": lambda x: jnp.arctan2(x + 2, -1.5),
    "arcsine and arccosine": lambda x: jnp.concatenate([jnp.arcsin(x / 2), jnp.arccos(x / 2)]),
    "arccosine near its end": lambda x: jnp.arccos(1 - (x / 2) ** 2),
    "inverse hyperbolic": lambda x: jnp.arcsinh(x) + jnp.arccosh(x + 2.5) - jnp.arctanh(x / 2),
    "error function": lambda x: jax.lax.erf(3 * x) + jax.lax.erfc(-2 * x),
    "order": jnp.sort,
    "order of five": lambda x: jnp.sort(jnp.append(jnp.append(x, x * x - 0.3), 0.2))[::-1],
    "order in columns": lambda x: lax.sort(jnp.stack([x, -x]), dimension=0).ravel(),
    "median": lambda x: jnp.median(jnp.append(x, 0.25))[None],
    "product": lambda x: jnp.prod(x + 1)[None],
    "products so far": lambda x: jnp.cumprod(jnp.append(x, 2.0)),
    "largest so far": lambda x: lax.cummax(jnp.append(x, 0.25)),
    "smallest so far": lambda x: lax.cummin(x, reverse=True),
    "windows": lambda x: lax.reduce_window(x, -jnp.inf, lax.max, (2,), (1,), "SAME"),
    "while": counted,
    "no steps": lambda x: lax.scan(lambda c, w: (c * w, c), x, jnp.zeros(0))[0],
    "comparisons on the way": compared_on_the_way,
    "printing": printing,
    "no comparison": lambda x: jnp.where(jnp.isfinite(x), jnp.nan_to_num(x), 0.0),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_primitives_are_sound(name):
    assert_sound(FUNCTIONS[name])


# fmt: off
ACTIVATIONS = [
    "relu", "relu6", "elu", "selu", "celu", "silu", "swish", "softplus", "soft_sign", "hard_tanh",
    "hard_sigmoid", "hard_swish", "leaky_relu", "log_sigmoid", "mish", "sigmoid", "squareplus",
    "sparse_plus", "sparse_sigmoid", "tanh", "glu", "gelu",
]
# fmt: on


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_activations_are_sound(name):
    assert_sound(getattr(jax.nn, name), 2 * LOWER, 2 * UPPER)


@pytest.mark.costly
def test_tight_bounds_of_what_is_never_negative():
    low, high = interval(network(lambda x: jnp.linalg.norm(x)[None]))
    np.testing.assert_allclose([low[0], high[0]], [0.0, np.hypot(1.0, 1.5)], atol=1e-13)


def test_a_product_of_numbers_far_apart_is_their_product():
    net = jax.device_get(network(lambda x: x[:1] * x[1:]))
    x = np.array([2.81153617e08, 3.01778787e-08])
    assert net.propagate(x, lambda unit, *y: unit(*y))[0] == x[0] * x[1]


def dropping(x):
    return nnx.Dropout(0.5, rngs=nnx.Rngs(0))(x)


def branching(x):
    return x if x[0] > 0 else -x


REFUSED = {
    "entries there are not": (lambda x: jnp.take(x, jnp.array([5, 0])), "'gather'.* out of range"),
    "narrow products": (
        lambda x: jnp.dot(A, x, preferred_element_type=jnp.float32),
        "'dot_general'.* rounds to float32",
    ),
    "products of rounded numbers": (
        lambda x: jnp.einsum(
            "ij,kj->ik", WEIGHTS[0, :, :2], x[None], precision=lax.DotAlgorithmPreset.BF16_BF16_F32
        )[:, 0],
        "'dot_general'.* rounds the numbers that it multiplies",
    ),
    "products by an algorithm": (
        lambda x: jnp.dot(A, x, precision=lax.DotAlgorithm(np.float32, np.float32, np.float32)),
        "'dot_general'.* rounds the numbers that it multiplies",
    ),
    "products summed imprecisely": (
        lambda x: jnp.dot(
            A,
            x,
            precision=lax.DotAlgorithm(
                np.float64, np.float64, np.float64, allow_imprecise_accumulation=True
            ),
        ),
        "'dot_general'.* rounds the numbers that it multiplies",
    ),
    "numbers drawn": (
        lambda x: x + jax.random.normal(jax.random.key(0), (2,)),
        r"'random_seed' \(in .*draws random numbers",
    ),
    "dropout": (dropping, "draws random numbers.* evaluation mode"),
    "callbacks": (
        lambda x: jax.pure_callback(lambda x: x, jax.ShapeDtypeStruct((2,), float), x),
        "'pure_callback'.* outside of JAX",
    ),
    "a reduction of one's own": (
        lambda x: lax.reduce(x, 0.0, lambda a, b: a + b * b, (0,))[None],
        "'reduce'.* no bounds for it",
    ),
    "places in an order": (lambda x: x[jnp.argsort(x)], "'sort'.* order of other numbers jumps"),
    "the order of many": (
        lambda x: jnp.sort(jnp.outer(jnp.arange(1.0, 6.0), x).ravel()),
        "'sort'.* sorts 10 numbers, but 8 at most",
    ),
    "an endless loop": (
        lambda x: lax.while_loop(lambda c: c[0] >= 0, lambda c: (c[0] * 1, 0.5 * c[1]), (0, x))[1],
        "not ended after",
    ),
    "infinity": (lambda x: x + jnp.inf, "'add'.* not finite"),
    "the wrong infinity": (lambda x: jnp.maximum(x, jnp.inf), "'max'.* one of its operands is inf"),
    "an angle too far away": (lambda x: jnp.arctan2(x, 1e308), "'atan2'.* has no inverse"),
    "an entry there is not": (lambda x: x + x[2], "'dynamic_slice'.* an index is out of range"),
    "entries there are not, promised": (lambda x: x[jnp.array([0, 2])], "'gather'.* out of range"),
    "division by zero": (lambda x: x / 0.0, "'div'.* divides by zero"),
    "entries set twice": (
        lambda x: jnp.ones(2).at[jnp.array([0, 0])].set(2 * x),
        "'scatter'.* more than once",
    ),
    "angles all around": (lambda x: jnp.arctan2(x, 0.0), "'atan2'.* must not be zero"),
}


@pytest.mark.parametrize("name", REFUSED)
@pytest.mark.costly
def test_what_has_no_bounds_is_named(name):
    function, message = REFUSED[name]
    with pytest.raises(TypeError, match=message):
        network(function)


def turning(x, u):
    return jnp.array([x[0] + 0.1 * u[0], x[1] + 0.1 * jnp.arctan2(x[1], x[0])])


@pytest.mark.costly
def test_angles_have_bounds_in_all_quadrants_but_on_their_cut():
    loop = rj.ClosedLoop(rj.NonlinearPlant(turning, 2, 1), rj.Network(lambda x: -x[:1], 2, 1))
    rng = np.random.default_rng(0)
    for middle in ([1.1, 1.1], [-1.1, 1.1], [-1.1, -1.1], [1.1, -1.1], [0.0, 1.1], [0.0, -1.1]):
        X0 = rj.Box(np.subtract(middle, 0.1), np.add(middle, 0.1))
        for method in ([rj.LinearBounds()], []):
            tube = rj.reach(loop, X0, 1, rj.Template.box(2), *method)
            x = rng.uniform(X0.lower, X0.upper, size=(5000, 2))
            reached = x[:, 1] + 0.1 * np.arctan2(x[:, 1], x[:, 0])
            _, _, high, low = tube.sets[1].b
            assert -low <= reached.min()
            assert high >= reached.max()
            assert high + low - np.ptp(reached) <= 0.02  # of 0.2 and more
    with pytest.raises(UnboundedError, match=r"arctan2\(y, x\) \(in turning.*jump by 2 pi"):
        rj.reach(loop, rj.Box([-1.2, -0.1], [-1.0, 0.1]), 1, rj.Template.box(2))


def test_the_tangent_of_an_angle_is_told_from_the_angle():
    f = lambda x, u: x + 0.1 * jnp.arctan(x[1] / x[0]) + u  # noqa: E731
    loop = rj.ClosedLoop(rj.NonlinearPlant(f, 2, 1), rj.Network(lambda x: -x[:1], 2, 1))
    with pytest.raises(UnboundedError, match=r"inputs in .*away from zero .*arctan2\(y, x\)"):
        rj.reach(loop, rj.Box([-0.1, 1.0], [0.1, 2.0]), 1, rj.Template.box(2))


@pytest.mark.costly
def test_what_is_recorded_does_not_depend_on_numbers_of_parameters():
    def largest(p):
        f = Partial(lambda p, x: jax.nn.relu(x - 0.1) - jax.nn.relu(p * x**2), p)
        loop = rj.ClosedLoop(rj.AffinePlant([[1.0]], [[0.1]]), rj.Network(f, 1, 1))
        tube = rj.reach(loop, rj.Box([-1.0], [1.0]), 2, rj.Template.box(1), rj.LinearBounds())
        return tube.sets[2].b.sum()

    p, step = jnp.array(2.0), 1e-3
    difference = (largest(p + step) - largest(p - step)) / (2 * step)
    np.testing.assert_allclose(jax.grad(largest)(p), difference, rtol=1e-5)


def test_results_are_real_numbers_and_parameters_finite():
    with pytest.raises(ValueError, match=r"Network\.f must return real numbers, but bool arrived"):
        rj.Network(lambda x: x > 0, 2, 2)
    with pytest.raises(ValueError, match=r"must not branch on values.*use jnp\.where"):
        rj.Network(branching, 2, 2)
    with pytest.raises(ValueError, match=r"must be finite, but entry \(1,\) of array 0 is nan"):
        rj.Network(Partial(lambda p, x: p * x, jnp.array([1.0, jnp.nan])), 2, 2)


def test_a_root_of_what_rounding_takes_below_zero_is_zero():
    f = lambda x: jnp.where(x <= 0.3, -jnp.sqrt(abs(x - 0.3)), jnp.sqrt(abs(0.3 - x)))  # noqa: E731
    loop = rj.ClosedLoop(rj.AffinePlant([[0.0]], [[1.0]]), rj.Network(f, 1, 1))
    tube = rj.reach(loop, rj.Box([0.80227], [0.80327]), 1, rj.Template.box(1))
    assert np.isfinite(tube.proof(1).gaps).all()


def test_a_traced_divisor_without_an_inverse_leaves_nothing_known():
    @jax.jit
    def upper(p):
        net = rj.Network(Partial(lambda p, x: (x * 1e300) / p, p), 1, 1)
        loop = rj.ClosedLoop(rj.AffinePlant([[0.0]], [[1.0]]), net)
        tube = rj.reach(loop, rj.Box([1.0], [2.0]), 1, rj.Template.box(1), rj.LinearBounds())
        return tube.sets[1].b

    assert np.isnan(upper(1e308)).all()
    assert upper(1e200)[0] >= 2e100
