"""What ONNX's operators compute, over `jax.numpy`, and over numpy where nothing is a number.

Shapes, indices and limits are plain arrays; only what depends on the input or on weights is of JAX.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Attributes = Mapping[str, Any]
Operator = Callable[..., Any]
"""From attributes and operands, None for those left out, to the result, or to several."""

FLOATS = (1, 10, 11, 16)
"""ONNX's numbers of the types that are floats: 32, 16, 64 bits, and bfloat16."""


def _over(*operands: Any) -> Any:
    """`jax.numpy`, or numpy if all operands are plain."""
    return np if all(isinstance(each, np.ndarray | np.generic) for each in operands) else jnp


def _whole(values: Any) -> list[int]:
    return [int(each) for each in np.asarray(values).ravel()]


def _entrywise(name: str) -> Operator:
    return lambda attributes, *given: getattr(_over(*given), name)(*given)


def _folded(name: str) -> Operator:
    """Of any number of operands."""

    def operator(attributes: Attributes, *given: Any) -> Any:
        found, *rest = given
        for each in rest:
            found = getattr(_over(found, each), name)(found, each)
        return found

    return operator


def _gemm(attributes: Attributes, a: Any, b: Any, c: Any = None) -> Any:
    a = a.T if attributes.get("transA", 0) else a
    b = b.T if attributes.get("transB", 0) else b
    found = a @ b
    alpha, beta = attributes.get("alpha", 1.0), attributes.get("beta", 1.0)
    found = found if alpha == 1 else alpha * found
    return found if c is None else found + (c if beta == 1 else beta * c)


def _flatten(attributes: Attributes, x: Any) -> Any:
    axis = attributes.get("axis", 1)
    rows = int(np.prod(np.shape(x)[:axis], dtype=int))
    return x.reshape(rows, -1)


def _reshape(attributes: Attributes, x: Any, shape: Any) -> Any:
    sizes = _whole(shape)
    if not attributes.get("allowzero", 0):
        sizes = [np.shape(x)[k] if size == 0 else size for k, size in enumerate(sizes)]
    return x.reshape(sizes)


def _axes(attributes: Attributes, axes: Any) -> tuple[int, ...] | None:
    """Those of an attribute of old, or of an operand."""
    given = attributes.get("axes") if axes is None else axes
    return None if given is None else tuple(_whole(given))


def _squeeze(attributes: Attributes, x: Any, axes: Any = None) -> Any:
    return _over(x).squeeze(x, _axes(attributes, axes))


def _unsqueeze(attributes: Attributes, x: Any, axes: Any = None) -> Any:
    return _over(x).expand_dims(x, _axes(attributes, axes))


def _transpose(attributes: Attributes, x: Any) -> Any:
    return _over(x).transpose(x, attributes.get("perm"))


def _concatenated(attributes: Attributes, *parts: Any) -> Any:
    return _over(*parts).concatenate(parts, axis=attributes["axis"])


def _split(attributes: Attributes, x: Any, sizes: Any = None) -> Any:
    axis, sizes = attributes.get("axis", 0), attributes.get("split") if sizes is None else sizes
    if sizes is None:  # all but the last ones have one size
        count, total = attributes["num_outputs"], np.shape(x)[axis]
        size = -(-total // count)
        sizes = [min(size, max(total - k * size, 0)) for k in range(count)]
    return _over(x).split(x, np.cumsum(_whole(sizes))[:-1].tolist(), axis)


def _gathered(attributes: Attributes, x: Any, indices: Any) -> Any:
    indices, axis = np.asarray(indices), attributes.get("axis", 0)
    return _over(x).take(x, np.where(indices < 0, indices + np.shape(x)[axis], indices), axis)


def _sliced(
    attributes: Attributes,
    x: Any,
    starts: Any = None,
    ends: Any = None,
    axes: Any = None,
    steps: Any = None,
) -> Any:
    starts = _whole(attributes["starts"] if starts is None else starts)
    ends = _whole(attributes["ends"] if ends is None else ends)
    axes = _axes(attributes, axes) or tuple(range(len(starts)))
    steps = [1] * len(starts) if steps is None else _whole(steps)
    taken = [slice(None)] * np.ndim(x)
    for axis, start, end, step in zip(axes, starts, ends, steps, strict=True):
        last = None if step < 0 and end < -np.shape(x)[axis] else end
        taken[axis] = slice(start, last, step)
    return x[tuple(taken)]


def _clip(attributes: Attributes, x: Any, low: Any = None, high: Any = None) -> Any:
    low = attributes.get("min") if low is None else low
    high = attributes.get("max") if high is None else high
    x = x if low is None else _over(x).maximum(x, low)
    return x if high is None else _over(x).minimum(x, high)


def _reduced(name: str) -> Operator:
    def operator(attributes: Attributes, x: Any, axes: Any = None) -> Any:
        found = _axes(attributes, axes) or None
        if found is None and attributes.get("noop_with_empty_axes", 0):
            return x
        keep = bool(attributes.get("keepdims", 1))
        return getattr(_over(x), name)(x, axis=found, keepdims=keep)

    return operator


def _normalised(
    attributes: Attributes, x: Any, scale: Any, bias: Any, mean: Any, variance: Any
) -> Any:
    """Batch normalisation, with the statistics that were found in training."""
    shape = (1, -1, *([1] * (np.ndim(x) - 2)))
    factor = scale / jnp.sqrt(variance + attributes.get("epsilon", 1e-5))
    return (x - mean.reshape(shape)) * factor.reshape(shape) + bias.reshape(shape)


def _constant_of_shape(attributes: Attributes, shape: Any) -> Any:
    value = attributes.get("value")
    return np.full(_whole(shape), 0.0 if value is None else np.asarray(value).ravel()[0])


def _cast(attributes: Attributes, x: Any) -> Any:
    """Numbers stay as exact as they are; what becomes whole must be plain."""
    if attributes["to"] in FLOATS:
        return x.astype(float)
    return np.asarray(x).astype(np.int64)


OPERATORS: dict[str, Operator] = {
    "Abs": _entrywise("abs"),
    "Add": _entrywise("add"),
    "Atan": _entrywise("arctan"),
    "BatchNormalization": _normalised,
    "Cast": _cast,
    "Clip": _clip,
    "Concat": _concatenated,
    "ConstantOfShape": _constant_of_shape,
    "Cos": _entrywise("cos"),
    "Cosh": _entrywise("cosh"),
    "Div": _entrywise("divide"),
    "Dropout": lambda attributes, x, *others: x,
    "Elu": lambda attributes, x: jax.nn.elu(x, attributes.get("alpha", 1.0)),
    "Exp": _entrywise("exp"),
    "Flatten": _flatten,
    "Gather": _gathered,
    "Gemm": _gemm,
    "HardSigmoid": lambda a, x: jnp.clip(a.get("alpha", 0.2) * x + a.get("beta", 0.5), 0.0, 1.0),
    "Identity": lambda attributes, x: x,
    "LeakyRelu": lambda a, x: jnp.where(x >= 0, x, a.get("alpha", 0.01) * x),
    "Log": _entrywise("log"),
    "MatMul": _entrywise("matmul"),
    "Max": _folded("maximum"),
    "Min": _folded("minimum"),
    "Mul": _entrywise("multiply"),
    "Neg": _entrywise("negative"),
    "PRelu": lambda attributes, x, slope: jnp.where(x >= 0, x, slope * x),
    "Pow": lambda attributes, x, power: _over(x, power).power(x, power),
    "Reciprocal": lambda attributes, x: 1.0 / x,
    "ReduceMean": _reduced("mean"),
    "ReduceSum": _reduced("sum"),
    "Relu": lambda attributes, x: jnp.maximum(x, 0.0),
    "Reshape": _reshape,
    "Shape": lambda attributes, x: np.array(np.shape(x), np.int64),
    "Sigmoid": lambda attributes, x: jax.nn.sigmoid(x),
    "Sin": _entrywise("sin"),
    "Sinh": _entrywise("sinh"),
    "Slice": _sliced,
    "Softplus": lambda attributes, x: jax.nn.softplus(x),
    "Softsign": lambda attributes, x: jax.nn.soft_sign(x),
    "Split": _split,
    "Sqrt": _entrywise("sqrt"),
    "Squeeze": _squeeze,
    "Sub": _entrywise("subtract"),
    "Sum": _folded("add"),
    "Tan": _entrywise("tan"),
    "Tanh": _entrywise("tanh"),
    "Transpose": _transpose,
    "Unsqueeze": _unsqueeze,
}

FIXED = {"Pow": (1,), "Clip": (1, 2)}
"""Operands that are numbers and yet no weights, by their places."""
