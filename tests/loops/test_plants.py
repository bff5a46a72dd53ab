"""Claims about affine plants: any of the three arrays may vary in time."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.networks import plant

STEPS = 4


@pytest.mark.parametrize("varying", list(product([False, True], repeat=3)), ids=str)
@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_each_array_may_vary_in_time_on_its_own(n, varying):
    constant, moving = plant(n, 2, seed=n), plant(n, 2, seed=n, steps=STEPS)
    arrays = [moving[i] if v else constant[i] for i, v in enumerate(varying)]
    system = rj.AffinePlant(*arrays)
    assert (system.states, system.inputs) == (n, 2)
    assert system.steps == (STEPS if any(varying) else None)
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=n), rng.normal(size=2)
    successor = jax.jit(system.propagate)
    for t in range(STEPS):
        A, B, c = (a[t] if v else a for a, v in zip(arrays, varying, strict=True))
        np.testing.assert_array_equal(system.at(t)[0], A)
        np.testing.assert_array_equal(system.at(t)[1], B)
        np.testing.assert_array_equal(system.at(t)[2], c)
        expected = A @ x + B @ u + c
        np.testing.assert_allclose(system.propagate(x, u, t), expected, rtol=0, atol=1e-14)
        np.testing.assert_allclose(successor(x, u, t), expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("lead", [(), (STEPS,)], ids=["LTI", "LTV"])
def test_the_offset_is_zero_when_left_out(lead):
    system = rj.AffinePlant(np.ones((*lead, 3, 3)), np.ones((*lead, 3, 1)))
    np.testing.assert_array_equal(system.c, np.zeros(3))
    np.testing.assert_allclose(system.propagate(jnp.ones(3), jnp.ones(1), 1), 4.0)


PAIR = (0.9 * np.eye(2), 1.1 * np.eye(2))
TUPLES = {
    "A": lambda: rj.AffinePlant(PAIR, np.ones((2, 1))),
    "B": lambda: rj.AffinePlant(np.eye(2), [jnp.ones((2, 1)), jnp.zeros((2, 1))]),
    "c": lambda: rj.AffinePlant(np.eye(2), np.ones((2, 1)), (np.zeros(2), np.ones(2))),
}


@pytest.mark.parametrize("name", TUPLES)
def test_a_tuple_of_matrices_is_neither_read_as_times_nor_as_an_interval(name):
    both_ways = "for a plant that varies in time give one array .* needs a disturbance"
    with pytest.raises(TypeError, match=rf"AffinePlant\.{name} must be one array .* {both_ways}"):
        TUPLES[name]()


def test_a_tuple_of_nested_lists_is_refused_too():
    with pytest.raises(TypeError, match="needs a disturbance"):
        rj.AffinePlant(([[0.9]], [[1.1]]), [[1.0]])  # type: ignore[arg-type]
    assert rj.AffinePlant(((1.0, 0.0), (0.0, 1.0)), ((1.0,), (0.0,))).steps is None


def test_lists_of_numbers_and_of_rows_are_matrices():
    rows = rj.AffinePlant([np.ones(2), jnp.zeros(2)], [[1.0], [2.0]], [np.float64(1.0), 2])
    np.testing.assert_array_equal(rows.A, [[1.0, 1.0], [0.0, 0.0]])
    assert rows.steps is None
    assert rj.AffinePlant([[[1.0, 0.0], [0.0, 1.0]]] * 3, np.ones((2, 1))).steps == 3


def test_integers_become_floats():
    system = rj.AffinePlant([[1, 1], [0, 1]], [[0], [1]], [2, 0])
    assert {a.dtype for a in jax.tree.leaves(system)} == {jnp.dtype("float64")}
