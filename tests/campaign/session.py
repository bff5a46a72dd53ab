"""The campaign as a plugin of pytest: its options, its progress and the tables at its end.

Every finished case is a line of `results/campaign-<seed>.jsonl`, with which `--resume` goes on.
"""

import json
import os

import pytest

from tests.campaign.outcomes import Outcome
from tests.campaign.tables import report, summary

DEFAULT = range(0, 300, 2)
"""Half of one block of each of the first twelve architectures."""

PROPERTY = "campaign"


def pytest_addoption(parser: pytest.Parser) -> None:
    """How many cases, and which."""
    group = parser.getgroup("campaign", "the campaign of random loops")
    number = {"type": int, "metavar": "N"}
    group.addoption(
        "--cases", default=None, help=f"how many cases ({len(DEFAULT)} of them)", **number
    )
    group.addoption("--case", default=None, help="one case alone", **number)
    group.addoption("--seed", default=0, help="of all that is drawn (0)", **number)
    group.addoption("--resume", action="store_true", help="keep the cases that are finished")


def numbers(config: pytest.Config) -> list[int]:
    """The cases that were asked for."""
    if (case := config.getoption("case")) is not None:
        return [case]
    asked = config.getoption("cases")
    return [*(DEFAULT if asked is None else range(asked))]


class Journal:
    """The file of finished cases; none is kept of a case that is run alone.

    Args:
        config: of the session.
    """

    def __init__(self, config: pytest.Config):
        self.seed = config.getoption("seed")
        self.path = config.rootpath / "results" / f"campaign-{self.seed}.jsonl"
        self._alone = config.getoption("case") is not None
        self._resumed = config.getoption("resume") and not self._alone

    def begin(self) -> None:
        """An empty file, unless it is to be resumed."""
        self.path.parent.mkdir(exist_ok=True)
        if not (self._resumed or self._alone):
            self.path.write_text("")

    def finished(self) -> dict[int, Outcome]:
        """The cases that need not be run again."""
        if not (self._resumed and self.path.exists()):
            return {}
        found = {}
        for line in self.path.read_text().splitlines():
            try:
                outcome = Outcome.read(json.loads(line))
            except ValueError:  # the process ended while it wrote
                continue
            found[outcome.number] = outcome
        return found

    def add(self, outcome: Outcome) -> None:
        """One more finished case: a line, written at once, since other processes write too."""
        if not self._alone:
            line = json.dumps(outcome.record()) + "\n"
            with self.path.open("ab", buffering=0) as file:
                file.write(line.encode())


@pytest.hookimpl(tryfirst=True)
def pytest_collection_finish(session: pytest.Session) -> None:
    """Begin the file, before any process runs a case."""
    chosen = any("block" in getattr(item, "fixturenames", ()) for item in session.items)
    runs = not session.config.getoption("collectonly")
    if chosen and runs and os.environ.get("PYTEST_XDIST_WORKER", "gw0") == "gw0":
        Journal(session.config).begin()


@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    """The process that prints collects what all processes found."""
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(Gathered(config), "gathered-campaign")


class Gathered:
    """What has come of the cases so far.

    Args:
        config: of the session.
    """

    def __init__(self, config: pytest.Config):
        self._config, self._outcomes, self._bar = config, [], None

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Take a block's outcomes from its report, which may come from another process."""
        found = [json.loads(v) for k, v in report.user_properties if k == PROPERTY]
        if report.when != "call" or not found:
            return
        self._outcomes += [Outcome.read(data) for data in found]
        if self._config.getoption("cases") is not None:
            if self._bar is None:
                from tqdm import tqdm

                file, total = self._config.get_terminal_writer()._file, len(numbers(self._config))
                self._bar = tqdm(total=total, unit="case", file=file, mininterval=2.0)
            self._bar.update(len(found))
            self._bar.set_postfix(failing=sum(bool(one.failures) for one in self._outcomes))

    def pytest_terminal_summary(self, terminalreporter) -> None:
        """Print the tables, and write them with reproductions of what failed."""
        if self._bar is not None:
            self._bar.close()
        if not self._outcomes:
            return
        outcomes = sorted(self._outcomes, key=lambda one: one.number)
        journal = Journal(self._config)
        terminalreporter.section("campaign")
        terminalreporter.write_line(summary(outcomes, journal.seed))
        if self._config.getoption("case") is None:
            path = journal.path.with_suffix(".md")
            path.write_text(report(outcomes, journal.seed))
            terminalreporter.write_line(f"\nwritten to {path.relative_to(self._config.rootpath)}")
