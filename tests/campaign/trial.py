"""One case under way: it evaluates its parts and notes what came, and what failed."""

import re
import time
import traceback
import warnings
from collections.abc import Callable

import numpy as np

from tests.campaign.cases import Case
from tests.campaign.errors import message_kind, place, unclear
from tests.campaign.kinds import KindCase
from tests.campaign.outcomes import Failure, Outcome

DOUBTS = re.compile(r"scale|seem|may be|perhaps|gave up|thin")
"""Words of an error that does not claim to know."""


class Trial:
    """One case under way.

    Args:
        case: to be run.
    """

    def __init__(self, case: Case | KindCase):
        self.case = case
        self.outcome = Outcome(case.number, case.tried)

    def run(self, checked: Callable) -> Outcome:
        """Check claims by `checked(trial)`; nothing is raised but what ends the process."""
        began = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with np.errstate(all="ignore"):
                try:
                    checked(self)
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
                family = f"{name}: {wrong} in {place(error)}: {kind[:60]}"
                self.fails(family, f"{name} raises {kind}", *lines, expression)
            return None

    def _untrue(self, error: Exception) -> str | None:
        """Whether an error says of a set with points in it that it has none, or is unbounded."""
        text = str(error)
        if "X0" not in text or not self.case.nonempty or "overflow" in text:
            return None
        said = [word for word in ("empty", "unbounded", "no point in common") if word in text]
        return f"untrue: X0 is said to be {said[0]}" if said and not DOUBTS.search(text) else None
