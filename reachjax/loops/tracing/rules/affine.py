"""Primitives that are affine in what depends on the inputs, and products and quotients."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from reachjax.loops.tracing.recording import Recorder
from reachjax.loops.tracing.rules.equations import Equation, Rule, entrywise, on_host
from reachjax.loops.tracing.rules.picks import is_binary, product_of
from reachjax.loops.tracing.rules.related import over_norm, over_sum
from reachjax.loops.tracing.values import Operand, Parameter, UnsupportedError, Value, is_known
from reachjax.loops.units import Reciprocal


def _linear(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    """Any primitive that is linear in its one operand that is no plain array: as a matrix."""
    where, *others = (k for k, each in enumerate(operands) if isinstance(each, Value))
    if others:
        raise UnsupportedError(
            "of its operands only one may depend on inputs: write it as products and sums of these"
        )
    value = operands[where]

    plain = [each for each in operands if each is not value]
    bare = [np.asarray(each) if isinstance(each, Parameter) else each for each in operands]

    def of(flat: Any) -> Any:
        given = [*bare]
        given[where] = flat.reshape(value.shape)
        return equation.evaluate(*given).reshape(-1)

    # known numbers stay known where others are traced
    with jax.ensure_compile_time_eval() if is_known(*plain) else contextlib.nullcontext():
        matrix = jax.vmap(of)(jnp.eye(value.size)).T
    if is_known(matrix) and all(map(on_host, plain)):
        matrix = np.asarray(matrix)
        if any(isinstance(each, Parameter) for each in plain):
            matrix = Parameter.of(matrix)
    return recorder.mapped(value, matrix, equation.shape)


def _sum_along_axes(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    (value,) = operands
    assert isinstance(value, Value)
    units = np.eye(value.size).reshape(*value.shape, value.size)
    sums = units.sum(axis=tuple(equation.params["axes"]))
    matrix = sums.reshape(math.prod(equation.shape), value.size)
    return recorder.mapped(value, matrix, equation.shape)


def _contraction(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    left, right = operands
    over, batch = equation.params["dimension_numbers"]
    if isinstance(left, Value) and isinstance(right, Value):
        return _inner_products(recorder, equation, left, right)
    one, other = (0, 1) if isinstance(left, Value) else (1, 0)
    value, plain = operands[one], operands[other]
    if np.ndim(plain) == 2 and len(value.shape) == 1 and len(over[one]) == 1:
        matrix = plain if over[other][0] == 1 else plain.T
        return recorder.mapped(value, matrix, equation.shape)
    if not on_host(plain):
        return _linear(recorder, equation, operands)
    columns = _arranged(_entry_numbers(value), batch[one], over[one])
    factors = _arranged(np.asarray(plain), batch[other], over[other])
    if value is left:  # the free axes of the left operand come first
        columns, factors = columns[:, :, None], factors[:, None]
    else:
        columns, factors = columns[:, None], factors[:, :, None]
    columns, factors = np.broadcast_arrays(columns, factors)
    matrix = np.zeros((*columns.shape[:3], value.size))
    np.put_along_axis(matrix, columns, factors, axis=-1)
    matrix = matrix.reshape(math.prod(equation.shape), value.size)
    if isinstance(plain, Parameter):
        matrix = Parameter.of(matrix)
    return recorder.mapped(value, matrix, equation.shape)


def _entry_numbers(value: Value) -> np.ndarray:
    """The number of each entry of a value, in the shape of its array."""
    return np.arange(value.size).reshape(value.shape)


def _arranged(entries: np.ndarray, batch: Sequence[int], over: Sequence[int]) -> np.ndarray:
    """Entries of an operand of a contraction as `(batch, free, contracted)`."""
    free = [k for k in range(entries.ndim) if k not in (*batch, *over)]
    sizes = [math.prod(entries.shape[k] for k in axes) for axes in (batch, free, over)]
    return entries.transpose(*batch, *free, *over).reshape(sizes)


def _inner_products(recorder: Recorder, equation: Equation, left: Value, right: Value) -> Value:
    """A contraction of two values that depend on inputs."""
    (over_left, over_right), (batch_left, batch_right) = equation.params["dimension_numbers"]
    one, other = np.broadcast_arrays(
        _arranged(_entry_numbers(left), batch_left, over_left)[:, :, None],
        _arranged(_entry_numbers(right), batch_right, over_right)[:, None],
    )
    if is_binary(recorder, left) or is_binary(recorder, right):
        products = product_of(recorder, recorder.picked(left, one), recorder.picked(right, other))
        count = math.prod(equation.shape)
        sums = np.kron(np.eye(count), np.ones((1, one.shape[-1])))
        return recorder.mapped(products, sums, equation.shape)
    terms = one.shape[-1]
    pairs = one.reshape(-1, terms).T, other.reshape(-1, terms).T
    return recorder.inner_products(left, right, equation.shape, pairs)


@entrywise
def _sum(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    return recorder.added(operands[0], operands[1])


@entrywise
def _difference(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    return recorder.added(operands[0], operands[1], -1)


def _negated(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    return recorder.scaled(operands[0], np.array(-1.0))


@entrywise
def _product(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    one, other = operands
    if not isinstance(other, Value):
        return recorder.scaled(one, other)
    return (
        _multiplied(recorder, one, other) if isinstance(one, Value) else recorder.scaled(other, one)
    )


def _multiplied(recorder: Recorder, one: Value, other: Value) -> Value:
    """A product, of a number and the inverse of its norm among others."""
    for pair in ((one, other), (other, one)):
        found = over_norm(recorder, *pair)
        if found is not None:
            return found
    return product_of(recorder, one, other)


@entrywise
def _quotient(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    one, other = operands
    if not isinstance(other, Value):
        return recorder.divided(one, other)
    found = over_sum(recorder, one, other)
    if found is not None:
        return found
    inverse = recorder.unit(Reciprocal(), other)
    if isinstance(one, Value):
        return _multiplied(recorder, one, inverse)
    return recorder.scaled(inverse, one)


def _itself(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Operand:
    return operands[0]


RULES: dict[str, Rule] = {
    **dict.fromkeys(["cumsum", "conv_general_dilated", "reduce_window_sum"], _linear),
    "reduce_sum": _sum_along_axes,
    **dict.fromkeys(
        ["copy", "copy_p", "stop_gradient", "optimization_barrier", "convert_element_type"], _itself
    ),
    "dot_general": _contraction,
    "add": _sum,
    "add_any": _sum,
    "sub": _difference,
    "neg": _negated,
    "mul": _product,
    "div": _quotient,
}
