"""Midpoint-radius arithmetic: numbers with a bound on how far they can be from the exact ones.

A `Ball` stands for every exact array `a` with `|a - mid| <= rad`, entry by entry. Its operations
enlarge `rad` by what rounding can add: a sum of `k` products of floating-point numbers is off by
at most `gamma(k) |W| |x|` in whatever order it is formed (Higham, Accuracy and Stability of
Numerical Algorithms, section 3.1; Rump, Fast and parallel interval arithmetic, BIT 1999). The same
arithmetic therefore serves two purposes: intervals of values, and rounding errors of coefficients.

Rounding is a layer: in a scope `rounding(False)` what it may add is `NOTHING`, a zero with which
sums and products are not computed at all. The same formulas then give what would hold in exact
arithmetic, in a fraction of the operations: enough for penalties and first looks, and no bound.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.xla_metadata import set_xla_metadata

from reachjax.numerics.checks import floats_of, is_concrete
from reachjax.numerics.numbers import AbstractNumber
from reachjax.numerics.pytrees import pytree

UNIT = 2.0**-53
"""The unit roundoff of float64."""

TINY = float(np.finfo(float).tiny)
"""The smallest positive number that XLA tells from zero: what underflow takes from a product."""

_COUNTED: ContextVar[bool] = ContextVar("counted", default=True)


@jax.tree_util.register_static
class Nothing:
    """The zero that rounding adds where it is not counted: what is added to it stays as it is."""

    __array_ufunc__ = None  # arrays of numpy leave arithmetic to this class

    def __add__(self, other: Any) -> Any:
        return WHOLE if type(other) is int and other == 1 else other

    __radd__ = __add__

    def __rsub__(self, other: Any) -> Any:
        return other + self

    def __mul__(self, other: Any) -> Nothing:
        return self

    __rmul__ = __truediv__ = __matmul__ = __rmatmul__ = __getitem__ = __mul__

    def __abs__(self) -> Nothing:
        return self

    def __repr__(self) -> str:
        return "NOTHING"


class Whole:
    """The factor `1 + NOTHING`: what is multiplied by it stays as it is."""

    __array_ufunc__ = None

    def __mul__(self, other: Any) -> Any:
        return other

    __rmul__ = __mul__

    def __add__(self, other: Any) -> Any:
        return 1.0 + other

    __radd__ = __add__

    def __sub__(self, other: Any) -> Any:
        return 1.0 - other


NOTHING, WHOLE = Nothing(), Whole()


@contextmanager
def rounding(counted: bool) -> Iterator[None]:
    """A scope in which errors of rounding are counted, or are not: then nothing in it is a bound.

    What JAX compiles is kept for each kind of scope apart: else whoever calls a function first
    would decide whether its later values are bounds.

    Example:
        >>> with rounding(False):
        ...     2.0 * (1 + gamma(3)) + gamma(3) * 5.0
        2.0
    """
    same = counted is is_counted()
    told_apart = nullcontext() if same else set_xla_metadata(rounding=str(counted))
    token = _COUNTED.set(counted)
    try:
        with told_apart:
            yield
    finally:
        _COUNTED.reset(token)


def is_counted() -> bool:
    """Whether errors of rounding are counted."""
    return _COUNTED.get()


def counting(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with errors of rounding counted, wherever it is called."""

    @functools.wraps(function)
    def counted(*given: Any, **named: Any) -> Any:
        with rounding(True):
            return function(*given, **named)

    return counted


def errors(size: Callable[[], Any]) -> Any:
    """What rounding may add, of which no derivative is taken; nothing where it is not counted."""
    return constant(size()) if is_counted() else NOTHING


def namespace(*numbers: Any) -> Any:
    """The module whose functions these numbers want: `jax.numpy`, or numpy if none is of JAX.

    What is written over it serves compiled code and the host alike, where nothing is compiled.

    Example:
        >>> namespace(np.zeros(2), 1.0).__name__, namespace(jnp.zeros(2)).__name__
        ('numpy', 'jax.numpy')
    """
    for each in numbers:
        if type(each) not in OF_HOST and isinstance(each, jax.Array):
            return jnp
    return np


OF_HOST = frozenset([np.ndarray, np.float64, np.bool_, float, int, bool])
"""Types that are none of JAX, for whom there is no need to ask slowly."""


def larger(one: Any, other: Any) -> Any:
    """The larger of two numbers each: NaN if the first one is, the first one if the second is NaN.

    `jnp.maximum` halves its derivative where both are equal, which takes long to compile.
    """
    return select(one < other, other, one)


def smaller(one: Any, other: Any) -> Any:
    """The smaller of two numbers each, as `larger`."""
    return select(one > other, other, one)


def select(which: Any, one: Any, other: Any) -> Any:
    """The one number where something is so, and the other one elsewhere.

    As `where`, which is a call of its own for compilers.
    """
    if namespace(which, one, other) is np:
        return np.where(which, one, other)
    shape = np.broadcast_shapes(*(np.shape(each) for each in (which, one, other)))
    kind = jnp.result_type(one, other)
    cases = (_filled(each, shape, kind) for each in (one, other))
    return jax.lax.select(_filled(which, shape, bool), *cases)


def _filled(number: Any, shape: tuple[int, ...], kind: Any) -> Any:
    """An array of JAX of a shape."""
    if np.shape(number) == shape and getattr(number, "dtype", None) == kind:
        return number if isinstance(number, jax.Array) else jnp.asarray(number)
    if np.ndim(number) == 0 and not isinstance(number, jax.Array):
        return jax.lax.full(shape, number, kind)
    return jnp.broadcast_to(jnp.asarray(number, kind), shape)


def settled(parts: Any) -> Any:
    """One rounding of numbers for all that is made of them, whatever a compiler fuses.

    They define what a column stands for, which must be the same wherever it is; a comparison of
    them chooses between relaxations, whose slope and offset must be those of one. On a CPU XLA
    drops barriers before it fuses, and computes what is behind them again for each of its uses: for
    each entry of a row, where the row is concatenated. A call that it must not inline is kept.
    """
    if namespace(*jax.tree.leaves(parts)) is np:
        return parts
    if jax.default_backend() != "cpu":
        return jax.lax.optimization_barrier(parts)
    with set_xla_metadata(inlineable="false"):
        return _called(parts)


_called = jax.jit(jax.lax.optimization_barrier)


def constant(numbers: Any) -> Any:
    """What derivatives take for a constant: what rounding may add does not depend on anything."""
    return jax.lax.stop_gradient(numbers) if namespace(numbers) is not np else numbers


def gamma(operations: int) -> Any:
    """Relative error bound of `operations` rounded operations, with eight to spare.

    Recordings of functions use these up where a constant is rounded, as that of `x / 3`.
    """
    if not is_counted():
        return NOTHING
    count = (operations + 8) * UNIT
    return count / (1.0 - count)


def underflow(matrix: Any, there: Any, count: int = 1) -> Any:
    """What underflow may take from each row of a matrix times numbers, and from their sums.

    It takes less than `TINY` from a product, or from a sum where tiny numbers count as zeros. A
    relative error does not see it: of what vanishes nothing is left to be a part of. Nothing is
    taken where a factor is zero.

    Args:
        matrix: the factors.
        there: which numbers are not zero.
        count: how many of these stand side by side, such as the coefficients of a form.
    """
    return 2 * TINY * count * ((matrix != 0) * 1.0 @ (there * 1.0))


def holds_subnormals(tree: Any) -> bool:
    """Whether a known number of a tree is not zero, but XLA takes it for zero.

    Example:
        >>> holds_subnormals([1.0, 1e-310]), holds_subnormals([1.0, 0.0])
        (True, False)
    """
    sizes = (abs(np.asarray(leaf)) for leaf in floats_of(tree) if is_concrete(leaf))
    return any(bool(((size > 0) & (size < TINY)).any()) for size in sizes)


def exponents(rows) -> Any:
    """Whole numbers `e`, one a row, with the row's largest entry in `[2^e, 2^(e+1))`; -1 for zeros.

    Derivatives take them for constants.
    """
    return jnp.frexp(jax.lax.stop_gradient(jnp.max(abs(rows), axis=-1)))[1] - 1


def shifted(numbers, by) -> Any:
    """`numbers * 2^by`, exact unless it overflows or underflows.

    In two factors, neither of which leaves the range of floats before the product does.
    """
    by = jnp.clip(by, -2044, 2046)  # beyond, everything overflows or underflows
    half = by // 2
    return numbers * _power(half) * _power(by - half)


def raised(numbers, by) -> Any:
    """`numbers * 2^by`, rounded up where it underflows."""
    values = shifted(numbers, by)
    return jnp.where((numbers > 0) & (values < TINY), TINY, values)


def _power(exponent) -> Any:
    """`2^exponent` from -1022 to 1023: the bits, since a compiled power may be rounded."""
    kind = jnp.finfo(jnp.result_type(float))  # that of float32 where 64-bit floats are off
    bits = (jnp.asarray(exponent, dtype=f"int{kind.bits}") + kind.maxexp - 1) << kind.nmant
    return jax.lax.bitcast_convert_type(bits, kind.dtype)


def lengths(rows) -> Any:
    """The norm of each row, whose squares may overflow or vanish."""
    by = exponents(rows)
    return shifted(jnp.linalg.norm(shifted(rows, -by[..., None]), axis=-1), by)


@pytree
class Ball(AbstractNumber):
    """Arrays `mid` and `rad >= 0` of one shape: all `a` with `|a - mid| <= rad`."""

    mid: Any
    rad: Any

    def __len__(self) -> int:
        return self.mid.shape[0]

    @classmethod
    def exact(cls, mid) -> Self:
        """Numbers taken as they are: a ball of radius zero."""
        return cls(mid, namespace(mid).zeros_like(mid))

    @classmethod
    def joined(cls, parts: Sequence[Ball]) -> Self:
        """The numbers of several, one behind the other."""
        if len(parts) == 1:
            return parts[0]  # type: ignore[return-value]
        xp = namespace(*(part.mid for part in parts))
        mid, rad = (xp.concatenate([getattr(y, name) for y in parts]) for name in ("mid", "rad"))
        return cls(mid, rad)

    @property
    def lower(self):
        """A lower bound of every entry."""
        return self.mid - self.rad * (1 + gamma(2)) - gamma(2) * abs(self.mid)

    @property
    def upper(self):
        """An upper bound of every entry."""
        return self.mid + self.rad * (1 + gamma(2)) + gamma(2) * abs(self.mid)

    @classmethod
    def between(cls, lower, upper) -> Self:
        """A ball that surely holds `[lower, upper]`; a single point is held exactly.

        A compiler may evaluate an expression in several places and round it differently in each,
        so the radius holds for every rounding of the midpoint. It takes what is no normal number
        for zero, the width of narrow ranges among them.
        """
        mid = lower + (upper - lower) / 2
        if not is_counted():
            return cls(mid, (upper - lower) / 2)
        rad = (upper - lower) / 2 * (1 + gamma(4)) + gamma(4) * abs(mid)
        if namespace(mid) is not np:
            rad = rad + 2 * TINY
        return cls(mid, select(lower == upper, 0.0, rad))

    @property
    def _there(self):
        """Which numbers are not zero."""
        return (self.mid != 0) | (self.rad != 0)

    def lift(self, other) -> Ball:
        """`other` as a ball of this kind; plain numbers are taken to be exact."""
        return other if isinstance(other, Ball) else type(self).exact(other)

    def _rebuilt(self, mid, rad, rounding) -> Self:
        return type(self)(mid, (rad + rounding) * (1 + gamma(4)))

    def __rmatmul__(self, matrix) -> Self:
        """`matrix @ self` for an exact matrix."""
        error = gamma(matrix.shape[-1])
        size, weights = abs(self.mid), abs(matrix)
        rounding = errors(lambda: error * (weights @ size) + underflow(matrix, self._there))
        return self._rebuilt(matrix @ self.mid, weights @ (self.rad * (1 + error)), rounding)

    def __matmul__(self, matrix) -> Self:
        """`self @ matrix` for an exact matrix."""
        error = gamma(matrix.shape[0])
        size, weights = abs(self.mid), abs(matrix)
        lost = errors(lambda: error * (size @ weights) + underflow(matrix.T, self._there.T).T)
        return self._rebuilt(self.mid @ matrix, (self.rad * (1 + error)) @ weights, lost)

    def __rmul__(self, factors) -> Self:
        """Every entry, or every row, times an exact factor; those of 0, 1 and -1 round nothing."""
        factors = namespace(factors, self.mid).asarray(factors)
        factors = factors.reshape(factors.shape + (1,) * (self.mid.ndim - factors.ndim))
        mid, inexact = factors * self.mid, (factors != 0) & (abs(factors) != 1)
        size = errors(lambda: inexact * (gamma(1) * abs(mid) + 2 * TINY * self._there))
        return self._rebuilt(mid, abs(factors) * self.rad, size)

    def __add__(self, other) -> Self:
        other = self.lift(other)
        mid = self.mid + other.mid
        return self._rebuilt(mid, self.rad + other.rad, gamma(1) * abs(mid))

    def __neg__(self) -> Self:
        return type(self)(-self.mid, self.rad)

    def __sub__(self, other) -> Self:
        return self + (-self.lift(other))

    def __rsub__(self, other) -> Self:
        return self.lift(other) + (-self)

    def __getitem__(self, index) -> Self:
        return type(self)(self.mid[index], self.rad[index])

    def widened(self, by) -> Self:
        """The numbers up to an error of so much each."""
        return self._rebuilt(self.mid, self.rad, by)

    def flowed(self, flow: Any, given: tuple[Any, ...], unit: Callable[..., Any]) -> Any:
        """The state after one period of a flow, enclosed."""
        return flow.enclosed(tuple(map(self.lift, given)))

    def met(self, held: Callable[..., Self], *given: Self) -> Self:
        """What these hold and what others say of them."""
        return self.meeting(held(*given))

    def where_known(self, others: Sequence[Self]) -> Self:
        """The numbers, of which nothing is known where an end of others is infinite, or none."""
        ends = [end for each in others for end in (each.lower, each.upper)]
        return type(self)(self.mid, self.rad + sum((end - end).sum() for end in ends))

    def meeting(self, other: Self) -> Self:
        """Numbers that both hold."""
        lower = larger(self.lower, other.lower)
        return type(self).between(lower, larger(smaller(self.upper, other.upper), lower))
