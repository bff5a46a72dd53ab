"""Maxima, minima, products and the order of many numbers, by two at a time."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np

from reachjax.loops.tracing.recording import Recorder
from reachjax.loops.tracing.rules.bends import largest, smallest
from reachjax.loops.tracing.rules.equations import Equation, Rule
from reachjax.loops.tracing.values import Operand, UnsupportedError, Value

Pair = Callable[[Recorder, Value, Value], Value]


def _folded(recorder: Recorder, parts: list[Value], pair: Pair) -> Value:
    """One value of many parts, pair by pair."""
    while len(parts) > 1:
        pairs = zip(parts[::2], parts[1::2], strict=False)
        rest = parts[-1:] if len(parts) % 2 else []
        parts = [pair(recorder, *both) for both in pairs] + rest
    return parts[0]


def _over_axes(pair: Pair) -> Rule:
    """Over the axes that vanish."""

    def rule(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
        (value,), axes = operands, equation.params["axes"]
        index = np.arange(value.size).reshape(value.shape)
        kept = [k for k in range(index.ndim) if k not in axes]
        index = index.transpose(*axes, *kept).reshape(-1, *equation.shape)
        return _folded(recorder, [recorder.picked(value, each) for each in index], pair)

    return rule


def _so_far(pair: Pair) -> Rule:
    """Over all that comes before along an axis."""

    def rule(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
        (value,), axis = operands, equation.params["axis"]
        index = np.moveaxis(np.arange(value.size).reshape(value.shape), axis, 0)
        index = index[::-1] if equation.params["reverse"] else index
        parts = [recorder.picked(value, index[0])]
        for each in index[1:]:
            parts.append(pair(recorder, parts[-1], recorder.picked(value, each)))
        order = np.arange(value.size).reshape(index.shape)
        order = order[::-1] if equation.params["reverse"] else order
        return recorder.picked(recorder.joined(parts), np.moveaxis(order, 0, axis))

    return rule


def _over_windows(pair: Pair) -> Rule:
    """Over windows that move; entries beyond the edges take nothing."""

    def rule(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
        (value,), params = operands, equation.params
        if any(each != 1 for each in params["base_dilation"]):
            raise UnsupportedError("its operand must not be dilated")
        index = np.arange(value.size).reshape(value.shape)
        index = np.pad(index, params["padding"], constant_values=-1)
        strides, apart = params["window_strides"], params["window_dilation"]
        parts = []
        for corner in itertools.product(*map(range, params["window_dimensions"])):
            taken = tuple(
                slice(k * d, k * d + (size - 1) * stride + 1, stride)
                for k, d, size, stride in zip(corner, apart, equation.shape, strides, strict=True)
            )
            parts.append(index[taken])
        inside = np.max(parts, axis=0)
        if np.any(inside < 0):
            raise UnsupportedError("one of its windows is empty: use less padding")
        picked = [recorder.picked(value, np.where(each < 0, inside, each)) for each in parts]
        return _folded(recorder, picked, pair)

    return rule


SORTED = 8
"""So many numbers are sorted at most: each pair of them is a rectifier."""


def _sorted(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> list[Value]:
    """The numbers along an axis by their size: neighbours trade places, until none need to."""
    (value, *others), axis = operands, equation.params["dimension"]
    if others:
        raise UnsupportedError(
            "what is moved by the order of other numbers jumps where that changes: use jnp.sort of "
            "the numbers themselves"
        )
    index = np.moveaxis(np.arange(value.size).reshape(value.shape), axis, 0)
    if len(index) > SORTED:
        raise UnsupportedError(
            f"it sorts {len(index)} numbers, but {SORTED} at most have bounds: use jnp.max or "
            "jnp.min"
        )
    parts = [recorder.picked(value, each) for each in index]
    for turn in range(len(parts)):
        for k in range(turn % 2, len(parts) - 1, 2):
            both = parts[k], parts[k + 1]
            parts[k : k + 2] = [smallest(recorder, *both), largest(recorder, *both)]
    order = np.moveaxis(np.arange(value.size).reshape(index.shape), 0, axis)
    return [recorder.picked(recorder.joined(parts), order)]


def _product(recorder: Recorder, one: Value, other: Value) -> Value:
    return recorder.product(one, other)


RULES: dict[str, Rule] = {
    "sort": _sorted,
    "reduce_max": _over_axes(largest),
    "reduce_min": _over_axes(smallest),
    "reduce_prod": _over_axes(_product),
    "cummax": _so_far(largest),
    "cummin": _so_far(smallest),
    "cumprod": _so_far(_product),
    "reduce_window_max": _over_windows(largest),
    "reduce_window_min": _over_windows(smallest),
}
