"""Systems of linear equations whose matrices depend on the inputs: inverses, solves, factors.

What LAPACK computes by pivoting is in exact arithmetic the solution, whatever the pivots are; that
is what is recorded: an inverse times what is on the right. Most of what entries and a determinant
have in common cancels in an inverse, and is lost where they meet numbers of both signs before it:
linear bounds of an arm of three links were 1.2 times as wide as what was sampled by inverses, and
10 times by Cramer's rule.

A matrix is first brought to block triangular form by where its zeros are (Dulmage and Mendelsohn,
Coverings of bipartite graphs, 1958), so that blocks are solved one after the other. How far floats
of LAPACK are from the solution is rounding of a simulation, as that of sums and products is, and no
part of what is certified.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, maximum_bipartite_matching

from reachjax.loops.tracing.combinations import Combination
from reachjax.loops.tracing.recording import Recorder
from reachjax.loops.tracing.rules.entries import (
    ONE,
    Product,
    Scalar,
    as_value,
    entries,
    identity,
    row_of,
    sums,
    varying,
    zeros,
)
from reachjax.loops.tracing.rules.equations import Equation, Rule
from reachjax.loops.tracing.rules.inverses import Block, block_of, inverse, less, reciprocals
from reachjax.loops.tracing.traces import description, equations
from reachjax.loops.tracing.values import (
    Operand,
    Unknown,
    UnsupportedError,
    Value,
    is_known,
    is_plain,
)
from reachjax.loops.units import Sqrt

LARGEST = 6
"""Blocks of more rows have too many minors: 434 products are those of six rows."""

PIVOTS = (
    "an LU factorisation takes the largest pivots, so that its factors jump where these change: "
    "take jnp.linalg.solve(A, b) or jnp.linalg.inv(A), whose results do not"
)
"""Why factors have no bounds, though solutions have."""

MOVES = ("dot_general", "transpose", "reshape", "broadcast_in_dim", "squeeze", "reduce_sum", "jit")
"""Primitives of products of a matrix and a vector that JAX's own solvers are made of."""


def _solved(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """`custom_linear_solve`, of which `jnp.linalg.solve` and `inv` are made: the solution."""
    counts, bodies = equation.params["const_lengths"], equation.params["jaxprs"]
    given, right = operands[: counts.matvec], operands[sum(counts) :]
    made = [each.primitive.name for each in equations(bodies.matvec)]
    if len(given) != 1 or len(right) != 1 or made.count("dot_general") != 1 or {*made} - {*MOVES}:
        raise UnsupportedError(
            "its product with a vector is not that of one matrix: use jnp.linalg.solve(A, b)"
        )
    factors = operands[counts.matvec + counts.vecmat :][: counts.solve]
    if not _is_own_solver(bodies, given[0], right[0].shape, factors):
        raise UnsupportedError(
            "its solver is not known to give the solution, as one by iterations, or by factors of "
            "another matrix, does not: use jnp.linalg.solve(A, b)"
        )
    matrix, b = (entries(recorder, each) for each in (given[0], right[0]))
    if isinstance(factors[0], Value):
        matrix = _squared(recorder, factors[0], bodies.solve).reshape(matrix.shape)
    if not b.size:
        return [as_value(recorder, b)]
    places = _places(bodies.matvec, matrix.shape, b.shape)
    A = zeros(*places.shape)
    A[places > 0] = matrix.ravel()[places[places > 0] - 1]
    return [as_value(recorder, solution(recorder, A, b.ravel()).reshape(b.shape))]


def _is_own_solver(
    bodies: Any, matrix: Operand, shape: tuple[int, ...], factors: Sequence[Operand]
) -> bool:
    """Whether a solver is one of JAX's: by pivots of this very matrix, or by roots of any."""
    double = bool(jax.config.read("jax_enable_x64"))
    own = _own_solvers(np.shape(matrix), tuple(shape), double)
    if (description(bodies.matvec), description(bodies.solve)) not in own:
        return False
    if all(map(is_plain, factors)):
        return is_plain(matrix) and _agree(bodies, matrix, shape, factors)
    if len(factors) == 1:
        return isinstance(factors[0], Value)
    sources = [each.source for each in factors if isinstance(each, Unknown)]
    return len(sources) == len(factors) and all(
        isinstance(each, Value) and isinstance(matrix, Value) and each.place == matrix.place
        for each in sources
    )


def _squared(recorder: Recorder, factor: Value, solve: Any) -> np.ndarray:
    """The symmetric matrix of which a triangular one is the factor: of one triangle of it.

    Args:
        recorder: of the factor.
        factor: of which the solver takes one triangle.
        solve: the jaxpr of the solver.
    """
    made = [place for place in recorder.between(factor) if place in recorder.factored]
    sides = [e.params["lower"] for e in equations(solve) if e.primitive.name == "triangular_solve"]
    root = recorder.values[made[-1]] if made else None
    if root is None or not sides or not _is_root(recorder, factor, root, sides[0]):
        raise UnsupportedError("its factor is that of no matrix: use jnp.linalg.solve(A, b)")
    A = entries(recorder, recorder.factored[root.place])
    return np.where(np.tri(A.shape[-1], dtype=bool), A, A.swapaxes(-1, -2))


def _is_root(recorder: Recorder, factor: Value, root: Value, lower: bool) -> bool:
    """Whether a triangle of a matrix is that of a Cholesky factor, or of its transpose."""
    if factor.size != root.size:
        return False
    numbers = np.arange(root.size).reshape(factor.shape)
    below = np.broadcast_to(np.tri(factor.shape[-1], dtype=bool), factor.shape)
    own = (numbers if lower else numbers.swapaxes(-1, -2))[below]
    apart = Combination.of(recorder, factor)[own] - Combination.of(recorder, root)[numbers[below]]
    parts = (*apart.parts.values(), apart.offset)
    return not apart.errors and not any(map(np.any, parts))


@lru_cache(maxsize=256)
def _own_solvers(
    matrix: tuple[int, ...], right: tuple[int, ...], double: bool
) -> frozenset[tuple[str | None, str | None]]:
    """Descriptions of products and solvers of JAX's for these shapes, turned ones too."""
    turned = (*right[:-2], *right[:-3:-1])
    found = set()
    positive = partial(jax.scipy.linalg.solve, assume_a="pos")
    for shape in dict.fromkeys((right, turned)):
        given = [jax.ShapeDtypeStruct(each, float) for each in (matrix, shape)]
        for way in (jnp.linalg.solve, positive, partial(positive, lower=True)):
            each = jax.vmap(way)
            shared = jax.vmap(way, (None, 0)), jax.vmap(each, (None, 0))
            for solve in (way, each, jax.vmap(each), *shared, lambda A, b: jnp.linalg.inv(A)):
                with contextlib.suppress(TypeError, ValueError):  # of other shapes
                    found.update(_both_ways(jax.make_jaxpr(solve)(*given)))
    return frozenset(found)


def _both_ways(closed: core.ClosedJaxpr) -> Iterator[tuple[str | None, str | None]]:
    """Descriptions of the products and solvers of a jaxpr, as they are and turned."""
    for each in equations(closed):
        if each.primitive.name == "custom_linear_solve":
            own = each.params["jaxprs"]
            yield description(own.matvec), description(own.solve)
            yield description(own.vecmat), description(own.transpose_solve)


def _agree(bodies: Any, matrix: Any, shape: tuple[int, ...], factors: Sequence[Any]) -> bool:
    """Whether known factors are of a known matrix: products of solutions are what was given."""
    known = [is_known(each) for each in (matrix, *factors)]
    if not all(known):
        return not any(known)  # traced are both, or one of them is of something else
    given = np.random.default_rng(0).normal(size=shape)
    with jax.ensure_compile_time_eval():
        own = [jnp.asarray(np.asarray(each)) for each in (matrix, *factors)]
        (found,) = core.jaxpr_as_fun(bodies.solve)(*own[1:], jnp.asarray(given))
        (again,) = core.jaxpr_as_fun(bodies.matvec)(own[0], found)
    if not np.isfinite(np.asarray(found)).all():
        return True  # singular, which is said elsewhere
    size = abs(np.asarray(matrix)).max(initial=0.0) * abs(np.asarray(found)).max(initial=0.0)
    near = np.sqrt(np.finfo(np.asarray(found).dtype).eps) * (1 + size)
    return bool((abs(np.asarray(again) - given) <= near).all())


def _places(matvec: Any, matrix: Sequence[int], vector: Sequence[int]) -> np.ndarray:
    """Which entry, counted from 1, stands where in the matrix that multiplies a flat vector."""
    size, count = int(np.prod(vector)), int(np.prod(matrix))
    numbers = np.arange(1.0, count + 1).reshape(matrix)
    with jax.ensure_compile_time_eval():

        def column(unit: Any, numbers: Any) -> Any:
            (found,) = core.jaxpr_as_fun(matvec)(numbers, unit.reshape(vector))
            return found.reshape(-1)

        columns = jax.vmap(column, (0, None))
        found, squares = (
            np.asarray(columns(jnp.eye(size), jnp.asarray(each))).T
            for each in (numbers, numbers**2)
        )
    if not np.array_equal(squares, found**2):  # as they are of sums of entries
        raise UnsupportedError("its matrix is made of sums: use jnp.linalg.solve(A, b)")
    return found.astype(int)


def _triangular(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """Equations with a triangular matrix, or several such."""
    params, (factor, right) = equation.params, operands
    L, B = entries(recorder, factor), entries(recorder, right)
    lower = np.tri(L.shape[-1], dtype=bool)
    L = np.where(lower if params["lower"] else lower.T, L, zeros(1))
    if params["unit_diagonal"]:
        L = np.where(np.eye(L.shape[-1], dtype=bool), identity(L.shape[-1]), L)
    if params["transpose_a"]:
        L = L.swapaxes(-1, -2)
    if not params["left_side"]:
        L, B = L.swapaxes(-1, -2), B.swapaxes(-1, -2)
    columns = np.moveaxis(B, -1, -2)
    x = _each(recorder, L, columns)
    x = np.moveaxis(x, -1, -2)
    return as_value(recorder, x if params["left_side"] else x.swapaxes(-1, -2))


def _each(recorder: Recorder, A: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """The solutions of `A x = b` for each column `b`, `(*batch, m, n)`, at once."""
    n, count = A.shape[-1], columns.size // max(A.shape[-1], 1)
    matrices = np.broadcast_to(A[..., None, :, :], (*columns.shape, n)).reshape(count, n, n)
    whole = zeros(count, n, count, n)
    for k in range(count):
        whole[k, :, k] = matrices[k]
    found = solution(recorder, whole.reshape(count * n, count * n), columns.ravel())
    return found.reshape(columns.shape)


def _cholesky(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """`L` with `L L' = A`, of which only the lower triangle is read."""
    A = entries(recorder, operands[0])
    n, batch = A.shape[-1], A.reshape(-1, *A.shape[-2:])
    L = zeros(*batch.shape)
    for j in range(n):
        rows = [(k, i) for k in range(len(batch)) for i in range(j, n)]
        left = sums(
            recorder,
            (
                [
                    Product(1, batch[k, i, j], ONE),
                    *(Product(-1, L[k, i, m], L[k, j, m]) for m in range(j)),
                ]
                for k, i in rows
            ),
        )
        squares = [each for each, (_, i) in zip(left, rows, strict=True) if i == j]
        pivots = _roots(recorder, squares)
        ratios = reciprocals(recorder, pivots)
        below = [(k, i, each) for each, (k, i) in zip(left, rows, strict=True) if i > j]
        made = sums(recorder, ([Product(1, each, ratios[k])] for k, _, each in below))
        L[:, j, j] = pivots
        for (k, i, _), each in zip(below, made, strict=True):
            L[k, i, j] = each
    found = as_value(recorder, L.reshape(A.shape))
    if isinstance(found, Value):
        recorder.factored[found.place] = operands[0]
    return found


def _roots(recorder: Recorder, squares: Sequence[Scalar]) -> list[Scalar]:
    value = varying(recorder, as_value(recorder, row_of(squares)))
    return [*entries(recorder, recorder.unit(Sqrt(), value))]


def _factors(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> list[Unknown]:
    """An LU factorisation, which may only be passed on to a solver."""
    return [Unknown(equation.name, PIVOTS, operands[0])] * 3


def solution(recorder: Recorder, A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The `x` with `A x = b`.

    Args:
        recorder: of the steps.
        A: `(n, n)`, of scalars.
        b: `(n,)`, of scalars.

    Raises:
        UnsupportedError: a block of it is too large, or is singular whatever the inputs are.
    """
    x = zeros(len(b))
    for blocks in _levels(A != 0):
        rows, columns = (np.concatenate(each) for each in zip(*blocks, strict=True))
        done = [j for j in range(len(b)) if j not in {*columns} and np.any(A[rows, j] != 0)]
        rest = less(recorder, b[rows, None], A[rows][:, done], x[done, None]).ravel()
        known = dict(zip(rows.tolist(), rest, strict=True))
        inverses: dict[Block, np.ndarray] = {}
        products, places = [], []
        for mine, its in blocks:
            block = block_of(A[np.ix_(mine, its)])
            if block not in inverses:
                inverses[block] = inverse(recorder, block)
            for row, column in zip(inverses[block], its, strict=True):
                products.append(
                    [Product(1, each, known[i]) for each, i in zip(row, mine, strict=True)]
                )
                places.append(column)
        x[places] = row_of(sums(recorder, products))
    return x


def _levels(there: np.ndarray) -> list[list[tuple[np.ndarray, np.ndarray]]]:
    """Rows and columns of diagonal blocks of a matrix, such that each needs those before alone.

    Args:
        there: `(n, n)`, where it has entries that are not zero.
    """
    graph = csr_matrix(there.astype(int))
    column = maximum_bipartite_matching(graph, perm_type="column")
    if np.any(column < 0):
        raise UnsupportedError(
            "its matrix is singular, whatever the inputs are: give one that has an inverse"
        )
    count, label = connected_components(graph[:, column], directed=True, connection="strong")
    needs = np.zeros((count, count), bool)
    for i, j in zip(*np.nonzero(there[:, column]), strict=True):
        needs[label[i], label[j]] = label[i] != label[j]
    found, left = [], np.ones(count, bool)
    while np.any(left):
        free = np.flatnonzero(left & ~np.any(needs & left, axis=1))
        rows = [np.flatnonzero(label == k) for k in free]
        if max(map(len, rows)) > LARGEST:
            raise UnsupportedError(
                f"a block of its matrix has {max(map(len, rows))} rows, but {LARGEST} at most have "
                "bounds: if the matrix is constant, multiply by jnp.linalg.inv(A)"
            )
        found.append([(each, column[each]) for each in rows])
        left[free] = False
    return found


RULES: dict[str, Rule] = {
    "custom_linear_solve": _solved,
    "triangular_solve": _triangular,
    "cholesky": _cholesky,
    "lu": _factors,
}
