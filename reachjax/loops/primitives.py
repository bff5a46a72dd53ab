"""What each primitive of a jaxpr is as steps of a recording.

Affine ones and those that move entries become matrices and choices of entries; the others are units
and what is made of them. Choices between numbers are continuous ones in disguise, or errors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from reachjax.loops.recording import Comparison, Operand, Recorder, Value, common, is_known
from reachjax.loops.units import Atan, Cos, Exp, Log, Reciprocal, Sin, Sqrt, Tanh, clipped

Parameters = dict[str, Any]

Rule = Callable[[Recorder, "Equation", Sequence[Operand]], Any]
"""From the operands, of which one at least is no plain array, to the value, or to several."""

AGREE = 1e-12
"""Coefficients that differ by no more than this part of them are the same."""


class Equation:
    """One equation of a jaxpr.

    Attributes:
        name: of the primitive.
        shape: of its first output.
        params: of the primitive.
        evaluate: what the primitive makes of plain arrays.
    """

    def __init__(self, equation: Any):
        self.name = equation.primitive.name
        self.shape = tuple(equation.outvars[0].aval.shape)
        self.kind = equation.outvars[0].aval.dtype
        self.params, self._primitive = equation.params, equation.primitive

    def evaluate(self, *operands: Any) -> Any:
        """Plain arrays in, plain arrays out: numpy's if all are."""
        if not is_known(operands):
            return self._primitive.bind(*operands, **self.params)
        with jax.ensure_compile_time_eval():  # known numbers stay known where others are traced
            found = self._primitive.bind(*operands, **self.params)
        on_host = all(isinstance(each, np.ndarray | np.generic) for each in operands)
        return jax.tree.map(np.asarray, found) if on_host else found


class UnsupportedError(Exception):
    """That a primitive cannot be certified, and what to do.

    Attributes:
        primitive: its name, once it is known.
        line: where a user wrote it, the same.
    """

    primitive, line = "", ""


# fmt: off
DISCONTINUOUS = (
    "sign", "round", "floor", "ceil", "argmax", "argmin", "sort", "is_finite", "rem", "and",
    "or", "not", "xor", "nextafter", "shift_left", "reduce_and", "reduce_or", "top_k",
)
"""Primitives that jump."""

MOVING = (
    "reshape", "squeeze", "expand_dims", "transpose", "broadcast_in_dim", "slice", "rev",
    "dynamic_slice", "gather", "split",
)
"""Primitives that only move entries."""
# fmt: on


def recorded(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    """The value, or a list of them, of one equation.

    Raises:
        UnsupportedError: there is no rule for it.
    """
    if not any(isinstance(each, Value | Comparison) for each in operands):
        return equation.evaluate(*operands)
    rule = RULES.get(equation.name)
    if any(isinstance(each, Comparison) for each in operands) and rule is not _selected:
        raise UnsupportedError(
            "a comparison of numbers may only choose between two of them that agree where it "
            "changes, as jnp.where(y > 0, y, 0.1 * y) does"
        )
    if rule is None and equation.name in DISCONTINUOUS:
        raise UnsupportedError(
            "it is discontinuous: bounds of what follows would be those of its range"
        )
    if rule is None:
        raise UnsupportedError(
            "there are no bounds for it: write it with primitives that have some"
        )
    return rule(recorder, equation, operands)


def _same_shape(recorder: Recorder, operand: Operand, shape: tuple[int, ...]) -> Operand:
    if isinstance(operand, Value):
        return operand if operand.shape == shape else recorder.broadcast(operand, shape)
    return jnp.broadcast_to(operand, shape) if not _on_host(operand) else _wide(operand, shape)


def _on_host(operand: Any) -> bool:
    return isinstance(operand, np.ndarray | np.generic | float | int)


def _wide(operand: Any, shape: tuple[int, ...]) -> np.ndarray:
    return np.broadcast_to(np.asarray(operand, float), shape)


def _entrywise(rule: Rule) -> Rule:
    """With operands brought to the shape of the result."""

    def widened(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
        same = [_same_shape(recorder, each, equation.shape) for each in operands]
        return rule(recorder, equation, same)

    return widened


def _moved(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    """Primitives that only move entries: done to their numbers."""
    value, *others = operands
    if not isinstance(value, Value) or not all(map(is_known, others)):
        raise UnsupportedError(
            "which entries it takes must not depend on inputs or traced parameters"
        )
    with jax.ensure_compile_time_eval():
        numbers = jnp.arange(value.size).reshape(value.shape)
        moved = equation.evaluate(numbers, *others)
    if isinstance(moved, list | tuple):
        return [recorder.picked(value, np.asarray(part)) for part in moved]  # type: ignore[return-value]
    index = np.asarray(moved)
    if index.size and not (index.min() >= 0 and index.max() < value.size):
        raise UnsupportedError("it takes entries that there are not")
    return recorder.picked(value, index)


def _joined(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    """Concatenation and stacking: done to the numbers of entries."""
    numbers, end = [], 0
    for each in operands:
        shape = each.shape if isinstance(each, Value) else np.shape(each)
        numbers.append(np.arange(end, end + math.prod(shape)).reshape(shape))
        end += math.prod(shape)
    with jax.ensure_compile_time_eval():
        index = equation.evaluate(*map(jnp.asarray, numbers))
    return recorder.picked(recorder.joined(operands), np.asarray(index))


def _linear(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    """Any primitive that is linear in its one operand that is no plain array: as a matrix."""
    (where,) = (k for k, each in enumerate(operands) if isinstance(each, Value))
    value = operands[where]

    def of(flat: Any) -> Any:
        given = [*operands]
        given[where] = flat.reshape(value.shape)
        return equation.evaluate(*given).reshape(-1)

    matrix = jax.vmap(of)(jnp.eye(value.size)).T
    if is_known(matrix) and all(_on_host(each) for each in operands if each is not value):
        matrix = np.asarray(matrix)
    return recorder.mapped(value, matrix, equation.shape)


def _padded(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    value, around = operands
    if isinstance(around, Value) or not is_known(around) or np.asarray(around) != 0:
        raise UnsupportedError("it must pad with zeros")
    return _linear(recorder, equation, [value, np.asarray(around)])


def _contracted(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    left, right = operands
    (over_left, over_right), (batch_left, batch_right) = equation.params["dimension_numbers"]
    if not (isinstance(left, Value) and isinstance(right, Value)):
        plain, value = (right, left) if isinstance(left, Value) else (left, right)
        if np.ndim(plain) == 2 and len(value.shape) == 1 and len(over_left) == 1:
            axis = over_right[0] if isinstance(left, Value) else over_left[0]
            return recorder.mapped(value, plain if axis == 1 else plain.T, equation.shape)
        return _linear(recorder, equation, operands)

    def arranged(value: Value, batch: Sequence[int], over: Sequence[int]) -> np.ndarray:
        """Numbers of entries as `(batch, free, contracted)`."""
        index = np.arange(value.size).reshape(value.shape)
        free = [k for k in range(index.ndim) if k not in (*batch, *over)]
        sizes = [math.prod(value.shape[k] for k in axes) for axes in (batch, free, over)]
        return index.transpose(*batch, *free, *over).reshape(sizes)

    one, other = (
        arranged(left, batch_left, over_left)[:, :, None],
        arranged(right, batch_right, over_right)[:, None],
    )
    one, other = np.broadcast_arrays(one, other)
    products = recorder.product(recorder.picked(left, one), recorder.picked(right, other))
    count = math.prod(equation.shape)
    sums = np.kron(np.eye(count), np.ones((1, one.shape[-1])))
    return recorder.mapped(products, sums, equation.shape)


@_entrywise
def _sum(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    return recorder.added(operands[0], operands[1])


@_entrywise
def _difference(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    return recorder.added(operands[0], operands[1], -1)


@_entrywise
def _product(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    one, other = operands
    if not isinstance(other, Value):
        return recorder.scaled(one, other)
    return recorder.product(one, other) if isinstance(one, Value) else recorder.scaled(other, one)


@_entrywise
def _quotient(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    one, other = operands
    if not isinstance(other, Value):
        return recorder.scaled(one, 1.0 / other)
    inverse = recorder.unit(Reciprocal(), other)
    if isinstance(one, Value):
        return recorder.product(one, inverse)
    return recorder.scaled(inverse, one)


def _raised(recorder: Recorder, value: Value, power: int) -> Any:
    """A whole power, by squares and products."""
    if power < 0:
        return recorder.unit(Reciprocal(), _raised(recorder, value, -power))
    if power == 0:
        return np.ones(value.shape)
    half = value if power < 2 else _raised(recorder, value, power // 2)
    if power < 2:
        return half
    square = recorder.product(half, half)
    return square if power % 2 == 0 else recorder.product(square, value)


def _integer_power(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    return _raised(recorder, operands[0], equation.params["y"])


def _power(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    value, power = operands
    if isinstance(power, Value) or not is_known(power) or len(np.unique(power)) != 1:
        raise UnsupportedError("the exponent must be one known number")
    exponent = float(np.unique(power)[0])
    if exponent.is_integer():
        return _raised(recorder, value, int(exponent))
    if exponent == 0.5:
        return recorder.unit(Sqrt(), value)
    return recorder.unit(Exp(), recorder.scaled(recorder.unit(Log(), value), np.array(exponent)))


@_entrywise
def _largest(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    one, other = operands
    if not isinstance(one, Value):
        one, other = other, one
    if not isinstance(other, Value) and is_known(other) and not np.any(other):
        return recorder.rectified(one)
    return recorder.added(recorder.rectified(recorder.added(one, other, -1)), other)


@_entrywise
def _smallest(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    one, other = operands
    if not isinstance(one, Value):
        one, other = other, one
    return recorder.added(one, recorder.rectified(recorder.added(one, other, -1)), -1)


@_entrywise
def _clamped(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    least, value, most = operands
    if not isinstance(value, Value) or isinstance(least, Value) or isinstance(most, Value):
        raise UnsupportedError("its limits must be constants: use jnp.minimum and jnp.maximum")
    low, high = (each.reshape(-1) for each in (least, most))
    place = value.place
    return recorder._added(value.shape, lambda found, unit: clipped(found[place], low, high, unit))


def _reduced(rule: Rule) -> Rule:
    """By halves along the axes that vanish."""

    def folded(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
        (value,), axes = operands, equation.params["axes"]
        index = np.arange(value.size).reshape(value.shape)
        kept = [k for k in range(index.ndim) if k not in axes]
        index = index.transpose(*axes, *kept).reshape(-1, *equation.shape)
        parts = [recorder.picked(value, each) for each in index]
        while len(parts) > 1:
            pairs = zip(parts[::2], parts[1::2], strict=False)
            rest = parts[-1:] if len(parts) % 2 else []
            parts = [rule(recorder, equation, pair) for pair in pairs] + rest
        return parts[0]

    return folded


def _absolute(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    (value,) = operands
    return recorder.added(recorder.scaled(recorder.rectified(value), 2.0), value, -1)


@_entrywise
def _compared(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Comparison:
    one, other = operands if equation.name in ("gt", "ge") else reversed(operands)
    return Comparison(recorder.added(one, other, -1))


@_entrywise
def _whether_different(
    recorder: Recorder, equation: Equation, operands: Sequence[Operand]
) -> np.ndarray:
    """A number is different from itself only where it is none."""
    one, other = operands
    if isinstance(one, Value) and isinstance(other, Value) and one.place == other.place:
        return np.full(equation.shape, equation.name == "eq")
    raise UnsupportedError(
        "it is discontinuous: bounds of what follows would be those of its range"
    )


def _selected(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Any:
    which, *cases = operands
    if not isinstance(which, Comparison):
        if isinstance(which, Value):
            raise UnsupportedError(
                "what is chosen must not depend on numbers that depend on inputs"
            )
        cases = [_same_shape(recorder, each, equation.shape) for each in cases]
        return _chosen(recorder, np.asarray(which) if is_known(which) else which, cases)
    if len(cases) != 2:
        raise UnsupportedError("it must choose between two numbers")
    condition = _same_shape(recorder, which.value, equation.shape)
    below, above = (_same_shape(recorder, each, equation.shape) for each in cases)
    return _bent(recorder, condition, below, above)


def _chosen(recorder: Recorder, which: Any, cases: Sequence[Operand]) -> Value:
    """Entries of several operands, by known numbers; or weighed, by traced ones."""
    if is_known(which):
        joined = recorder.joined(cases)
        count = math.prod(cases[0].shape)
        which = np.broadcast_to(np.asarray(which, int), cases[0].shape)
        return recorder.picked(joined, which * count + np.arange(count).reshape(which.shape))
    parts: list[Any] = []
    for number, each in enumerate(cases):
        weight = jnp.broadcast_to(which == number, each.shape).astype(float)
        parts.append(recorder.scaled(each, weight) if isinstance(each, Value) else weight * each)
    return reduce(recorder.added, parts)


def _bent(recorder: Recorder, condition: Value, below: Operand, above: Operand) -> Value:
    """`above` where the condition is above zero, else `below`: `below + k max(condition, 0)`.

    That is so where `above - below = k condition` (a function that is bent, and continuous).
    """
    shared = common(condition, below, above)
    if shared is not None:
        on, low, high = shared
        parts = on.scale, on.offset, high.scale - low.scale, high.offset - low.offset
        if is_known(parts):
            scale, offset, rise, lift = np.broadcast_arrays(*map(np.asarray, parts))
            slope = rise / np.where(scale == 0, 1.0, scale)
            near = AGREE * (abs(slope * offset) + abs(lift))
            if np.all(scale != 0) and np.all(abs(slope * offset - lift) <= near):
                slope = np.broadcast_to(slope, (condition.size,)).reshape(condition.shape)
                bend = recorder.scaled(recorder.rectified(condition), slope)
                return recorder.added(bend, below)
    raise UnsupportedError(
        "where values are chosen by a comparison, both must be affine in what is compared and "
        "agree where it changes, as in jnp.where(y > 0, y, 0.1 * y): use jnp.maximum, jnp.minimum "
        "or jnp.clip"
    )


def _by_unit(unit: Any) -> Rule:
    return lambda recorder, equation, operands: recorder.unit(unit, operands[0])


def _logistic(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    half = recorder.unit(Tanh(), recorder.scaled(operands[0], np.array(0.5)))
    return recorder.shifted(recorder.scaled(half, np.array(0.5)), np.array(0.5))


def _tangent(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    sine, cosine = (recorder.unit(unit, operands[0]) for unit in (Sin(), Cos()))
    return recorder.product(sine, recorder.unit(Reciprocal(), cosine))


def _inverse_root(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    return recorder.unit(Reciprocal(), recorder.unit(Sqrt(), operands[0]))


def _log_of_more(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    return recorder.unit(Log(), recorder.shifted(operands[0], np.array(1.0)))


def _exp_less_one(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    return recorder.shifted(recorder.unit(Exp(), operands[0]), np.array(-1.0))


def _power_of_two(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    return recorder.unit(Exp(), recorder.scaled(operands[0], np.array(math.log(2.0))))


def _square(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    return recorder.product(operands[0], operands[0])


def _negated(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    return recorder.scaled(operands[0], np.array(-1.0))


def _cast(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Value:
    if equation.kind != np.float64:
        raise UnsupportedError(
            f"it rounds to {equation.kind}: compute in 64-bit floats, for example by not giving "
            "layers a dtype"
        )
    return operands[0]


def _itself(recorder: Recorder, equation: Equation, operands: Sequence[Operand]) -> Operand:
    return operands[0]


RULES: dict[str, Rule] = {
    **dict.fromkeys(MOVING, _moved),
    **dict.fromkeys(("concatenate", "stack"), _joined),
    **dict.fromkeys(
        ["reduce_sum", "cumsum", "conv_general_dilated", "reduce_window_sum"],
        _linear,
    ),
    **dict.fromkeys(["copy", "copy_p", "stop_gradient", "optimization_barrier"], _itself),
    "convert_element_type": _cast,
    "pad": _padded,
    "dot_general": _contracted,
    "add": _sum,
    "add_any": _sum,
    "sub": _difference,
    "neg": _negated,
    "mul": _product,
    "div": _quotient,
    "square": _square,
    "integer_pow": _integer_power,
    "pow": _power,
    "max": _largest,
    "min": _smallest,
    "clamp": _clamped,
    "reduce_max": _reduced(_largest),
    "reduce_min": _reduced(_smallest),
    "abs": _absolute,
    **dict.fromkeys(("gt", "ge", "lt", "le"), _compared),
    **dict.fromkeys(("eq", "ne"), _whether_different),
    "select_n": _selected,
    "tanh": _by_unit(Tanh()),
    "sin": _by_unit(Sin()),
    "cos": _by_unit(Cos()),
    "atan": _by_unit(Atan()),
    "exp": _by_unit(Exp()),
    "log": _by_unit(Log()),
    "sqrt": _by_unit(Sqrt()),
    "logistic": _logistic,
    "tan": _tangent,
    "rsqrt": _inverse_root,
    "log1p": _log_of_more,
    "expm1": _exp_less_one,
    "exp2": _power_of_two,
}
