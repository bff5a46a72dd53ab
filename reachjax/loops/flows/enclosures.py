"""Sets that no solution leaves within a step: the theorem of Picard and Lindelof, over boxes.

If `X + [0, h] f(B, U, W)` is inside the box `B`, then every solution of `x' = f(x, u, w)` from `X`
exists up to `h` and stays in the former set, for every measurable `w` in `W` (Caratheodory). So
candidates are inflated until they hold what they lead to; where none does, the step is too long, or
solutions escape.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from reachjax.loops.flows.series import Series, Tape
from reachjax.numerics.rounding import (
    TINY,
    Ball,
    constant,
    gamma,
    larger,
    namespace,
    settled,
    smaller,
)

TRIES = 12
"""Candidates on the host; a step that needs more of them is better halved."""

COMPILED = 8
"""Candidates of compiled code, where all of them are tried."""

INFLATED = 0.1
"""The part of its growth by which a candidate is inflated."""


def swept(X: Ball, rate: Ball, h: Any) -> Ball:
    """The set `X + [0, h] rate`."""
    step = h * rate
    return X + Ball.between(smaller(step.lower, 0.0), larger(step.upper, 0.0))


def _holds(B: Ball, other: Ball) -> Any:
    """Whether a box surely holds another one; not if either is unknown."""
    finite = (abs(B.mid) < np.inf) & (B.rad < np.inf)
    rounding = gamma(4) * (abs(B.mid) + B.rad)
    low, high = B.mid - B.rad + rounding, B.mid + B.rad - rounding
    return (finite & (low <= other.lower) & (other.upper <= high)).all()


def _inflated(X: Ball, B: Ball) -> Ball:
    """A somewhat larger candidate."""
    lower, upper = smaller(X.lower, B.lower), larger(X.upper, B.upper)
    more = INFLATED * larger(upper - X.upper, X.lower - lower)
    size = larger(abs(lower), abs(upper))
    more = more + 1e-12 * size + 1e-3 * (upper - lower) + 8 * TINY
    return Ball.between(lower - more, upper + more)


def enclosed(tape: Tape, X: Ball, others: list[Ball], h: Any) -> tuple[Ball, Array | np.ndarray]:
    """A box that holds all solutions within a step, and whether that is proved.

    Args:
        tape: of `f`.
        X: where solutions begin.
        others: what the other arguments are in.
        h: how long the step is.

    Raises:
        UnboundedError: a unit has no bounds on a candidate, in numpy.
    """
    X, h, others = constant_ball(X), constant(h), [constant_ball(each) for each in others]

    def image(B: Ball) -> Ball:
        return swept(X, Series.value(tape, [B, *others]), h)

    if namespace(X.mid) is np:
        B = _inflated(X, image(X))
        for _ in range(TRIES):
            found = image(B)
            if _holds(B, found):
                return image(found).meeting(found), np.array(True)
            B = _inflated(X, found)
        return B, np.array(False)

    def tried(_: int, carry: tuple[Ball, Array]) -> tuple[Ball, Array]:
        B, proved = carry
        found = image(B)
        proved = settled(proved | _holds(B, found))
        candidate = _inflated(X, found)
        parts = zip((found.mid, found.rad), (candidate.mid, candidate.rad), strict=True)
        return Ball(*(jax.numpy.where(proved, *pair) for pair in parts)), proved

    return jax.lax.fori_loop(0, COMPILED, tried, (X, jax.numpy.array(False)))


def constant_ball(ball: Ball) -> Ball:
    """Intervals that derivatives take for constants."""
    return Ball(constant(ball.mid), constant(ball.rad))
