"""The rules of the exact reader: what each primitive of JAX makes of fractions."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
from jax import lax

from tests.oracles.exact import Reader, UndefinedError, Varying

DIGITS = 60


def _shape(equation: Any, k: int = 0) -> tuple[int, ...]:
    return tuple(equation.outvars[k].aval.shape)


def _entrywise(function: Callable[..., Any]) -> Callable[..., Varying]:
    """A function of the numbers at each place."""

    def rule(reader: Reader, equation: Any, operands: Sequence[Any]) -> Varying:
        shape = _shape(equation)
        columns = [reader.of(each, shape).numbers for each in operands]
        return Varying(np.frompyfunc(function, len(columns), 1)(*columns), shape)

    return rule


def _digits(function: Callable[..., Any]) -> Callable[..., Varying]:
    """A function of mpmath at each place."""

    def value(*numbers: Any) -> Any:
        with mpmath.workdps(DIGITS):
            given = [
                mpmath.mpf(each.numerator) / each.denominator
                if isinstance(each, Fraction)
                else mpmath.mpf(each)
                for each in numbers
            ]
            found = function(*given)
            if isinstance(found, mpmath.mpc):
                raise UndefinedError(f"{function} of {numbers} is no real number")
            if not mpmath.isfinite(found):
                return float(found)
            return Fraction(*mpmath.libmp.to_rational(found._mpf_))

    def rule(reader: Reader, equation: Any, operands: Sequence[Any]) -> Varying:
        reader.is_cut = True
        return _entrywise(value)(reader, equation, operands)

    return rule


def _root(reader: Reader, equation: Any, operands: Sequence[Any]) -> Varying:
    """Square roots, exact where these are rational."""
    numbers = reader.of(operands[0]).numbers
    roots = np.frompyfunc(_rational_root, 1, 1)(numbers)
    if all(each is not None for each in roots.flat):
        return Varying(roots, _shape(equation))
    return _digits(mpmath.sqrt)(reader, equation, operands)


def _rational_root(y: Any) -> Fraction | None:
    if y < 0:
        raise UndefinedError(f"the root of {y}")
    root = Fraction(math.isqrt(y.numerator), math.isqrt(y.denominator))
    return root if root * root == y else None


def _power(reader: Reader, equation: Any, operands: Sequence[Any]) -> Varying:
    """Powers; whole ones are exact."""
    exponents = reader.of(operands[1]).numbers
    if all(isinstance(e, Fraction) and e.denominator == 1 for e in exponents.flat):
        return _entrywise(lambda y, e: y ** int(e))(reader, equation, operands)
    return _digits(mpmath.power)(reader, equation, operands)


def _rounded(reader: Reader, equation: Any, operands: Sequence[Any]) -> Varying:
    to_even = int(equation.params["rounding_method"]) == 1

    def value(y: Fraction) -> Fraction:
        away = math.floor(abs(y) + Fraction(1, 2)) * (1 if y > 0 else -1)
        return Fraction(round(y) if to_even else away)

    return _entrywise(value)(reader, equation, operands)


def _converted(reader: Reader, equation: Any, operands: Sequence[Any]) -> Varying:
    """Casts: those of states to fewer bits round nothing, but whole numbers are cut."""
    kind = equation.outvars[0].aval.dtype
    value: Callable[[Any], Any]
    if kind == bool:
        value = bool
    elif jnp.issubdtype(kind, jnp.integer):
        value = lambda y: Fraction(math.trunc(y))  # noqa: E731
    else:
        value = lambda y: Fraction(y) if isinstance(y, bool | int) else y  # noqa: E731
    return _entrywise(value)(reader, equation, operands)


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
        return Varying(found, _shape(equation))

    return rule


def _folded(folded: np.ufunc) -> Callable[..., Varying]:
    """Reductions over axes."""

    def rule(reader: Reader, equation: Any, operands: Sequence[Any]) -> Varying:
        (value,) = operands
        found = value.array
        for axis in sorted(equation.params["axes"], reverse=True):
            found = folded.reduce(found, axis=axis)
        return Varying(np.asarray(found, object), _shape(equation))

    return rule


def _so_far(folded: np.ufunc) -> Callable[..., Varying]:
    def rule(reader: Reader, equation: Any, operands: Sequence[Any]) -> Varying:
        axis, turned = equation.params["axis"], equation.params["reverse"]
        given = np.flip(operands[0].array, axis) if turned else operands[0].array
        found = folded.accumulate(given, axis=axis)
        return Varying(np.flip(found, axis) if turned else found, _shape(equation))

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
        return Varying(place, _shape(equation))

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
        return Varying(np.stack(rows), _shape(equation))

    return rule


def _contracted(reader: Reader, equation: Any, operands: Sequence[Any]) -> Varying:
    (over_left, over_right), (batch_left, batch_right) = equation.params["dimension_numbers"]

    def arranged(operand: Any, batch: Sequence[int], over: Sequence[int]) -> np.ndarray:
        value = reader.of(operand)
        free = [k for k in range(len(value.shape)) if k not in (*batch, *over)]
        sizes = [math.prod(value.shape[k] for k in axes) for axes in (batch, free, over)]
        return value.array.transpose(*batch, *free, *over, -1).reshape(*sizes, -1)

    left = arranged(operands[0], batch_left, over_left)[:, :, None]
    right = arranged(operands[1], batch_right, over_right)[:, None]
    return Varying(np.add.reduce(left * right, axis=3), _shape(equation))


def _convolved(reader: Reader, equation: Any, operands: Sequence[Any]) -> Varying:
    """A bilinear function: the entries' products times what it makes of ones."""
    left, right = map(reader.of, operands)

    def of(one: Any, other: Any) -> Any:
        given = one.reshape(left.shape), other.reshape(right.shape)
        return equation.primitive.bind(*given, **equation.params).ravel()

    ones = [jnp.eye(len(each.numbers)) for each in (left, right)]
    weights = fractions_of(jax.vmap(lambda a: jax.vmap(lambda b: of(a, b))(ones[1]))(ones[0]))
    found = np.full((weights.shape[-1], reader.points), Fraction(0), object)
    for i, j, k in np.argwhere(weights != 0):
        found[k] = found[k] + weights[i, j, k] * left.numbers[i] * right.numbers[j]
    return Varying(found, _shape(equation))


def fractions_of(plain: Any) -> np.ndarray:
    """Floats as fractions."""
    return np.frompyfunc(Fraction, 1, 1)(np.asarray(plain, float))


def _sorted(reader: Reader, equation: Any, operands: Sequence[Any]) -> list[Varying]:
    axis, keys = equation.params["dimension"], equation.params["num_keys"]
    given = [np.moveaxis(reader.of(each).array, axis, 0) for each in operands]
    found = [each.copy() for each in given]
    for at in np.ndindex(given[0].shape[1:]):
        columns = [each[(slice(None), *at)] for each in given]
        order = sorted(range(len(columns[0])), key=lambda i: [c[i] for c in columns[:keys]])
        for each, column in zip(found, columns, strict=True):
            each[(slice(None), *at)] = column[order]
    return [Varying(np.moveaxis(each, 0, axis), _shape(equation)) for each in found]


def _largest(reader: Reader, equation: Any, operands: Sequence[Any]) -> list[Varying]:
    rows = np.moveaxis(operands[0].array, -2, 0)
    count = equation.params["k"]
    values, places = (np.empty((count, *rows.shape[1:]), object) for _ in range(2))
    for at in np.ndindex(rows.shape[1:]):
        column = rows[(slice(None), *at)]
        order = sorted(range(len(column)), key=lambda i: -column[i])[:count]
        values[(slice(None), *at)] = column[order]
        places[(slice(None), *at)] = [Fraction(k) for k in order]
    return [Varying(np.moveaxis(each, 0, -2), _shape(equation)) for each in (values, places)]


def _chosen(which: Any, *cases: Any) -> Any:
    return cases[int(which)]


def _sign(y: Any) -> Fraction:
    return Fraction((y > 0) - (y < 0))


def _remainder(y: Any, by: Any) -> Any:
    return y - by * math.trunc(y / by)


def _log_of_size_of_gamma(y: Any) -> Any:
    return mpmath.log(abs(mpmath.gamma(y)))


def _real_root(y: Any) -> Any:
    return mpmath.cbrt(y) if y >= 0 else -mpmath.cbrt(-y)


def _same(y: Any) -> Any:
    return y


PLACES: dict[str, tuple[int, ...]] = {
    **dict.fromkeys(["gather", "dynamic_slice"], (0,)),
    "dynamic_update_slice": (0, 1),
    "scatter": (0, 2),
    # fmt: off
    **dict.fromkeys(
        ["reshape", "transpose", "broadcast_in_dim", "squeeze", "expand_dims", "slice", "rev",
         "concatenate", "pad", "split", "tile", "stack", "unstack"], ()
    ),
    # fmt: on
}
"""Which operands of what moves entries are moved; of the others all are."""

EXACT: dict[str, Callable[..., Any]] = {
    "add": operator.add,
    "add_any": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "div": operator.truediv,
    "neg": operator.neg,
    "abs": abs,
    "max": max,
    "min": min,
    "clamp": lambda low, y, high: min(max(y, low), high),
    "square": lambda y: y * y,
    "sign": _sign,
    "floor": lambda y: Fraction(math.floor(y)),
    "ceil": lambda y: Fraction(math.ceil(y)),
    "rem": _remainder,
    "select_n": _chosen,
    "is_finite": lambda y: isinstance(y, Fraction),
    "eq": operator.eq,
    "ne": operator.ne,
    "lt": operator.lt,
    "le": operator.le,
    "gt": operator.gt,
    "ge": operator.ge,
    "and": lambda a, b: a and b,
    "or": lambda a, b: a or b,
    "xor": operator.ne,
    "not": operator.not_,
    "copy": _same,
    "copy_p": _same,
    "stop_gradient": _same,
    "real": _same,
}

NOT_RATIONAL: dict[str, Callable[..., Any]] = {
    **{
        name: getattr(mpmath, name)
        for name in (
            "exp expm1 log log1p sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh "
            "atan2 erf erfc digamma"
        ).split()
    },
    "exp2": lambda y: mpmath.power(2, y),
    "logistic": lambda y: 1 / (1 + mpmath.exp(-y)),
    "rsqrt": lambda y: 1 / mpmath.sqrt(y),
    "cbrt": _real_root,
    "erf_inv": mpmath.erfinv,
    "lgamma": _log_of_size_of_gamma,
}

RULES: dict[str, Callable[..., Any]] = {
    **{name: _entrywise(function) for name, function in EXACT.items()},
    **{name: _digits(function) for name, function in NOT_RATIONAL.items()},
    **{name: _moved(*places) for name, places in PLACES.items()},
    "optimization_barrier": lambda reader, equation, operands: list(operands),
    "integer_pow": lambda reader, equation, operands: _entrywise(
        lambda y: y ** equation.params["y"]
    )(reader, equation, operands),
    "pow": _power,
    "sqrt": _root,
    "round": _rounded,
    "convert_element_type": _converted,
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
    "dot_general": _contracted,
    "conv_general_dilated": _convolved,
    "sort": _sorted,
    "top_k": _largest,
}
