"""Rules of the exact reader: where entries go, and which of them are taken together."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from tests.oracles.exact.varying import Varying

if TYPE_CHECKING:
    from tests.oracles.exact.exact_reader import Reader


def shape_of(equation: Any) -> tuple[int, ...]:
    """The shape of the first result."""
    return tuple(equation.outvars[0].aval.shape)


def _moved(*numbered: int) -> Callable[..., Any]:
    """Entries that only change their places: JAX moves their numbers. No places given: all do."""

    def rule(reader: Reader, equation: Any, operands: Sequence[Any]) -> list[Varying]:
        pool: list[np.ndarray] = []
        given: list[Any] = []
        for k, each in enumerate(operands):
            if numbered and k not in numbered:
                given.append(jnp.asarray(reader.settled(each), equation.invars[k].aval.dtype))
                continue
            value = reader.of(each)
            start = sum(map(len, pool))
            given.append(jnp.arange(start, start + len(value.numbers)).reshape(value.shape))
            pool.append(value.numbers)
        params = dict(equation.params)
        filled = params.get("fill_value", math.nan)
        if "fill_value" in params:
            params["fill_value"] = -1
        found = equation.primitive.bind(*given, **params)
        missing = fractions_row(math.nan if filled is None else filled, reader.points)
        entries = np.vstack([*pool, missing])  # the number -1 is the last one
        places = found if equation.primitive.multiple_results else [found]
        return [Varying(entries[np.asarray(each).ravel()], each.shape) for each in places]

    return rule


def fractions_row(value: float, points: int) -> np.ndarray:
    """One number at all points."""
    row = np.empty((1, points), object)
    row[:] = Fraction(value) if math.isfinite(value) else value
    return row


def _landed(equation: Any, reader: Reader, operands: Sequence[Any]) -> np.ndarray:
    """`(updates, entries)`: where each update of a scatter lands."""
    into, where, updates = operands
    shape = into.shape if isinstance(into, Varying) else np.shape(into)
    size = math.prod(np.shape(updates) if not isinstance(updates, Varying) else updates.shape)
    indices = jnp.asarray(reader.settled(where))

    def alone(update: Any) -> Any:
        return lax.scatter_add(
            jnp.zeros(shape),
            indices,
            update.reshape(equation.invars[2].aval.shape),
            equation.params["dimension_numbers"],
            mode=equation.params["mode"],
        ).ravel()

    return np.asarray(jax.vmap(alone)(jnp.eye(size))).reshape(size, -1) != 0


def _scattered(combined: Callable[[Any, Any], Any]) -> Callable[..., Varying]:
    def rule(reader: Reader, equation: Any, operands: Sequence[Any]) -> Varying:
        found = reader.of(operands[0]).numbers.copy()
        updates = reader.of(operands[2]).numbers
        for k, place in np.argwhere(_landed(equation, reader, operands)):
            pairs = zip(found[place], updates[k], strict=True)
            found[place] = [combined(a, b) for a, b in pairs]
        return Varying(found, shape_of(equation))

    return rule


def _folded(folded: np.ufunc) -> Callable[..., Varying]:
    """Reductions over axes."""

    def rule(reader: Reader, equation: Any, operands: Sequence[Any]) -> Varying:
        (value,) = operands
        found = value.array
        for axis in sorted(equation.params["axes"], reverse=True):
            found = folded.reduce(found, axis=axis)
        return Varying(np.asarray(found, object), shape_of(equation))

    return rule


def _so_far(folded: np.ufunc) -> Callable[..., Varying]:
    def rule(reader: Reader, equation: Any, operands: Sequence[Any]) -> Varying:
        axis, turned = equation.params["axis"], equation.params["reverse"]
        given = np.flip(operands[0].array, axis) if turned else operands[0].array
        found = folded.accumulate(given, axis=axis)
        return Varying(np.flip(found, axis) if turned else found, shape_of(equation))

    return rule


def _place_of(better: Callable[[Any, Any], bool]) -> Callable[..., Varying]:
    """Which entry is the first of the largest, or of the smallest."""

    def rule(reader: Reader, equation: Any, operands: Sequence[Any]) -> Varying:
        (axis,) = equation.params["axes"]
        rows = np.moveaxis(operands[0].array, axis, 0)
        best, place = rows[0].copy(), np.full(rows[0].shape, Fraction(0), object)
        for k in range(1, len(rows)):
            for at in np.ndindex(best.shape):
                if better(rows[(k, *at)], best[at]):
                    best[at], place[at] = rows[(k, *at)], Fraction(k)
        return Varying(place, shape_of(equation))

    return rule


def _windows(folded: np.ufunc) -> Callable[..., Varying]:
    """Reductions over windows, of which JAX tells what is in them."""

    def rule(reader: Reader, equation: Any, operands: Sequence[Any]) -> Varying:
        (value,), params = operands, equation.params

        def counted(one: Any) -> Any:
            return lax.reduce_window(
                one.reshape(value.shape), 0.0, lax.add, params["window_dimensions"],
                params["window_strides"], params["padding"], params["base_dilation"],
                params["window_dilation"],
            ).ravel()  # fmt: skip

        inside = np.asarray(jax.vmap(counted)(jnp.eye(len(value.numbers)))) != 0
        rows = [folded.reduce(value.numbers[each], axis=0) for each in inside.T]
        return Varying(np.stack(rows), shape_of(equation))

    return rule


def _sorted(reader: Reader, equation: Any, operands: Sequence[Any]) -> list[Varying]:
    axis, keys = equation.params["dimension"], equation.params["num_keys"]
    given = [np.moveaxis(reader.of(each).array, axis, 0) for each in operands]
    found = [each.copy() for each in given]
    for at in np.ndindex(given[0].shape[1:]):
        columns = [each[(slice(None), *at)] for each in given]
        order = sorted(range(len(columns[0])), key=lambda i: [c[i] for c in columns[:keys]])
        for each, column in zip(found, columns, strict=True):
            each[(slice(None), *at)] = column[order]
    return [Varying(np.moveaxis(each, 0, axis), shape_of(equation)) for each in found]


def _largest(reader: Reader, equation: Any, operands: Sequence[Any]) -> list[Varying]:
    rows = np.moveaxis(operands[0].array, -2, 0)
    count = equation.params["k"]
    values, places = (np.empty((count, *rows.shape[1:]), object) for _ in range(2))
    for at in np.ndindex(rows.shape[1:]):
        column = rows[(slice(None), *at)]
        order = sorted(range(len(column)), key=lambda i: -column[i])[:count]
        values[(slice(None), *at)] = column[order]
        places[(slice(None), *at)] = [Fraction(k) for k in order]
    return [Varying(np.moveaxis(each, 0, -2), shape_of(equation)) for each in (values, places)]


PLACES: dict[str, tuple[int, ...]] = {
    **dict.fromkeys(["gather", "dynamic_slice"], (0,)),
    "dynamic_update_slice": (0, 1),
    "scatter": (0, 2),
    **dict.fromkeys(
        [
            "reshape",
            "transpose",
            "broadcast_in_dim",
            "squeeze",
            "expand_dims",
            "slice",
            "rev",
            "concatenate",
            "pad",
            "split",
            "tile",
            "stack",
            "unstack",
        ],
        (),
    ),
}
"""Which operands of what moves entries are moved; of the others all are."""

MOVES: dict[str, Callable[..., Any]] = {
    **{name: _moved(*places) for name, places in PLACES.items()},
    "optimization_barrier": lambda reader, equation, operands: list(operands),
    "scatter-add": _scattered(operator.add),
    "scatter-sub": _scattered(operator.sub),
    "scatter-mul": _scattered(operator.mul),
    "scatter-min": _scattered(min),
    "scatter-max": _scattered(max),
    "reduce_sum": _folded(np.add),
    "reduce_prod": _folded(np.multiply),
    "reduce_max": _folded(np.maximum),
    "reduce_min": _folded(np.minimum),
    "reduce_and": _folded(np.logical_and),
    "reduce_or": _folded(np.logical_or),
    "cumsum": _so_far(np.add),
    "cumprod": _so_far(np.multiply),
    "cummax": _so_far(np.maximum),
    "cummin": _so_far(np.minimum),
    "argmax": _place_of(operator.gt),
    "argmin": _place_of(operator.lt),
    "reduce_window_sum": _windows(np.add),
    "reduce_window_max": _windows(np.maximum),
    "reduce_window_min": _windows(np.minimum),
    "sort": _sorted,
    "top_k": _largest,
}
