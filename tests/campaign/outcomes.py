"""What became of a case: what came, what was tried, and which claims failed."""

from collections import Counter
from dataclasses import dataclass, field

COUNTERS = ("statuses", "verdicts", "errors", "counts")


@dataclass
class Failure:
    """A claim that failed.

    Attributes:
        family: a few words that failures of one cause share.
        sentence: what failed.
        script: Python that shows it.
    """

    family: str
    sentence: str
    script: list[str]


@dataclass
class Outcome:
    """What became of one case; all counts are by name.

    Attributes:
        number: of the case.
        tried: what it was, by kind of thing.
        statuses: how solvers ended, by name.
        verdicts: what was decided, by name.
        errors: clear errors, by message with its numbers left out.
        counts: states, gradients and such.
        failures: claims that failed.
        seconds: of the processor.
    """

    number: int
    tried: dict[str, str]
    statuses: Counter = field(default_factory=Counter)
    verdicts: Counter = field(default_factory=Counter)
    errors: Counter = field(default_factory=Counter)
    counts: Counter = field(default_factory=Counter)
    failures: list[Failure] = field(default_factory=list)
    seconds: float = 0.0

    def record(self) -> dict:
        """As plain data."""
        counts = {name: dict(getattr(self, name)) for name in COUNTERS}
        return vars(self) | counts | {"failures": [vars(failure) for failure in self.failures]}

    @classmethod
    def read(cls, data: dict) -> "Outcome":
        """From plain data."""
        failures = [Failure(**each) for each in data["failures"]]
        changed = {name: Counter(data[name]) for name in COUNTERS}
        return cls(**{**data, **changed, "failures": failures})
