"""What values are affine combinations of, however these were written: `y - mean(y)`, say.

Numbers that know each other, such as one and the norm that it is divided by, are found by that.
Factors are computed in floats, with bounds of what these are off by: what is recorded of them may
be off by a few roundings, and what is decided by them must not depend on any.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from reachjax.loops.tracing.recording import Recorder
from reachjax.loops.tracing.values import Value
from reachjax.numerics.numbers import AbstractNumber
from reachjax.numerics.rounding import TINY, UNIT

LARGEST = 4096
"""Values of more entries are not looked into: matrices between them would fill memory."""


Made = Callable[[np.ndarray, np.ndarray], np.ndarray]

NEAR = 3 * UNIT
"""What recorded factors are off by at most, of the eight roundings that `gamma` has to spare."""


class InexactError(Exception):
    """Rounding of factors would decide what is recorded."""


class Combination(AbstractNumber):
    """`offset + sum_p matrix_p value_p`, `k` numbers over values by their places: a kind.

    Attributes:
        parts: the matrices `(k, size of the value)`.
        offset: `(k,)`.
        errors: what matrices are off by at most, entry by entry, and, at `None`, the offset; those
            that are left out are exact.
    """

    def __init__(
        self,
        parts: dict[int, np.ndarray],
        offset: Float[np.ndarray, " k"],
        errors: dict[int | None, np.ndarray] | None = None,
    ):
        self.parts, self.offset = parts, offset
        self.errors = {place: error for place, error in (errors or {}).items() if np.any(error)}

    def __len__(self) -> int:
        return len(self.offset)

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
        zeros = {**parts, None: np.zeros(1)}
        errors = {
            place: np.concatenate(
                [
                    each.errors.get(place, np.zeros((len(each.offset), *zeros[place].shape[1:])))
                    for each in rows
                ]
            )
            for place in {place for each in rows for place in each.errors}
        }
        return cls(parts, np.concatenate([each.offset for each in rows]), errors)

    def require_near(self) -> None:
        """Raise an error if a factor is off by more than a few roundings of its own.

        Raises:
            InexactError: one is.
        """
        for place, error in self.errors.items():
            found = self.offset if place is None else self.parts[place]
            if np.any(error > NEAR * abs(found)):
                raise InexactError

    def recorded(self, recorder: Recorder, shape: tuple[int, ...]) -> Any:
        """The numbers, made anew: a value; plain ones if they are constant.

        One that is not exact is made of no sum, so that nobody takes its factors to be so.

        Raises:
            InexactError: they would be others, by rounding.
        """
        self.require_near()
        found: Any = None
        for place, matrix in self.parts.items():
            if not np.any(matrix):  # what is no number is none times zero either
                recorder.require(recorder.values[place], sums=True)
                continue
            if place in self.errors:  # products take factors of one to be exact
                rounded = (abs(matrix) == 1) & (self.errors[place] > 0)
                matrix = np.where(rounded, matrix * (1 - UNIT), matrix)
            part = _product(recorder, matrix, recorder.values[place], shape)
            found = part if found is None else recorder.added(found, part)
        offset = self.offset.reshape(shape)
        if found is None:
            if self.errors:
                raise InexactError
            return offset
        found = recorder.shifted(found, offset) if np.any(offset) else found
        if not self.errors:
            return found
        error = self.errors.get(None, np.zeros(len(self.offset)))
        return recorder.loosened(found, np.broadcast_to(error, self.offset.shape))

    def _with(self, other: Combination, sign: float) -> Combination:
        parts, errors = dict(self.parts), dict(self.errors)
        for place, error in other.errors.items():
            errors[place] = errors.get(place, 0.0) + error
        for place, matrix in other.parts.items():
            if place in parts:
                parts[place], error = _sum(parts[place], sign * matrix)
                errors[place] = errors.get(place, 0.0) + error
            else:
                parts[place] = sign * matrix
        offset, error = _sum(self.offset, sign * other.offset)
        errors[None] = errors.get(None, 0.0) + error
        return Combination(parts, offset, errors)

    def __add__(self, other: Any) -> Combination:
        if not isinstance(other, Combination):
            plain = np.broadcast_to(np.asarray(other, float), self.offset.shape)
            other = Combination({}, plain)
        return self._with(other, 1.0)

    def __neg__(self) -> Combination:
        return -1.0 * self

    def __sub__(self, other: Any) -> Combination:
        return self._with(other, -1.0) if isinstance(other, Combination) else self + (-other)

    def __rmul__(self, factor: Any) -> Combination:
        factor = np.broadcast_to(np.asarray(factor, float), self.offset.shape)
        return self._scaled(lambda y, by: y * by, _product_error, factor, abs(factor))

    def widened(self, by: Any) -> Combination:
        """The numbers with an offset that is off by so much more."""
        errors = {**self.errors, None: self.errors.get(None, 0.0) + by}
        return Combination(self.parts, self.offset, errors)

    def over(self, divisor: Any, inverse: Any = None) -> Combination:
        """Quotients by plain numbers."""
        divisor = np.broadcast_to(np.asarray(divisor, float), self.offset.shape)
        return self._scaled(lambda y, by: y / by, _quotient_error, divisor, 1 / abs(divisor))

    def _scaled(self, made: Made, off: Made, by: np.ndarray, size: np.ndarray) -> Combination:
        """Each number times or over one, with what is off by it; errors grow with its size."""
        parts = {place: made(matrix, by[:, None]) for place, matrix in self.parts.items()}
        given: dict[int | None, np.ndarray] = {**self.parts, None: self.offset[:, None]}
        errors = {place: off(matrix, by[:, None]) for place, matrix in given.items()}
        for place, error in self.errors.items():
            grown = size.reshape(-1, *[1] * (error.ndim - 1)) * error
            errors[place] = errors[place] + grown.reshape(len(size), -1)
        errors[None] = errors[None][:, 0]
        return Combination(parts, made(self.offset, by), errors)

    def __rmatmul__(self, matrix: Any) -> Combination:
        matrix = np.asarray(matrix, float)
        parts = {place: matrix @ part for place, part in self.parts.items()}
        given: dict[int | None, np.ndarray] = {**self.parts, None: self.offset}
        errors = {
            place: _rounding(matrix, part) + abs(matrix) @ self.errors.get(place, 0.0 * part)
            for place, part in given.items()
        }
        return Combination(parts, matrix @ self.offset, errors)

    def __getitem__(self, index: Any) -> Combination:
        parts = {place: matrix[index] for place, matrix in self.parts.items()}
        errors = {place: error[index] for place, error in self.errors.items()}
        return Combination(parts, self.offset[index], errors)


def _sum(one: Any, other: Any) -> tuple[Any, Any]:
    """A sum, and what it is off by, which is a float (Knuth's TwoSum)."""
    total = one + other
    added = total - one
    return total, abs((one - (total - added)) + (other - added))


def _halves(number: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two floats of half as many digits whose sum a number is (Veltkamp)."""
    large = (2.0**27 + 1) * number
    high = large - (large - number)
    return high, number - high


def _product_error(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """What a product is off by, which is a float unless that is out of range (Dekker)."""
    product = one * other
    (high, low), (more, less) = _halves(one), _halves(other)
    error = abs(((high * more - product) + high * less + low * more) + low * less)
    is_normal = np.isfinite(error) & ((abs(product) > TINY / UNIT**3) | (one == 0) | (other == 0))
    return np.where(is_normal, error, UNIT * abs(product) + TINY)


def _quotient_error(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """What a quotient is off by at most; nothing if its product with the divisor is exact."""
    quotient = one / other
    exact = (quotient * other == one) & (_product_error(quotient, other) == 0)
    return np.where(exact, 0.0, UNIT * abs(quotient) + TINY * (quotient != 0))


def _is_power(factor: np.ndarray) -> np.ndarray:
    """Whether numbers are powers of two, or zero: their products are exact."""
    return np.isin(abs(np.frexp(factor)[0]), (0.0, 0.5))


def _rounding(matrix: np.ndarray, part: np.ndarray) -> np.ndarray:
    """What a product of matrices is off by at most; nothing where it only moves entries."""
    is_exact = np.all(_is_power(matrix)) or np.all(_is_power(part))
    terms = (matrix != 0).astype(float) @ (part != 0)
    roundings = np.maximum(terms - 1, 0) + (0 if is_exact else 1)
    return roundings * UNIT * (1 + UNIT * (terms + 2)) * (abs(matrix) @ abs(part))


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
