"""Derivatives of bounds as they are proved, what a solver proposed being held.

The offset that multipliers prove is the largest value of a quadratic function on a ball (strong
duality of trust regions; `eta` as in `recheck`, with `n` entries of which one is constant):

    2 b  =  max { [eta, 1] M [eta, 1]' : |eta|^2 <= n - 1 },    M = F' Gamma F + p e' + e p'.

With `X` the moments of a maximiser, `db = <X / 2, dM>`: the derivative of a bound that holds,
however far the multipliers are from the best ones. Where they are the best, `b` has a kink in most
programs, and the moments of the dual, which are those of several maximisers, tell more than one of
them does: where a solver has them they are used instead (`reported`). A bound by intervals is
`p [s, 1]` with `s` the signs of `p`, which is the same with no multipliers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

from reachjax.numerics.rounding import Ball
from reachjax.programs.lmi import Program, form_rows
from reachjax.proofs.recheck import (
    best_offset,
    bordered,
    clipped,
    half_square_by_intervals,
    matrix,
    sound_level,
    squared,
)
from reachjax.sets import NormalForm


class Held(NamedTuple):
    """What the derivative of bounds rests on: that of `<X, Z>` (`lmi`), these being held.

    Attributes:
        multipliers: `(f, K)`.
        moments: `(f, N, N)`.
    """

    multipliers: Float[Array | np.ndarray, "f K"]
    moments: Float[Array | np.ndarray, "f N N"]


def held_offsets(
    program: Program,
    multipliers: Float[np.ndarray, "f K"],
    by_multipliers: Bool[np.ndarray, " f"],
) -> Held:
    """Multipliers and moments of the bound of each offset.

    Args:
        program: of finite numbers.
        multipliers: of each facet.
        by_multipliers: where these prove the offset; elsewhere it is that of intervals.
    """
    rows = program.objective
    moments = np.zeros((*rows.mid.shape, rows.mid.shape[1]))
    for i, (mid, rad) in enumerate(zip(rows.mid, rows.rad, strict=True)):
        if by_multipliers[i]:
            moments[i] = _moments(program, multipliers[i], bordered(mid, rad))
        else:
            corner = np.append(np.sign(mid[:-1]), 1.0)
            moments[i] = np.outer(corner, corner)
    return Held(np.where(by_multipliers[:, None], clipped(program, multipliers), 0.0), moments)


def held_level(program: Program, multipliers: Float[np.ndarray, "1 K"], form: NormalForm) -> Held:
    """Multipliers and moments of the bound of a level, by multipliers or by intervals.

    The level `s` is `sound_level`'s; with `V = A x+ + b`, `s ds = <X / 2, d(F' Gamma F + V' V)>`.
    Zero where the level is.
    """
    V = form_rows(program, form)
    q, n = V.mid.shape
    moments, held = np.zeros((1, n + q, n + q)), np.zeros_like(multipliers)
    level = sound_level(program, multipliers, form)
    if not 0 < level < np.inf:
        return Held(held, moments)
    if level**2 / 2 < half_square_by_intervals(V):
        X = _moments(program, multipliers[0], squared(V))
        held, rows = clipped(program, multipliers) / level, V.mid @ X / level
        moments[0, :n, :n] = -X / 2
    else:
        signs = np.sign(V.mid)
        rows = signs * abs(V.mid).sum(axis=1, keepdims=True) / level
    moments[0, n:, :n] = rows / 2
    return Held(held, moments)


def _moments(program: Program, multipliers: np.ndarray, goal: Ball) -> Float[np.ndarray, "n n"]:
    """Moments of a maximiser; of two, with their mean, where the ball alone bounds a direction."""
    mid, _ = matrix(program, multipliers, goal)
    shift = best_offset(mid)[1]
    values, vectors = np.linalg.eigh(mid[:-1, :-1])
    inner = (vectors.T @ mid[-1, :-1]) / np.where(shift > values, shift - values, np.inf)
    point = np.append(vectors @ inner, 1.0)
    X = np.outer(point, point)
    room = len(inner) - float(np.sum(inner**2))
    if shift > 0 and room > 0:
        X[:-1, :-1] += room * np.outer(vectors[:, -1], vectors[:, -1])
    whole, used = np.zeros((len(program.used),) * 2), np.flatnonzero(program.used)
    whole[np.ix_(used, used)] = X
    return whole
