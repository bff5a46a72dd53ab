"""Numbers of the exact reader: fractions and truth values, at several points at once."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np


class UnreadError(Exception):
    """That the reader knows no rule for a primitive."""


class UndefinedError(Exception):
    """That a function has no value at a point."""


class DisagreeError(Exception):
    """That points go different ways, so that they have to be read one by one."""


class Varying:
    """Numbers that depend on the point.

    Args:
        numbers: `(size, points)` fractions or truth values.
        shape: of the array that they are at one point.
    """

    def __init__(self, numbers: np.ndarray, shape: Sequence[int]):
        self.shape = tuple(shape)
        self.numbers = numbers.reshape(-1, numbers.shape[-1])

    @property
    def array(self) -> np.ndarray:
        """The numbers as `(*shape, points)`."""
        return self.numbers.reshape(*self.shape, -1)


def fractions(plain: Any) -> np.ndarray:
    """The entries of an array as they are: fractions, truth values, and infinities.

    Example:
        >>> fractions(np.float32([0.5, 2.0])).tolist()
        [Fraction(1, 2), Fraction(2, 1)]
    """
    plain = np.asarray(plain)
    if plain.dtype != bool and not np.issubdtype(plain.dtype, np.integer):
        plain = plain.astype(float)  # those of fewer bits are all floats of 64
    made = np.empty(plain.shape, object)
    for where, value in np.ndenumerate(plain):
        is_number = plain.dtype != bool and np.isfinite(value)
        made[where] = Fraction(value.item()) if is_number else value.item()
    return made
