"""The columns that stand for the initial state: `x_0 = q + M w`, `w` in a unit ball.

The ball is that of the largest entry around a box, and the round one around an ellipsoid, so every
entry of `w` lies in `[-1, 1]`, and what a row over `w` attains is its 1-norm or its 2-norm. Where
the set is smaller than `q + M w`, a set `S` that also holds it cuts off more: for any row `a`,

    r . w  <=  sup_S a - a . q + |r - a M|,

since `x_0` is in `S`; `a = r M^+` leaves nothing over but rounding.

Where a loop has smooth units, products of the `w` are columns too, `2 w_i^2 - 1` and `w_i w_j`, all
in `[-1, 1]`: forms over both are polynomials of degree two of the initial state. Over the box

    g w + q (2 w^2 - 1)  <=  g^2 / (8 |q|) + |q|  if q < 0 and |g| <= 4 |q|,  else |g| + q,

and from `(1 - s_i w_i) (1 - s_j w_j) >= 0`, `s_i` being the sign of `g_i`, where `q s_i s_j < 0`,

    q w_i w_j  <=  |q| - m s_i w_i - m s_j w_j  for any m in [0, |q|].

Over a box within the box, `w = c + d v` where `v` has its entries in `[-1, 1]`, and

    2 w_i^2 - 1  =  2 c_i^2 + d_i^2 - 1 + 4 c_i d_i v_i + d_i^2 (2 v_i^2 - 1),
    w_i w_j  =  c_i c_j + c_j d_i v_i + c_i d_j v_j + d_i d_j v_i v_j.
"""

from __future__ import annotations

import itertools
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from reachjax.numerics.pytrees import Replaceable, pytree, static
from reachjax.numerics.rounding import (
    TINY,
    Ball,
    constant,
    counting,
    errors,
    gamma,
    is_counted,
    larger,
    namespace,
    select,
    settled,
    smaller,
)
from reachjax.sets import AbstractSet, Box, PolyhedralSet
from reachjax.sets.base import RoundSet
from reachjax.sets.linear_programs import support

Rows = Float[Array | np.ndarray, "k n"]

Ends = tuple[Any, Any]
"""Lower and upper bounds `(k,)`."""


@pytree
class InitialColumns(Replaceable):
    """The columns `w` of an initial set, `x_0 = center + spread w`.

    Attributes:
        center: `(n,)`.
        spread: `(n, n)`.
        back: `(n, n)`, nearly the pseudoinverse of `spread`.
        cut: a set that also holds `x_0`, where there is one: a box, or on the host a polytope.
        box: around the initial set, on the host, where its ends are looked at without rounding.
        round: whether `|w| <= 1` in the 2-norm; in that of the largest entry if not.
        curved: whether products of the `w` are columns too.
    """

    center: Float[Array | np.ndarray, " n"]
    spread: Float[Array | np.ndarray, "n n"]
    back: Float[Array | np.ndarray, "n n"]
    cut: PolyhedralSet | None
    round: bool = static()
    curved: bool = static(default=False)
    box: Box | None = None

    @classmethod
    def of(cls, X: AbstractSet, box: Box, curved: bool = False) -> InitialColumns:
        """The columns of a set, numpy arrays if the set has numpy arrays.

        Args:
            X: the set. A polytope is itself the cut on the host, and is held by its box in JAX.
            box: around it.
            curved: whether products of columns are columns too.
        """
        cut, ball = X.parts
        if cut is not None and cut.needs_programs and namespace(*cut.facets) is not np:
            cut = box
        if ball is not None:
            found = _of_ball(ball, cut)
        else:
            found = _of_box(box, cut if cut is not None and cut.needs_programs else None)
        return found.replace(curved=curved, box=box if namespace(box.lower) is np else None)

    @property
    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Which `w_i` and `w_j` each product is of, `i <= j`; none unless it is curved."""
        return _pairs(self.spread.shape[1] if self.curved else 0)

    @property
    def count(self) -> int:
        """How many columns there are, products among them."""
        return self.spread.shape[1] + len(self.pairs[0])

    def _require_products(self) -> None:
        if not self.curved:
            raise RuntimeError("a loop without columns for products met a unit that is curved")

    def by_coordinate(self, products: Float[np.ndarray, "k m"]) -> Float[np.ndarray, "k n"]:
        """What products are worth, to each column that they are of; squares twice; in numpy."""
        found = np.zeros((self.spread.shape[1], len(products)))
        for places in self.pairs:
            np.add.at(found, places, products.T)
        return found.T

    def squared(self, rows: Rows) -> tuple[Any, Rows]:
        """`(r . w)^2` for each row: its constant, and its coefficients of the products.

        Raises:
            RuntimeError: there are no columns for these.
        """
        self._require_products()
        i, j = self.pairs
        products = taken(rows, i) * taken(rows, j) * np.where(i == j, 0.5, 2.0)
        return (rows**2).sum(axis=1) / 2, products

    def multiplied(self, one: Rows, other: Rows) -> tuple[Any, Rows]:
        """`(r . w) (s . w)` for each pair of rows, as `squared`."""
        self._require_products()
        i, j = self.pairs
        mixed = taken(one, i) * taken(other, j) + taken(one, j) * taken(other, i)
        products = mixed * np.where(i == j, 0.25, 1.0)
        return (one * other).sum(axis=1) / 2, products

    def curved_ends(self, rows: Rows) -> Ends:
        """Bounds of each row over all columns, products among them, by the formulas above."""
        n, counted = self.spread.shape[1], is_counted()
        if not self.round and not counted:  # the norm is no better
            both = _highest(namespace(rows).concatenate([rows, -rows]), self.pairs)
            return -both[len(rows) :], both[: len(rows)]
        error = errors(lambda: gamma(4 * rows.shape[1] + 16) * abs(rows).sum(axis=1))
        rest = abs(rows[:, n:]).sum(axis=1)
        below, above = self.ends(rows[:, :n])
        if not self.round:
            both = _highest(namespace(rows).concatenate([rows, -rows]), self.pairs)
            above = smaller(above + rest, both[: len(rows)])
            below = larger(below - rest, -both[len(rows) :])
        else:
            below, above = below - rest, above + rest
        return below - error, above + error

    def bounds(self, rows: Rows, cut: bool = False) -> Ends:
        """Bounds of each row over all columns, the better of all that are known.

        Args:
            rows: over these columns.
            cut: whether what cuts the initial set is looked at as well.
        """
        w = self.spread.shape[1]
        if self.curved and not is_counted() and (self.cut is None or not cut):
            return self.curved_ends(rows)  # the norm is no better
        lower, upper = self.cut_ends(rows[:, :w]) if cut else self.ends(rows[:, :w])
        if not self.curved:
            return lower, upper
        products = abs(rows[:, w:]).sum(axis=1) * (1 + gamma(rows.shape[1]))
        return met(self.curved_ends(rows), (lower - products, upper + products))

    def uppers(self, rows: Rows, cut: bool = False) -> Any:
        """The upper bounds of `bounds`: where nothing is proved a box asks for no lower ones."""
        if is_counted() or not self.curved or self.round or (cut and self.cut is not None):
            return self.bounds(rows, cut)[1]
        return _highest(rows, self.pairs)

    def attaining(self, rows: Float[np.ndarray, "k n"]) -> Float[np.ndarray, "k n"]:
        """The columns where each row is largest as `bounds` has it, whatever the cut; in numpy."""
        if self.curved:  # the gradient of what is positively homogeneous
            count = 1 << max(len(rows) - 1, 0).bit_length()  # few shapes: each is compiled
            filled = np.concatenate([rows, np.zeros((count - len(rows), rows.shape[1]))])
            return np.asarray(_slopes(self.replace(cut=None), filled))[: len(rows)]
        if not self.round:
            return np.sign(rows)
        lengths = np.linalg.norm(rows, axis=1, keepdims=True)
        return rows / np.where(lengths > 0, lengths, 1.0)

    def norms(self, rows: Rows) -> Any:
        """What `r . w` does not exceed for each row, whatever the cut."""
        if not self.round:
            return abs(rows).sum(axis=1) * (1 + gamma(rows.shape[1]))
        xp = namespace(rows)
        largest = abs(rows).max(axis=1, initial=0.0)
        some = largest > 0
        unit = xp.where(some, constant(largest), 1.0)
        squares = xp.where(some, ((rows / unit[:, None]) ** 2).sum(axis=1), 1.0)
        return xp.where(some, unit * xp.sqrt(squares) * (1 + gamma(rows.shape[1] + 8)), 0.0)

    def mixed_norms(self, one: Rows, other: Rows) -> Any:
        """What `(g . w) (h' . v) + (g' . w) (h . v)` does not exceed for each pair of rows.

        With rows `[g, h]` over the `w` and all other columns `v` that is the sum of the 1-norms of
        `h'_j g + h_j g'`, but for rounding; in a round ball no more than each alone allows.
        """
        xp, n = namespace(one, other), self.spread.shape[1]
        (g, h), (also, rest) = ((rows[:, :n], rows[:, n:]) for rows in (one, other))
        if xp is not np:  # it is one loop where it is compiled
            found = abs(g[:, None] * rest[..., None] + also[:, None] * h[..., None]).sum((1, 2))
        else:
            found = np.zeros(len(one))
            for i in range(n):
                found = found + abs(g[:, i, None] * rest + also[:, i, None] * h).sum(axis=1)
        if not self.round:
            return found
        sizes = (abs(part).sum(axis=1) for part in (rest, h))
        alone = (self.norms(part) * size for part, size in zip((g, also), sizes, strict=True))
        return smaller(found, sum(alone))

    def farthest(self, rows: Rows) -> Rows:
        """Initial states at which `r . w` is largest for each row, whatever the cut; rounded."""
        xp = namespace(rows)
        if not self.round:
            return self.center + xp.sign(rows) @ self.spread.T
        length = xp.sqrt((rows**2).sum(axis=1, keepdims=True))
        return self.center + rows / xp.where(length > 0, length, 1.0) @ self.spread.T

    def ends(self, rows: Rows) -> Ends:
        """Bounds of `r . w` for each row, by the norm."""
        norms = self.norms(rows)
        return -norms, norms

    def over_part(self, part: Box) -> SubboxColumns:
        """The columns of a box within the box that these are of; in numpy."""
        q, r = np.asarray(self.center), np.diagonal(self.spread)
        wide = r > 0
        ends = [(np.asarray(end) - q) / np.where(wide, r, 1.0) for end in (part.lower, part.upper)]
        room = [gamma(4) * abs(end) + TINY for end in ends]
        around = Ball.between(ends[0] - room[0], ends[1] + room[1])
        c, d = np.where(wide, around.mid, 0.0), np.where(wide, around.rad, 1.0)
        (i, j), n = self.pairs, len(q)
        first, products = np.arange(n), n + np.arange(len(i))
        change, square = np.zeros((self.count, 1 + self.count)), i == j
        change[first, 0], change[first, 1 + first] = c, d
        change[products, 0] = np.where(square, 2 * c[i] ** 2 + d[i] ** 2 - 1, c[i] * c[j])
        change[products, 1 + i] = np.where(square, 4, 1) * c[j] * d[i]
        mixed = products[~square]
        change[mixed, 1 + j[~square]] = (c[i] * d[j])[~square]
        change[products, 1 + products] = d[i] * d[j]
        spread = np.diag(r * d)
        start = self.replace(center=q + r * c, spread=spread, cut=None, box=part)
        return SubboxColumns(start, change)

    def cut_ends(self, rows: Rows) -> Ends:
        """Bounds of `r . w` for each row, by the cut as well."""
        if self.cut is None:
            return self.ends(rows)
        n, norms, a = rows.shape[1], self.norms(rows), settled(rows @ self.back)
        least, most = _ends(self.cut, a)
        left = abs(rows - a @ self.spread) + gamma(n + 2) * (abs(a) @ abs(self.spread) + abs(rows))
        at, size = a @ self.center, abs(a) @ abs(self.center)
        error = left.sum(axis=1) + gamma(n + 8) * (size + abs(rows).sum(axis=1))
        lower = least - at - constant((error + gamma(4) * abs(least)) * (1 + gamma(n)))
        upper = most - at + constant((error + gamma(4) * abs(most)) * (1 + gamma(n)))
        return larger(-norms, lower), smaller(norms, upper)


class SubboxColumns(NamedTuple):
    """The columns of a box within the box of other columns, of which those are made.

    Attributes:
        start: its columns.
        change: `(n, 1 + n)`, of each of the others its constant and its coefficients of these;
            their absolute values add up to `SIZE` at most.
    """

    start: InitialColumns
    change: Float[np.ndarray, "n n+1"]

    def columns_of(self, values: Float[np.ndarray, "k n"]) -> Float[np.ndarray, "k n"]:
        """Values of the other columns, of some of these; rounded."""
        return self.change[:, 0] + values @ self.change[:, 1:].T


SIZE = 10
"""The coefficients of a square are `2 c^2 + d^2 + 1`, `4 |c| d` and `d^2`, where `|c| + d` is about
1."""


def met(one: Ends, other: Ends) -> Ends:
    """What both bounds hold; never empty. What is no number stays so in the first alone."""
    lower = larger(one[0], other[0])
    return lower, larger(smaller(one[1], other[1]), lower)


@jax.jit
@counting
def _slopes(start: InitialColumns, rows: Float[Array, "k n"]) -> Float[Array, "k n"]:
    """Derivatives of the upper bound of each row over all columns."""
    return jax.grad(lambda rows: start.bounds(rows)[1].sum())(rows)


@lru_cache(maxsize=64)
def _pairs(n: int) -> tuple[np.ndarray, np.ndarray]:
    return np.triu_indices(n)


@lru_cache(maxsize=64)
def _rounds(n: int) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """All pairs of `n` numbers, by rounds in which each number has at most one other.

    As players of a tournament meet: in round `r` those whose sum is `r`, up to `m`, and the last
    one, if `n` is even, the one that would meet itself.

    Returns:
        For each round the other of each number, itself where it has none, and the number of their
        pair in `_pairs`, or how many pairs there are.
    """
    m = n - 1 if n % 2 == 0 else n
    numbers = {pair: k for k, pair in enumerate(zip(*_pairs(n), strict=True))}
    found = []
    for r in range(m):
        other = [(r - i) % m for i in range(m)] + [n - 1] * (n - m)
        for i in [i for i in range(m) if other[i] == i][: n - m]:
            other[i], other[n - 1] = n - 1, i
        pairs = [numbers[min(i, j), max(i, j)] for i, j in enumerate(other)]
        alone = np.arange(n) == other
        found.append((np.array(other), np.where(alone, len(numbers), pairs)))
    return tuple(found)


def _highest(rows: Rows, pairs: tuple[np.ndarray, np.ndarray]) -> Any:
    """The largest value of each row over the box, as above; plain rounding.

    Products take from linear terms by rounds of pairs that share none: what takes them one by one
    is compiled for minutes where there are twelve states.
    """
    xp, n = namespace(rows), int(pairs[1].max(initial=-1)) + 1
    i, j = pairs
    linear, signs = abs(rows[:, :n]), select(rows[:, :n] < 0, -1.0, 1.0)
    products, mixed = rows[:, n:], i != j
    against = (products * taken(signs, i) * taken(signs, j) < 0) & mixed
    spare = select(against, abs(products), 0.0)
    spare = xp.concatenate([spare, xp.zeros((len(rows), 1))], axis=1)
    for other, number in _rounds(n) if n > 1 else ():
        least = smaller(linear, taken(linear, other))
        linear = linear - smaller(taken(spare, number), least)
    q = taken(products, np.flatnonzero(~mixed))
    inside = (q < 0) & (linear < -4 * q)
    inside = settled(inside) if is_counted() else inside
    depth = select(inside, -q, 1.0)
    alone = select(inside, linear * (linear / (8 * depth)) + depth, linear + q)
    return abs(taken(products, np.flatnonzero(mixed))).sum(axis=1) + alone.sum(axis=1)


def taken(rows: Rows, columns: np.ndarray) -> Rows:
    """Some columns of rows."""
    if namespace(rows) is np:
        return rows[:, columns]
    if not is_counted():  # the derivative is a product, too, and no loop
        return rows @ (np.arange(rows.shape[1])[:, None] == columns).astype(float)
    whole = columns.astype(np.uint32)  # none is counted from the end, as compilers would see to
    return jax.numpy.asarray(rows).at[:, whole].get(mode="promise_in_bounds")


def _of_box(box: Box, cut: PolyhedralSet | None) -> InitialColumns:
    around = Ball.between(box.lower, box.upper)
    xp = namespace(around.mid)
    center, rad = settled((around.mid, around.rad))
    back = xp.where(rad > 0, 1.0 / xp.where(rad > 0, rad, 1.0), 0.0)
    return InitialColumns(center, xp.diag(rad), xp.diag(back), cut, round=False)


def _of_ball(ball: RoundSet, cut: PolyhedralSet | None) -> InitialColumns:
    center, spread, back = _ball_map(ball)
    if namespace(ball.center) is np:
        center, spread, back = jax.device_get((center, spread, back))
    return InitialColumns(center, spread, back, cut, round=True)


@jax.jit
@counting
def _ball_map(ball: RoundSet) -> tuple[Array, Array, Array]:
    spread = ball.from_ball()
    return settled((ball.center, spread, jax.numpy.linalg.inv(spread)))


def _ends(cut: PolyhedralSet, directions: Rows) -> Ends:
    """Least and largest values of directions on the cut, rounded outwards."""
    if cut.intervals is not None:
        values = directions @ Ball.between(*cut.intervals)
        return values.lower, values.upper
    A, b = (np.asarray(part) for part in cut.facets)
    lower, upper = np.full(len(directions), -np.inf), np.full(len(directions), np.inf)
    known = np.isfinite(directions).all(axis=1)
    some, count = directions[known], int(known.sum())
    if count:
        try:
            found, *_ = support(A, b, np.concatenate([-some, some]))
        except RuntimeError:  # linear programs too hard for the solver: the norms do
            return lower, upper
        lower[known], upper[known] = -found[:count], found[count:]
    return lower, upper


def product_facts(start: InitialColumns) -> tuple[np.ndarray, np.ndarray]:
    """`(1 + a w_i) (1 + b w_j) >= 0` for all signs `a`, `b`, over the columns of a curved start.

    None of a ball: there they say little, and its programs are not solved to many digits.

    Returns:
        Rows and radii of forms (`affine.AffineForms`).
    """
    n, (i, j) = start.spread.shape[1], start.pairs
    rows = []
    for number, (one, other) in enumerate(zip(i, j, strict=True) if not start.round else ()):
        signs = [(1, 1), (-1, -1)] if one == other else itertools.product((1, -1), repeat=2)
        for a, b in signs:
            row = np.zeros(2 + start.count)
            row[2 + n + number] = 0.5 if one == other else a * b
            row[:2] = 1.5 if one == other else 1.0, 2.0  # a square is half of 1 and its column
            row[2 + one] += a
            row[2 + other] += b
            rows.append(row)
    radii = np.tile([0.0, 2.0], (len(rows), 1))  # each is in [0, 4]
    return np.reshape(rows, (-1, 2 + start.count)), radii
