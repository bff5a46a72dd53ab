"""Offsets on the central path at a chosen barrier weight: looser, and smooth in all data.

An optimal offset has kinks: where a facet only touches, or an optimal point is not unique. The
offset of the minimiser of a barrier function has none, is no smaller, and larger by at most the
weight times the number of basis entries and multipliers. It moves as the implicit function theorem
says, with the Hessian of that function.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from reachjax.lmi import Program, lagrangian
from reachjax.recheck import interval_offsets, sound_offsets
from reachjax.solvers.barrier import DAMPING
from reachjax.solvers.base import Solution, SolverStatus
from reachjax.solvers.central_path import FROM_AFAR, path_end, solved
from reachjax.solvers.compact import CompactProgram, compact
from reachjax.solvers.facet_barrier import FacetBarrier
from reachjax.solvers.host import all_finite, asked_for, on_host, shapes_of
from reachjax.solvers.trimming import squared_sizes


class Slopes(NamedTuple):
    """The derivative of each facet's offset `b` in its own units, as that of two Lagrangians.

    Attributes:
        multipliers: `(f, K)`, at the centre.
        moments: `(f, n, n)`, how the moments there answer the offset.
        multipliers_slope: `(f, K)`, how the multipliers answer it.
        moments_slope: `(f, n, n)`, the moments there.
    """

    multipliers: np.ndarray
    moments: np.ndarray
    multipliers_slope: np.ndarray
    moments_slope: np.ndarray

    @classmethod
    def unknown(cls, facets: int, count: int, size: int) -> Slopes:
        """NaN throughout."""
        vectors, matrices = np.full((facets, count), np.nan), np.full((facets, size, size), np.nan)
        return cls(vectors, matrices, vectors.copy(), matrices.copy())


def smoothed_offsets(program: Program, weight: float) -> tuple[Float[Array, " f"], Solution]:
    """The offsets of the centres, proved; differentiable in the program's rows.

    Args:
        program: the facets of one step.
        weight: `mu`, in units of the 2-norm of each objective row over the scaled basis.

    Returns:
        The offsets `(f,)`, and the multipliers and moments (which have no derivative).
    """
    result: Any = _smoothed(weight, program.facts.mid, program.objective.mid, program)
    offsets, _, solution, _ = result
    return offsets, solution


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _smoothed(weight, facts, objective, program):
    facets, size = objective.shape
    count = program.products.free.shape[0]
    solution = shapes_of(Solution.blank(facets, count, size))
    numbers = jax.ShapeDtypeStruct((facets,), float)
    slopes = shapes_of(Slopes.unknown(facets, count, size))
    return on_host(partial(_solve, weight), (numbers, numbers, solution, slopes), program)


def _forward(weight, facts, objective, program):
    result: Any = _smoothed(weight, facts, objective, program)
    _, centred, _, slopes = result
    return result, (program, centred, slopes)


def _backward(weight, residual, cotangents):
    program, centred, slopes = residual

    def value(facts, objective):
        center, linear = objective[:, -1], objective.at[:, -1].set(0.0)
        squares = jnp.sum(linear**2, axis=1)
        varies = squares > 0
        size = jnp.where(varies, squares, 1.0) ** 0.5
        rows = program.with_midpoints(facts, linear / size[:, None])
        flat = program.with_midpoints(facts, 0 * linear)
        # of the slope only the derivative counts
        slope = lagrangian(rows, slopes.multipliers, slopes.moments) - lagrangian(
            flat, slopes.multipliers_slope, slopes.moments_slope
        )
        # damping is of multipliers of generators of unit size
        together = slopes.multipliers * slopes.multipliers_slope
        slope -= DAMPING * weight * together @ squared_sizes(program.products, facts)
        held = jax.lax.stop_gradient(size)
        return (
            center
            + jnp.where(varies, size * centred, 0.0)
            + held * (slope - jax.lax.stop_gradient(slope))
        )

    pull: Any = jax.vjp(value, program.facts.mid, program.objective.mid)[1]
    return *pull(jnp.where(asked_for(cotangents[2]), jnp.nan, cotangents[0])), None


_smoothed.defvjp(_forward, _backward)


def _solve(weight: float, program: Program):
    """Proved offsets, those of the centres in their units, the proposal, and its slopes."""
    facets, size = program.objective.mid.shape
    count = len(program.products.free)
    solution, slopes = Solution.blank(facets, count, size), Slopes.unknown(facets, count, size)
    centres = np.full(facets, np.nan)
    if not all_finite(program):
        return np.full(facets, np.nan), centres, solution, slopes
    reduced = compact(program)
    # the 1-norm, in which offsets are sought elsewhere, has kinks of its own
    reduced = reduced.with_units(reduced.units * np.linalg.norm(reduced.objective, axis=1))
    for i in range(facets):
        began = time.perf_counter()
        centres[i] = _centre(reduced, i, weight, solution, slopes)
        solution.seconds[i] = time.perf_counter() - began
    by_intervals = interval_offsets(program)
    proved = np.fmin(sound_offsets(program, np.asarray(solution.multipliers)), by_intervals)
    solution.offsets[:] = reduced.centers + reduced.units * centres
    ours = solution.statuses == SolverStatus.SOLVED
    short = proved > solution.offsets + 1e-6 * (by_intervals - reduced.centers)
    centres[short] = np.nan
    return np.where(ours, np.fmax(proved, solution.offsets), proved), centres, solution, slopes


def _centre(
    reduced: CompactProgram, i: int, weight: float, solution: Solution, slopes: Slopes
) -> float:
    """The offset of a facet's centre in its units, NaN where none is found; the rest is written."""
    if reduced.units[i] == 0:  # one value, whatever the weight
        for part in (*slopes, solution.moments):
            part[i] = 0.0
        solution.moments[i, -1, -1], solution.statuses[i] = 1.0, SolverStatus.SOLVED
        return 0.0
    barrier = FacetBarrier(reduced, i)
    weights = (*(each for each in FROM_AFAR if each > weight), weight)
    found = path_end(barrier, barrier.inside, weights)
    if found is None or found.weight > weight:
        return np.nan
    y, hessian, _ = found
    count = solution.multipliers.shape[1]
    move, inverse = (
        solved(hessian, barrier.cost * (np.arange(len(y)) == len(y) - 1)),
        barrier.inverse(y),
    )
    answer = inverse @ barrier.weighted(move) @ inverse
    for part, vector in ((slopes.multipliers, y), (slopes.multipliers_slope, move)):
        part[i] = barrier.multipliers(vector, count)
    used = np.ix_(reduced.columns, reduced.columns)
    moments = (slopes.moments, answer), (slopes.moments_slope, inverse), (solution.moments, inverse)
    for part, matrix in moments:
        part[i] = 0.0
        part[i][used] = 2 * weight * matrix
    solution.multipliers[i] = reduced.units[i] * slopes.multipliers[i]
    solution.statuses[i] = SolverStatus.SOLVED
    return float(y[-1])
