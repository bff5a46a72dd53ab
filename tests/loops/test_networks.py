"""Claims about networks: the forward pass, and what is read from flax."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen, nnx
from flax.core import freeze

import reachjax as rj
from tests.networks import controller, he_network


@pytest.mark.parametrize("hidden", [(), (4,), (5, 3), (4, 4, 4, 4)], ids=str)
@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_a_network_maps_as_an_independent_loop_over_its_layers_does(n, hidden):
    layers = he_network((n, *hidden, 2), seed=n)
    net = rj.MLP.from_layers(layers, activation=rj.ReLU())
    assert (net.inputs, net.outputs, len(net.layers)) == (n, 2, len(hidden) + 1)
    x = np.random.default_rng(0).normal(size=(50, n))
    np.testing.assert_allclose(jax.vmap(net)(x), controller(layers, x), rtol=0, atol=1e-13)


def test_propagate_hands_every_layer_but_the_last_to_the_unit():
    net = rj.MLP.from_layers(he_network((2, 4, 3, 1), seed=0))
    seen = []

    def unit(activation, y):
        seen.append((activation, y.shape))
        return y

    y = net.propagate(jnp.ones(2), unit)
    assert seen == [(rj.ReLU(), (4,)), (rj.ReLU(), (3,))]
    (W0, b0), (W1, b1), (W2, b2) = net.layers
    np.testing.assert_allclose(y, W2 @ (W1 @ (W0 @ jnp.ones(2) + b0) + b1) + b2)


def linear(inputs, outputs, **options):
    return nnx.Linear(inputs, outputs, rngs=nnx.Rngs(inputs + 10 * outputs), **options)


class Attributes(nnx.Module):
    """Layers as attributes whose names are not in alphabetical order."""

    def __init__(self):
        self.start, self.middle, self.end = linear(3, 3), linear(3, 3), linear(3, 3)

    def __call__(self, x):
        return self.end(nnx.relu(self.middle(nnx.relu(self.start(x)))))


class Listed(nnx.Module):
    """A list of hidden layers, more than ten, and an output layer."""

    def __init__(self):
        self.hidden = nnx.List([linear(3, 3) for _ in range(12)])
        self.output = linear(3, 2)

    def __call__(self, x):
        for layer in self.hidden:
            x = nnx.relu(layer(x))
        return self.output(x)


class Nested(nnx.Module):
    """A network inside a module."""

    def __init__(self):
        self.body, self.head = Listed(), linear(2, 1)

    def __call__(self, x):
        return self.head(nnx.relu(self.body(x)))


NNX = {
    "one layer": lambda: linear(3, 2),
    "sequential": lambda: nnx.Sequential(linear(3, 5), nnx.relu, linear(5, 2)),
    "without biases": lambda: nnx.Sequential(
        linear(3, 5, use_bias=False), nnx.relu, linear(5, 2, use_bias=False)
    ),
    "attributes": Attributes,
    "a list": Listed,
    "nested": Nested,
}


def with_biases(module):
    """Biases start at zero, which would hide one that is lost."""
    leaves = jax.tree.leaves_with_path(nnx.state(module, nnx.Param))
    keys = jax.random.split(jax.random.key(0), len(leaves))
    drawn = iter([jax.random.normal(k, v.shape) for k, (_, v) in zip(keys, leaves, strict=True)])
    nnx.update(module, jax.tree.map(lambda _: next(drawn), nnx.state(module, nnx.Param)))
    return module


@pytest.mark.parametrize("build", NNX.values(), ids=NNX.keys())
@pytest.mark.costly
def test_a_network_from_an_nnx_module_maps_as_the_module_does(build):
    module = with_biases(build())
    x = jax.random.normal(jax.random.key(1), (20, 3))
    expected = module(x)
    assert float(jnp.abs(expected).max()) > 1e-3
    # flax computes in 32 bits here
    np.testing.assert_allclose(jax.vmap(rj.MLP.from_flax(module))(x), expected, rtol=1e-4)


class Unsorted(nnx.Module):
    """Layers of one shape, last in the alphabet first; nnx sorts attributes when it rebuilds."""

    def __init__(self):
        self.hidden, self.head = linear(3, 3), linear(3, 3, use_bias=False)

    def __call__(self, x):
        return self.head(nnx.relu(self.hidden(x)))


def test_a_module_that_nnx_rebuilt_keeps_its_order_or_is_refused():
    module = with_biases(Unsorted())
    x = jnp.ones(3)
    try:
        net = rj.MLP.from_flax(nnx.merge(*nnx.split(module)))
    except ValueError:
        return
    np.testing.assert_allclose(net(x), module(x), rtol=1e-4)


class Linen(linen.Module):
    """More than ten layers, so that `Dense_10` must not come after `Dense_1`."""

    sizes: tuple = (4,) * 12 + (2,)
    use_bias: bool = True

    @linen.compact
    def __call__(self, x):
        for size in self.sizes[:-1]:
            layer = linen.Dense(size, self.use_bias, bias_init=linen.initializers.normal(1.0))
            x = linen.relu(layer(x))
        return linen.Dense(self.sizes[-1], self.use_bias)(x)


@pytest.mark.parametrize("wrap", [dict, lambda v: v["params"], freeze])
@pytest.mark.parametrize("use_bias", [True, False])
@pytest.mark.costly
def test_a_network_from_linen_parameters_maps_as_the_module_does(use_bias, wrap):
    module = Linen(use_bias=use_bias)
    x = jax.random.normal(jax.random.key(1), (20, 4))
    variables = module.init(jax.random.key(0), x)
    net = rj.MLP.from_flax(wrap(variables), module=module)
    assert len(net.layers) == 13
    np.testing.assert_allclose(jax.vmap(net)(x), module.apply(variables, x), rtol=1e-6, atol=1e-7)


@pytest.mark.costly
def test_linen_parameters_may_be_traced():
    module = Linen(sizes=(4, 2))
    variables = module.init(jax.random.key(0), jnp.ones(3))

    def through(apply):
        return jax.jit(jax.grad(lambda v: jnp.sum(apply(v, jnp.ones(3)))))(variables)

    read = functools.partial(rj.MLP.from_flax, activation=rj.ReLU())
    ours, theirs = through(lambda v, x: read(v)(x)), through(module.apply)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), ours, theirs)


class Around(nnx.Module):
    """Something else between two linear layers that are attributes."""

    def __init__(self, between):
        self.first, self.between, self.second = linear(2, 3), between, linear(3, 1)

    def __call__(self, x):
        return self.second(nnx.relu(self.between(self.first(x))))


UNSUPPORTED_NNX = {
    "scale": lambda rngs: nnx.LayerNorm(3, rngs=rngs),
    "kernel": lambda rngs: nnx.Conv(3, 3, (1,), rngs=rngs),
    "lora_a": lambda rngs: nnx.LoRA(3, 1, 3, rngs=rngs),
    "LoRALinear": lambda rngs: nnx.LoRALinear(3, 3, lora_rank=1, rngs=rngs),
}


@pytest.mark.parametrize("name", UNSUPPORTED_NNX)
def test_an_nnx_module_with_other_parameters_is_refused(name):
    layer = UNSUPPORTED_NNX[name](nnx.Rngs(0))
    with pytest.raises(ValueError, match=r"parameter '.*' in .*not a linear layer"):
        rj.MLP.from_flax(Around(layer))
    with pytest.raises(ValueError, match=r"must alternate nnx\.Linear and ReLU"):
        rj.MLP.from_flax(nnx.Sequential(linear(2, 3), layer, linear(3, 1)))


NOT_RELU = {
    "another activation": lambda: nnx.Sequential(linear(2, 3), nnx.tanh, linear(3, 1)),
    "no activation": lambda: nnx.Sequential(linear(2, 3), linear(3, 1)),
    "one at the end": lambda: nnx.Sequential(linear(2, 3), nnx.relu),
    "one too late": lambda: nnx.Sequential(linear(2, 3), linear(3, 1), nnx.relu),
    "dropout": lambda: nnx.Sequential(linear(2, 3), nnx.Dropout(0.5), linear(3, 1)),
}


@pytest.mark.parametrize("build", NOT_RELU.values(), ids=NOT_RELU.keys())
def test_a_sequential_that_is_no_chain_of_linear_layers_and_relus_is_refused(build):
    with pytest.raises(ValueError, match=r"must alternate nnx\.Linear and ReLU"):
        rj.MLP.from_flax(build())


def test_a_module_that_computes_something_else_than_its_layers_is_refused():
    with pytest.raises(ValueError, match="computes something else than its linear layers"):
        rj.MLP.from_flax(Around(nnx.tanh))


def test_layers_in_a_mapping_are_refused():
    module = Around(nnx.relu)
    module.between = nnx.data({"a": linear(3, 3)})
    with pytest.raises(ValueError, match="in a mapping, which has no order"):
        rj.MLP.from_flax(module)


def test_attributes_are_refused_where_their_order_cannot_be_checked():
    graph, weights = nnx.split(Around(nnx.relu))
    with pytest.raises(ValueError, match=r"whose order is lost inside jit: keep them in nnx\.List"):
        jax.jit(lambda w: rj.MLP.from_flax(nnx.merge(graph, w))(jnp.ones(2)))(weights)


class NestedLinen(linen.Module):
    """The outer layer is constructed first, so linen numbers it 0."""

    @linen.compact
    def __call__(self, x):
        return linen.Dense(2)(linen.relu(linen.Dense(2)(x)))


@pytest.mark.costly
def test_linen_layers_that_chain_in_several_orders_are_refused_without_their_module():
    variables = NestedLinen().init(jax.random.key(0), jnp.ones(2))
    with pytest.raises(ValueError, match=r"chain in more than one order.*pass module="):
        rj.MLP.from_flax(variables, rj.ReLU())
    with pytest.raises(ValueError, match="computes something else than its linear layers"):
        rj.MLP.from_flax(variables, module=NestedLinen())
    assert (
        len(
            rj.MLP.from_flax(
                Linen(sizes=(2, 2)).init(jax.random.key(0), jnp.ones(2)), module=Linen(sizes=(2, 2))
            ).layers
        )
        == 2
    )


@pytest.mark.costly
def test_linen_parameters_need_an_activation_or_their_module():
    class Tanh(linen.Module):
        @linen.compact
        def __call__(self, x):
            hidden = linen.tanh(linen.Dense(3)(x))
            return linen.Dense(1)(hidden)

    variables = Tanh().init(jax.random.key(0), jnp.ones(2))
    with pytest.raises(ValueError, match="do not tell what is between the layers: give"):
        rj.MLP.from_flax(variables)
    with pytest.raises(ValueError, match="computes something else than its linear layers"):
        rj.MLP.from_flax(variables, module=Tanh())
    alone = linen.Dense(1).init(jax.random.key(0), jnp.ones(2))
    assert len(rj.MLP.from_flax({"Dense_0": alone["params"]}).layers) == 1


def test_a_traced_module_is_not_taken_for_a_relu_network():
    class Tanh(nnx.Module):
        def __init__(self):
            self.layers = nnx.List([linear(2, 3), linear(3, 1)])

        def __call__(self, x):
            return self.layers[1](nnx.tanh(self.layers[0](x)))

    graph, weights = nnx.split(Tanh())
    with pytest.raises(ValueError, match=r"cannot be seen where it is traced.*give activation="):
        jax.jit(lambda w: rj.MLP.from_flax(nnx.merge(graph, w))(jnp.ones(2)))(weights)


def test_linen_layers_whose_names_do_not_tell_their_order_are_refused():
    named = {"hidden": {"kernel": np.ones((2, 2))}, "head": {"kernel": np.ones((2, 2))}}
    with pytest.raises(ValueError, match=r"named by one word and a number, .*'head', 'hidden'"):
        rj.MLP.from_flax(named)


def test_a_layer_that_is_used_twice_is_refused():
    shared = linear(3, 3)
    with pytest.raises(ValueError, match="uses one layer more than once"):
        rj.MLP.from_flax(nnx.Sequential(shared, nnx.relu, shared))


KERNEL = np.ones((2, 3))
UNSUPPORTED_LINEN = {
    "a batch norm": ({"BatchNorm_0": {"scale": np.ones(2), "bias": np.ones(2)}}, "'BatchNorm_0'"),
    "a nested module": ({"MLP_0": {"Dense_0": {"kernel": KERNEL}}}, r"it holds \['Dense_0'\]"),
    "a single layer": ({"kernel": KERNEL, "bias": np.ones(3)}, "named by one word and a number"),
    "a bias alone": ({"Dense_0": {"bias": np.ones(3)}}, r"must hold a kernel .*\['bias'\]"),
    "a convolution": ({"Conv_0": {"kernel": np.ones((3, 3, 2, 2))}}, r"W of .*\(outputs, inputs\)"),
    "nothing": ({}, "at least one pair"),
}


@pytest.mark.parametrize(
    ("params", "message"), UNSUPPORTED_LINEN.values(), ids=UNSUPPORTED_LINEN.keys()
)
def test_linen_parameters_of_something_else_are_refused(params, message):
    with pytest.raises(ValueError, match=message):
        rj.MLP.from_flax({"params": params})


@pytest.mark.parametrize("source", [Linen(), nnx.Linear, [KERNEL]], ids=["module", "class", "list"])
def test_what_is_not_flax_at_all_is_refused(source):
    with pytest.raises(TypeError, match="source must be a flax nnx module or the parameters"):
        rj.MLP.from_flax(source)


SATURATING = {
    "relu6": jax.nn.relu6,
    "clipped at 1e5": lambda y: jnp.clip(y, 0.0, 1e5),
    "clipped below": lambda y: jnp.maximum(jnp.maximum(y, -50.0), 0.1 * y),
}


@pytest.mark.parametrize("name", SATURATING)
def test_an_activation_that_differs_far_out_is_another_one(name):
    source = nnx.Sequential(nnx.Linear(1, 2, rngs=nnx.Rngs(0)), SATURATING[name])
    layers = {"Dense_0": {"kernel": np.ones((2, 3)), "bias": np.zeros(3)}}
    layers["Dense_1"] = {"kernel": np.ones((3, 1)), "bias": np.zeros(1)}
    with pytest.raises(ValueError, match="activation must compute what one of"):
        rj.MLP.from_flax({"params": layers}, activation=SATURATING[name])
    source = nnx.Sequential(*source.layers, nnx.Linear(2, 1, rngs=nnx.Rngs(1)))
    with pytest.raises(ValueError, match="must alternate"):
        rj.MLP.from_flax(source)


@pytest.mark.costly
def test_a_module_that_saturates_far_out_is_not_read():
    class Saturating(linen.Module):
        @linen.compact
        def __call__(self, x):
            hidden = linen.Dense(3)(x)
            return linen.Dense(1)(jax.nn.relu6(hidden))

    module = Saturating()
    params = module.init(jax.random.key(0), jnp.ones((1, 2)))
    with pytest.raises(ValueError, match="something else"):
        rj.MLP.from_flax(params, module=module)
