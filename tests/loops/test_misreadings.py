"""Functions and files that look like others: they are read as they are, or refused."""

import contextlib
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from jax.scipy.sparse.linalg import cg
from jax.tree_util import Partial

import reachjax as rj
from reachjax.loops.units.step import Floor
from reachjax.sets.cells import grid
from tests.loops.onnx_models import node, run, saved
from tests.loops.traced import interval

STILL = rj.MLP.from_layers([([[0.0]], [0.0])])
BRAIN = jnp.array([[1.0, 0.3], [-0.7, 0.1]], jnp.bfloat16)
SINGLE = jnp.array([0.1, 0.7], jnp.float32)


def quotients(x):
    """A quotient of counts, of reals and of whole numbers: the second is cut off."""
    a, b = jnp.sum(x > 0), 1 + jnp.sum(x > 1)
    return jnp.stack([a.astype(float) / b.astype(float), jax.lax.div(a, b).astype(float)])


def square_of_eight_bits(x):
    a = 12 * jnp.sum(x > 0, dtype=jnp.int8)
    return jnp.stack([a.astype(float) * a.astype(float), (a * a).astype(float)])


def one_iteration(x):
    """A step towards the solution of equations, which is not it."""
    return cg(jnp.diag(1 + x**2), jnp.ones(2), maxiter=1)[0]


def written(w, x):
    kept = jax.new_ref(w)
    kept[...] = x
    return kept[...]


def chosen_in_few_bits(w, x):
    """A parameter is picked by an input, and computed with in its own bits."""
    return jnp.where(x > 0, w, -w) * w


def weighed_in_few_bits(w, x):
    return jnp.stack([(x > 0).astype(w.dtype) @ w, (x > 1).astype(w.dtype) @ w])


def large_whole_number(x):
    places = 2 * jnp.sum(x > 0) + (2**53 + 1) - 2**53
    return jnp.arange(8.0)[places.astype(jnp.int32)] * x


REFUSED = {
    "parameters picked by an input": Partial(chosen_in_few_bits, SINGLE),
    "truth values in a parameter's bits": Partial(weighed_in_few_bits, SINGLE),
    "a product in a parameter's bits": Partial(
        lambda w, x: jnp.dot(w, x, preferred_element_type=w.dtype) * jnp.ones(2), SINGLE
    ),
    "a whole number that is no float": large_whole_number,
    "an array that is written into": Partial(written, jnp.array([1.0, 2.0])),
    "a quotient of whole numbers beside one of reals": quotients,
    "a product that wraps beside one of reals": square_of_eight_bits,
    "a solver by iterations": one_iteration,
    "an input in a parameter's sixteen bits": Partial(lambda w, x: x.astype(w.dtype) @ w, BRAIN),
    "an input among zeros of a parameter's bits": Partial(
        lambda w, x: jnp.zeros(2, w.dtype).at[:2].set(x) * w, SINGLE
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_read_exactly_is_refused(name):
    with pytest.raises(TypeError):
        rj.Network(REFUSED[name], 2, 2)


def by_precision(w, x):
    return 2 * x + w if w.dtype == jnp.float32 else x + w


def least_difference(w, x):
    return x + w + jnp.finfo(w.dtype).eps


def powers(w, x):
    return x ** (3 if w.dtype == jnp.float32 else 2) + w


def turned(w, x):
    return w - x if w.dtype == jnp.float32 else x - w


def swapped(w, x):
    one, other = (w[0], w[1]) if w.dtype == jnp.float32 else (w[1], w[0])
    return x * one + other


def cut_off(w, x):
    kept = (3.7 * w).astype(int) if w.dtype == jnp.float32 else 3.7 * w
    return x * kept


@pytest.mark.parametrize(
    "function", [by_precision, least_difference, powers, turned, swapped, cut_off]
)
def test_a_function_that_asks_for_a_parameters_precision_is_what_it_computes(function):
    net = rj.Network(Partial(function, SINGLE), 2, 2)
    x = np.array([0.3, -0.4])
    expected = np.asarray(function(SINGLE, x), float)
    low, high = interval(net, x, x)
    assert (low <= expected).all()
    assert (expected <= high).all()
    np.testing.assert_allclose(net(x), expected, rtol=1e-15)


@pytest.mark.parametrize("kind", [jnp.float32, jnp.bfloat16])
def test_a_weak_parameter_takes_the_precision_of_others(kind):
    """As a number of Python's does: JAX makes weak arrays of these."""
    gain = jnp.array(0.3)
    assert gain.weak_type
    function = Partial(lambda g, x: x * (g * kind(0.1)), gain)
    net, x = rj.Network(function, 1, 1), np.ones(1)
    low, high = interval(net, x, x)
    expected = np.asarray(function(x), float)
    assert (low <= expected).all()
    assert (expected <= high).all()


class Gentle(nnx.Module):
    """Two layers of small gain, with what is computed of their outputs."""

    def __init__(self, activation, gain, end=lambda y: y):
        self.first = nnx.Linear(2, 8, rngs=nnx.Rngs(0))
        self.second = nnx.Linear(8, 1, rngs=nnx.Rngs(1))
        for layer in (self.first, self.second):
            layer.kernel[...] = gain * layer.kernel[...]
        self.activation, self.end = activation, end

    def __call__(self, x):
        return self.end(self.second(self.activation(self.first(x))))


@pytest.mark.parametrize(
    ("activation", "gain", "end"),
    [
        (jnp.tanh, 3e-3, lambda y: y),
        (lambda z: nnx.leaky_relu(z, 1e-4), 1.0, lambda y: y),
        (nnx.relu, 1.0, lambda y: 1.0005 * y),
        (nnx.relu, 1.0, lambda y: y + 1e-4),
    ],
)
def test_a_module_is_not_read_as_one_that_is_nearly_the_same(activation, gain, end):
    rj.MLP.from_flax(Gentle(nnx.relu, gain))
    with pytest.raises(ValueError, match="computes something else"):
        rj.MLP.from_flax(Gentle(activation, gain, end))


@pytest.mark.parametrize("jump", ["Round", "Floor", "Ceil"])
def test_weights_that_are_rounded_are_rounded_in_the_files_precision(jump, tmp_path):
    nodes = [node("Div", "w s", "d"), node(jump, "d", "r"), node("Mul", "r s", "q")]
    nodes += [node("MatMul", "x q")]
    w = np.array([[0.35], [0.7], [-0.35]], np.float32)
    path = saved(tmp_path / "net.onnx", nodes, {"w": w, "s": np.float32(0.1)})
    net, x = rj.Network.from_onnx(path), np.array([0.3, -0.4, 1.0], np.float32)
    np.testing.assert_allclose(net(jnp.asarray(x, float)), run(path, x=x[None]), rtol=1e-6)


def test_one_hot_at_places_that_are_no_whole_numbers_is_refused(tmp_path):
    held = {"depth": np.int64(4), "values": np.array([0.0, 1.0], np.float32)}
    path = saved(tmp_path / "net.onnx", [node("OneHot", "x depth values")], held)
    with pytest.raises(ValueError, match="cast them to INT64"):
        rj.Network.from_onnx(path)


def test_nothing_is_said_for_ever_of_a_plant_that_may_depend_on_the_time():
    @jax.tree_util.register_dataclass
    @dataclasses.dataclass(frozen=True)
    class Late(rj.AbstractPlant):
        rate: jax.Array

        @property
        def states(self):
            return 1

        @property
        def inputs(self):
            return 1

        @property
        def steps(self):
            return None

        def propagate(self, x, u, t=0, unit=None, w=None):
            return self.rate * x + 0.0 * u + jnp.where(t >= 600, 10.0, 0.0)

    X0 = rj.Box([-1.0], [1.0])
    tube = rj.reach(rj.ClosedLoop(Late(jnp.array(0.5)), STILL), X0, 3, rj.Template.box(1))
    with pytest.raises(ValueError, match="time"):
        rj.verify(tube, safe=X0, forever=True)


@pytest.mark.parametrize(
    ("function", "low"),
    [
        (lambda x: jnp.where(jnp.isfinite(jnp.log(x)), x, -x), -1.0),
        (lambda x: jnp.where(jnp.isnan(jnp.sqrt(x)), 1.0, 0.0), -1.0),
        (lambda x: jnp.where(jnp.isinf(1 / x), 5.0, 0.0), 0.0),
        (lambda x: jnp.where(jnp.log(x) > -jnp.inf, 0.0, 1.0), -1.0),
        (lambda x: jnp.where(jnp.isfinite(jnp.exp(x)), 0.0, 1.0), 800.0),
        (lambda x: jnp.floor(jnp.arcsin(x) / 4 + 0.5), 1.5),
        (lambda x: 0.0 * jnp.sign(jnp.log(x)) + 1.0, -1.0),
        (lambda x: jnp.hypot(0.0 * jnp.log(x), x), -1.0),
        (lambda x: jnp.where(x > 0, x + 0.0 * jnp.log(x - 5), x), 1.5),
        (lambda x: jnp.where(x > 0, x + jnp.log(x - 5) - jnp.log(x - 5), x), 1.5),
        (lambda x: jnp.where(jnp.isfinite(x * x), 0.0, 1.0), 1e200),
        (lambda x: jnp.where(x * x < jnp.inf, 0.0, 1.0), 1e200),
        (lambda x: (x * x == x * x).astype(float), 1e200),
        (lambda x: jnp.isfinite(jnp.log(x)).astype(int), -1.0),
        (lambda x: jax.nn.softmax(jnp.stack([x[0] + jnp.log(x[0]), jnp.log(x[0])]))[:1], -1.0),
    ],
)
def test_what_rests_on_a_number_says_nothing_where_there_is_none(function, low):
    """Outside of a domain there is no number, whether or not the result is one."""
    net = rj.Network(function, 1, 1)
    loop = rj.ClosedLoop(rj.AffinePlant([[0.0]], [[1.0]]), net)
    around = rj.Box([low - 0.1], [low + 0.1 * max(1.0, low)])
    with pytest.raises((ValueError, ArithmeticError)):
        rj.reach(loop, around, 1, rj.Template.box(1), rj.LinearBounds())
    with contextlib.suppress(ValueError):
        assert not rj.decide(loop, around, 1, goal=rj.Box([-1e3], [1e3]), cells=4).proved


def frozen(x):
    """The solution for another matrix, as a solver that has its factors gives it."""
    factor = jax.scipy.linalg.cho_factor(4 * jnp.eye(2))
    return jax.lax.custom_linear_solve(
        lambda v: jnp.diag(1 + x**2) @ v,
        jnp.ones(2),
        lambda mv, b: jax.scipy.linalg.cho_solve(factor, b),
    )


def frozen_of_known(x):
    factor = jax.scipy.linalg.lu_factor(4 * jnp.eye(2))
    return jax.lax.custom_linear_solve(
        lambda v: jnp.diag(jnp.arange(1.0, 3.0)) @ v,
        x,
        lambda mv, b: jax.scipy.linalg.lu_solve(factor, b),
    )


def frozen_of_roots(x):
    factor = jax.scipy.linalg.cho_factor(jnp.diag(2 + x**2))
    return jax.lax.custom_linear_solve(
        lambda v: jnp.diag(1 + x**2) @ v,
        jnp.ones(2),
        lambda mv, b: jax.scipy.linalg.cho_solve(factor, b),
        symmetric=True,
    )


def frozen_at_twice_the_roots(x):
    A = jnp.diag(1 + x**2)
    factor = jnp.linalg.cholesky(A)
    return jax.lax.custom_linear_solve(
        lambda v: A @ v,
        jnp.ones(2),
        lambda mv, b: jax.scipy.linalg.cho_solve((2 * factor, True), b),
        symmetric=True,
    )


SPREAD = jnp.array([[2.0, 0.3], [-0.1, 1.5]])


@pytest.mark.parametrize(
    "function",
    [
        lambda x: jnp.linalg.solve(SPREAD, x),
        lambda x: jnp.linalg.solve(SPREAD + jnp.outer(x, x), x),
        lambda x: jnp.linalg.inv(SPREAD + jnp.diag(x**2)) @ x,
        jax.grad(lambda x: x @ jnp.linalg.solve(SPREAD, x)),
        lambda x: jax.scipy.linalg.solve(jnp.diag(1 + x**2), x, assume_a="pos"),
        lambda x: jax.scipy.linalg.solve(SPREAD @ SPREAD.T, x, assume_a="pos", lower=True),
        lambda x: jax.scipy.linalg.solve(SPREAD + jnp.diag(x**2), x, assume_a="pos"),
    ],
)
def test_jaxs_own_solvers_are_read(function):
    net, x = rj.Network(function, 2, 2), np.array([0.3, -0.4])
    low, high = interval(net, x, x)
    assert (low - 1e-9 <= function(x)).all()
    assert (function(x) <= high + 1e-9).all()


@pytest.mark.parametrize(
    "function", [frozen, frozen_of_known, frozen_of_roots, frozen_at_twice_the_roots]
)
def test_solvers_by_factors_of_another_matrix_are_refused(function):
    with pytest.raises(TypeError, match=r"jnp\.linalg\.solve"):
        rj.Network(function, 2, 2)


def test_rectifiers_of_numbers_whose_width_overflows_are_not_zero():
    for unit in (rj.ReLU(), rj.LeakyReLU(0.1)):
        lines = unit.lines(np.array([-1.5e308, -1e300]), np.array([1.5e308, 1e-9]))
        assert not lines.affine.any()
        ends = lines.above.slope * np.array([1.5e308, 1e-9]) + lines.above.offset
        assert (ends >= np.array([1.5e308, 1e-9])).all()


def test_the_nearest_whole_number_away_from_zero_is_within_its_bounds():
    unit = Floor(0.5, even=False)
    y = np.array([-0.49999999999999994, 0.49999999999999994, -(2.0**52) - 1, 0.5, -0.5, 2.5])
    found = unit(y)
    assert found.tolist() == [0, 0, -(2.0**52) - 1, 1, -1, 3]
    low, high = unit.interval(y, y)
    assert ((low <= found) & (found <= high)).all()


def test_numbers_that_compiled_code_takes_for_zero_are_not_lost():
    tiny = 1e-310
    assert float(rj.Box([0.0], [tiny]).support([[1.0]])[0]) >= tiny
    assert float(rj.Box([0.0], [1e308]).support([[tiny]])[0]) >= tiny * 1e308
    cells = grid(rj.Box([-tiny], [10 * tiny]), (2,))
    assert min(float(np.asarray(cell.part.lower)[0]) for cell in cells) == -tiny
    loop = rj.ClosedLoop(rj.AffinePlant([[0.0]], [[0.0]]), STILL)
    below, start = rj.Box([-1.0], [0.0]), rj.Box([0.0], [tiny])
    assert not rj.decide(loop, start, 1, safe=below).proved


TURN = 2 * np.pi
TURNING = {
    "question": lambda y: jnp.where(jnp.isfinite(jnp.log(y + 0.5)), 1.0, 0.0),
    "quotient": lambda y: jnp.exp(-2000 * y) / (1 + jnp.exp(-2000 * y)),
    "logarithm": lambda y: jnp.log(1 + jnp.exp(-2000 * y)),
    "multiple": lambda y: 0.0 * jnp.sqrt(y + 0.5),
}


@pytest.mark.parametrize("name", TURNING)
def test_an_equation_is_not_one_where_its_domain_is_left_in_between_samples(name):
    """States go round in a period: at samples they are where the function is a number."""

    def turned(x, u):
        return jnp.stack([TURN * x[1], -TURN * x[0], TURNING[name](x[0]) + 0 * u[0]])

    def bounds(radius):
        box = rj.Box([radius, -1e-3, 0.0], [radius + 1e-3, 1e-3, 0.0])
        return rj.reach(loop, box, 1, rj.Template.box(3), rj.LinearBounds()).spans[0].b

    net = rj.MLP.from_layers([([[0.0] * 3], [0.0])])
    loop = rj.ClosedLoop(rj.SampledPlant(turned, 3, 1, 1.0), net)
    with pytest.raises(ValueError, match=r"no bounds|overflow"):
        bounds(0.9)
    assert np.isfinite(bounds(0.01)).all()


def test_a_constant_of_a_transformation_is_no_obstacle():
    """What is traced around the function is a number of it."""

    def value(s):
        net = rj.Network(Partial(lambda w, x: s * x + w, SINGLE), 2, 2)
        return net(jnp.array([1.0, 2.0])).sum()

    assert float(jax.grad(value)(2.0)) == 3.0
