"""ONNX's operators of arrays: those that move entries, and those over axes.

They move shapes, slices and indices, and find sums, norms, largest entries, softmax and
normalisations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from reachjax.loops.readers.arrays import log_softmax, logsumexp, over, softmax

Attributes = Mapping[str, Any]
"""Attributes of a node by name, with the standard's defaults."""

ROOM = 2**24
"""Entries that one array within a network may have, 128 MiB; its weights are as the file holds."""


def require_room(shape: Sequence[int]) -> None:
    """Raise an error for a shape of more entries than an array within a network may have.

    Raises:
        ValueError: there are more.
    """
    if math.prod(shape) > ROOM:
        raise ValueError(f"an array of shape {list(shape)} is larger than {ROOM} entries")


def whole(values: Any) -> list[int]:
    """Whole numbers, as Python's own."""
    return [int(each) for each in np.asarray(values).ravel()]


def axes_of(attributes: Attributes, axes: Any, ndim: int) -> tuple[int, ...] | None:
    """Axes from an attribute, as of old, or from an operand; counted from the front.

    Raises:
        ValueError: there is no such axis, or one is named twice.
    """
    given = attributes.get("axes") if axes is None else axes
    if given is None:
        return None
    found = whole(given)
    if any(not -ndim <= axis < ndim for axis in found):
        raise ValueError(f"there are {ndim} axes, but {found} are named")
    found = [axis % ndim for axis in found]
    if len(set(found)) != len(found):
        raise ValueError(f"an axis is named twice: {found}")
    return tuple(found)


def flattened(attributes: Attributes, x: Any) -> Any:
    """A matrix whose rows run over the axes in front of one."""
    rows = math.prod(np.shape(x)[: attributes["axis"]])
    return x.reshape(rows, np.size(x) // max(rows, 1))


def reshaped(attributes: Attributes, x: Any, shape: Any) -> Any:
    """The entries in another shape: 0 stands for a size as it was, and -1 for what is left."""
    sizes = whole(shape)
    if not attributes.get("allowzero", 0):
        sizes = [np.shape(x)[k] if size == 0 else size for k, size in enumerate(sizes)]
    if min(sizes, default=0) < -1:
        raise ValueError(f"{sizes} is no shape")
    return x.reshape(sizes)


def squeezed(attributes: Attributes, x: Any, axes: Any = None) -> Any:
    """Without axes of size one."""
    return over(x).squeeze(x, axes_of(attributes, axes, np.ndim(x)))


def unsqueezed(attributes: Attributes, x: Any, axes: Any = None) -> Any:
    """With more axes of size one."""
    given = whole(attributes["axes"] if axes is None else axes)
    found = axes_of({}, np.array(given), np.ndim(x) + len(given))
    return over(x).expand_dims(x, found)


def transposed(attributes: Attributes, x: Any) -> Any:
    """The axes in another order, or in the opposite one."""
    return over(x).transpose(x, attributes.get("perm"))


def concatenated(attributes: Attributes, *parts: Any) -> Any:
    """Arrays one behind the other along an axis."""
    return over(*parts).concatenate(parts, axis=attributes["axis"])


def split(attributes: Attributes, x: Any, sizes: Any = None) -> list[Any]:
    """Parts along an axis, of given sizes, or all but the last ones of one size."""
    axis, sizes = attributes["axis"], attributes.get("split") if sizes is None else sizes
    total, count = np.shape(x)[axis], attributes["parts"]
    if sizes is None:
        size = -(-total // count)
        if attributes["opset"] < 18 and size * count != total:
            raise ValueError(f"{total} entries cannot be split into {count} equal parts")
        sizes = [min(size, max(total - k * size, 0)) for k in range(count)]
    sizes = whole(sizes)
    if len(sizes) != count or sum(sizes) != total or min(sizes) < 0:
        raise ValueError(f"{total} entries cannot be split into {count} parts of sizes {sizes}")
    return over(x).split(x, np.cumsum(sizes)[:-1].tolist(), axis)


def gathered(attributes: Attributes, x: Any, indices: Any) -> Any:
    """Entries by their places along an axis; negative ones count from the end."""
    axis = attributes["axis"]
    size, places, xp = np.shape(x)[axis], indices, over(x, indices)
    known = isinstance(places, np.ndarray)
    if known and ((places < -size) | (places >= size)).any():
        raise ValueError(f"the places {places.ravel()[:4].tolist()} are not all among {size}")
    return xp.take(x, over(places).where(places < 0, places + size, places), axis=axis)


def sliced(
    attributes: Attributes,
    x: Any,
    starts: Any = None,
    ends: Any = None,
    axes: Any = None,
    steps: Any = None,
) -> Any:
    """Every so many entries between two places along axes; places beyond the ends are the ends."""
    starts = whole(attributes["starts"] if starts is None else starts)
    ends = whole(attributes["ends"] if ends is None else ends)
    found = axes_of(attributes, axes, np.ndim(x))
    found = tuple(range(len(starts))) if found is None else found
    steps = [1] * len(starts) if steps is None else whole(steps)
    if not len(starts) == len(ends) == len(found) == len(steps) or 0 in steps:
        raise ValueError(f"{starts}, {ends}, {found} and {steps} are no slices")
    taken = [slice(None)] * np.ndim(x)
    for axis, start, end, step in zip(found, starts, ends, steps, strict=True):
        size = np.shape(x)[axis]
        low, high = (0, size) if step > 0 else (-1, size - 1)
        first, last = (
            min(max(place + size if place < 0 else place, bottom), high)
            for place, bottom in ((start, 0), (end, low))
        )
        taken[axis] = slice(first, None if last < 0 else last, step)
    return x[tuple(taken)]


def expanded(attributes: Attributes, x: Any, shape: Any) -> Any:
    """Entries repeated along axes of size one, of either side."""
    sizes = np.broadcast_shapes(np.shape(x), tuple(whole(shape)))
    require_room(sizes)
    return over(x).broadcast_to(x, sizes)


def shape_of(attributes: Attributes, x: Any) -> np.ndarray:
    """The sizes of the axes between two of them."""
    return np.array(np.shape(x)[attributes["start"] : attributes.get("end")], np.int64)


def filled(attributes: Attributes, shape: Any) -> np.ndarray:
    """One number in every entry of a shape."""
    sizes, value = whole(shape), attributes.get("value", np.zeros(1, np.float32))
    if min(sizes, default=0) < 0 or np.size(value) != 1:
        raise ValueError(f"the shape {sizes} and the value {np.asarray(value)} do not fit")
    require_room(sizes)
    return np.full(sizes, value.ravel()[0], value.dtype)


def ranged(attributes: Attributes, start: Any, limit: Any, delta: Any) -> np.ndarray:
    """Numbers at equal distances."""
    first, last, step = (each.ravel()[0].item() for each in (start, limit, delta))
    if step == 0 or not np.isfinite([first, last, step]).all():
        raise ValueError(f"there is no range from {first} to {last} by {step}")
    count = max(math.ceil((last - first) / step), 0)
    require_room([count])
    return (np.arange(count) * delta.ravel()[0] + start.ravel()[0]).astype(start.dtype)


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
