"""Every claim on a case: states, suprema, proofs, verdicts, derivatives."""

from collections import Counter

import numpy as np

import reachjax as rj
from tests.campaign.cases import Case
from tests.campaign.containment import Found, compared_with, searched
from tests.campaign.errors import message_kind, place
from tests.campaign.faults import OF_NUMBERS, USELESS, Faulty
from tests.campaign.gradients import compared
from tests.campaign.oracle import Region, exact
from tests.campaign.outcomes import Outcome
from tests.campaign.regions import finite, plain, same
from tests.campaign.suprema import affine_steps
from tests.campaign.trial import Trial
from tests.campaign.verdicts import judged, question

QUESTIONS = 2
DECIDED, DECIDED_ELSE = 0.5, 0.1
"""The parts of questions that are decided without a tube too: of `BranchAndCut`, of others."""

DECISIONS = (", relaxation=relaxation", ", relaxation=rj.BranchAndCut(nodes=3)", ", time_limit=0.0")
ROUNDING = 1e-9


def tried(case: Case) -> Outcome:
    """What becomes of a case."""
    return Trial(case).run(checked)


def checked(trial: Trial) -> None:
    """Every claim on a case."""
    case, names = trial.case, {"rj": rj, "np": np, "Faulty": Faulty}
    for name, expression in case.parts.items():
        names[name] = trial.attempt(name, expression, names)
        if names[name] is None:
            return
    tube = names["tube"] = trial.attempt("reach", case.reach, names)
    if tube is None:
        return
    trial.outcome.counts["tubes"] += 1
    proofs = [tube.proof(t) for t in range(1, case.shapes.horizon + 1)]
    for t, proof in enumerate(proofs, start=1):
        lines = [f"tube = {case.reach}", f"proof = tube.proof({t})"]
        statuses = trial.attempt("statuses", "proof.statuses", {"proof": proof}, *lines)
        ends = Counter(status.name for status in statuses or ())
        trial.outcome.statuses += ends
        if isinstance(proof, rj.BranchCertificate):
            trial.outcome.counts.update(f"rung: {way.name}" for way in proof.ways)
        useless = case.fault in USELESS and case.every == 1 and type(proof) is rj.Certificate
        spoilt = case.fault not in OF_NUMBERS or np.size(_multipliers(proof)) > 0
        if useless and spoilt and set(ends) - {"FAILED"}:
            said = f"useless answers ({case.fault}) are reported as {dict(ends)}"
            trial.fails("a useless answer does not count as failed", said, *lines)
    sets = [case.initial.region, *map(plain, tube.sets[1:])]
    if not all(map(finite, sets)):
        trial.fails("a set that is no number", f"{tube.sets[1:]}", f"tube = {case.reach}")
        return
    if not same(plain(tube.sets[0]), case.initial.region):
        trial.fails("the initial set is another one", f"{tube.sets[0]}", f"tube = {case.reach}")
    rng = case.rng
    found = searched(case.loop, case.initial, sets, rng)
    trial.outcome.counts["states"] += found.checked
    trial.outcome.counts["states in fractions"] += found.exactly
    for sentence in found.outside[:1]:
        trial.fails("a state outside", sentence, f"tube = {case.reach}")
    steps = affine_steps(case.loop, case.initial, case.shapes.horizon)
    if steps is not None:
        _suprema(trial, sets, steps)
    _certificates(trial, proofs, sets, found, rng)
    if case.initial.inner is not None:
        for _ in range(QUESTIONS):
            _verdict(trial, names, found, steps, rng)
    if case.shapes.gradients and "LocalBounds" in case.parts["relaxation"]:
        _gradient(trial, names, rng)


def _suprema(trial: Trial, sets: list[Region], steps: list) -> None:
    """Every facet is beyond the exact supremum of a loop that is affine on its set."""
    trial.outcome.counts["affine loops"] += 1
    for t, region in enumerate(sets[1:], start=1):
        facets = [] if region.A is None else zip(region.A, region.b, strict=True)
        for row, b in facets:
            found = steps[t].supremum(trial.case.initial, exact(row))
            if found is not None:
                trial.outcome.counts["exact suprema"] += 1
            if found is not None and found[0] > exact(b)[()]:
                said = f"the bound {b!r} at t = {t} is below the exact supremum {found[0]}"
                trial.fails("a state outside", said, f"tube = {trial.case.reach}")
                return


def _certificates(trial: Trial, proofs, sets, found: Found, rng) -> None:
    """Proofs repeat; witnesses do not exceed bounds; garbage proves nothing false."""
    for t, (proof, region) in enumerate(zip(proofs, sets[1:], strict=True), start=1):
        lines = [f"tube = {trial.case.reach}", f"proof = tube.proof({t})"]
        names = {"proof": proof, "np": np}
        bounds, witnesses = np.asarray(proof.bounds), np.asarray(proof.witnesses)
        size = np.ones(len(bounds))
        facets = 0 if region.A is None else len(region.A)
        if found.states:
            states = abs(found.states[t][0]).max(axis=0).astype(float)
            size[:facets] = abs(region.A) @ states if facets else 0
        size[:facets] = np.maximum(size[:facets], abs(bounds[:facets]))
        again = trial.attempt("recheck", "proof.recheck()", names, *lines)
        if again is not None and not np.all(again <= bounds + ROUNDING * size):
            part = "ellipsoids" if not facets else "facets or ellipsoids"
            said = f"recheck gives {again.tolist()} for the bounds {bounds.tolist()}"
            trial.fails(f"recheck does not repeat the proof of {part}", said, *lines)
        beyond = witnesses > bounds + ROUNDING * size
        if np.any(beyond) and found.states:
            start = exact(np.asarray(proof.witness_states)[np.argmax(beyond)])
            where = "in" if trial.case.initial.region.holds(start) else "outside of"
            said = f"at t = {t} the gaps are {(bounds - witnesses).tolist()}"
            trial.fails(f"a witness {where} X0 exceeds its bound", said, *lines)
        if facets and found.states and rng.random() < 0.3:
            _garbage(trial, proof, region, found, rng, t)


def _multipliers(proof) -> np.ndarray:
    """What `recheck` takes others of."""
    if isinstance(proof, rj.BranchCertificate):
        return np.asarray(proof.branches.multipliers)
    linear = isinstance(proof, rj.LinearCertificate)
    return np.asarray(proof.slopes if linear else proof.multipliers)


def _spoilt(held: np.ndarray, rng) -> np.ndarray:
    """Multipliers that nothing was optimised for, or that were for something else."""
    kind = rng.choice(
        ["random", "huge", "flipped", "scaled", "shuffled"], p=[0.5, 0.1, 0.15, 0.15, 0.1]
    )
    if kind == "random":
        return rng.normal(size=held.shape) * 10 ** rng.uniform(-6, 6)
    if kind == "huge":
        return rng.choice([-1.0, 1.0], held.shape) * 10 ** rng.uniform(100, 305)
    if kind == "flipped":
        return -held
    if kind == "scaled":
        return held * (1 + 10 ** rng.uniform(-9, 1) * rng.normal(size=held.shape))
    return held.ravel()[rng.permutation(held.size)].reshape(held.shape)


def _garbage(trial: Trial, proof, region: Region, found: Found, rng, t: int) -> None:
    """What random multipliers prove holds too."""
    held = np.asarray(_multipliers(proof))
    multipliers = _spoilt(held, rng)
    names = {"proof": proof, "multipliers": multipliers}
    lines = [f"tube = {trial.case.reach}", f"proof = tube.proof({t})"]
    lines.append(f"multipliers = np.array({multipliers.tolist()})")
    bounds = trial.attempt("recheck", "proof.recheck(multipliers)", names, *lines)
    if bounds is None:
        return
    proved = Region(region.A, np.asarray(bounds)[: len(region.A)])
    if not finite(proved):
        return
    trial.outcome.counts["rechecks of garbage"] += 1
    count = len(found.outside)
    compared_with(trial.case.loop, trial.case.initial, proved, found, t)
    for sentence in found.outside[count:][:1]:
        trial.fails("garbage proves too much", sentence, *lines)


def _verdict(trial: Trial, names: dict, found: Found, steps, rng) -> None:
    asked = question(trial.case, found, steps, rng)
    if asked is None:
        return
    sizes = abs(asked.rows).max(axis=1)
    extreme = " (rows of extreme length)" if abs(np.log10(sizes)).max() > 150 else ""
    chance = DECIDED if trial.case.branched else DECIDED_ELSE
    own = np.random.default_rng(
        [trial.case.seed, trial.case.number, len(trial.outcome.verdicts), 3]
    )
    calls = {"verify": asked.expression}
    if own.random() < chance:
        first = 0 if trial.case.branched else 1
        calls["decide"] = asked.decided(trial.case, DECISIONS[own.integers(first, len(DECISIONS))])
    said = {}
    for call, expression in calls.items():
        lines = [f"tube = {trial.case.reach}"] if call == "verify" else []
        verdict = trial.attempt(f"{call}{extreme}", expression, names, *lines)
        if verdict is not None:
            said[call] = verdict.status.name
            _judged(trial, asked, call, verdict, extreme, *lines, f"print({expression})")
    if {*said.values()} >= {"PROVED", "REFUTED"}:
        sentence = f"verify and decide contradict each other: {said}"
        lines = [f"tube = {trial.case.reach}", *(f"print({each})" for each in calls.values())]
        trial.fails("verify and decide contradict each other", sentence, *lines)


def _judged(trial: Trial, asked, call: str, verdict, extreme: str, *lines: str) -> None:
    """Count a verdict, and compare it with what is known."""
    status = verdict.status.name
    known = "violated" if asked.violated else "satisfied" if asked.satisfied else "not known"
    prefix = "" if call == "verify" else f"{call}: "
    trial.outcome.verdicts[f"{prefix}{asked.kind}, {known}: {status}"] += 1
    wrong = judged(trial.case, asked, status, verdict.counterexample)
    if wrong is not None:
        trial.fails(prefix + wrong.split(",")[0][:60] + extreme, wrong, *lines)
    for (name, t), proof in verdict.certificates.items():
        trial.outcome.counts["rechecks of decisions"] += 1
        names = {"proof": proof, "np": np}
        held = trial.attempt("recheck", "proof.recheck()", names, *lines)
        if held is not None and np.any(held > 0):
            said = f"recheck gives {held.tolist()} for {name} at t = {t}, which is proved"
            trial.fails("recheck does not repeat a decision", said, *lines)


def _gradient(trial: Trial, names: dict, rng) -> None:
    try:
        word, wrong = compared(trial.case, names["loop"], names["X0"], rng)
    except Exception as error:
        word, wrong = "error", f"{message_kind(error)} at {place(error)}"
    trial.outcome.counts[f"gradients: {word}"] += 1
    if wrong is not None:
        trial.fails(f"gradient: {word}", wrong, "# jax.value_and_grad of weighted bounds")
