"""Runs a case and checks every claim on it."""

import re
import time
import traceback
import warnings
from collections import Counter

import numpy as np

import reachjax as rj
from tests.campaign.cases import Case
from tests.campaign.containment import Found, searched
from tests.campaign.errors import message_kind, place, unclear
from tests.campaign.faults import USELESS, Faulty
from tests.campaign.gradients import compared
from tests.campaign.oracle import Region, exact
from tests.campaign.outcomes import Failure, Outcome
from tests.campaign.suprema import affine_steps
from tests.campaign.verdicts import judged, question

QUESTIONS = 2
ROUNDING = 1e-9
DOUBTS = re.compile(r"scale|seem|may be|perhaps|gave up|thin")
"""Words of an error that does not claim to know."""


def plain(region: rj.AbstractSet) -> Region:
    """A set of the library as arrays."""
    if isinstance(region, rj.Intersection):
        facets, ball = plain(region.polytope), plain(region.ellipsoid)
        return Region(facets.A, facets.b, ball.center, ball.shape)
    if isinstance(region, rj.Ellipsoid):
        return Region(None, None, np.asarray(region.center), np.asarray(region.shape))
    A, b = region.facets
    return Region(np.asarray(A), np.asarray(b))


def finite(region: Region) -> bool:
    """Whether all its numbers are."""
    return all(v is None or np.isfinite(v).all() for v in vars(region).values())


def same(one: Region, other: Region) -> bool:
    """Whether two sets have the same numbers."""
    return all(np.array_equal(value, getattr(other, name)) for name, value in vars(one).items())


class Trial:
    """One case under way.

    Args:
        case: to be run.
    """

    def __init__(self, case: Case):
        self.case = case
        self.outcome = Outcome(
            case.number,
            {
                "architecture": case.shapes.name,
                "set": case.initial.kind,
                "template": case.parts["template"].split("([[")[0].split("(loop")[0],
                "relaxation": case.parts["relaxation"],
                "window": str(case.window),
                "solver": case.parts["solver"] if case.fault is None else "faulty",
                "fault": str(case.fault),
                "scales": case.scales.kind,
                "time": "varying" if case.shapes.varying else "constant",
            },
        )

    def run(self) -> Outcome:
        """Check every claim; nothing is raised but what ends the process."""
        began = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with np.errstate(all="ignore"):
                try:
                    self._checked()
                except Exception:  # the campaign's own: the others of the block go on
                    said = traceback.format_exc().strip().splitlines()
                    self.fails(f"the campaign broke: {said[-1][:60]}", " / ".join(said[-4:]))
        self.outcome.seconds = time.process_time() - began
        return self.outcome

    def fails(self, family: str, sentence: str, *more: str) -> None:
        """Note a claim that failed, with the lines that show it."""
        comment = f"# case {self.case.number}: {sentence}"
        script = [*self.case.script, *more, comment]
        self.outcome.failures.append(Failure(family, sentence, script))

    def attempt(self, name: str, expression: str, names: dict, *lines: str):
        """The value of an expression, or None where it raises; unclear errors are failures."""
        try:
            return eval(expression, names)
        except Exception as error:
            kind, wrong = message_kind(error), unclear(error) or self._untrue(error)
            if wrong is None:
                self.outcome.errors[f"{name}: {kind}"] += 1
            else:
                family = f"{wrong} in {place(error)}: {kind[:60]}"
                self.fails(family, f"{name} raises {kind}", *lines, expression)
            return None

    def _untrue(self, error: Exception) -> str | None:
        """Whether an error says of a set with points in it that it has none, or is unbounded."""
        text = str(error)
        if "X0" not in text or self.case.initial.inner is None or "overflow" in text:
            return None
        said = [word for word in ("empty", "unbounded", "no point in common") if word in text]
        return f"untrue: X0 is said to be {said[0]}" if said and not DOUBTS.search(text) else None

    def _checked(self) -> None:
        case, names = self.case, {"rj": rj, "np": np, "Faulty": Faulty}
        for name, expression in case.parts.items():
            names[name] = self.attempt(name, expression, names)
            if names[name] is None:
                return
        tube = names["tube"] = self.attempt("reach", case.reach, names)
        if tube is None:
            return
        self.outcome.counts["tubes"] += 1
        proofs = [tube.proof(t) for t in range(1, case.shapes.horizon + 1)]
        for t, proof in enumerate(proofs, start=1):
            lines = [f"tube = {case.reach}", f"proof = tube.proof({t})"]
            statuses = self.attempt("statuses", "proof.statuses", {"proof": proof}, *lines)
            ends = Counter(status.name for status in statuses or ())
            self.outcome.statuses += ends
            useless = case.fault in USELESS and case.every == 1 and type(proof) is rj.Certificate
            if useless and set(ends) - {"FAILED"}:
                said = f"useless answers ({case.fault}) are reported as {dict(ends)}"
                self.fails("a useless answer does not count as failed", said, *lines)
        sets = [case.initial.region, *map(plain, tube.sets[1:])]
        if not all(map(finite, sets)):
            self.fails("a set that is no number", f"{tube.sets[1:]}", f"tube = {case.reach}")
            return
        if not same(plain(tube.sets[0]), case.initial.region):
            self.fails("the initial set is another one", f"{tube.sets[0]}", f"tube = {case.reach}")
        rng = case.rng
        found = searched(case.loop, case.initial, sets, rng)
        self.outcome.counts["states"] += found.checked
        self.outcome.counts["states in fractions"] += found.exactly
        for sentence in found.outside[:1]:
            self.fails("a state outside", sentence, f"tube = {case.reach}")
        steps = affine_steps(case.loop, case.initial, case.shapes.horizon)
        if steps is not None:
            self._suprema(sets, steps)
        self._certificates(proofs, sets, found, rng)
        if case.initial.inner is not None:
            for _ in range(QUESTIONS):
                self._verdict(names, found, steps, rng)
        if case.shapes.gradients and rng.random() < 0.5:
            self._gradient(names, rng)

    def _suprema(self, sets: list[Region], steps: list) -> None:
        """Every facet is beyond the exact supremum of a loop that is affine on its set."""
        self.outcome.counts["affine loops"] += 1
        for t, region in enumerate(sets[1:], start=1):
            facets = [] if region.A is None else zip(region.A, region.b, strict=True)
            for row, b in facets:
                found = steps[t].supremum(self.case.initial, exact(row))
                if found is not None:
                    self.outcome.counts["exact suprema"] += 1
                if found is not None and found[0] > exact(b)[()]:
                    said = f"the bound {b!r} at t = {t} is below the exact supremum {found[0]}"
                    self.fails("a state outside", said, f"tube = {self.case.reach}")
                    return

    def _certificates(self, proofs, sets, found: Found, rng) -> None:
        """Proofs repeat; witnesses do not exceed bounds; garbage proves nothing false."""
        for t, (proof, region) in enumerate(zip(proofs, sets[1:], strict=True), start=1):
            lines = [f"tube = {self.case.reach}", f"proof = tube.proof({t})"]
            names = {"proof": proof, "np": np}
            bounds, witnesses = np.asarray(proof.bounds), np.asarray(proof.witnesses)
            size = np.ones(len(bounds))
            facets = 0 if region.A is None else len(region.A)
            if found.states:
                states = abs(found.states[t][0]).max(axis=0).astype(float)
                size[:facets] = abs(region.A) @ states if facets else 0
            size[:facets] = np.maximum(size[:facets], abs(bounds[:facets]))
            again = self.attempt("recheck", "proof.recheck()", names, *lines)
            if again is not None and not np.all(again <= bounds + ROUNDING * size):
                part = "ellipsoids" if not facets else "facets or ellipsoids"
                said = f"recheck gives {again.tolist()} for the bounds {bounds.tolist()}"
                self.fails(f"recheck does not repeat the proof of {part}", said, *lines)
            beyond = witnesses > bounds + ROUNDING * size
            if np.any(beyond):
                start = exact(np.asarray(proof.witness_states)[np.argmax(beyond)])
                where = "in" if self.case.initial.region.holds(start) else "outside of"
                said = f"at t = {t} the gaps are {(bounds - witnesses).tolist()}"
                self.fails(f"a witness {where} X0 exceeds its bound", said, *lines)
            if facets and found.states and rng.random() < 0.3:
                self._garbage(proof, region, found.states[t], rng, t)

    def _garbage(self, proof, region: Region, states, rng, t: int) -> None:
        """What random multipliers prove holds too."""
        shape = proof.multipliers.shape
        multipliers = rng.normal(size=shape) * 10 ** rng.uniform(-6, 6)
        names = {"proof": proof, "multipliers": multipliers}
        bounds = self.attempt("recheck", "proof.recheck(multipliers)", names)
        if bounds is None:
            return
        proved = Region(region.A, np.asarray(bounds)[: len(region.A)])
        if not finite(proved):
            return
        room, off = proved.room_wide(*states)
        self.outcome.counts["rechecks of garbage"] += 1
        if np.any(room < -off):
            self.fails("garbage proves too much", f"at t = {t}: {bounds}")

    def _verdict(self, names: dict, found: Found, steps, rng) -> None:
        asked = question(self.case, found, steps, rng)
        if asked is None:
            return
        lines = [f"tube = {self.case.reach}"]
        verdict = self.attempt("verify", asked.expression, names, *lines)
        if verdict is None:
            return
        status = verdict.status.name
        known = "violated" if asked.violated else "satisfied" if asked.satisfied else "not known"
        self.outcome.verdicts[f"{asked.kind}, {known}: {status}"] += 1
        wrong = judged(self.case, asked, status, verdict.counterexample)
        if wrong is not None:
            self.fails(wrong.split(",")[0][:60], wrong, *lines, f"print({asked.expression})")

    def _gradient(self, names: dict, rng) -> None:
        try:
            word, wrong = compared(self.case, names["loop"], names["X0"], rng)
        except Exception as error:
            word, wrong = "error", f"{message_kind(error)} at {place(error)}"
        self.outcome.counts[f"gradients: {word}"] += 1
        if wrong is not None:
            self.fails(f"gradient: {word}", wrong, "# jax.value_and_grad of weighted bounds")
