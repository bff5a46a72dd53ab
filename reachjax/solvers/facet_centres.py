"""The points of the central path of each facet, how they move, and what they prove."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from reachjax.numerics.host import all_finite
from reachjax.programs.compact import CompactProgram, compact
from reachjax.programs.lmi import Program
from reachjax.proofs.accepted import ROUNDING
from reachjax.proofs.recheck import interval_offsets, sound_offsets
from reachjax.solvers.central_path import FROM_AFAR, LARGEST, PRICES, path_end, solved
from reachjax.solvers.facet_barrier import FacetBarrier
from reachjax.solvers.proposals import Solution, SolverStatus
from reachjax.solvers.slopes import Held, held_offsets

SHORT = 1e-6
"""A centre counts as found if its multipliers prove it to this part of the interval's radius."""


class Slopes(NamedTuple):
    """The derivative of offsets `b` in their own units, as that of two Lagrangians.

    Attributes:
        multipliers: `(f, K)`, of `y`.
        moments: `(f, n, n)`, `2 mu A`.
        multipliers_slope: `(f, K)`, of `y'`.
        moments_slope: `(f, n, n)`, `2 mu Z^-1`, the moments.
    """

    multipliers: np.ndarray
    moments: np.ndarray
    multipliers_slope: np.ndarray
    moments_slope: np.ndarray


class Centres(NamedTuple):
    """What is found for the facets of a program; arrays only.

    Attributes:
        offsets: `(f,)`, proved.
        centres: `(f,)`, those of the path in their units, NaN where they are not found or not
            proved.
        weights: `(f,)`, `mu`.
        slopes: of the centres; finite where these are.
        held: `(f, K)` and `(f, n, n)`, multipliers and moments of the Lagrangian whose derivative
            is that of the offsets elsewhere (`slopes.held_offsets`); NaN for all without numbers.
        solution: the same as a proposal.
    """

    offsets: np.ndarray
    centres: np.ndarray
    weights: np.ndarray
    slopes: Slopes
    held: Held
    solution: Solution

    @classmethod
    def unknown(cls, program: Program) -> Centres:
        """NaN throughout, of the right shapes."""
        facets, size = program.objective.mid.shape
        count = program.products.free.shape[0]
        vectors, matrices = np.full((facets, count), np.nan), np.full((facets, size, size), np.nan)
        slopes = Slopes(vectors, matrices, vectors.copy(), matrices.copy())
        offsets, centres, weights = np.full((3, facets), np.nan)
        held = vectors.copy(), matrices.copy()
        return cls(offsets, centres, weights, slopes, held, Solution.blank(facets, count, size))


def facet_centres(program: Program, weight: float) -> Centres:
    """Follow the path of each facet, and prove where it leads.

    Args:
        program: the facets of one step.
        weight: as `CentralPath` has it.
    """
    found = Centres.unknown(program)
    if not all_finite(program):
        return found
    reduced = compact(program)
    # the 1-norm, in which offsets are sought elsewhere, has kinks of its own
    reduced = reduced.with_units(reduced.units * np.linalg.norm(reduced.objective, axis=1))
    found.weights[:] = weight / (len(reduced.columns) + len(reduced.kept) + 1)
    for i in range(len(found.centres)):
        began = time.perf_counter()
        status, found.centres[i], slopes = _centre(reduced, i, found, found.weights[i])
        for whole, part in zip(found.slopes, slopes, strict=True):
            whole[i] = part
        found.solution.statuses[i] = status
        found.solution.seconds[i] = time.perf_counter() - began
    return _proved(program, reduced, found)


def _proved(program: Program, reduced: CompactProgram, found: Centres) -> Centres:
    """What the multipliers prove, but no less than the centres, which are smooth."""
    slopes, solution = found.slopes, found.solution
    answered = np.array([np.isfinite(each).all() for each in slopes.multipliers])
    multipliers = reduced.units[:, None] * np.where(answered[:, None], slopes.multipliers, 0.0)
    offsets = reduced.centers + reduced.units * found.centres
    by_intervals = interval_offsets(program)
    by_multipliers = sound_offsets(program, multipliers)
    proved = np.fmin(by_multipliers, by_intervals)
    slack = SHORT * (by_intervals - reduced.centers) + ROUNDING * abs(by_intervals)
    borne_out = proved <= offsets + slack  # False where there is no centre
    statuses = np.where(
        answered & ~borne_out, int(SolverStatus.INACCURATE), np.asarray(solution.statuses)
    )
    return found._replace(
        offsets=np.where(borne_out, np.fmax(proved, offsets), proved),
        centres=np.where(borne_out, found.centres, np.nan),
        held=held_offsets(program, multipliers, by_multipliers < by_intervals),
        solution=solution._replace(
            offsets=offsets,
            multipliers=multipliers,
            moments=slopes.moments_slope,
            statuses=statuses,
        ),
    )


def _centre(
    reduced: CompactProgram, i: int, found: Centres, weight: float
) -> tuple[SolverStatus, float, Slopes]:
    """The offset of one facet's centre in its units, and its slopes.

    A path that ends at a larger weight still leaves multipliers to prove something with.
    """
    blank = Slopes(*(part[i].copy() for part in found.slopes))
    if reduced.units[i] == 0:  # one value, whatever the weight
        slopes = Slopes(*(0 * np.nan_to_num(part) for part in blank))
        slopes.moments_slope[-1, -1] = 1.0
        return SolverStatus.SOLVED, 0.0, slopes
    if len(reduced.kept) > LARGEST:
        return SolverStatus.FAILED, np.nan, blank
    barrier = FacetBarrier(reduced, i)
    weights = (*(each for each in FROM_AFAR if each > weight), weight)
    # one price, or offsets would jump from one to the next
    end = path_end(barrier, barrier.inside, weights, PRICES[-1:])
    if end is None:
        return SolverStatus.FAILED, np.nan, blank
    reached, inverse = end.weight == weight, barrier.inverse(end.y)
    move = solved(end.hessian, np.eye(len(end.y))[-1])
    answer = inverse @ barrier.weighted(move) @ inverse
    count, used = blank.multipliers.shape[0], np.ix_(reduced.columns, reduced.columns)
    moments = [np.zeros_like(blank.moments) for _ in range(2)]
    for whole, matrix in zip(moments, (answer, inverse), strict=True):
        whole[used] = 2 * end.weight * matrix
    first, last = (barrier.multipliers(vector, count) for vector in (end.y, move))
    status = SolverStatus.SOLVED if reached else SolverStatus.INACCURATE
    value = float(end.y[-1]) if reached else np.nan
    return status, value, Slopes(first, moments[0], last, moments[1])
