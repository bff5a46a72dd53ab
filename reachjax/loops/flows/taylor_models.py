"""Taylor models: polynomials of degree two with a bound on what they leave out.

Numbers of one small set of symbols, whatever they came from: `w`, the columns of the initial set,
their products `2 w_i^2 - 1` and `w_i w_j` where forms have these, and one symbol `r_i` for all else
that there is to a state, an input or a disturbance. Each number is

    c + g . w + q . (products of w) + l . r  up to a radius,    |w_i| <= 1,  |r_i| <= radii_i,

and a product of two leaves out all that is of degree three in `w`, or of degree two with an `r`.
On the host more products are symbols within a step of a flow: of three `w`, and of two of all `w`
and `r` (`higher`). What they are worth is found at its end, where most of it has cancelled of what
each operation alone would leave out. Products of `w` are those of Chebyshev polynomials, so that
none exceeds one: `T_2(w_i) w_j`, `T_3(w_i) = 4 w_i^3 - 3 w_i`; so are those of `r_i / radii_i`.

Since symbols are few, what is computed with them does not grow with the columns of a horizon; the
`l` are the derivatives by which these are carried on (`programs.flows`).
"""

from __future__ import annotations

import itertools
import math
from functools import cached_property, lru_cache
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Array, Float

from reachjax.loops.units import AbstractUnit, SmoothUnit, UnboundedError
from reachjax.numerics.numbers import AbstractNumber
from reachjax.numerics.rounding import (
    NOTHING,
    TINY,
    Ball,
    constant,
    errors,
    gamma,
    is_counted,
    namespace,
    settled,
    underflow,
)

SQUARE = 0.5
"""`w^2` is half of one and of `2 w^2 - 1`."""


@lru_cache(maxsize=64)
def _pairs(n: int) -> tuple[np.ndarray, np.ndarray]:
    return np.triu_indices(n)


@lru_cache(maxsize=64)
def _packing(n: int) -> np.ndarray:
    """From all products of two of `n` numbers to coefficients of the products that are symbols."""
    i, j = _pairs(n)
    found, columns = np.zeros((n * n, len(i))), np.arange(len(i))
    found[i * n + j, columns] = np.where(i == j, SQUARE, 1.0)
    found[j * n + i, columns] = np.where(i == j, SQUARE, 1.0)
    return found


@lru_cache(maxsize=64)
def _mixed(n: int, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of `n + count` numbers that are not of the first `n` alone, and their weights."""
    i, j = np.triu_indices(n + count)
    i, j = i[j >= n], j[j >= n]
    return i, j, np.where(i == j, 0.25, 1.0)


@lru_cache(maxsize=64)
def _cubic(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """How a linear form `g` and products `q` of two make products of three of `n` numbers.

    Returns:
        Which `g_i` and `q_jk` make up each product of three, at most three of these pairs, and
        their weights; and which `q_ij` stands at each `(i, j)`.
    """
    i, j = _pairs(n)
    place = np.zeros((n, n), int)
    place[i, j] = place[j, i] = np.arange(len(i))
    linear, pairs, weights = (list[list[float]]() for _ in range(3))
    for a, b, c in itertools.combinations_with_replacement(range(n), 3):
        ways = dict.fromkeys([(a, (b, c)), (b, (a, c)), (c, (a, b))])
        worth = [1.0 if one not in two else 0.5 for one, two in ways]
        rest = [0] * (3 - len(ways))
        linear.append([*(one for one, _ in ways), *rest])
        pairs.append([*(place[two] for _, two in ways), *rest])
        weights.append([*worth, *rest])
    of_linear, of_pairs = (np.reshape(each, (-1, 3)).T.astype(int) for each in (linear, pairs))
    return of_linear, of_pairs, np.reshape(np.array(weights), (-1, 3)).T, place


class Symbols(NamedTuple):
    """What polynomials are of.

    Attributes:
        initial: how many `w` there are.
        curved: whether products of them are symbols too.
        radii: `(K,)`, of the `r`.
        higher: whether products of three `w`, then of two `s`, of which one is an `r` at least, are
            symbols, the last ones; the `s` are the `w`, and the `r` by their radii.
    """

    initial: int
    curved: bool
    radii: Float[Array | np.ndarray, " K"]
    higher: bool = False

    @property
    def with_higher(self) -> Symbols:
        """The symbols, and higher products where those of two `w` are symbols; in numpy."""
        return self._replace(higher=self.curved and namespace(self.radii) is np)

    @property
    def cubic(self) -> int:
        """How many products of three `w` there are."""
        return math.comb(self.initial + 2, 3)

    @property
    def total(self) -> int:
        """How many there are."""
        K = len(self.radii)
        return self.own + K + (self.cubic + len(_mixed(self.initial, K)[0]) if self.higher else 0)

    @property
    def vanishing(self) -> Any:
        """What underflow of a product in every coefficient may take from a number, and more."""
        return 2 * TINY * (1 + self.total + self.radii.sum())

    @property
    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Which `w_i` and `w_j` each product is of, `i <= j`."""
        return _pairs(self.initial if self.curved else 0)

    @property
    def own(self) -> int:
        """How many `w` and products of them there are."""
        return self.initial + len(self.pairs[0])


class TaylorModels(AbstractNumber):
    """A vector of such numbers.

    Attributes:
        rows: `(k, 1 + total)`, the constants, and coefficients of all symbols.
        radii: `(k,)`, by how much numbers may be off, rounding included.
        symbols: what they are of.
    """

    def __init__(self, rows: Any, radii: Any, symbols: Symbols):
        self.rows, self.radii, self.symbols = rows, radii, symbols

    @classmethod
    def of(cls, ball: Ball) -> TaylorModels:
        """Numbers that are intervals, each with a symbol of its own."""
        xp, n = namespace(ball.mid), len(ball.mid)
        rows = xp.concatenate([ball.mid[:, None], xp.eye(n)], axis=1)
        return cls(rows, xp.zeros(n), Symbols(0, False, ball.rad * (1 + gamma(2))))

    def _with(self, rows: Any, radii: Any, rounding: Any) -> TaylorModels:
        """Numbers of the same symbols."""
        return TaylorModels(rows, (radii + constant(rounding)) * (1 + gamma(8)), self.symbols)

    @cached_property
    def _parts(self) -> tuple[Any, ...]:
        """Sizes of what is linear in `w`, of products of two, of `r`, and of higher products."""
        n, count, symbols = self.symbols.initial, self.symbols.own, self.symbols
        sizes, last = abs(self.rows[:, 1:]), count + len(symbols.radii)
        parts = [sizes[:, :n].sum(axis=1), sizes[:, n:count].sum(axis=1)]
        parts.append(sizes[:, count:last] @ symbols.radii)
        if symbols.higher:
            parts.append(sizes[:, last:].sum(axis=1))
        return tuple(part * (1 + gamma(self.rows.shape[1])) for part in parts)

    @cached_property
    def _size(self) -> Any:
        """Bounds of `|c|` and all terms, for rounding; nothing where that is not counted."""
        return abs(self.rows[:, 0]) + sum(self._parts) if is_counted() else NOTHING

    @property
    def spread(self) -> Any:
        """How far numbers can be from their constants."""
        return (sum(self._parts) + self.radii) * (1 + gamma(8))

    def ends(self) -> tuple[Any, Any]:
        """Lower and upper bounds `(k,)`."""
        center, spread = self.rows[:, 0], self.spread
        spread = spread + gamma(4) * constant(abs(center) + spread)
        return center - spread, center + spread

    @property
    def ball(self) -> Ball:
        """Intervals around the numbers."""
        return Ball.between(*self.ends())

    def zeros(self) -> TaylorModels:
        """Zeros of the same symbols, as many of them."""
        xp = namespace(self.rows)
        return TaylorModels(xp.zeros_like(self.rows), xp.zeros_like(self.radii), self.symbols)

    def widened(self, by: Any) -> TaylorModels:
        """The numbers up to errors of so much more."""
        return self._with(self.rows, self.radii + by, 0.0)

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: Any) -> TaylorModels:
        return TaylorModels(self.rows[index], self.radii[index], self.symbols)

    def __rmatmul__(self, matrix: Any) -> TaylorModels:
        matrix = namespace(self.rows).asarray(matrix)
        weights, error = abs(matrix), gamma(matrix.shape[1])

        def lost() -> Any:
            vanishing = self.symbols.vanishing / TINY * underflow(matrix, self._size > 0)
            return error * (weights @ self._size) + vanishing

        return self._with(matrix @ self.rows, weights @ self.radii * (1 + error), errors(lost))

    def __add__(self, other: Any) -> TaylorModels:
        xp = namespace(self.rows)
        if isinstance(other, TaylorModels):
            rows = self.rows + other.rows
            lost = gamma(1) * (self._size + other._size)
            return self._with(rows, self.radii + other.radii, lost)
        first = self.rows[:, :1] + xp.asarray(other)[..., None]
        rows = xp.concatenate([first, self.rows[:, 1:]], axis=1)
        return self._with(rows, self.radii, gamma(1) * abs(first[:, 0]))

    def __neg__(self) -> TaylorModels:
        return TaylorModels(-self.rows, self.radii, self.symbols)

    def __rmul__(self, factor: Any) -> TaylorModels:
        """Each number times an exact one, or all times one."""
        factor = namespace(self.rows).broadcast_to(factor, (len(self.rows),))
        lost = errors(lambda: gamma(1) * abs(factor) * self._size + self.symbols.vanishing)
        return self._with(factor[:, None] * self.rows, abs(factor) * self.radii, lost)

    def times(self, other: TaylorModels) -> TaylorModels:
        """Products, entry by entry, without what is of a degree that there are no symbols for."""
        xp, symbols = namespace(self.rows, other.rows), self.symbols
        n, count = symbols.initial, symbols.own
        a, b = self.rows, other.rows
        center, another = a[:, :1], b[:, :1]
        rows = center * b + another * a
        (one, two, three, *_), (_, two_, three_, *_) = self._parts, other._parts
        whole, whole_ = sum(self._parts), sum(other._parts)
        constants, linear, rest = center * another, rows[:, 1 : 1 + n], [rows[:, 1 + count :]]
        products, left = rows[:, 1 + n : 1 + count], whole * whole_
        if symbols.curved:
            g, h = a[:, 1 : 1 + n], b[:, 1 : 1 + n]
            squares = (g[:, :, None] * h[:, None, :]).reshape(len(g), n * n) @ _packing(n)
            constants = constants + SQUARE * (g * h).sum(axis=1, keepdims=True)
            products = products + squares
            left = one * (two_ + three_) + (two + three) * whole_
        if symbols.higher:
            middle, more, higher = _higher(a, b, symbols)
            last, constants = len(symbols.radii), constants + middle
            linear, rest = linear + more, [rest[0][:, :last], rest[0][:, last:] + higher]
            high, high_ = self._parts[3], other._parts[3]
            left = (one + three) * high_ + three * two_ + two * (two_ + three_ + high_)
            left = left + high * whole_
        rows = xp.concatenate([constants, linear, products, *rest], axis=1)
        size, size_ = abs(center[:, 0]) + whole, abs(another[:, 0]) + whole_
        radii = left + self.radii * (size_ + other.radii) + other.radii * size

        def lost() -> Any:
            vanishing = 8 * symbols.vanishing * (1 + size + size_)
            return gamma(rows.shape[1] + 8) * size * size_ + vanishing

        return self._with(rows, radii * (1 + gamma(16)), errors(lost))

    def at(self, unit: AbstractUnit) -> TaylorModels:
        """The values of smooth units: by a quadratic, or by lines where these leave less out.

        Raises:
            UnboundedError: known inputs leave the domain.
        """
        xp, (lower, upper) = namespace(self.rows), settled(self.ends())
        if not unit.curved:
            return self._bent(unit, lower, upper)
        unit = cast(SmoothUnit, unit)
        line = unit.linear(lower, upper)
        require_bounds(unit, line.gap, lower, upper)
        off = self - line.center
        if not self.symbols.curved:
            return (line.slope * off + line.offset).widened(line.gap)
        model, square = unit.quadratic(lower, upper, line), off.times(off)
        # both are about the middle of the inputs
        better = settled(model.gap + abs(model.curvature) * square.radii <= line.gap)
        parts = zip(model[1:], line[1:], strict=True)
        offset, slope, curvature, gap = (xp.where(better, *pair) for pair in parts)
        return (curvature * square + slope * off + offset).widened(gap)

    def _bent(self, unit: AbstractUnit, lower: Any, upper: Any) -> TaylorModels:
        """The values of units that are not smooth, where no input reaches a bend."""
        slope, offset = straight(unit, lower, upper)
        return slope * self + offset


def _higher(a: np.ndarray, b: np.ndarray, symbols: Symbols) -> tuple[np.ndarray, ...]:
    """What products of rows have of one, the `w`, and higher products, by those of lower degrees.

    As `w_i T_2(w_i)` is `(w_i + T_3(w_i)) / 2` and `s_i^2` is `(1 + T_2(s_i)) / 2`.
    """
    n, count = symbols.initial, symbols.own
    first, second, own = slice(1, 1 + n), slice(1 + n, 1 + count), len(symbols.radii)
    linear, pairs, weights, place = _cubic(n)
    both = (a[:, first], b[:, second]), (b[:, first], a[:, second])
    ways, more = np.zeros((len(a), *weights.shape)), np.zeros((len(a), n))
    for g, q in both:
        ways += g[:, linear] * q[:, pairs]
        more += 0.5 * (g[:, None] @ q[:, place])[:, 0]
    cubic = (weights * ways).sum(axis=1)
    i, j, weights = _mixed(n, own)
    scaled = (row[:, 1 + count : 1 + count + own] * symbols.radii for row in (a, b))
    g, h = (np.hstack([row[:, first], of_r]) for row, of_r in zip((a, b), scaled, strict=True))
    middle = 0.5 * (g[:, n:] * h[:, n:]).sum(axis=1, keepdims=True)
    mixed = (g[:, i] * h[:, j] + g[:, j] * h[:, i]) * weights
    return middle, more, np.hstack([cubic, mixed])


def straight(unit: AbstractUnit, lower: Any, upper: Any) -> tuple[Any, Any]:
    """Slopes and offsets of units that are affine on these intervals; NaN where they are not.

    Raises:
        UnboundedError: known intervals hold a bend.
    """
    lines, xp = unit.lines(lower, upper), namespace(lower, upper)
    require_bounds(unit, xp.where(lines.affine, 0.0, xp.inf), lower, upper)
    slope, offset = (xp.where(lines.affine, each, xp.nan) for each in lines.above)
    return slope, offset


def require_bounds(unit: AbstractUnit, gap: Any, lower: Any, upper: Any) -> None:
    """Raise an error where known units have no bounds, or none with derivatives.

    Raises:
        UnboundedError: so it is.
    """
    if namespace(gap, lower, upper) is not np:
        return
    lost = np.flatnonzero(~np.isfinite(gap) & np.isfinite(lower) & np.isfinite(upper))
    if len(lost):
        raise UnboundedError(unit, 0, float(lower[lost[0]]), float(upper[lost[0]]))


def image(unit: AbstractUnit, y: Ball) -> Ball:
    """What a unit makes of intervals.

    Ends of inputs may be rounded differently where the midpoint and the radius are formed.

    Raises:
        UnboundedError: known inputs leave the domain, or hold a bend.
    """
    y = Ball(y.mid, y.rad + 2 * gamma(8) * (abs(y.mid) + y.rad))
    if unit.curved:
        lower, upper = unit.interval(y.lower, y.upper)
        require_bounds(unit, upper - lower, y.lower, y.upper)
        return Ball.between(lower, upper)
    slope, offset = straight(unit, y.lower, y.upper)
    return slope * y + offset


def joined(numbers: list[Any]) -> Any:
    """Numbers of one kind, one behind the other."""
    first = numbers[0]
    if isinstance(first, TaylorModels):
        xp = namespace(first.rows)
        rows = xp.concatenate([each.rows for each in numbers])
        return TaylorModels(rows, xp.concatenate([each.radii for each in numbers]), first.symbols)
    xp = namespace(*numbers) if not isinstance(first, Ball) else namespace(first.mid)
    if isinstance(first, Ball):
        parts = zip(*((each.mid, each.rad) for each in numbers), strict=True)
        return Ball(*(xp.concatenate(part) for part in parts))
    return xp.concatenate(numbers)


def product(one: Any, other: Any) -> Any:
    """Products, entry by entry, of numbers of one kind."""
    if isinstance(one, TaylorModels):
        return one.times(other)
    if not isinstance(one, Ball):
        return one * other
    mid = one.mid * other.mid  # |a b - m n| <= |m| s + |n| r + r s
    spread = abs(one.mid) * other.rad + abs(other.mid) * one.rad + one.rad * other.rad
    return Ball(mid, (spread * (1 + gamma(4)) + gamma(1) * abs(mid) + 4 * TINY) * (1 + gamma(4)))


def zeros(number: Any) -> Any:
    """Zeros of the same kind, as many of them."""
    if isinstance(number, TaylorModels):
        return number.zeros()
    if isinstance(number, Ball):
        return Ball.exact(namespace(number.mid).zeros_like(number.mid))
    return namespace(number).zeros_like(number)


def arrays(number: Any) -> list[Any]:
    """The arrays that a number is made of."""
    if isinstance(number, TaylorModels):
        return [number.rows, number.radii]
    return [number.mid, number.rad] if isinstance(number, Ball) else [number]


def rebuilt(like: Any, parts: list[Any]) -> Any:
    """A number of the kind and the symbols of another one."""
    if isinstance(like, TaylorModels):
        return TaylorModels(parts[0], parts[1], like.symbols)
    return Ball(*parts) if isinstance(like, Ball) else parts[0]


def settled_number(number: Any) -> Any:
    """A number that a compiler computes once, whatever is made of it."""
    parts = arrays(number)
    return number if namespace(*parts) is np else rebuilt(number, settled(parts))
