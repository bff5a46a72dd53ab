"""Rules of the exact reader: what each primitive of JAX makes of fractions."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mpmath
import numpy as np

from tests.oracles.exact.exact_linear import LINEAR
from tests.oracles.exact.exact_moves import MOVES, shape_of
from tests.oracles.exact.varying import UndefinedError, Varying, fractions

if TYPE_CHECKING:
    from tests.oracles.exact.exact_reader import Reader


DIGITS = 60


def _entrywise(function: Callable[..., Any]) -> Callable[..., Varying]:
    """A function of the numbers at each place."""

    def rule(reader: Reader, equation: Any, operands: Sequence[Any]) -> Varying:
        shape = shape_of(equation)
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
        return Varying(roots, shape_of(equation))
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
    if jnp.issubdtype(kind, jnp.bool_):
        value = bool
    elif jnp.issubdtype(kind, jnp.integer):
        value = lambda y: Fraction(math.trunc(y))  # noqa: E731
    else:
        value = lambda y: Fraction(y) if isinstance(y, bool | int) else y  # noqa: E731
    return _entrywise(value)(reader, equation, operands)


def _contracted(reader: Reader, equation: Any, operands: Sequence[Any]) -> Varying:
    (over_left, over_right), (batch_left, batch_right) = equation.params["dimension_numbers"]

    def arranged(operand: Any, batch: Sequence[int], over: Sequence[int]) -> np.ndarray:
        value = reader.of(operand)
        free = [k for k in range(len(value.shape)) if k not in (*batch, *over)]
        sizes = [math.prod(value.shape[k] for k in axes) for axes in (batch, free, over)]
        return value.array.transpose(*batch, *free, *over, -1).reshape(*sizes, -1)

    left = arranged(operands[0], batch_left, over_left)[:, :, None]
    right = arranged(operands[1], batch_right, over_right)[:, None]
    return Varying(np.add.reduce(left * right, axis=3), shape_of(equation))


def _convolved(reader: Reader, equation: Any, operands: Sequence[Any]) -> Varying:
    """A bilinear function: the entries' products times what it makes of ones."""
    left, right = map(reader.of, operands)

    def of(one: Any, other: Any) -> Any:
        given = one.reshape(left.shape), other.reshape(right.shape)
        return equation.primitive.bind(*given, **equation.params).ravel()

    ones = [jnp.eye(len(each.numbers)) for each in (left, right)]
    weights = fractions(jax.vmap(lambda a: jax.vmap(lambda b: of(a, b))(ones[1]))(ones[0]))
    found = np.full((weights.shape[-1], reader.points), Fraction(0), object)
    for i, j, k in np.argwhere(weights != 0):
        found[k] = found[k] + weights[i, j, k] * left.numbers[i] * right.numbers[j]
    return Varying(found, shape_of(equation))


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
    "lt_to": operator.lt,
    "le_to": operator.le,
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


TRANSCENDENTAL = [
    "exp", "expm1", "log", "log1p", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh",
    "tanh", "asinh", "acosh", "atanh", "atan2", "erf", "erfc", "digamma",
]  # fmt: skip
"""Primitives that mpmath has under their names."""


NOT_RATIONAL: dict[str, Callable[..., Any]] = {
    **{name: getattr(mpmath, name) for name in TRANSCENDENTAL},
    "exp2": lambda y: mpmath.power(2, y),
    "logistic": lambda y: 1 / (1 + mpmath.exp(-y)),
    "rsqrt": lambda y: 1 / mpmath.sqrt(y),
    "cbrt": _real_root,
    "erf_inv": mpmath.erfinv,
    "lgamma": _log_of_size_of_gamma,
}


RULES: dict[str, Callable[..., Any]] = {
    **MOVES,
    **LINEAR,
    **{name: _entrywise(function) for name, function in EXACT.items()},
    **{name: _digits(function) for name, function in NOT_RATIONAL.items()},
    "integer_pow": lambda reader, equation, operands: _entrywise(
        lambda y: y ** equation.params["y"]
    )(reader, equation, operands),
    "pow": _power,
    "sqrt": _root,
    "round": _rounded,
    "convert_element_type": _converted,
    "dot_general": _contracted,
    "conv_general_dilated": _convolved,
}
