"""One period of a differential equation, in steps of Taylor models.

With `X` and `U` what the state and the input are in, `B` what solutions do not leave within a step
of length `h` (`enclosures`), and `x_k` the coefficients of the solution,

    x(t + h)  in  sum_{k <= p} h^k x_k(x, u)  +  h^{p+1} x_{p+1}(B, U),

where the first sum is over Taylor models, which know what it has in common with `x` and `u`
(Berz, Makino, Reliable Computing 1998), and the second is an interval. Between both ends the cubic
with their values and derivatives has the Bernstein points

    x_t,   x_t + h/3 x'_t,   x_{t+h} - h/3 x'_{t+h},   x_{t+h},

and `|x(s) - cubic(s)| <= h^4/384 sup |x^(4)|`: so is what is in between.

**Disturbances** that may change at any time. Let `y` be the solution with the mean `v` of `w` over
the period in place of `w`, and `e = x - y`. Then `e' = A(t) e + G(t) (w - v)`, where `A` and `G`
are in what the derivatives of `f` are in, so that

    |e(h)| = |int (Phi(h, s) G(s) - K) (w(s) - v) ds|  <=  h (rad G + (exp(h |A|) - 1) |G|) rad W

with `K = mid G`, as `w - v` has no mean, and for `w` in a box of radius `r` the mean of `|w - v|`
is at most `r`. So what `w` does within a period is worth its mean, but for the second order in `h`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float

from reachjax.loops.flows.enclosures import constant_ball, enclosed
from reachjax.loops.flows.series import Series, Solution, Tape, solved
from reachjax.loops.flows.taylor_models import Symbols, TaylorModels, joined, zeros
from reachjax.loops.units import Origin, UnboundedError, Within
from reachjax.numerics.numbers import split
from reachjax.numerics.rounding import (
    Ball,
    constant,
    errors,
    gamma,
    is_counted,
    larger,
    namespace,
    settled,
    smaller,
)

ORDER, SKETCHED = 6, 4
"""The order of compiled steps, where none is given; and where nothing is proved, where higher ones
that are asked for are no more than the first."""

HIGHEST = 20
"""The highest order that is chosen on the host: beyond, a step is better halved."""

WORTH = 1e-4
"""On the host the remainder of a step shall be at most this part of how far the set spreads."""

EXACT = 1e-14
"""Or this part of its size, where that is larger."""

IN_BETWEEN = 0.01
"""What control points are beside the solutions shall be at most this part of what these move by in
a period, and of how far the set spreads: four steps of half a turn make spans wider by 5 %."""

SHORTEST = 2.0**-12
"""No step is a smaller part of a period: solutions escape, or are too fast."""

MOST = 64
"""Beyond so many steps in a period a remainder is taken as it is."""

TERMS = 16
"""Terms of the series of a matrix exponential, the rest of which is bounded."""


class Settings(NamedTuple):
    """How periods are done.

    Attributes:
        period: how long they are.
        order: of the Taylor polynomials; None to choose it.
        steps: at least so many in each period.
        held: whether disturbances are constant over periods.
    """

    period: Any
    order: int | None = None
    steps: int = 1
    held: bool = False


class Control(NamedTuple):
    """The control points of one step.

    Attributes:
        points: four of them, each a state.
        part: how long the step is, of a period.
    """

    points: tuple[TaylorModels, ...]
    part: float


class Flowed(NamedTuple):
    """The state after one period, of the symbols of the state before.

    Attributes:
        state: at the end.
        controls: of each step, if they were asked for.
    """

    state: TaylorModels
    controls: tuple[Control, ...]


class _Piece(NamedTuple):
    """One step whose solutions are enclosed.

    Attributes:
        B: what they stay in.
        remainder: of the polynomials.
        fourth: bounds of `|h^4 x_4|`; None for what it is where the step begins.
        order: of the polynomials.
        excess: the remainder over what it shall be.
    """

    B: Ball
    remainder: Ball
    fourth: Any
    order: int
    excess: float


def flowed(
    tape: Tape,
    x: TaylorModels,
    others: list[TaylorModels],
    box: Ball,
    settings: Settings,
    between: bool = False,
) -> Flowed:
    """The state after one period.

    Args:
        tape: of `f`.
        x: the state before, each with a symbol of its own, which are the first ones.
        others: the input and, if there are any, disturbances, the same, the next ones.
        box: what else is known of the state.
        settings: how it is done.
        between: whether control points are asked for.

    Raises:
        UnboundedError: solutions escape, leave a domain, or are too fast, in numpy.
    """
    todo, controls = [1.0 / settings.steps] * settings.steps, list[Control]()
    state, proved, count, done = x, np.array(True), settings.steps, 0.0
    varying, slopes = len(others) > 1 and not settings.held, list[tuple[Ball, Ball]]()
    signal = others[-1].ball
    end: Any = 0.0
    within: Any = 0.0
    while todo:
        part = todo.pop()
        h, halves = settings.period * part, count < MOST and part / 2 >= SHORTEST
        here, given = _refreshed(state, others)
        # a signal may have taken states away from where its mean has
        X = here.widened(within).ball if done else here.ball.meeting(box)
        boxes = [each.ball for each in given]
        if is_counted():
            piece, holds = _enclosed(tape, X, boxes, h, part, settings, between, halves)
        else:
            piece, holds = _sketched(X, settings.order), True
        if piece is None or (piece.excess > 1 and halves):
            todo, count = [*todo, part / 2, part / 2], count + 1
            continue
        proved = proved & holds
        sketches = between and piece.fourth is None
        terms = solved(tape, here, given, h, max(piece.order, 4 if sketches else 1))
        polynomial = terms[: piece.order]
        found = _sum([here, *polynomial])
        found = (found + piece.remainder.mid).widened(piece.remainder.rad * (1 + gamma(4)))
        if between:
            if sketches:  # the polynomial's own rate takes no unit
                last = _sum([float(k) * term for k, term in enumerate(polynomial, start=1)])
            else:
                last = h * Series.value(tape, [found, *given])
            inner = here + (1 / 3) * terms[0], found - (1 / 3) * last
            fourth: Any = _largest(terms[3].ball) if sketches else piece.fourth
            wide = [point.widened(fourth / 16) for point in (here, *inner, found)]
            *wide, state = split(_composed(joined([*wide, found]), state), 5)
            controls.append(Control(tuple(wide), part))
        else:
            state = _composed(found, state)
        done += part
        if varying:
            slopes.append(_slopes(tape, [piece.B, *(each.ball for each in others)]))
            end, within = drift(slopes, signal, settings.period * done)
    xp = namespace(state.rows)
    lost = xp.where(proved, 0.0, xp.inf)
    controls = [
        each._replace(points=tuple(point.widened(within + lost) for point in each.points))
        for each in controls
    ]
    return Flowed(state.widened(end + lost), tuple(controls))


def _sketched(X: Ball, order: int | None) -> _Piece:
    """A step of which nothing is proved, as if polynomials left nothing out."""
    return _Piece(X, zeros(X), None, min(order or SKETCHED, ORDER), 0.0)


def _sum(numbers: list[TaylorModels]) -> TaylorModels:
    matrix = np.kron(np.ones(len(numbers)), np.eye(len(numbers[0])))
    return matrix @ joined([*numbers])


def _refreshed(
    state: TaylorModels, others: list[TaylorModels]
) -> tuple[TaylorModels, list[TaylorModels]]:
    """A state with a new symbol each for all of it that is not of the initial set.

    Returns:
        The state, and the other arguments, of these symbols and of higher products.
    """
    xp, n, (initial, curved, radii, _) = namespace(state.rows), len(state), state.symbols
    first = 1 + state.symbols.own
    own = abs(state.rows[:, first:]) @ radii * (1 + gamma(len(radii))) + state.radii
    own = xp.concatenate([own * (1 + gamma(2)), radii[n:]])
    symbols = Symbols(initial, curved, own).with_higher

    def filled(rows: Any, radii: Any) -> TaylorModels:
        more = 1 + symbols.total - rows.shape[1]
        rows = xp.concatenate([rows, xp.zeros((len(rows), more))], axis=1)
        return TaylorModels(rows, radii, symbols)

    rows = xp.concatenate([state.rows[:, :first], xp.eye(n, len(radii))], axis=1)
    here = filled(rows, xp.zeros_like(state.radii))
    return here, [filled(each.rows, each.radii) for each in others]


def _composed(found: TaylorModels, state: TaylorModels) -> TaylorModels:
    """What was found of a state's new symbols, of the state's own ones.

    Higher products are worth what they can be.
    """
    xp, n, symbols = namespace(found.rows), len(state), state.symbols
    first = 1 + symbols.own
    last = first + len(symbols.radii)
    slope, own = found.rows[:, first : first + n], state.rows[:, first:]
    more = xp.concatenate([xp.zeros((len(found), n)), found.rows[:, first + n : last]], axis=1)
    rows = xp.concatenate([found.rows[:, :first], slope @ own + more], axis=1)
    sizes = (abs(slope) @ abs(own) + abs(more)) @ symbols.radii
    radii = found.radii + abs(slope) @ state.radii * (1 + gamma(n)) + gamma(2 * n + 8) * sizes
    radii = radii + errors(lambda: 2 * n * symbols.vanishing)
    if found.symbols.higher:
        radii = radii + abs(found.rows[:, last:]).sum(axis=1) * (1 + gamma(found.symbols.total))
    return TaylorModels(rows, radii * (1 + gamma(4)), symbols)


def _enclosed(
    tape: Tape,
    X: Ball,
    others: list[Ball],
    h: Any,
    part: float,
    settings: Settings,
    between: bool,
    halves: bool,
) -> tuple[_Piece | None, Any]:
    """A step with its enclosure, and whether that is proved; None of one that has to be halved.

    Raises:
        UnboundedError: it cannot be halved any more, in numpy.
    """
    on_host, shortest = namespace(X.mid) is np, part / 2 < SHORTEST
    if on_host and not np.isfinite(X.rad).all():  # there is nothing to know
        unknown = Ball(X.mid, X.rad + np.inf)
        return _Piece(unknown, unknown, np.inf, 0, 0.0), np.array(False)
    try:
        B, proved = enclosed(tape, X, others, h)
        if on_host and not proved:
            if shortest:
                raise _escaped(X, B)
            return None, proved
        whole = 1 / part if between else None
        return _remainder(tape, X, B, others, h, settings.order, whole, halves), proved
    except UnboundedError:
        if shortest:
            raise
        return None, np.array(False)


def _remainder(
    tape: Tape,
    X: Ball,
    B: Ball,
    others: list[Ball],
    h: Any,
    order: int | None,
    whole: float | None = None,
    halves: bool = False,
) -> _Piece:
    """A step of the order that was asked for, or of the lowest whose remainder is small enough.

    Derivatives take remainders for constants.

    If none is, of the one whose remainder is smallest. On the host a step whose control points are
    too far from solutions is too long as well.

    Args:
        tape: of `f`.
        X: where solutions begin.
        B: what they stay in.
        others: what the other arguments are in.
        h: how long the step is.
        order: of the polynomials; None to choose it.
        whole: how many such steps a period is, if control points are asked for.
        halves: whether a step that is too long is halved, so that nothing else is of use.
    """
    chosen, apart, on_host = order or ORDER, 0.0, namespace(X.mid) is np
    if not on_host:
        terms = solved(tape, B, others, h, max(chosen, 3) + 1)
        return _Piece(B, constant_ball(terms[chosen]), _size(terms[3]), chosen, 0.0)
    rate, solution = h * Series.value(tape, [X, *others]), Solution(tape, B, others, h)
    terms = [solution.advance() for _ in range(4)]
    second, fourth = (_size(terms[k]) for k in (1, 3))
    if whole is not None:
        moved = IN_BETWEEN * (X.rad + whole * (_size(rate) + second))
        apart = _over(second / 12 + fourth / 16, moved)
    excess = list[float]()
    for k in range(HIGHEST + 1 if order is None else 0):
        if k == len(terms):
            if halves and apart > 1:
                break
            terms.append(solution.advance())
        excess.append(_excess(terms[k], rate, X) if k else np.inf)
        if min(excess) <= 1 or (k > 4 and excess[k] > 4 * min(excess)):
            break
    least = 0.0
    if order is None:
        chosen, least = int(np.argmin(excess)), min(excess)
    while len(terms) <= chosen:
        terms.append(solution.advance())
    return _Piece(B, constant_ball(terms[chosen]), fourth, chosen, max(least, apart))


def _excess(remainder: Ball, rate: Ball, X: Ball) -> float:
    """A remainder over what it shall be, of the worst state; infinite if it is not known."""
    allowed = WORTH * (X.rad + rate.rad) + EXACT * (abs(X.mid) + X.rad + abs(rate.mid))
    return _over(remainder.rad, allowed)


def _over(found: Any, allowed: Any) -> float:
    """The largest ratio of what is found to what is allowed; infinite if it is not known."""
    with np.errstate(all="ignore"):
        ratios = np.where(found > 0, found / allowed, found)
    return float(np.nan_to_num(ratios, nan=np.inf).max(initial=0.0))


def _size(ball: Ball) -> Any:
    """Bounds of absolute values, which derivatives take for constants."""
    return constant(_largest(ball))


def _largest(ball: Ball) -> Any:
    """Bounds of absolute values."""
    return larger(abs(ball.lower), abs(ball.upper))


def _escaped(X: Ball, B: Ball) -> UnboundedError:
    """The error of the state that grows most."""
    with np.errstate(all="ignore"):
        growth = np.nan_to_num(B.rad / (X.rad + abs(X.mid) + 1e-300), nan=np.inf)
    k = int(np.argmax(growth))
    origin = Origin(
        f"state {k + 1} of the differential equation",
        "has no enclosure, however short the steps, from",
        "solutions escape in finite time, or are too fast for explicit steps. Take a shorter "
        "period, or slower units",
    )
    return UnboundedError(Within(origin=origin), 0, float(X.lower[k]), float(X.upper[k]))


def _known(extreme: Any, of: Sequence[Ball]) -> Any:
    """The extremes of some balls, NaN where one of these is."""
    xp = namespace(extreme)
    unknown = (xp.isnan(end) for each in of for end in (each.lower, each.upper))
    return xp.where(reduce(xp.logical_or, unknown), xp.nan, extreme)


def drift(slopes: list[tuple[Ball, Ball]], W: Ball, h: Any) -> tuple[Any, Any]:
    """How far a signal can take states from where its mean does.

    Args:
        slopes: bounds of derivatives by states and by the signal, of each step.
        W: what the signal is in.
        h: how long the period is.

    Returns:
        Bounds `(n,)` at the end of the period, and within it.
    """
    low, high = (
        reduce(extreme, (getattr(G, end) for _, G in slopes))
        for extreme, end in ((smaller, "lower"), (larger, "upper"))
    )
    low, high = (_known(each, [G for _, G in slopes]) for each in (low, high))
    G, n = Ball.between(low, high), len(slopes[0][0].mid)
    rate = reduce(larger, (larger(abs(A.lower), abs(A.upper)) for A, _ in slopes))
    rate = _known(rate, [A for A, _ in slopes])
    size, radius = larger(abs(low), abs(high)), h * W.rad * (1 + gamma(4))
    growth = _exponential_less_one(h * rate * (1 + gamma(2)))
    error = 1 + gamma(4 * n + 16)
    end = (G.rad * (1 + gamma(2)) + growth @ size * error) @ radius * error
    return end, (size + growth @ size * error) @ radius * error


def _slopes(tape: Tape, given: list[Ball]) -> tuple[Ball, Ball]:
    """Bounds of the derivatives of `f` by states `(n, n)` and by the last argument `(n, d)`."""
    base, xp = Series(tape), namespace(given[0].mid)
    base.advance(given)
    nothing, found = [zeros(each) for each in given], list[Ball]()
    for place in (0, len(given) - 1):
        columns = list[Ball]()
        for unit in np.eye(len(given[place].mid)):
            moved = [*nothing]
            moved[place] = Ball.exact(xp.asarray(unit))
            columns.append(base.copy().advance(moved))
        parts = ([getattr(each, name) for each in columns] for name in ("mid", "rad"))
        found.append(Ball(*(xp.stack(part, axis=1) for part in parts)))
    return found[0], found[1]


def _exponential_less_one(M: Float[Array | np.ndarray, "n n"]) -> Any:
    """An upper bound of `exp(M) - 1`, entry by entry, for `M >= 0`; infinite for large ones."""
    xp = namespace(M)
    term = total = M
    for k in range(2, TERMS + 1):
        term = term @ M / k
        total = total + term
    norm = M.sum(axis=1).max() * (1 + gamma(len(M)))
    small = settled(norm < TERMS / 2)
    rest = xp.where(small, norm, 1.0) ** (TERMS + 1) / math.factorial(TERMS + 1) * 2
    return (total + xp.where(small, rest, xp.inf)) * (1 + gamma(TERMS * (len(M) + 4)))
