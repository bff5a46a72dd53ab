"""The second claim: no violated requirement is proved, and no satisfied one refuted.

Thresholds stand at, a few units in the last place beside, and far from what is attained: the exact
supremum where the loop is affine on its initial set, else the best exact trajectory.
"""

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from tests.campaign.cases import SAMPLES, Case
from tests.campaign.containment import Found, start_of
from tests.campaign.oracle import Region, exact, rounded
from tests.campaign.random_regions import literal
from tests.campaign.suprema import Affine

NEAR = (-3, -2, -1, 0, 1, 2, 3)
"""Units in the last place."""

BESIDE = (1e-14, 1e-12, 1e-9, 1e-6, 1e-3, 0.5, 10.0)
"""Parts of the size of what is attained."""


@dataclass(frozen=True)
class Question:
    """A specification of two rows.

    Attributes:
        region: Python of the requirement, a keyword argument.
        kind: `goal`, `safe` or `avoid`.
        rows: `(2, n)`.
        limits: `(2,)`.
        violated: whether it surely is.
        satisfied: whether it surely is.
    """

    region: str
    kind: str
    rows: np.ndarray
    limits: np.ndarray
    violated: bool
    satisfied: bool

    @property
    def expression(self) -> str:
        """Python of the call of `verify`."""
        return f"rj.verify(tube, {self.region}, samples={SAMPLES})"

    def decided(self, case: Case, options: str) -> str:
        """Python of the call of `decide`, with further arguments."""
        return (
            f"rj.decide(loop, X0, {case.shapes.horizon}, {self.region}, "
            f"start={case.loop.start}, samples={SAMPLES}{options})"
        )


def question(
    case: Case, found: Found, steps: list[Affine] | None, rng: np.random.Generator
) -> Question | None:
    """A specification near what the loop attains; None where numbers are beyond float64."""
    kind = str(rng.choice(["goal", "safe", "avoid"], p=[0.5, 0.25, 0.25]))
    horizon = case.shapes.horizon
    times = [horizon] if kind == "goal" else [*range(horizon + 1)]
    rows = np.array([_row(case, found, rng) for _ in range(2)])
    if kind == "avoid":
        rows[1] = 2 * rows[0]
    attained = [_attained(case, found, steps, row, times, kind) for row in rows]
    with np.errstate(over="ignore"):
        limits = np.array([_limit(-v if kind == "avoid" else v, rng) for v, _ in attained])
    if kind == "avoid":
        limits[1] = 2 * limits[0]
    if not (np.isfinite(rows).all() and np.isfinite(limits).all() and rows.any(axis=1).all()):
        return None
    d = exact(limits)
    if kind == "avoid":  # `attained` are values of -row: the least of row is minus the largest
        low, high = attained[0]
        violated, satisfied = -low <= d[0], high is not None and -high > d[0]
        region = f"avoid=[rj.Polytope({literal(rows)}, {literal(limits)})]"
    else:
        violated = any(low > limit for (low, _), limit in zip(attained, d, strict=True))
        pairs = zip(attained, d, strict=True)
        satisfied = all(high is not None and high <= limit for (_, high), limit in pairs)
        region = f"{kind}=rj.Polytope({literal(rows)}, {literal(limits)})"
    return Question(region, kind, rows, limits, violated, satisfied)


def _row(case: Case, found: Found, rng: np.random.Generator) -> np.ndarray:
    """A direction whose entries weigh coordinates by their sizes, of any length."""
    n = case.shapes.states
    row = np.eye(n)[rng.integers(n)] * rng.choice([-1.0, 1.0])
    if rng.random() < 0.5:
        sizes = abs(found.states[-1][0]).max(axis=0).astype(float)
        row = rng.normal(size=n) / np.where(sizes > 0, sizes, 1.0)
    power = rng.choice([0, rng.integers(-30, 30), 515, -560], p=[0.5, 0.35, 0.08, 0.07])
    return row * 2.0 ** float(power)


def _attained(
    case: Case, found: Found, steps: list[Affine] | None, row, times, kind: str
) -> tuple[Fraction, Fraction | None]:
    """What the row (its negative, where sets are avoided) surely attains, and never exceeds."""
    row = -exact(row) if kind == "avoid" else exact(row)
    if steps is not None:
        found_each = [steps[t].supremum(case.initial, row) for t in times]
        if None not in found_each:
            return max(low for low, _ in found_each), max(high for _, high in found_each)
    direction = rounded(row)
    best = None
    for t in times:
        for k in np.argsort(-(found.states[t][0] @ direction), kind="stable")[:3]:
            x0 = start_of(case.initial, found, k)
            if k < len(case.initial.corners) or case.initial.region.holds(x0):
                value = row @ case.loop.simulate(x0[None], t)[t, 0]
                best = value if best is None else max(best, value)
    if best is None:
        inner = case.initial.inner[None]
        best = max(row @ case.loop.simulate(inner, t)[t, 0] for t in times)
    return best, None


def _limit(attained: Fraction, rng: np.random.Generator) -> float:
    """A threshold at, near or far from what is attained."""
    try:
        value = float(attained)
    except OverflowError:
        return np.inf
    if rng.random() < 0.6:
        units = int(rng.choice(NEAR))
        for _ in range(abs(units)):
            value = np.nextafter(value, np.inf * units)
        return value
    part = float(rng.choice(BESIDE)) * float(rng.choice([-1.0, 1.0]))
    return value + part * (abs(value) or 1e-300)


def judged(case: Case, asked: Question, status: str, counterexample) -> str | None:
    """What is false about a verdict; None if nothing is."""
    if status == "PROVED" and asked.violated:
        return "false verdict: PROVED, but the requirement is violated"
    if status == "REFUTED" and asked.satisfied:
        return "false verdict: REFUTED, but the requirement is satisfied"
    if status != "REFUTED":
        return None
    x0 = exact(np.asarray(counterexample.states[0], dtype=float))
    if not case.initial.region.holds(x0):
        return f"false counterexample: {x0.astype(float).tolist()} is not in X0"
    t = counterexample.time
    state = case.loop.simulate(x0[None], t)[t, 0]
    inside = Region(asked.rows, asked.limits).holds(state)
    if inside is not (asked.kind == "avoid"):
        return f"false counterexample: the state at t = {t} breaks nothing"
    return None
