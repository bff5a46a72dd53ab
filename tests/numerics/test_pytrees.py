"""Claims about the immutable dataclasses: users' objects are checked, JAX's are not."""

import dataclasses
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.numerics.checks import Numbers
from reachjax.numerics.pytrees import Replaceable, converted, pytree, static
from tests.networks import he_network


@pytree
class Interval(Replaceable):
    """A checked object with every kind of field."""

    lower: jax.Array = converted(converter=Numbers("(n,)"))
    upper: jax.Array = converted(converter=Numbers("(n,)"), default=None)
    label: str = static(default="interval")

    def __post_init__(self):
        if self.upper is None:
            self._set(upper=self.lower)
        if self.lower.shape != self.upper.shape:
            raise ValueError("shapes differ")


class OtherReLU(rj.ReLU):
    """The same function in another class: another structure."""


def network(seed, activation=rj.ReLU()):  # noqa: B008  (immutable)
    return rj.MLP.from_layers(he_network((2, 4, 1), seed), activation=activation)


def test_a_constructor_converts_and_then_checks():
    interval = Interval([1, 2])
    assert interval.lower.dtype == jnp.float64
    np.testing.assert_array_equal(interval.upper, [1.0, 2.0])
    with pytest.raises(ValueError, match="shapes differ"):
        Interval([1, 2], [3])


def test_conversion_errors_name_the_class_and_the_field():
    with pytest.raises(ValueError, match=r"Interval\.upper must be finite, but entry \(1,\)"):
        Interval([0, 0], [1, np.nan])


def test_replace_checks_again_and_leaves_the_original_alone():
    interval = Interval([1.0, 2.0], label="first")
    other = interval.replace(upper=[5, 6])
    np.testing.assert_array_equal(other.upper, [5.0, 6.0])
    assert other.label == "first"
    np.testing.assert_array_equal(interval.upper, [1.0, 2.0])
    with pytest.raises(ValueError, match="shapes differ"):
        interval.replace(upper=[1.0])
    with pytest.raises(TypeError, match="uper"):
        interval.replace(uper=[1.0, 2.0])


def test_fields_cannot_be_assigned():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Interval([1.0]).lower = jnp.zeros(1)


@pytest.mark.parametrize("leaf", [None, "a word", object()], ids=["None", "str", "object"])
def test_jax_may_put_anything_in_place_of_a_leaf(leaf):
    for tree in (Interval([1.0]), network(0), rj.Box([0.0], [1.0]), rj.Template.box(2)):
        rebuilt = jax.tree.map(lambda _: leaf, tree)
        assert type(rebuilt) is type(tree)
        assert all(each is leaf for each in jax.tree.leaves(rebuilt))


def test_leaves_are_the_fields_that_are_not_static_under_their_names():
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree.leaves_with_path(Interval([1.0]))]
    assert paths == [".lower", ".upper"]
    restored = jax.tree.map(lambda leaf: leaf + 1, Interval([1.0], label="kept"))
    assert restored.label == "kept"
    np.testing.assert_array_equal(restored.upper, [2.0])


def test_stacked_networks_are_mapped_over():
    nets = [network(seed) for seed in range(3)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *nets)
    x = jnp.array([0.3, -0.7])
    outputs = jax.vmap(lambda net: net(x))(stacked)
    np.testing.assert_allclose(outputs, [net(x) for net in nets], rtol=1e-14)
    assert len(np.unique(outputs)) == 3


def test_networks_are_built_by_a_mapped_function():
    weights = jax.vmap(lambda s: network(0).replace(layers=[(s * jnp.ones((1, 2)), s[None])]))(
        jnp.arange(1.0, 4.0)
    )
    assert weights.layers[0][0].shape == (3, 1, 2)


def test_a_gradient_has_the_structure_of_the_network():
    net = network(0)
    gradient = jax.grad(lambda net: net(jnp.ones(2))[0])(net)
    assert jax.tree.structure(gradient) == jax.tree.structure(net)
    np.testing.assert_array_equal(gradient.layers[-1][1], [1.0])


def counted(function):
    """The function compiled, and the list that grows each time it is traced."""
    traces = []

    def traced(*arguments):
        traces.append(arguments)
        return function(*arguments)

    return jax.jit(traced), traces


def test_new_weights_compile_once_and_a_new_activation_compiles_anew():
    apply, traces = counted(lambda net, x: net(x))
    outputs = [apply(network(seed), jnp.ones(2)) for seed in range(3)]
    assert len(traces) == 1
    assert len(np.unique(outputs)) == 3
    apply(network(0, rj.ReLU()), jnp.ones(2))
    assert len(traces) == 1
    apply(network(0, OtherReLU()), jnp.ones(2))
    assert len(traces) == 2


def test_new_loops_compile_once():
    def loop(seed):
        plant = rj.AffinePlant(seed * jnp.eye(2), jnp.ones((2, 1)))
        return rj.ClosedLoop(plant, network(seed), rj.Box([-1.0 - seed], [1.0 + seed]))

    step, traces = counted(lambda loop, x: loop.step(x))
    states = [step(loop(seed), jnp.ones(2)) for seed in range(1, 4)]
    np.testing.assert_allclose(states, [loop(s).step(jnp.ones(2)) for s in range(1, 4)])
    assert len(traces) == 1
    step(loop(1).replace(input_box=None), jnp.ones(2))
    assert len(traces) == 2


def test_what_is_kept_beside_the_fields_is_not_sent():
    box = rj.Box([0.0], [1.0])
    object.__setattr__(box, "_kept", lambda: None)  # as recordings of functions are
    again = pickle.loads(pickle.dumps(box))
    assert not hasattr(again, "_kept")
    assert (again.lower, again.upper) == (box.lower, box.upper)
