"""The claims on loops of every other kind: sets hold all states, proofs repeat, verdicts are true.

A search among samples and witnesses in longdouble finds suspects; sixty digits convict.
"""

from collections import Counter
from typing import Any

import jax
import numpy as np

import reachjax as rj
from reachjax.loops.units import UnboundedError
from reachjax.programs.unrolled import unrolled, unrolled_from_boxes
from reachjax.tubes.rechecks import Recheck
from tests.campaign.containment import DRAWS
from tests.campaign.kinds import KindCase
from tests.campaign.oracle import WIDE, Region, exact
from tests.campaign.outcomes import Outcome
from tests.campaign.regions import finite, plain
from tests.campaign.trial import Trial

ROUNDING = 1e-9
DOUBTFUL = 1
"""So many states nearest to each facet are computed in sixty digits."""
DOUBT = 1e-6
"""Of a state's size: what is nearer to a facet may be outside of it."""
BESIDE = (-1e-9, -1e-12, 0.0, 1e-12, 1e-9, 1e-3, 0.3)
"""Parts of what is attained, by which thresholds stand beside it."""
LONG = 8
"""Proofs of more steps are repeated by the recheck of their tube, which takes each step once."""

Scenario = tuple[np.ndarray, np.ndarray | None, np.ndarray | None]


def tried(case: KindCase) -> Outcome:
    """What becomes of a case."""
    return Trial(case).run(checked)


def checked(trial: Trial) -> None:
    """Every claim on a case."""
    case, rng = trial.case, trial.case.rng
    names = {"rj": rj, "case": case, "template": case.kind.template(case.kind.states)}
    call = "rj.reach(case.loop, case.X0, case.kind.horizon, template, **case.options)"
    tube = names["tube"] = trial.attempt("reach", call, names)
    if tube is None:
        return
    trial.outcome.counts["tubes"] += 1
    proofs = [tube.proof(t) for t in range(1, case.kind.horizon + 1)]
    for proof in proofs:
        trial.outcome.statuses += Counter(status.name for status in proof.statuses)
        trial.outcome.counts[f"proof: {type(proof).__name__}"] += 1
    sets = [plain(each) for each in tube.sets]
    if not all(map(finite, sets)):
        trial.fails("a set that is no number", f"{tube.sets[1:]}", f"tube = {call}")
        return
    scenarios = _scenarios(case, tube, proofs)
    runs = np.stack([case.states(*one, _wide, np) for one in scenarios])
    trial.outcome.counts["states"] += runs.shape[0] * runs.shape[1]
    for t, region in enumerate(sets[1:], start=1):
        _contained(trial, region, scenarios, runs[:, t], t, f"tube = {call}", "a state outside")
        _witnessed(trial, proofs[t - 1], t)
        if case.kind.horizon <= LONG or t == case.kind.horizon:
            _repeated(trial, proofs[t - 1], region, scenarios, runs[:, t], t)
    if case.kind.horizon > LONG:
        _repeated_at_once(trial, names, sets, scenarios, runs)
    if case.kind.columns and isinstance(case.X0, rj.Box):
        _merged(trial, names, scenarios, runs)
    for _ in range(2):
        _decided(trial, names, scenarios, runs, rng)


def _merged(
    trial: Trial, names: dict[str, Any], scenarios: list[Scenario], runs: np.ndarray
) -> None:
    """No state is outside of what forms say whose old columns are merged."""
    case, rows = trial.case, np.asarray(names["template"].directions)
    names["rows"] = np.broadcast_to(rows, (case.kind.horizon, *rows.shape))
    names["bounds"] = unrolled_from_boxes
    call = "bounds(case.loop, case.X0.lower[None], case.X0.upper[None], rows, columns={})[0, :, 0]"
    call = call.format(case.kind.columns)
    found = trial.attempt("merged columns", call, names)
    if found is None:
        return
    trial.outcome.counts["tubes of merged columns"] += 1
    for t, offsets in enumerate(np.asarray(found), start=1):
        if np.isfinite(offsets).all():
            region = Region(rows, offsets)
            said = "a state outside of merged columns"
            _contained(trial, region, scenarios, runs[:, t], t, call, said)


def _wide(values: Any) -> np.ndarray:
    return np.asarray(values, WIDE)


def _scenarios(case: KindCase, tube: rj.ReachTube, proofs: list) -> list[Scenario]:
    """Initial states with what is drawn, from samples and witnesses, surely of their sets."""
    loop, steps = case.loop, case.kind.horizon
    found: list[Scenario] = []
    states = np.asarray(case.X0.sample(jax.random.key(case.number), DRAWS))
    if isinstance(case.X0, rj.Box):
        states = np.concatenate([states, np.asarray(case.X0.corners())])
    if case.kind.jumps:  # where decisions are tied, exactly
        tied = states.copy()
        tied[:, 0] = case.parameters["at"]
        states = np.concatenate([states, tied])
    surface = case.X0.sample_boundary(jax.random.key(case.number), DRAWS)
    if surface is not None:
        states = np.concatenate([states, np.asarray(surface)])
    drawn = [
        None if W is None else _extremes(W, len(states), steps, case.number + k)
        for k, W in enumerate((loop.disturbance, loop.noise))
    ]
    for k, state in enumerate(states):
        found.append((state, *(None if part is None else part[k] for part in drawn)))
    for proof in proofs:
        for row in np.asarray(proof.witness_states):
            if np.isfinite(row).all():
                x, w, v = loop.split(row)
                parts = (None if part is None else _lengthened(part, steps) for part in (w, v))
                found.append((np.asarray(x), *parts))
    allowed = _allowed(case)
    return [one for one in found if all(map(_holds, allowed, one))]


def _lengthened(part: Any, steps: int) -> np.ndarray:
    """What is drawn at fewer times, and then what was drawn last: of a set that stays the same."""
    part = np.asarray(part)
    return part[np.minimum(np.arange(steps), len(part) - 1)]


def _extremes(W: Any, count: int, steps: int, seed: int) -> np.ndarray:
    """Points `(count, steps, n)`, of a box mostly corners."""
    rng, found = np.random.default_rng(seed), []
    for t in range(steps):
        here = W if W.steps is None else W.at(t)
        points = np.asarray(here.sample(jax.random.key(seed + t), count))
        if isinstance(here, rj.Box):
            corners = np.asarray(here.corners())
            ends = corners[rng.integers(len(corners), size=count)]
            points = np.where(rng.uniform(size=(count, 1)) < 0.7, ends, points)
        found.append(points)
    return np.stack(found, axis=1)


def _allowed(case: KindCase) -> list[list[Region] | None]:
    """The sets of initial states, disturbances and noises at each time, one where all are alike."""

    def regions(W: Any) -> list[Region] | None:
        if W is None:
            return None
        return [plain(W)] if W.steps is None else [plain(W.at(t)) for t in range(W.steps)]

    return [regions(W) for W in (case.X0, case.loop.disturbance, case.loop.noise)]


def _holds(regions: list[Region] | None, points: Any) -> bool:
    """Whether points surely are in sets, by fractions; those of all times if there are several."""
    if regions is None:
        return True
    points = exact(np.atleast_2d(points))
    sets = regions * len(points) if len(regions) == 1 else regions[: len(points)]
    return all(each.holds(point) for each, point in zip(sets, points, strict=True))


def _contained(
    trial: Trial,
    region: Region,
    scenarios: list[Scenario],
    states: np.ndarray,
    t: int,
    line: str,
    family: str,
) -> None:
    """No state at a time is outside of a set."""
    room, _ = region.room_wide(states, np.zeros_like(states))
    for column in range(room.shape[1]):
        for k in np.argsort(room[:, column], kind="stable")[:DOUBTFUL]:
            if room[k, column] > DOUBT * (1 + abs(states[k]).max()):
                continue
            trial.outcome.counts["states in sixty digits"] += 1
            left = trial.case.room(*scenarios[k], region, t)[column]
            if left < 0:
                said = f"at t = {t}, column {column}: the room is {float(left):.3g} for "
                trial.fails(family, said + f"{[_listed(part) for part in scenarios[k]]}", line)
                return


def _listed(part: Any) -> Any:
    return None if part is None else np.asarray(part).tolist()


PROOF = ("tube = rj.reach(...)", "proof = tube.proof({})")


def _witnessed(trial: Trial, proof: Any, t: int) -> None:
    """No witness exceeds its bound."""
    bounds, witnesses = np.asarray(proof.bounds), np.asarray(proof.witnesses)
    if np.any(witnesses > bounds + ROUNDING * np.maximum(1.0, abs(bounds))):
        said = f"at t = {t} the gaps are {(bounds - witnesses).tolist()}"
        trial.fails("a witness exceeds its bound", said, *_lines(t))


def _repeated(
    trial: Trial,
    proof: Any,
    region: Region,
    scenarios: list[Scenario],
    states: np.ndarray,
    t: int,
) -> None:
    """A recheck repeats the bounds, and slopes that nothing was optimised for hold too."""
    bounds = np.asarray(proof.bounds)
    size = np.maximum(1.0, abs(bounds))
    again = trial.attempt("recheck", "proof.recheck()", {"proof": proof}, *_lines(t))
    if again is not None and not np.all(np.asarray(again) <= bounds + ROUNDING * size):
        said = f"recheck gives {np.asarray(again).tolist()} for the bounds {bounds.tolist()}"
        trial.fails("recheck does not repeat the proof", said, *_lines(t))
    if not isinstance(proof, rj.LinearCertificate) or region.A is None:
        return
    names = {
        "proof": proof,
        "slopes": _spoilt(proof, np.random.default_rng([trial.case.number, t])),
    }
    found = trial.attempt("recheck", "proof.recheck(slopes)", names, *_lines(t))
    if found is not None:
        _of_garbage(trial, found, region, scenarios, states, t)


def _repeated_at_once(
    trial: Trial,
    names: dict[str, Any],
    sets: list[Region],
    scenarios: list[Scenario],
    runs: np.ndarray,
) -> None:
    """What `_repeated` says of the last step, of those before it, of which each is taken once."""
    tube, steps = names["tube"], trial.case.kind.horizon
    trial.attempt("recheck", "again(tube)", {"again": _again, "tube": tube}, _lines(steps)[0])
    proof = tube.proof(steps)
    if not isinstance(proof, rj.LinearCertificate):
        return
    slopes = _spoilt(proof, np.random.default_rng([trial.case.number, 0]))
    rows = np.broadcast_to(proof.directions, (steps, *proof.directions.shape))
    given = proof.loop, proof.X0, proof.X0.bounding_box(), rows, proof.start, slopes
    found = _offsets(*given)
    for t, offsets in enumerate(found[: steps - 1], start=1):
        _of_garbage(trial, offsets, sets[t], scenarios, runs[:, t], t)


def _again(tube: rj.ReachTube) -> None:
    """Prove every step anew.

    Raises:
        DisagreementError: a bound is not repeated.
    """
    recheck = Recheck(tube)
    while recheck.left:
        recheck.advance()


def _offsets(*given: Any) -> list[np.ndarray]:
    """Bounds by forms of each step, up to one in which a unit has none."""
    found = []
    try:
        for step in unrolled(*given):
            found.append(np.asarray(step.offsets))
    except UnboundedError:
        pass
    return found


def _spoilt(proof: rj.LinearCertificate, rng: np.random.Generator) -> np.ndarray:
    """Slopes that nothing was optimised for."""
    slopes = np.asarray(proof.slopes)
    return slopes + rng.choice([1e-6, 0.1, 10.0]) * rng.normal(size=slopes.shape)


def _of_garbage(
    trial: Trial,
    found: Any,
    region: Region,
    scenarios: list[Scenario],
    states: np.ndarray,
    t: int,
) -> None:
    """What such slopes prove holds."""
    if not np.isfinite(found).all():
        return
    trial.outcome.counts["rechecks of garbage"] += 1
    proved = Region(region.A, np.asarray(found)[: len(region.A)])
    _contained(trial, proved, scenarios, states, t, _lines(t)[0], "garbage proves too much")


def _lines(t: int) -> list[str]:
    return [line.format(t) for line in PROOF]


def _decided(
    trial: Trial,
    names: dict[str, Any],
    scenarios: list[Scenario],
    runs: np.ndarray,
    rng: np.random.Generator,
) -> None:
    """A half-space at the horizon, beside what is attained: no verdict is false."""
    case, t = trial.case, trial.case.kind.horizon
    row = rng.normal(size=case.kind.states)
    best = int(np.argmax(runs[:, t] @ row))
    attained = float(runs[best, t] @ row)
    limit = attained + float(rng.choice(BESIDE)) * max(abs(attained), 1e-3)
    names["goal"] = rj.Polytope(np.stack([row, 2 * row]), np.array([limit, 2 * limit]))
    half = Region(row[None], np.array([limit]))
    violated = case.room(*scenarios[best], half, t)[0] < 0
    calls = {"verify": "rj.verify(tube, goal, samples=50)"}
    if rng.random() < 0.3:
        calls["decide"] = (
            "rj.decide(case.loop, case.X0, case.kind.horizon, goal, samples=50, time_limit=0.4)"
        )
    said = set()
    for call, expression in calls.items():
        lines = f"goal = rj.Polytope({names['goal'].A.tolist()}, {names['goal'].b.tolist()})"
        verdict = trial.attempt(call, expression, names, lines)
        if verdict is None:
            continue
        status = verdict.status.name
        said.add(status)
        known = "violated" if violated else "not known"
        prefix = "" if call == "verify" else "decide: "
        trial.outcome.verdicts[f"{prefix}goal of other kinds, {known}: {status}"] += 1
        if status == "PROVED" and violated:
            trial.fails("false verdict: PROVED, but it is violated", expression, lines)
        if status == "REFUTED":
            one = verdict.counterexample
            parts = (np.asarray(one.states[0]), one.disturbances, one.noises)
            if not all(map(_holds, _allowed(case), parts)):
                trial.fails("false counterexample: not of its sets", expression, lines)
            elif case.room(*parts, half, t)[0] >= 0:
                trial.fails("false counterexample: it breaks nothing", expression, lines)
    if {"PROVED", "REFUTED"} <= said:
        trial.fails("verify and decide contradict each other", str(calls), *case.script)
