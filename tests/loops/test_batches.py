"""Many trajectories at once: points that stand for one another, beside those that do not."""

import numpy as np
import pytest

from reachjax import ReLU
from reachjax.loops.batches import Batch

ROWS = np.array([0, 2, 2, 1, 2])


@pytest.fixture
def alike() -> Batch:
    """Five points, three of which are one."""
    return Batch(np.array([[1.0, -2.0], [-3.0, 4.0], [0.5, 0.25]]), ROWS)


@pytest.fixture
def apart() -> Batch:
    """Five other points."""
    return Batch(np.arange(10.0).reshape(5, 2) - 4.0)


def test_sums_and_differences_are_those_of_all_points(alike, apart):
    np.testing.assert_array_equal((alike + apart).values, alike.values + apart.values)
    np.testing.assert_array_equal((apart - alike).values, apart.values - alike.values)
    np.testing.assert_array_equal((alike - alike).values, np.zeros((5, 2)))


def test_constants_and_units_keep_points_that_are_one(alike):
    moved = np.array([1.0, 2.0]) - (alike - 3.0)
    np.testing.assert_array_equal(moved.values, np.array([1.0, 2.0]) - (alike.values - 3.0))
    ramp = Batch.evaluated(ReLU(), moved)
    np.testing.assert_array_equal(ramp.values, np.maximum(moved.values, 0.0))
    assert len(ramp._own) == len(alike._own) == 3, "computed once for points that are one"
