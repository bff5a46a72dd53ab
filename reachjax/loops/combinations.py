"""What values are affine combinations of, however these were written: `y - mean(y)`, say.

Numbers that know each other, such as one and the norm that it is divided by, are found by that.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from reachjax.loops.recording import Recorder
from reachjax.loops.values import Value

LARGEST = 4096
"""Values of more entries are not looked into: matrices between them would fill memory."""


class Combination:
    """`offset + sum_p matrix_p value_p`, `k` numbers over values by their places: a kind.

    Attributes:
        parts: the matrices `(k, size of the value)`.
        offset: `(k,)`.
    """

    # numpy arrays on the left leave `array @ combination` and `array - combination` to this class
    __array_ufunc__ = None

    def __init__(self, parts: dict[int, np.ndarray], offset: Float[np.ndarray, " k"]):
        self.parts, self.offset = parts, offset

    @classmethod
    def of(cls, recorder: Recorder, value: Value) -> Combination:
        """A value over others that are not affine in what is before them, by constants."""
        needed, todo = set(), [value.place]
        while todo:
            place = todo.pop()
            step = recorder.steps[place]
            if place not in needed and step is not None and step.linear:
                todo += step.parents
            needed.add(place)
        found: dict[int, Combination] = {}
        for place in sorted(needed):
            step, size = recorder.steps[place], recorder.values[place].size
            if step is None or not step.linear:
                found[place] = cls({place: np.eye(size)}, np.zeros(size))
            else:
                found[place] = step.apply(_no_unit, *(found[parent] for parent in step.parents))
        return found[value.place]

    @classmethod
    def stacked(cls, rows: Sequence[Combination]) -> Combination:
        """Several, one below the other."""
        sizes: dict[int, int] = {}
        for each in rows:
            sizes.update((place, matrix.shape[1]) for place, matrix in each.parts.items())
        parts = {
            place: np.concatenate(
                [each.parts.get(place, np.zeros((len(each.offset), size))) for each in rows]
            )
            for place, size in sizes.items()
        }
        return cls(parts, np.concatenate([each.offset for each in rows]))

    def recorded(self, recorder: Recorder, shape: tuple[int, ...]) -> Any:
        """The numbers, made anew: a value; plain ones if they are constant."""
        found: Any = None
        for place, matrix in self.parts.items():
            if np.any(matrix):
                part = _product(recorder, matrix, recorder.values[place], shape)
                found = part if found is None else recorder.added(found, part)
        offset = self.offset.reshape(shape)
        if found is None:
            return offset
        return recorder.shifted(found, offset) if np.any(offset) else found

    def _with(self, other: Combination, sign: float) -> Combination:
        parts = dict(self.parts)
        for place, matrix in other.parts.items():
            parts[place] = parts.get(place, 0.0) + sign * matrix
        return Combination(parts, self.offset + sign * other.offset)

    def __add__(self, other: Any) -> Combination:
        if isinstance(other, Combination):
            return self._with(other, 1.0)
        return Combination(self.parts, self.offset + np.asarray(other))

    __radd__ = __add__

    def __sub__(self, other: Combination) -> Combination:
        return self._with(other, -1.0)

    def __mul__(self, factor: Any) -> Combination:
        factor = np.broadcast_to(np.asarray(factor, float), self.offset.shape)
        parts = {place: factor[:, None] * matrix for place, matrix in self.parts.items()}
        return Combination(parts, factor * self.offset)

    __rmul__ = __mul__

    def __rmatmul__(self, matrix: Any) -> Combination:
        matrix = np.asarray(matrix, float)
        parts = {place: matrix @ part for place, part in self.parts.items()}
        return Combination(parts, matrix @ self.offset)

    def __getitem__(self, index: Any) -> Combination:
        parts = {place: matrix[index] for place, matrix in self.parts.items()}
        return Combination(parts, self.offset[index])


def _product(recorder: Recorder, matrix: np.ndarray, value: Value, shape: Any) -> Value:
    """A matrix times a value; where it picks one entry for each row, these, times its numbers."""
    index = abs(matrix).argmax(axis=1)
    if np.any((matrix != 0).sum(axis=1) != 1):
        return recorder.mapped(value, matrix, shape)
    factors = matrix[np.arange(len(matrix)), index].reshape(shape)
    picked = recorder.picked(value, index.reshape(shape))
    return picked if np.all(factors == 1) else recorder.scaled(picked, factors)


def _no_unit(*_: Any) -> Any:
    raise AssertionError("affine steps have no units")
