"""Units `z = f(y)` that bend smoothly, and what Taylor and interpolation say of them.

On an interval `f(y) - s y` is extreme at an end or where `f'(y) = s`; that gives bounds for any
slope, and lines. The quadratic through `f` at the Chebyshev nodes `c` and `c +- sqrt(3)/2 r` of an
interval of middle `c` and half width `r` is off by at most `r^3/24 max |f'''|`.

Library functions are taken to be off by a few roundings, and their errors are bounded where they
are used: no bound relies on how a slope, a stationary point or a coefficient was found.
"""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float

from reachjax.loops.units.base import AbstractUnit, Block, Facts, Line, Lines, Mark, Product
from reachjax.numerics.rounding import (
    TINY,
    UNIT,
    constant,
    errors,
    gamma,
    is_counted,
    larger,
    namespace,
    select,
    settled,
    smaller,
)

SLACK = 64 * UNIT
"""Relative error allowed of a library function. Those of numpy and XLA that are used here were off
by 7 units at most on a CPU (XLA's tanh near 20), and by 1 to 4 otherwise."""

THIN = 1e-7
"""Intervals shorter than this part of their size are thin: differences of values lose so many
digits that a derivative in the middle is the better slope, and no quadratic beats a line."""

SQUARES = 1e-100
"""Half widths below this, or above its inverse, have squares next to underflow or overflow."""

FAR = 1e3
"""Units that have bounds between its negative and it are taken to have some everywhere."""

POLE = 1e-60
"""Nearer to a pole, third derivatives are taken to be infinite: powers of it would overflow."""


class Quadratic(NamedTuple):
    """`|f(y) - (offset + slope (y - center) + curvature (y - center)^2)| <= gap`, `(k,)` each.

    It holds for every real `y` of the interval and the coefficients as they are, in exact
    arithmetic. Where nothing is known the gap is infinite and the rest is 0.
    """

    center: Array
    offset: Array
    slope: Array
    curvature: Array
    gap: Array


EXTREMES = "extremes"
"""The name of what need not be found again for a derivative (`jax.checkpoint`)."""

ENDLESS = 1e100
"""Inputs of this size are no matter of a domain."""


class Origin(NamedTuple):
    """What a unit is a part of, for errors: that which a user wrote.

    Attributes:
        name: of the function.
        trouble: what is in a range on which the unit has no bounds: a verb, and up to the range.
        advice: how to avoid that.
    """

    name: str
    trouble: str
    advice: str


class UnboundedError(ValueError):
    """A unit has no bounds on the range of its inputs.

    Args:
        unit: which one.
        t: the time.
        lower: of the range.
        upper: the same.
        line: where a user wrote it; nothing where that is not known.
        cells: how small the cells are that were tried; nothing where none were.
    """

    def __init__(
        self,
        unit: AbstractUnit,
        t: int,
        lower: float,
        upper: float,
        line: str = "",
        cells: str = "",
    ):
        name, trouble, advice = (isinstance(unit, SmoothUnit) and unit.origin) or Origin(
            type(unit).__name__, "has inputs in", getattr(unit, "advice", SmoothUnit.advice)
        )
        parts = (
            "a smaller X0, or more time or cells for it"
            if cells
            else "smaller cells of X0 (reach_partitioned, or decide(..., cells=...))"
        )
        advice = f"{advice}, or take {parts}"
        if max(-lower, upper) > ENDLESS:
            advice = (
                "bounds grow without end. Take a shorter step of integration in the plant's "
                f"function, or {parts}; and see whether the loop is stable"
            )
        super().__init__(
            f"{name}{line} at t = {t} {trouble} [{lower:g}, {upper:g}], on which it has no "
            f"bounds{cells}: {advice}"
        )
        self.given, self.line = (unit, t, lower, upper), line

    def after(self, cells: int, widths: Sequence[float]) -> UnboundedError:
        """The error where it is of one of so many cells, of these widths."""
        sides = ", ".join(f"{width:.3g}" for width in widths)
        tried = f", even over one of {cells} cells, with sides of {sides}"
        return UnboundedError(*self.given, line=self.line, cells=tried)


@dataclasses.dataclass(frozen=True)
class SmoothUnit(AbstractUnit):
    """A unit three times differentiable where it is defined.

    Args:
        least: what its inputs are known never to be below, as sums of squares are never below zero;
            what bounds of them say beneath it then says nothing.
        most: what they are known never to be above.
        origin: what it is a part of, for errors; None if it is what a user wrote.

    Attributes:
        image: bounds of all its values.
        flushed: what numbers too small for floats may add to an error of its value.
        rises: whether it increases wherever it is defined.
        advice: what to do where inputs leave its domain.
    """

    least: float = dataclasses.field(default=-math.inf, repr=False, kw_only=True)
    most: float = dataclasses.field(default=math.inf, repr=False, kw_only=True)
    origin: Origin | None = dataclasses.field(default=None, repr=False, kw_only=True)

    curved = True
    image: ClassVar[tuple[float, float]] = (-math.inf, math.inf)
    flushed: ClassVar[float] = 1024 * TINY
    rises: ClassVar[bool] = False
    advice: ClassVar[str] = "keep them away from what is outside of its domain"

    def met(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """What inputs can be of those between bounds."""
        if self.least > -math.inf:
            lower, upper = larger(lower, self.least), larger(upper, self.least)
        if self.most < math.inf:
            lower, upper = smaller(lower, self.most), smaller(upper, self.most)
        return lower, upper

    @property
    def limited(self) -> bool:
        """Whether it has a domain, or overflows: of some inputs it says nothing."""
        ends: Any = np.full(1, -FAR), np.full(1, FAR)
        with np.errstate(all="ignore"):
            try:
                return not (self.defined(*ends).all() and np.isfinite(self.interval(*ends)).all())
            except UnboundedError:
                return True

    def knowing(self, ends: Callable[[], tuple[float, float]]) -> SmoothUnit:
        """The unit with what its inputs are known never to be below, or above."""
        least, most = ends()
        return dataclasses.replace(self, least=least, most=most)

    def limits(self, least: Any, most: Any) -> tuple[Any, Any]:
        """Bounds of the value for inputs of which an end, or both, may be infinite."""
        ends: Any = [np.where(np.isfinite(end), end, 1.0) for end in (least, most)]
        low, high = ends
        if self.rises:
            first, last = self.interval(low, low)[0], self.interval(high, high)[1]
        else:
            first, last = self.interval(low, high)
            least = most = np.where(np.isfinite(least) & np.isfinite(most), 0.0, math.inf)
        known = np.isfinite(least), np.isfinite(most)
        return np.where(known[0], first, self.image[0]), np.where(known[1], last, self.image[1])

    @abc.abstractmethod
    def derivative(self, y: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """The derivative `f'(y)`."""

    @abc.abstractmethod
    def stationary(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, ...]:
        """Points among which are those of `[lower, upper]` where `f(y) - slope y` is extreme.

        To half the digits of floats: an error counts by its square. Other points do no harm,
        wherever they are, and neither does NaN.
        """

    @abc.abstractmethod
    def third(self, lower: Array, upper: Array) -> Float[Array, " k"]:
        """An upper bound of `|f'''|` on `[lower, upper]`, infinite next to a pole."""

    def on_tape(self, tape: Any, y: tuple[int, ...], apply: Any = None) -> int:
        """Its value on a tape of Taylor series, and its slope."""
        return tape.smooth(self, *y, apply)

    def slope_on_tape(self, tape: Any, y: int, z: int) -> int | None:
        """The derivative on a tape, made of the input and the value; None if it is not known."""
        return None

    def defined(self, lower: Array, upper: Array) -> Bool[Array, " k"]:
        """Where `f` is defined on all of `[lower, upper]`, and its value can be trusted."""
        return (abs(lower) < math.inf) & (abs(upper) < math.inf)

    @np.errstate(all="ignore")
    def interval(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """What remains of the value if nothing is taken from it; NaN where an end is."""
        xp, (least, most) = namespace(lower, upper), self.image
        if not is_counted():
            return self._plain_interval(lower, upper)
        low, high = self.remainder(xp.zeros_like(lower), lower, upper)
        unknown = xp.isnan(lower) | xp.isnan(upper)
        low, high = larger(low, least), smaller(high, most)
        return xp.where(unknown, math.nan, low), xp.where(unknown, math.nan, high)

    @np.errstate(all="ignore")
    def remainder(self, slope: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
        """Bounds of `f(y) - slope y`, from both ends and its stationary points.

        They hold for any slope, and are infinite where the unit is not defined.
        """
        xp = namespace(slope, lower, upper)
        slope, lower, upper = settled((slope, *self.met(lower, upper)))
        fine = self.defined(lower, upper) & (abs(slope) < math.inf)
        slope = select(fine, slope, 0.0)
        lower, upper = (select(fine, end, 1.0) for end in (lower, upper))
        # by the envelope theorem a derivative needs no derivatives of the stationary points
        inner = self.stationary(*map(constant, (slope, lower, upper)))
        y = xp.stack([lower, upper, *(_within(point, lower, upper) for point in inner)])
        if not is_counted():
            y = self._extremes(slope, lower, upper, constant(y))
            low, high = self(y) - slope * y
            return select(fine, low, -math.inf), select(fine, high, math.inf)
        value, product = self(y), slope * y
        rest = value - product
        rounding = constant(
            SLACK * (abs(value) + abs(product))
            + (self.flushed + TINY * (abs(slope) + abs(y)))  # of what underflows
        )
        known = fine & (abs(rest) < math.inf) & (rounding < math.inf)
        low = select(known, rest - rounding, -math.inf)
        high = select(known, rest + rounding, math.inf)
        return reduce(smaller, low), reduce(larger, high)

    def _plain_interval(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """What remains of the value, where rounding is not counted."""
        if not self.rises:
            low, high = self.remainder(jnp.zeros_like(lower), lower, upper)
            return larger(low, self.image[0]), smaller(high, self.image[1])
        lower, upper = self.met(lower, upper)
        fine, (least, most) = self.defined(lower, upper), self.image
        low, high = self(select(fine, jnp.stack([lower, upper]), 1.0))
        return select(fine, low, least), select(fine, high, most)

    def _extremes(self, slope: Array, lower: Array, upper: Array, points: Array) -> Array:
        """Where `f(y) - slope y` is least and largest of some points, the first two of which are
        ends, that alone have derivatives; in JAX.
        """
        rest = self(points) - constant(slope) * points
        which = jnp.argmin(jnp.stack([rest, -rest]), axis=1)
        found = which[:, None] == np.arange(len(points))[:, None]
        inner = select(found, points, 0.0).sum(axis=1)
        which, inner = checkpoint_name((which, inner), EXTREMES)
        return select(which == 0, lower, select(which == 1, upper, inner))

    def lines(self, lower: Array, upper: Array) -> Lines:
        """Two lines of the slope of the chord, that touch: never the same.

        Where the unit is not defined they are infinitely far from each other.
        """
        lower, upper = self.met(lower, upper)
        slope = settled(self._chord(lower, upper))
        low, high = self.remainder(slope, lower, upper)
        return Lines(below=Line(slope, low), above=Line(slope, high))

    @np.errstate(all="ignore")
    def _chord(self, lower: Array, upper: Array) -> Float[Array, " k"]:
        """The slope of the chord; of the tangent in the middle where differences lose digits."""
        fine = self.defined(lower, upper)
        lower, upper = (select(fine, end, 1.0) for end in (lower, upper))
        first, last = self(lower), self(upper)
        width, rise = upper - lower, last - first
        lost = abs(rise) <= THIN * (abs(first) + abs(last))
        thin = (width <= THIN * (abs(lower) + abs(upper))) | ((width <= THIN) & lost)
        tangent = self.derivative(lower / 2 + upper / 2)
        tangent = tangent if is_counted() else constant(tangent)  # so thin that it does not matter
        slope = select(thin, tangent, rise / select(thin, 1.0, width))
        return select(fine & (abs(slope) < math.inf), slope, 0.0)

    @np.errstate(all="ignore")
    def quadratic(self, lower: Array, upper: Array, linear: Quadratic | None = None) -> Quadratic:
        """The interpolant at Chebyshev nodes, or the lines where those leave less out.

        Where rounding is not counted, nobody looks at the lines.

        The error at the nodes is measured. Between them it is at most 5/3 of that (the nodes'
        Lebesgue constant), here 2, beside the error of an exact interpolant.

        Args:
            lower: the lower ends of the inputs, `(k,)`.
            upper: the upper ends, `(k,)`.
            linear: the lines on these intervals, where they are known.
        """
        xp = namespace(lower, upper)
        linear = self.linear(lower, upper) if linear is None else linear
        lower, upper = settled(self.met(lower, upper))
        center = settled(lower / 2 + upper / 2)
        fine = self.defined(lower, upper)
        lower, upper, middle = (select(fine, y, 1.0) for y in (lower, upper, center))
        radius = larger(upper - middle, middle - lower) * (1 + gamma(2)) + TINY
        wide = fine & (radius > THIN * abs(middle))
        wide = settled(wide & (radius > SQUARES) & (radius < 1 / SQUARES))
        radius = select(wide, radius, 1.0)
        step = math.sqrt(0.75) * radius
        away = select(wide, step, 0.0)
        nodes = xp.stack([middle - away, middle, middle + away])
        values = self(nodes)
        before, at, after = values
        slope = (after - before) / (2 * step)
        curvature = ((after - at) - (at - before)) / (2 * step * step)
        offset, slope, curvature = settled((at, slope, curvature))
        third = self.third(lower, upper)
        wide, third = wide & (third < math.inf), select(third < math.inf, third, 0.0)
        # nodes may be off by some `UNIT |c|`, that is `1e-8 r`
        between = radius * radius * radius / 24 * third * (1 + THIN)

        def off() -> Any:
            y = nodes - middle
            terms = offset, slope * y, curvature * y * y
            rounding = SLACK * abs(values) + gamma(8) * sum(map(abs, terms)) + self.flushed
            return reduce(larger, abs(values - sum(terms)) + constant(rounding))

        if not is_counted():
            return Quadratic(middle, offset, slope, curvature, select(wide, between, math.inf))
        gap = settled((between + 2 * off()) * (1 + gamma(4)))
        better = settled(wide & (gap < linear.gap))
        curved = Quadratic(middle, offset, slope, curvature, gap)
        chosen = settled([select(better, *pair) for pair in zip(curved, linear, strict=True)])
        known = reduce(lambda a, b: a & b, (abs(each) < math.inf for each in chosen))
        *chosen, gap = (xp.where(known, each, 0.0) for each in chosen)
        return Quadratic(*settled((*chosen, xp.where(known, gap, math.inf))))

    def linear(self, lower: Array, upper: Array) -> Quadratic:
        """The lines as a quadratic without curvature."""
        (slope, low), (_, high) = self.lines(lower, upper)
        lower, upper = self.met(lower, upper)
        center = settled(lower / 2 + upper / 2)
        start, half = slope * center, low / 2 + high / 2
        gap = (
            high / 2
            - low / 2
            + errors(
                lambda: (
                    gamma(4) * (abs(start) + abs(low) + abs(high))
                    + TINY * (abs(slope) + abs(center) + 2)
                )
            )
        )
        return Quadratic(center, start + half, slope, namespace(slope).zeros_like(slope), gap)

    def facts(self, y: Any, z: Any, lower: Array, upper: Array) -> Facts:
        """The value is over the line below and under the line above."""
        below, above = self.lines(lower, upper)
        blocks = (
            Block(above.slope * y + above.offset - z, "under", Mark.BOUND),
            Block(z - (below.slope * y + below.offset), "over", Mark.BOUND),
        )
        return Facts(blocks, (), (Product("under", "over", Mark.BOUND),))


def _within(point: Array, lower: Array, upper: Array) -> Array:
    """The point of `[lower, upper]` nearest to this one; `lower` for NaN."""
    return smaller(upper, larger(lower, point))


def nearest(lower: Array, upper: Array) -> Array:
    """The least size `|y|` of the numbers in `[lower, upper]`."""
    return larger(larger(lower, -upper), 0.0)


def farthest(lower: Array, upper: Array) -> Array:
    """The largest size `|y|` of the numbers in `[lower, upper]`."""
    return larger(-lower, upper)
