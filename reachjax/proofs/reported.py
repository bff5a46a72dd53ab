"""Which bounds are reported: what the recheck proves, in the light of what the solver claims."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

from reachjax.numerics.rounding import gamma
from reachjax.programs.lmi import Program, form_rows
from reachjax.programs.presolve import LEAST_WIDTH, NormalProgram, presolved
from reachjax.proofs.proposal import ANSWERS, Enclosure, Solution
from reachjax.proofs.recheck import clipped, interval_offsets, sound_level, sound_offsets
from reachjax.proofs.slopes import Held, held_offsets
from reachjax.sets import NormalForm

SHORTFALL = 1e-3
"""A claim counts as the optimum if multipliers and moments bear it out to this part of what is
compared: the interval's radius for values, generators of unit norm for signs."""

ROUNDING = 1e-12
"""What rounding may add to a claim, as a part of its size."""


class Judged(NamedTuple):
    """What a solver proposed for a goal, and what that proves.

    Attributes:
        value: what is proved: the offsets `(f,)`, or an ellipsoid.
        optimal: whether it is the relaxation's optimum, of each facet or of the ellipsoid.
        held: what its derivative rests on.
        proposal: what the solver proposed.
    """

    value: Any
    optimal: Bool[Array | np.ndarray, "*f"]
    held: Any
    proposal: Any


def judged_offsets(program: Program, solution: Solution) -> Judged:
    """The rechecked offsets, never below what the relaxation itself gives, and their derivative.

    The recheck knows that the basis is bounded, so it may prove less than the program's optimal
    value. Where the solver has that value, the offset stays there: it means what the relaxation's
    name says. A claim is that value if the multipliers prove it and the moments attain it.
    Elsewhere the offset is what is proved, by multipliers or by intervals.

    The derivative is the program's where multipliers and moments bear the claim out, whatever the
    solver calls it. Elsewhere it is that of what is proved, multipliers being held (`slopes`).

    Args:
        program: of finite numbers.
        solution: of finite multipliers.
    """
    by_intervals = interval_offsets(program)
    multipliers = np.asarray(solution.multipliers)
    by_multipliers = sound_offsets(program, multipliers)
    offsets = np.fmin(by_multipliers, by_intervals)
    claims = np.asarray(solution.offsets)
    size = by_intervals - np.asarray(program.objective.mid)[:, -1]
    slack = SHORTFALL * size + ROUNDING * (abs(by_intervals) + size)
    proved = offsets <= claims + slack  # False where the claim is NaN
    borne_out = proved & np.isfinite(claims) & (_attained(program, solution) >= claims - slack)
    optimal = np.isin(solution.statuses, ANSWERS) & borne_out
    slope, moments = clipped(program, multipliers), np.array(solution.moments)
    held, used = np.flatnonzero(~borne_out), by_multipliers < by_intervals
    slope[held], moments[held] = held_offsets(
        program.with_objective(held), multipliers[held], used[held]
    )
    value = np.where(optimal, np.fmax(offsets, claims), offsets)
    return Judged(value, optimal, Held(slope, moments), solution)


def _attained(program: Program, solution: Solution) -> Float[np.ndarray, " f"]:
    """The values of the moment matrices, `-inf` for those that the program does not allow.

    The optimal value is no smaller (weak duality), but for what they miss their constraints by.
    """
    values = np.full(len(program.objective.mid), -np.inf)
    if not np.isfinite(np.asarray(solution.moments)).any():  # as of a program that was cut
        return values
    reduced = presolved(program)
    for i, whole in enumerate(np.asarray(solution.moments)):
        X = whole[np.ix_(reduced.columns, reduced.columns)]
        if not np.isfinite(X).all() or abs(X[-1, -1] - 1) > SHORTFALL:
            continue
        if _missed(reduced, X) <= SHORTFALL and np.linalg.eigvalsh(X)[0] >= -SHORTFALL:
            values[i] = reduced.centers[i] + reduced.units[i] * (reduced.objective[i] @ X[:, -1])
    return values


def _missed(reduced: NormalProgram, moments: np.ndarray) -> float:
    """By how much moments over the columns kept miss the sign of a product."""
    products = reduced.generators.paired(moments)
    return float(np.where(reduced.free, abs(products), -products).max(initial=0.0))


def judged_form(
    program: Program,
    enclosure: Enclosure,
    given: NormalForm | None = None,
    centred: bool = False,
) -> tuple[NormalForm, np.ndarray, np.ndarray]:
    """The ellipsoid `|A x+ + b| <= level` to report, its level being what is proved.

    It counts as the relaxation's optimum if it is on the central path, or if the solver answers and
    what is proved is as large as what it proposes, or less where the moments of a given shape show
    that the relaxation allows no less; the level is then 1 at least. Where the solver proposes
    nothing of use, the ellipsoid is `given`, or that around the box of successors.

    Returns:
        The form, the level, and whether it is the relaxation's optimum.
    """
    multipliers = np.asarray(enclosure.multipliers)
    form, level = enclosure.form, np.inf
    if _invertible(form):
        level = sound_level(program, multipliers, form)
    optimal = False
    if level <= 1 + SHORTFALL:
        answered = int(enclosure.status) in ANSWERS
        dual = given is not None and largest_factor(program, enclosure) <= 1 + SHORTFALL
        optimal = centred or (answered and (level >= 1 - SHORTFALL or dual))
    if optimal:
        level = max(1.0, level)
    else:
        other = _interval_form(program) if given is None else given
        least = LEAST_WIDTH * float(np.linalg.norm(other.A, 2))
        proved = max(sound_level(program, multipliers, other), least)
        if not log_volume(form, level) <= log_volume(other, proved):
            form, level = other, proved
    return form, np.array(level), np.array(optimal)


def largest_factor(program: Program, enclosure: Enclosure) -> float:
    """What no factor on the proposed `A` and `b` exceeds; infinite if nothing is shown.

    With `X` positive semidefinite and `<X, G_k>` of the right signs, `[e e' - G, f V'; f V, I]` is
    semidefinite for no `f` beyond `(X_nn + trace X_22) / (-2 <X_21, V>)` (weak duality).
    """
    n, X = len(program.transform), np.asarray(enclosure.moments)
    if not np.isfinite(X).all() or X[n - 1, n - 1] <= 0:
        return np.inf
    X, reduced = X / X[n - 1, n - 1], presolved(program)
    missed = _missed(reduced, X[np.ix_(reduced.columns, reduced.columns)])
    if max(missed, -np.linalg.eigvalsh((X + X.T) / 2)[0]) > SHORTFALL:
        return np.inf
    slope = -2 * np.sum(X[n:, :n] * form_rows(program, enclosure.form).mid)
    return (1 + np.trace(X[n:, n:])) / slope if slope > 0 else np.inf


def log_volume(form: NormalForm, level: float | np.ndarray) -> float:
    """The logarithm of the volume of `|A x + b| <= level`, but for that of the unit ball."""
    if not np.isfinite(level):
        return np.inf
    return float(len(form.b) * np.log(max(level, 1e-300)) - np.linalg.slogdet(form.A)[1])


def _interval_form(program: Program) -> NormalForm:
    """The ellipsoid around the interval bounds of the successor, never quite flat."""
    reduced = presolved(program)
    A = np.diag(1 / (np.sqrt(len(reduced.widths)) * reduced.widths))
    return NormalForm(A, -A @ reduced.centers)


def _invertible(form: NormalForm) -> bool:
    """Whether the ellipsoid can be turned into centre and shape with digits to spare."""
    A, b = form
    if not (np.isfinite(A).all() and np.isfinite(b).all()):
        return False
    try:
        inverse = np.linalg.inv(A)
    except np.linalg.LinAlgError:
        return False
    with np.errstate(over="ignore", invalid="ignore"):
        rounding = gamma(len(b)) * (abs(A) @ abs(inverse @ inverse.T) @ abs(A).T).sum(axis=1)
        rounding += gamma(len(b)) * (abs(A) @ abs(inverse @ b))
    return bool(np.all(rounding < SHORTFALL))
