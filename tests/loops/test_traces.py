"""A network is what its function was when it was given, and says so in every process."""

import pickle
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.loops.traced import interval, network

Partial = jax.tree_util.Partial


class Gain:
    k = 0.5

    def law(self, x):
        return self.k * x


def test_a_changed_attribute_is_seen_by_a_new_network_and_not_by_an_old_one():
    gain = Gain()
    old = network(gain.law)
    gain.k = 2.0
    new = network(gain.law)
    x = jnp.ones(2)
    for net, k in ((old, 0.5), (new, 2.0)):
        np.testing.assert_array_equal(net(x), k)
        np.testing.assert_array_equal(jax.jit(lambda net: net(x))(net), k)
        np.testing.assert_allclose(interval(net, np.ones(2), np.ones(2)), k, rtol=1e-13)


@pytest.mark.parametrize("jitted", [False, True])
def test_arrays_that_change_later_change_nothing(jitted):
    W = np.eye(2)

    def law(x):
        return W @ x

    net = network(jax.jit(law) if jitted else law)
    learned = network(Partial(lambda p, x: p @ x, W))
    W[:] = 5 * np.eye(2)
    for each in (net, learned):
        np.testing.assert_array_equal(each([1.0, 1.0]), 1.0)
        np.testing.assert_allclose(interval(each, np.ones(2), np.ones(2)), 1.0, rtol=1e-13)


def scaled(by):
    return lambda x: by * x


def test_structures_are_those_of_the_same_computation():
    nets = [network(each) for each in (scaled(2.0), lambda y: 2.0 * y, scaled(3.0))]
    first, same, other = (jax.tree.structure(net) for net in nets)
    assert (first, hash(first), str(first)) == (same, hash(same), str(same))
    assert first != other
    assert str(first) != str(other)
    one, again, another = (net.f.described for net in nets)
    assert one == again != another
    closed = [network(lambda x, W=W: W @ x).f.described for W in (np.eye(2), 2 * np.eye(2))]
    assert closed[0] != closed[1]


def test_parameters_are_no_part_of_a_structure_and_compile_nothing_anew():
    compiled = []

    def law(p, x):
        return jnp.tanh(p * x)

    @jax.jit
    def value(net):
        compiled.append(1)
        return net(jnp.ones(2))

    for p in (1.0, 2.0, 3.0):
        np.testing.assert_allclose(value(network(Partial(law, p))), np.tanh(p))
    assert len(compiled) == 1


def described():
    """Of functions with inner functions, choices, loops and constants."""

    def law(p, x):
        y = jax.nn.elu(jax.nn.relu(p) * x) + jnp.arange(2.0)
        return jax.lax.fori_loop(0, 2, lambda i, y: jnp.tanh(y), y)

    return network(Partial(law, 1.5)).f.described


@pytest.mark.costly
def test_a_description_is_the_same_in_another_process():
    script = (
        "import jax; jax.config.update('jax_enable_x64', True);"
        "from tests.loops.test_traces import described; print(described())"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == described()


GAINS = {"k": 2.0}


def law(x):
    return GAINS["k"] * x


def test_a_function_is_sent_to_another_process_unless_it_has_changed():
    net = network(law)
    again = pickle.loads(pickle.dumps(net))
    assert jax.tree.structure(again) == jax.tree.structure(net)
    packed = pickle.dumps(net)
    GAINS["k"] = 3.0
    try:
        np.testing.assert_array_equal(net([1.0, 1.0]), 2.0)
        with pytest.raises(ValueError, match="has changed since"):
            pickle.loads(packed)
    finally:
        GAINS["k"] = 2.0


def test_a_function_that_changes_before_64_bits_are_on_is_noticed():
    gains = {"k": 2.0}
    with jax.enable_x64(False):
        net = network(lambda x: gains["k"] * x)
    assert net(jnp.ones(2)).tolist() == [2.0, 2.0]
    with jax.enable_x64(False):
        other = network(lambda x: gains["k"] * x)
    gains["k"] = 9.0
    assert net(jnp.ones(2)).tolist() == [2.0, 2.0]
    with pytest.raises(ValueError, match="has changed since"):
        other(jnp.ones(2))


@pytest.mark.parametrize("kind", [jax.custom_jvp, jax.custom_vjp])
def test_rules_for_derivatives_are_part_of_a_description(kind):
    def made(slope):
        bent = kind(jnp.tanh)
        if kind is jax.custom_jvp:
            bent.defjvp(lambda x, dx: (jnp.tanh(*x), slope * dx[0]))
        else:
            bent.defvjp(lambda x: (jnp.tanh(x), None), lambda _, dz: (slope * dz,))
        return network(bent).f.described

    assert made(1.0) == made(1.0)
    assert made(1.0) != made(5.0)


def test_traced_numbers_that_are_closed_over_have_no_description_and_yet_derivatives():
    def bound(p):
        net = network(lambda x: p * x)
        with pytest.raises(ValueError, match="closes over traced numbers"):
            _ = net.f.described
        return net(jnp.ones(2)).sum()

    assert jax.grad(bound)(3.0) == 2.0


def test_a_linen_module_without_parameters_is_told_what_to_do():
    from flax import linen

    with pytest.raises(TypeError, match=r"Partial\(module\.apply, params\)"):
        rj.Network(linen.Dense(1), 2, 1)


def test_a_line_in_a_folder_that_is_called_as_a_package_is_a_users(tmp_path):
    folder = tmp_path / "jax"
    folder.mkdir()
    (folder / "laws.py").write_text(
        "import jax.numpy as jnp\ndef law(x):\n    return jnp.linalg.svd(x[None])[1]\n"
    )
    scope: dict = {}
    path = folder / "laws.py"
    exec(compile(path.read_text(), str(path), "exec"), scope)
    with pytest.raises(TypeError, match=r"'svd' \(in law, .*laws\.py:3\)"):
        network(scope["law"])
