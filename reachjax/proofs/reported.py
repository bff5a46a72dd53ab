"""Which bounds are reported: what the recheck proves, in the light of what the solver claims.

The recheck knows that the basis is bounded, so it may prove less than the program's optimal value.
Where the solver has that value, the bound stays there: it means what the relaxation's name says. A
claim is that value if the multipliers prove it and the moments, which attain it, show that the
relaxation allows no less. Elsewhere the bound is what is proved, by multipliers or by intervals.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

from reachjax.numerics.rounding import gamma
from reachjax.programs.lmi import Program, form_rows
from reachjax.programs.presolve import LEAST_WIDTH, NormalProgram, presolved
from reachjax.proofs.proposal import ANSWERS, Proposal
from reachjax.proofs.recheck import interval_offsets, proved_offsets, sound_level
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
        held: what else its derivative rests on.
        proposal: what the solver proposed.
    """

    value: Any
    optimal: Bool[Array | np.ndarray, "*f"]
    held: Any
    proposal: Proposal


class Sized(NamedTuple):
    """The ellipsoid `|A x + b| <= level`, of which `A` and `b` are the form's times the factor."""

    form: NormalForm
    level: Float[Array | np.ndarray, ""]
    factor: Float[Array | np.ndarray, ""] = np.array(1.0)

    @property
    def scaled(self) -> NormalForm:
        """`A` and `b`."""
        return NormalForm(self.factor * self.form.A, self.factor * self.form.b)

    @property
    def log_volume(self) -> float:
        """The logarithm of the volume, but for that of the unit ball; infinite without a level."""
        if not np.isfinite(self.level):
            return np.inf
        A, b = self.scaled
        return float(len(b) * np.log(max(self.level, 1e-300)) - np.linalg.slogdet(A)[1])


def judged_offsets(program: Program, proposal: Proposal) -> Judged:
    """The rechecked offsets, never below what the relaxation itself gives.

    The derivative is the program's where multipliers and moments bear the claim out, whatever the
    solver calls it: that is what is held. Elsewhere it is that of what is proved (`gradients`).

    Args:
        program: of finite numbers.
        proposal: of finite multipliers.
    """
    by_intervals = interval_offsets(program)
    multipliers = np.asarray(proposal.multipliers)
    offsets = proved_offsets(program, multipliers)
    claims = np.asarray(proposal.unknowns)[:, 0]
    size = by_intervals - np.asarray(program.objective.mid)[:, -1]
    slack = SHORTFALL * size + ROUNDING * (abs(by_intervals) + size)
    proved = offsets <= claims + slack  # False where the claim is NaN
    borne_out = proved & np.isfinite(claims) & (_attained(program, proposal) >= claims - slack)
    optimal = np.isin(proposal.statuses, ANSWERS) & borne_out
    value = np.where(optimal, np.fmax(offsets, claims), offsets)
    return Judged(value, optimal, borne_out, proposal)


def _attained(program: Program, proposal: Proposal) -> Float[np.ndarray, " f"]:
    """The values of the moment matrices, `-inf` for those that the program does not allow.

    The optimal value is no smaller (weak duality), but for what they miss their constraints by.
    """
    values = np.full(len(program.objective.mid), -np.inf)
    if not np.isfinite(np.asarray(proposal.moments)).any():  # as of a program that was cut
        return values
    normal = presolved(program)
    for i, whole in enumerate(np.asarray(proposal.moments)):
        if _allowed(normal, whole):
            column = whole[normal.columns, -1]
            values[i] = normal.centers[i] + normal.units[i] * (normal.objective[i] @ column)
    return values


def _allowed(normal: NormalProgram, moments: Float[np.ndarray, "N N"]) -> bool:
    """Whether moments have corner one, are semidefinite and give no product the wrong sign."""
    n = normal.whole[1]
    used = np.r_[normal.columns, np.arange(n, len(moments))]
    X = moments[np.ix_(used, used)]
    if not (np.isfinite(X).all() and abs(moments[n - 1, n - 1] - 1) <= SHORTFALL):
        return False
    own = slice(len(normal.columns))
    products = normal.generators.paired(X[own, own])
    missed = float(np.where(normal.free, abs(products), -products).max(initial=0.0))
    return missed <= SHORTFALL and np.linalg.eigvalsh(X)[0] >= -SHORTFALL


def judged_least(
    program: Program, proposal: Proposal, form: NormalForm, centred: bool = False
) -> tuple[Sized, bool]:
    """The ellipsoid around the successors to report, its level being what is proved.

    It counts as the relaxation's optimum if it is on the central path, or if the solver answers and
    what is proved is as large as what it proposes; the level is then 1 at least. Where the solver
    proposes nothing of use, it is the ellipsoid around the box of successors.

    Args:
        program: of finite numbers.
        proposal: of finite multipliers.
        form: what it proposes: `|A x+ + b| <= 1`.
        centred: whether that is on the central path.

    Returns:
        The ellipsoid, and whether it is the relaxation's optimum.
    """
    level = _level(program, proposal, form)
    answered = int(proposal.statuses[0]) in ANSWERS
    if level <= 1 + SHORTFALL and (centred or (answered and level >= 1 - SHORTFALL)):
        return Sized(form, np.array(max(1.0, level))), True
    around = _interval_form(program)
    return _smaller(program, proposal, Sized(form, np.array(level)), around), False


def judged_shape(program: Program, proposal: Proposal, given: NormalForm) -> tuple[Sized, bool]:
    """The ellipsoid of a given form to report, its level being what is proved.

    It counts as the relaxation's optimum if the solver answers, and multipliers and moments bear
    out the factor that it proposes; the level is then 1 at least.

    Args:
        program: of finite numbers.
        proposal: of finite multipliers, and the factor on the form.
        given: the form.

    Returns:
        The ellipsoid, and whether it is the relaxation's optimum.
    """
    proposed = Sized(given, np.array(np.inf), np.asarray(proposal.unknowns)[0, 0])
    level = _level(program, proposal, proposed.scaled)
    answered = int(proposal.statuses[0]) in ANSWERS
    if answered and level <= 1 + SHORTFALL and _most(program, proposal, proposed) <= 1 + SHORTFALL:
        return proposed._replace(level=np.array(max(1.0, level))), True
    return _smaller(program, proposal, proposed._replace(level=np.array(level)), given), False


def _most(program: Program, proposal: Proposal, proposed: Sized) -> float:
    """What no further factor on the proposed `A` and `b` exceeds; infinite if nothing is shown.

    With `X` positive semidefinite and `<X, G_k>` of the right signs, `[e e' - G, f V'; f V, I]` is
    semidefinite for no `f` beyond `(X_nn + trace X_22) / (-2 <X_21, V>)` (weak duality).
    """
    n, X = len(program.transform), np.asarray(proposal.moments)[0]
    if not _allowed(presolved(program), X):
        return np.inf
    slope = -2 * np.sum(X[n:, :n] * form_rows(program, proposed.scaled).mid)
    return (X[n - 1, n - 1] + np.trace(X[n:, n:])) / slope if slope > 0 else np.inf


def _level(program: Program, proposal: Proposal, form: NormalForm) -> float:
    """What is proved of a form; infinite if it is no ellipsoid."""
    if not _invertible(form):
        return np.inf
    return sound_level(program, np.asarray(proposal.multipliers), form)


def _smaller(program: Program, proposal: Proposal, one: Sized, form: NormalForm) -> Sized:
    """The ellipsoid itself, or one of another form with what is proved of it."""
    least = LEAST_WIDTH * float(np.linalg.norm(form.A, 2))
    level = max(sound_level(program, np.asarray(proposal.multipliers), form), least)
    other = Sized(form, np.array(level))
    return one if one.log_volume <= other.log_volume else other


def _interval_form(program: Program) -> NormalForm:
    """The ellipsoid around the interval bounds of the successor, never quite flat."""
    normal = presolved(program)
    A = np.diag(1 / (np.sqrt(len(normal.widths)) * normal.widths))
    return NormalForm(A, -A @ normal.centers)


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
