"""Solvers that fail: a real one, whose answers are spoilt on the way back."""

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

import reachjax as rj


class LicenceError(RuntimeError):
    """What a solver of someone else's may raise."""


def _spoilt_part(name: str, change: Callable) -> Callable:
    """An answer, one of whose fields is changed: `change(value, rng)`."""
    return lambda answer, rng: answer._replace(**{name: change(getattr(answer, name), rng)})


def _filled(value: float) -> Callable:
    return lambda array, rng: np.full(np.shape(array), value)


def _some(value: float) -> Callable:
    return lambda array, rng: np.where(rng.random(np.shape(array)) < 0.3, value, array)


def _garbage(array, rng):
    return rng.normal(size=np.shape(array)) * 10 ** rng.uniform(-12, 12)


def _huge(array, rng):
    return rng.choice([-1.0, 1.0], np.shape(array)) * 1e300


def _noisy(array, rng):
    return array * (1 + 10 ** rng.uniform(-9, 0) * rng.normal(size=np.shape(array)))


def _status(code: Any) -> Callable:
    """Every status replaced."""
    return _spoilt_part("statuses", lambda statuses, rng: np.full(np.shape(statuses), code))


def _claim(change: Callable) -> Callable:
    """What is sought as the solver has it, moved; the rest as it was."""
    return _spoilt_part("unknowns", change)


def _raises(answer, rng):
    raise LicenceError("the licence of this solver has expired")


FAULTS: dict[str, Callable] = {
    "garbage multipliers": _spoilt_part("multipliers", _garbage),
    "noisy multipliers": _spoilt_part("multipliers", _noisy),
    "negated multipliers": _spoilt_part("multipliers", lambda y, rng: -np.asarray(y)),
    "huge multipliers": _spoilt_part("multipliers", _huge),
    "NaN multipliers": _spoilt_part("multipliers", _filled(np.nan)),
    "some NaN multipliers": _spoilt_part("multipliers", _some(np.nan)),
    "infinite multipliers": _spoilt_part("multipliers", _some(np.inf)),
    "no multipliers": _spoilt_part("multipliers", lambda y, rng: None),
    "a list of multipliers": _spoilt_part("multipliers", lambda y, rng: np.asarray(y).tolist()),
    "too few multipliers": _spoilt_part("multipliers", lambda y, rng: np.asarray(y)[..., :-1]),
    "too many multipliers": _spoilt_part(
        "multipliers", lambda y, rng: np.concatenate([y, y], axis=-1)
    ),
    "flat multipliers": _spoilt_part("multipliers", lambda y, rng: np.ravel(y)[:1]),
    "complex multipliers": _spoilt_part("multipliers", lambda y, rng: np.asarray(y) * 1j),
    "text": _spoilt_part("multipliers", lambda y, rng: np.full(np.shape(y), "many")),
    "garbage moments": _spoilt_part("moments", _garbage),
    "NaN moments": _spoilt_part("moments", _filled(np.nan)),
    "no moments": _spoilt_part("moments", lambda X, rng: None),
    "small moments": _spoilt_part("moments", lambda X, rng: np.asarray(X)[..., :1, :1]),
    "a claim too low": _claim(lambda v, rng: np.asarray(v) - 1 - abs(np.asarray(v))),
    "a claim too good": _claim(lambda v, rng: np.asarray(v) * 1.01),
    "a NaN claim": _claim(_filled(np.nan)),
    "no claim": _claim(lambda v, rng: None),
    "unknown status": _status(99),
    "negative status": _status(-7),
    "status NaN": _status(np.nan),
    "inaccurate": _status(int(rj.SolverStatus.INACCURATE)),
    "infeasible": _status(int(rj.SolverStatus.INFEASIBLE)),
    "failed": _status(int(rj.SolverStatus.FAILED)),
    "None": lambda answer, rng: None,
    "a tuple": lambda answer, rng: tuple(answer),
    "a list": lambda answer, rng: list(answer),
    "an array": lambda answer, rng: np.asarray(getattr(answer, "multipliers", 0.0)),
    "raises": _raises,
}

USELESS = (
    "NaN multipliers",
    "no multipliers",
    "too few multipliers",
    "too many multipliers",
    "flat multipliers",
    "text",
    "unknown status",
    "negative status",
    "status NaN",
    "None",
    "an array",
    "a tuple",
    "a list",
    "complex multipliers",
    "raises",
)
"""Faults after which a facet's program counts as failed."""

OF_NUMBERS = ("NaN multipliers", "too few multipliers", "too many multipliers")
"""Of these, the faults that spoil nothing where a program has no multipliers."""


@dataclasses.dataclass(frozen=True)
class Faulty(rj.AbstractSolver):
    """A solver whose every so many-th answer is spoilt.

    Args:
        inner: the real one.
        fault: one of `FAULTS`.
        seed: of garbage.
        every: 1 if each answer is, 3 if each third one is.
    """

    inner: rj.AbstractSolver
    fault: str
    seed: int = 0
    every: int = 1
    calls: Any = dataclasses.field(default_factory=itertools.count, compare=False, repr=False)

    def _spoilt(self, answer: Any) -> Any:
        call = next(self.calls)
        if call % self.every != self.every - 1:
            return answer
        return FAULTS[self.fault](answer, np.random.default_rng([self.seed, call]))

    def solve(self, program: Any, goal: Any) -> Any:
        """The answer, spoilt."""
        return self._spoilt(self.inner.solve(program, goal))
