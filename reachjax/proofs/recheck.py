"""Offsets that hold whatever multipliers a solver returned.

For a facet, write the matrix of `lmi` as `[N v; v' s - 2b]` over the scaled basis `eta`, whose
entries lie in `[-1, 1]`. For every `eps >= 0` that makes `N - eps I` negative definite,

    2 a . x+  <=  s + v' (eps I - N)^-1 v + eps (n - 1)

on the set, so the best `eps` gives the smallest offset that these multipliers prove. It is found in
floating point and then proved: `eps I - M + theta I` is shown to be positive semidefinite by a
Cholesky factorisation that runs to completion (Rump, Verification of positive definiteness, BIT
2006), with the rounding errors of `M` itself bounded entry by entry; what is missing costs
`theta n / 2`. Where the arithmetic overflows, interval arithmetic is the answer. For an ellipsoid
the same steps bound `|A x+ + b|^2`.

Everything here is numpy on the host.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float
from scipy.optimize import root_scalar

from reachjax.numerics.rounding import UNIT, Ball, gamma
from reachjax.programs.lmi import Program, form_rows, weighted_products
from reachjax.sets import NormalForm


def sound_offsets(
    program: Program, multipliers: Float[np.ndarray, "f K"]
) -> Float[np.ndarray, " f"]:
    """The smallest offset `(f,)` that each facet's multipliers `(f, K)` are shown to prove.

    Signed multipliers that are negative are taken as zero.

    Raises:
        ValueError: the multipliers have another shape, or contain NaN or infinity.
    """
    rows = zip(program.objective.mid, program.objective.rad, strict=True)
    goals = (bordered(mid, rad) for mid, rad in rows)
    return _proved_of_each(program, multipliers, goals, interval_offsets(program))


def proved_offsets(
    program: Program, multipliers: Float[np.ndarray, "f K"]
) -> Float[np.ndarray, " f"]:
    """The offsets `(f,)` that multipliers prove, or interval arithmetic where it proves less.

    Raises:
        ValueError: the multipliers have another shape, or contain NaN or infinity.
    """
    return np.fmin(sound_offsets(program, multipliers), interval_offsets(program))


def interval_offsets(program: Program) -> np.ndarray:
    """Offsets `(f,)` by interval arithmetic alone: `|eta_i| <= 1` in the objective rows."""
    p = program.objective
    size = abs(p.mid[:, :-1]).sum(axis=1) + p.rad.sum(axis=1)
    rounding = gamma(p.mid.shape[1]) * (size + abs(p.mid[:, -1]))
    return p.mid[:, -1] + size + 2 * rounding


def sound_level(program: Program, multipliers: Float[np.ndarray, "1 K"], form: NormalForm) -> float:
    """A number that `|A x+ + b|` surely never exceeds, from any multipliers `(1, K)`.

    Signed multipliers that are negative are taken as zero. Without good ones it is the root of the
    sum of the squares of `A x+ + b` by intervals.

    Raises:
        ValueError: the multipliers have another shape, or contain NaN or infinity.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        V = form_rows(program, form)
        by_intervals = np.array([half_square_by_intervals(V)])
        half = _proved_of_each(program, multipliers, [squared(V)], by_intervals)
    half = float(np.fmin(half, by_intervals)[0])
    return float(np.sqrt(max(2 * half, 0.0)) * (1 + gamma(4)))


def half_square_by_intervals(V: Ball) -> float:
    """What `|V eta|^2 / 2` does not exceed, by interval arithmetic alone."""
    q, n = V.mid.shape
    largest = (abs(V.mid).sum(axis=1) + V.rad.sum(axis=1)) * (1 + gamma(n))
    return float(np.sum(largest**2)) * (1 + gamma(q)) / 2


def squared(V: Ball) -> Ball:
    """`V' V`: `|V eta|^2 = eta' V' V eta`, of which the recheck bounds the half."""
    size, squares = abs(V.mid), V.mid.T @ V.mid
    error = gamma(len(V.mid) + 4) * (size.T @ size) + V.rad.T @ (size + V.rad) + size.T @ V.rad
    return Ball(squares, error * (1 + gamma(8)))


def _proved_of_each(
    program: Program,
    multipliers: np.ndarray,
    goals: Iterable[Ball],
    by_intervals: Float[np.ndarray, " f"],
) -> Float[np.ndarray, " f"]:
    """What multipliers, checked first, are shown to prove of each goal's matrix."""
    shape = len(by_intervals), len(program.products.free)
    multipliers = np.asarray(multipliers, dtype=float)
    if multipliers.shape != shape:
        raise ValueError(
            f"multipliers must have shape {shape} (programs, products), but {multipliers.shape} "
            "arrived"
        )
    broken = ~np.isfinite(multipliers).all(axis=1)
    if broken.any():
        raise ValueError(
            f"multipliers of program {int(np.argmax(broken))} contain NaN or infinity: "
            "they prove nothing"
        )
    each = zip(multipliers, goals, by_intervals, strict=True)
    with np.errstate(over="ignore", invalid="ignore"):  # overflow ends in the interval bound
        return np.array([_proved(program, *given) for given in each])


def _proved(program: Program, multipliers: np.ndarray, goal: Ball, by_intervals: float) -> float:
    """The smallest `b` shown for `F' Gamma F + goal - 2 b e e'`: see this module's docstring."""
    mid, rad = matrix(program, multipliers, goal)
    if not (np.isfinite(mid).all() and np.isfinite(rad).all()):
        return float(by_intervals)
    offset, shift = best_offset(mid)
    error = float(rad.sum(axis=1).max()) * (1 + gamma(len(mid)))  # spectral norm <= row sums
    slack = _proved_slack(mid, offset, shift)
    n = len(mid)
    cost = (shift * (n - 1) + (slack + error) * n) / 2
    proved = offset + cost + gamma(4) * (abs(offset) + cost)
    return proved if np.isfinite(proved) else float(by_intervals)


def matrix(program: Program, multipliers: np.ndarray, goal: Ball) -> tuple[np.ndarray, np.ndarray]:
    """`F' Gamma F + goal` over the columns used, and a bound of its rounding errors.

    Products without weight are left out, which add nothing but to the bound of rounding: so it does
    not matter to what is proved which others a program has.
    """
    signed = clipped(program, multipliers)
    used = np.ix_(program.used, program.used)
    products = weighted_products(_weighing(program, signed), signed)
    mid = (products.mid + goal.mid)[used]
    return mid, ((products.rad + goal.rad)[used] + gamma(4) * abs(mid)) * (1 + gamma(4))


def clipped(program: Program, multipliers: np.ndarray) -> np.ndarray:
    """The multipliers as they count: negative ones are zero where the sign matters."""
    return np.where(program.products.free, multipliers, np.maximum(multipliers, 0.0))


def _weighing(program: Program, multipliers: np.ndarray) -> Program:
    """The program with those pairs of facts alone that have a weight."""
    products = program.products
    there = np.asarray(multipliers)[products.multiplier] != 0
    left, right, sign, owner = (
        np.asarray(part)[there]
        for part in (products.left, products.right, products.sign, products.multiplier)
    )
    return program.replace(
        products=products.replace(left=left, right=right, sign=sign, multiplier=owner)
    )


def bordered(mid: np.ndarray, rad: np.ndarray) -> Ball:
    """`p e' + e p'`."""
    last = np.eye(len(mid))[-1]
    return Ball(*(np.outer(part, last) + np.outer(last, part) for part in (mid, rad)))


def best_offset(matrix: np.ndarray) -> tuple[float, float]:
    """The offset `b` and the shift `eps` that minimise the bound of this module's docstring.

    Its derivative in `eps` is `(n - 1 - |(eps I - N)^-1 v|^2) / 2`, which grows with `eps`.
    """
    s, v, N = matrix[-1, -1], matrix[-1, :-1], matrix[:-1, :-1]
    if len(v) == 0:
        return s / 2, 0.0
    values, vectors = np.linalg.eigh(N)
    w = vectors.T @ v
    tiny = len(v) * UNIT * max(abs(values).max(), abs(v).max(), np.finfo(float).tiny)
    least = max(0.0, values[-1] + tiny)
    most = least + tiny + np.linalg.norm(w) / np.sqrt(len(v))

    def excess(shift: float) -> float:
        return float(np.sum((w / (shift - values)) ** 2) - len(v))

    if excess(least) > 0 > excess(most):
        shift = root_scalar(excess, bracket=(least, most), xtol=1e-6 * tiny, rtol=1e-12).root
    else:
        shift = least
    return (s + float(np.sum(w**2 / (shift - values)))) / 2, float(shift)


def _proved_slack(matrix: np.ndarray, offset: float, shift: float) -> float:
    """A `slack >= 0` for which `diag(shift I, 2 offset) - matrix + slack I` surely is semidefinite.

    A Cholesky factorisation that completes for `P - c I`, with `c` at least
    `gamma_{n+1} trace(P) / (1 - gamma_{n+1})`, shows that `P` is positive semidefinite.
    """
    n = len(matrix)
    P = -matrix + np.diag(np.r_[np.full(n - 1, shift), 2 * offset])
    formed = gamma(2) * (abs(matrix).max() + abs(shift) + 2 * abs(offset)) * 2
    size = abs(np.diag(P)).sum() + np.finfo(float).tiny
    slack = 0.0
    for _ in range(60):
        margin = 2 * gamma(n + 1) * (size + n * slack)
        try:
            np.linalg.cholesky(P + (slack - margin) * np.eye(n))
        except np.linalg.LinAlgError:
            slack = max(4 * slack, 8 * margin)
        else:
            return slack + formed
    return np.inf
