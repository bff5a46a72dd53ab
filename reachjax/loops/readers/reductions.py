"""ONNX's operators over axes: sums, norms, largest entries, softmax, normalisations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from reachjax.loops.readers.arrays import log_softmax, logsumexp, over, softmax
from reachjax.loops.readers.moving import Attributes, axes_of


def reduction(
    along: Callable[[Any, Any, bool], Any], alone: bool = False
) -> Callable[[Attributes, Any, Any], Any]:
    """The operator that reduces axes to one number each.

    Args:
        along: of an array, the axes and whether they are kept.
        alone: whether entries that are not reduced stay as they are.
    """

    def operator(attributes: Attributes, x: Any, axes: Any = None) -> Any:
        found = axes_of(attributes, axes, np.ndim(x)) or None
        if found is None and attributes.get("noop_with_empty_axes", 0):
            if not alone:
                raise ValueError("without axes, and told to do nothing then, it is not defined")
            return x
        return along(x, found, bool(attributes["keepdims"]))

    return operator


def named(name: str) -> Callable[[Any, Any, bool], Any]:
    """The reduction of numpy and JAX that has this name."""

    def along(x: Any, axes: Any, keep: bool) -> Any:
        wide = {"dtype": x.dtype} if name in ("sum", "prod") else {}
        return getattr(over(x), name)(x, axis=axes, keepdims=keep, **wide)

    return along


_sum = named("sum")

REDUCTIONS = {
    "ReduceL1": reduction(lambda x, axes, keep: _sum(over(x).abs(x), axes, keep)),
    "ReduceL2": reduction(lambda x, axes, keep: over(x).sqrt(_sum(over(x).square(x), axes, keep))),
    "ReduceLogSum": reduction(lambda x, axes, keep: over(x).log(_sum(x, axes, keep))),
    "ReduceLogSumExp": reduction(logsumexp),
    "ReduceMax": reduction(named("max"), alone=True),
    "ReduceMean": reduction(named("mean"), alone=True),
    "ReduceMin": reduction(named("min"), alone=True),
    "ReduceProd": reduction(named("prod"), alone=True),
    "ReduceSum": reduction(named("sum"), alone=True),
    "ReduceSumSquare": reduction(lambda x, axes, keep: _sum(over(x).square(x), axes, keep)),
}
"""Reductions by the names of ONNX."""


def normaliser(function: Callable[[Any, Any], Any]) -> Callable[[Attributes, Any], Any]:
    """Softmax, or its logarithm: before version 13 over an axis and all behind it."""

    def operator(attributes: Attributes, x: Any) -> Any:
        (axis,) = axes_of({}, np.array([attributes["axis"]]), np.ndim(x)) or (0,)
        taken = tuple(range(axis, np.ndim(x))) if attributes["opset"] < 13 else axis
        return function(x, taken)

    return operator


SOFTMAX, LOG_SOFTMAX = normaliser(softmax), normaliser(log_softmax)


def layer_normalised(attributes: Attributes, x: Any, scale: Any, bias: Any = None) -> Any:
    """Normalisation over an axis and all behind it."""
    (first,) = axes_of({}, np.array([attributes["axis"]]), np.ndim(x)) or (0,)
    axes = tuple(range(first, np.ndim(x)))
    centred = x - over(x).mean(x, axis=axes, keepdims=True)
    variance = over(x).mean(over(x).square(centred), axis=axes, keepdims=True)
    found = centred / over(x).sqrt(variance + attributes["epsilon"]) * scale
    return found if bias is None else found + bias


def rms_normalised(attributes: Attributes, x: Any, scale: Any) -> Any:
    """Division by the root of the mean square over an axis and all behind it."""
    (first,) = axes_of({}, np.array([attributes["axis"]]), np.ndim(x)) or (0,)
    axes = tuple(range(first, np.ndim(x)))
    mean = over(x).mean(over(x).square(x), axis=axes, keepdims=True)
    return x / over(x).sqrt(mean + attributes["epsilon"]) * scale


def batch_normalised(
    attributes: Attributes, x: Any, scale: Any, bias: Any, mean: Any, variance: Any
) -> Any:
    """Batch normalisation, with the statistics that were found in training."""
    if attributes.get("training_mode", 0) or attributes.get("spatial", 1) != 1:
        raise ValueError("only statistics from training are known, of one channel each")
    if np.ndim(x) < 2:
        raise ValueError("its operand needs a batch and channels")
    shape = (1, -1, *([1] * (np.ndim(x) - 2)))
    factor = scale / over(variance).sqrt(variance + attributes["epsilon"])
    return (x - mean.reshape(shape)) * factor.reshape(shape) + bias.reshape(shape)
