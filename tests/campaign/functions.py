"""Plants of functions that JAX computes by cases or by LAPACK, beside the same by plain formulas.

The library is given JAX's functions; a search and a judgement have formulas over their numbers.
"""

import itertools
import math
from fractions import Fraction
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
from scipy.special import erf

import reachjax as rj

PLACES, HEIGHTS = (-1.0, -0.25, 0.5, 2.0), (0.5, -1.0, 0.75, 0.0)
TENTHS = 7


def _sum_of_tenths() -> jax.Array:
    """A sum in 32 bits, which is no matter of states: it is what JAX makes of it at rest."""
    return jnp.sum(jnp.full((TENTHS,), 0.1, jnp.float32)).astype(float)


JAX = SimpleNamespace(
    arctan2=jnp.arctan2,
    arcsinh=jnp.arcsinh,
    erf=jax.scipy.special.erf,
    hypot=jnp.hypot,
    sinc=jnp.sinc,
    solve=jnp.linalg.solve,
    inverse=jnp.linalg.inv,
    table=lambda y: jnp.interp(y, jnp.array(PLACES), jnp.array(HEIGHTS)),
    constant=_sum_of_tenths,
    above=lambda y: (y > 0).astype(float),
    best=lambda scores, values: values[jnp.argmax(scores)],
    one_of=lambda values, w: rj.one_of(values[:, None], w)[0],
)


def _plain(m: Any, **functions: Any) -> SimpleNamespace:
    """What JAX has, by formulas over a namespace."""

    def inverse(A: Any) -> Any:
        (a, b), (c, d) = A
        return m.stack([m.stack([d, -b]), m.stack([-c, a])]) / (a * d - b * c)

    def table(y: Any) -> Any:
        steps = [Fraction(b) - Fraction(a) for a, b in itertools.pairwise(PLACES)]
        slopes = [
            (Fraction(b) - Fraction(a)) / step
            for a, b, step in zip(HEIGHTS, HEIGHTS[1:], steps, strict=False)
        ]
        turns = [b - a for a, b in zip([0, *slopes], [*slopes, 0], strict=True)]
        ramps = [m.maximum(y - at, 0 * y) for at in PLACES]
        scaled = [r * t.numerator / t.denominator for r, t in zip(ramps, turns, strict=True)]
        return HEIGHTS[0] + sum(scaled)

    def best(scores: Any, values: Any) -> Any:
        """The value of the largest score, and of several the first one's."""
        order = range(len(scores))
        return values[next(k for k in order if all(scores[k] >= each for each in scores))]

    return SimpleNamespace(
        above=lambda y: int(y > 0),
        best=best,
        one_of=lambda values, w: best(w, values),
        hypot=lambda a, b: m.sqrt(a * a + b * b),
        inverse=inverse,
        solve=lambda A, b: inverse(A) @ b,
        table=table,
        constant=lambda: float(_sum_of_tenths()),
        **functions,
    )


def _of(function: Any) -> Any:
    return np.vectorize(function, otypes=[object])


def _wave(m: Any, y: Any) -> Any:
    """`sin(pi y) / (pi y)` for `pi` as it is in floats."""
    angle = math.pi * y
    some = np.where(angle == 0, 1 + 0 * angle, angle)
    return np.where(angle == 0, 1 + 0 * angle, m.sin(some) / some)


def of(m: Any) -> SimpleNamespace:
    """The functions that go with a namespace of numbers: JAX's, numpy's or mpmath's.

    Args:
        m: that namespace.
    """
    if m is jnp:
        return JAX
    if m is np:
        own = {"arctan2": np.arctan2, "arcsinh": np.arcsinh, "erf": lambda y: erf(float(y))}
    else:
        named = {"arctan2": "atan2", "arcsinh": "asinh", "erf": "erf"}
        own = {name: _of(getattr(mpmath, theirs)) for name, theirs in named.items()}
    return _plain(m, sinc=lambda y: _wave(m, y), **own)


def by_cases(m: Any, x: Any, u: Any, w: Any, p: dict[str, Any]) -> Any:
    """Tables, lengths, angles in all quadrants but one, waves, and a constant that is rounded."""
    f, a = of(m), p["a"]
    angle = f.arctan2(x[1] / 4, 3 + x[0] * x[0]) + f.hypot(x[0], x[1]) * a[0]
    waves = a[2] * f.erf(x[0]) + f.sinc(2 * x[1]) / 4
    return m.stack([x[0] + a[1] * f.table(x[1]) + angle, waves + u[0] * f.constant()])


def switched(m: Any, x: Any, u: Any, w: Any, p: dict[str, Any]) -> Any:
    """A relay, friction, and one of three pushes: all are tied where `x[0]` is `at`."""
    f, a, off = of(m), p["a"], x[0] - p["at"][0]
    relay = a[0] * (2 * f.above(off) - 1)
    pushed = f.best(m.stack([off, 0 * off, -off / 2]), a)
    stuck = a[1] * (f.above(x[1]) - f.above(-x[1]))
    return m.stack([x[0] + x[1] / 8 + relay / 4, x[1] - stuck / 8 + pushed / 4 + u[0] / 8])


def switched_waves(m: Any, x: Any, u: Any, w: Any, p: dict[str, Any]) -> Any:
    """The same beside a sine, whose sign decides too."""
    wave = m.sin(x[0])
    return switched(m, x, u, w, p) + m.stack([0 * wave, wave * of(m).above(wave) / 4])


def piloted(m: Any, x: Any, u: Any, w: Any, p: dict[str, Any]) -> Any:
    """A pendulum under any of three pushes: the one whose number is the largest."""
    a = p["a"]
    turned = a[0] * m.sin(x[0]) + u[0] / 8 + of(m).one_of(a, w) / 4
    return m.stack([x[0] + x[1] / 8, x[1] + turned])


def advised(m: Any, x: Any, u: Any, w: Any, p: dict[str, Any]) -> Any:
    """A place, and which of two advisories it was sent by, as a one and a zero."""
    a, first = p["a"], of(m).above(u[0])
    sent = a[1] * first + a[2] * (1 - first)
    return m.stack([(1 + a[0] / 4) * x[0] + sent / 4, 0 * sent + first, 0 * sent + 1 - first])


def masses(m: Any, x: Any, u: Any, w: Any, p: dict[str, Any]) -> Any:
    """Two joints, whose matrix of masses depends on the second angle."""
    f, a = of(m), p["a"]
    bend = m.cos(x[1])
    M = m.stack([m.stack([3 + 2 * bend, 1 + bend]), m.stack([1 + bend, 1 + 0 * bend])])
    push = f.solve(M, m.stack([a[0] * u[0], f.arcsinh(x[0])]))
    return x + push / 8 + a[1] / 8 * (f.inverse(M) @ x)
