"""Many trajectories at once: points that stand for one another, beside those that do not."""

from unittest.mock import Mock

import jax.numpy as jnp
import numpy as np
import pytest

from reachjax import ReLU
from reachjax.loops.batches import Batch
from reachjax.loops.units import Bilinear

ALIKE = Batch(np.array([[1.0, -2.0], [-3.0, 4.0], [0.5, 0.25]]), np.array([0, 2, 2, 1, 2]))
"""Five points, three of which are one."""

OTHERS = Batch(np.array([[7.0, 8.0], [-9.0, 10.0], [11.0, 0.1]]), np.array([1, 2, 0, 0, 2]))
"""Five points, of which others are one."""

APART = Batch(np.arange(10.0).reshape(5, 2) - 4.0)
"""Five points that differ."""


@pytest.mark.parametrize("second", [ALIKE, OTHERS, APART])
@pytest.mark.parametrize("first", [ALIKE, OTHERS, APART])
def test_two_batches_meet_point_by_point(first, second):
    one, other = first.values, second.values
    product = Batch.evaluated(Bilinear(), first, second)
    np.testing.assert_array_equal((first + second).values, one + other)
    np.testing.assert_array_equal((first - second).values, one - other)
    np.testing.assert_array_equal(product.values, one * other)


@pytest.mark.parametrize("constant", [2.0, np.array([1.0, 2.0]), jnp.array([1.0, 2.0])])
def test_constants_are_taken_at_each_point_and_stay_in_numpy(constant):
    known = np.asarray(constant)
    for found, wanted in (
        (ALIKE + constant, ALIKE.values + known),
        (ALIKE - constant, ALIKE.values - known),
        (constant - ALIKE, known - ALIKE.values),
    ):
        assert type(found.values) is np.ndarray
        np.testing.assert_array_equal(found.values, wanted)


def test_units_are_computed_once_for_points_that_are_one():
    unit = Mock(wraps=ReLU(), idle=lambda values: None)
    found = Batch.evaluated(unit, ALIKE - 0.5)
    np.testing.assert_array_equal(found.values, np.maximum(ALIKE.values - 0.5, 0.0))
    assert [len(*call.args) for call in unit.call_args_list] == [3]
