"""Inverses of matrices of numbers that vary: minors over a determinant, or pivot by pivot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from reachjax.loops.tracing.limits import ConstantLimits
from reachjax.loops.tracing.recording import Recorder
from reachjax.loops.tracing.rules.entries import (
    ONE,
    Entry,
    Product,
    Scalar,
    as_value,
    entries,
    gathered,
    identity,
    row_of,
    sums,
    varying,
    zeros,
)
from reachjax.loops.tracing.values import UnsupportedError
from reachjax.loops.units import Origin, Reciprocal

SMALL = 3
"""Matrices of more rows are inverted pivot by pivot, where these are known to be of one sign: over
the accelerations of an arm of six links linear bounds were 2.4 to 3 times as wide as what was
sampled by that, and infinite by minors; of three links they were 1.17 times as wide by either."""

POINTS = 2
"""States at which a matrix is looked at."""

SURE = 0.5
"""How far from zero a pivot must be, by its size, where others could be taken."""

SINGULAR = Origin(
    "the inverse of a matrix",
    "divides by a determinant in",
    "keep the matrix away from singular ones",
)
"""What is wrong where a determinant may be zero."""


Block = tuple[tuple[Scalar, ...], ...]


def block_of(matrix: np.ndarray) -> Block:
    """A matrix as what keys of dictionaries are made of."""
    return tuple(map(tuple, matrix))


def inverse(recorder: Recorder, block: Block) -> np.ndarray:
    """The inverse of a matrix without zeros that split it."""
    A, n = _array(block), len(block)
    if n <= SMALL:
        return _adjugate(recorder, A)
    return _eliminated(recorder, A, identity(n), _is_symmetric(recorder, A))


def _is_symmetric(recorder: Recorder, A: np.ndarray) -> bool:
    """Whether a matrix seems to be symmetric, or rests on parameters, of which nothing is known.

    It only chooses pivots, and is seen at some states; so numbers of parameters have no say in it.
    """
    whole = varying(recorder, as_value(recorder, A))
    rng = np.random.default_rng(0)
    for _ in range(POINTS):
        points = [rng.normal(size=each.size) for each in recorder.inputs]
        given = [ConstantLimits(each, each) for each in points]
        found = recorder.run(given, lambda unit, y: y.at(unit), whole)
        low, high = (end.reshape(A.shape) for end in (found.least, found.most))
        if np.any((low > high.T) | (high < low.T)):
            return False
    return True


def _array(rows: Sequence[Sequence[Scalar]]) -> np.ndarray:
    return np.stack([*map(row_of, rows)])


def _eliminated(recorder: Recorder, A: np.ndarray, B: np.ndarray, symmetric: bool) -> np.ndarray:
    """The `X` with `A X = B`, pivot by pivot.

    Of symmetric matrices pivots are on the diagonal, in their order: those of positive definite
    ones, as masses are, are positive. Of others it is the surest one to be of one sign, and minors
    are taken where none is.
    """
    i, j, n, sure = 0, 0, len(A), np.ones((1, 1))
    if not symmetric:
        sure = np.vectorize(lambda each: _sureness(recorder, each), otypes=[float])(A)
        i, j = (int(k) for k in np.unravel_index(np.argmax(sure), A.shape))
    if A[i, j] == 0 or (not symmetric and (n <= SMALL or sure[i, j] < SURE)):
        return _times(recorder, _adjugate(recorder, A), B)
    rows, columns = ([k, *range(k), *range(k + 1, n)] for k in (i, j))
    A, B = A[np.ix_(rows, columns)], B[rows]
    (ratio,) = reciprocals(recorder, [A[0, 0]])
    across, right = (
        _array([sums(recorder, ([Product(1, ratio, each)] for each in row))])
        for row in (A[0, 1:], B[0])
    )
    X = zeros(*B.shape)
    if n > 1:
        rest, others = (
            less(recorder, whole[1:, -each.shape[1] :], A[1:, :1], each)
            for whole, each in ((A, across), (B, right))
        )
        X[1:] = _eliminated(recorder, rest, others, symmetric)
    X[:1] = less(recorder, right, across, X[1:])
    found = np.empty_like(X)
    found[columns] = X
    return found


def _sureness(recorder: Recorder, number: Scalar) -> float:
    """How far from zero a number is, by its size, whatever the inputs are."""
    if isinstance(number, Fraction):
        return math.inf if number else 0.0
    limits = recorder.limits(recorder.values[number.place], ConstantLimits)
    low, high = limits.least[number.number], limits.most[number.number]
    with np.errstate(all="ignore"):
        return float(np.nan_to_num(max(low, -high, 0.0) / max(-low, high)))


def _times(recorder: Recorder, A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """The product `A B`."""
    places = [*np.ndindex(len(A), B.shape[1])]
    rows = ([Product(1, *pair) for pair in zip(A[i], B[:, j], strict=True)] for i, j in places)
    return row_of(sums(recorder, rows)).reshape(len(A), -1)


def less(recorder: Recorder, C: np.ndarray, A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """`C - A B`."""
    rows = (
        [
            Product(1, C.item(i, j), ONE),
            *(Product(-1, *pair) for pair in zip(A[i], B[:, j], strict=True)),
        ]
        for i, j in np.ndindex(*C.shape)
    )
    return row_of(sums(recorder, rows)).reshape(C.shape)


def _adjugate(recorder: Recorder, A: np.ndarray) -> np.ndarray:
    """The inverse of a matrix as that of its minors, over its determinant."""
    n = len(A)
    others = [[*range(k), *range(k + 1, n)] for k in range(n)]
    minors = [[block_of(A[np.ix_(others[i], others[j])]) for i in range(n)] for j in range(n)]
    found = _determinants(recorder, [block_of(A), *(each for row in minors for each in row)])
    (ratio,) = reciprocals(recorder, [found[block_of(A)]])
    rows = [[Product((-1) ** (i + j), found[minors[j][i]], ratio)] for j, i in np.ndindex(n, n)]
    return row_of(sums(recorder, rows)).reshape(n, n)


def reciprocals(recorder: Recorder, numbers: Sequence[Scalar]) -> list[Scalar]:
    """Inverses of numbers, none of which may be zero."""
    if any(each == 0 for each in numbers):
        raise UnsupportedError(
            "its matrix is singular, whatever the inputs are: give one that has an inverse"
        )
    own = sorted({each for each in numbers if isinstance(each, Entry)})
    found: dict[Scalar, Scalar] = {each: 1 / each for each in numbers if isinstance(each, Fraction)}
    if own:
        value = recorder.unit(Reciprocal(origin=SINGULAR), gathered(recorder, own))
        found.update(zip(own, entries(recorder, value), strict=True))
    return [found[each] for each in numbers]


def _determinants(recorder: Recorder, wanted: Sequence[Block]) -> dict[Block, Scalar]:
    """Determinants, by their minors of the first rows: from one row to all."""
    needed: dict[Block, list[tuple[int, Scalar, Block]]] = {}
    todo = [*wanted]
    while todo:
        block = todo.pop()
        if block and block not in needed:
            needed[block] = _expanded(block)
            todo += [minor for _, _, minor in needed[block]]
    found: dict[Block, Scalar] = {(): ONE}
    for size in range(1, 1 + max(map(len, wanted))):
        terms = {block: each for block, each in needed.items() if len(block) == size}
        rows = ([Product(s, a, found[minor]) for s, a, minor in each] for each in terms.values())
        found.update(zip(terms, sums(recorder, rows), strict=True))
    return found


def _expanded(block: Block) -> list[tuple[int, Scalar, Block]]:
    """A determinant along its last row: signs, entries, and minors of the rows before."""
    n = len(block)
    if any(all(row[j] == 0 for row in block) for j in range(n)):
        return []
    return [
        ((-1) ** (n - 1 - j), entry, tuple(row[:j] + row[j + 1 :] for row in block[:-1]))
        for j, entry in enumerate(block[-1])
        if entry != 0
    ]
